"""CarlaVision-v0 on the fake server: the contract, what is seen, and who is where."""

import math
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as check_sb3_env

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla_fixtures  # noqa: E402
from fake_carla import Server  # noqa: E402
from fake_carla_fixtures import ALONE, SMALL, Start  # noqa: E402

from sb3_have.envs import HighwayVisionEnv, vision  # noqa: E402
from sb3_have.envs.carla_vision import PAPER, CarlaVisionEnv, sensors  # noqa: E402
from sb3_have.envs.vision import compose  # noqa: E402
from sb3_have.envs.weather import WEATHERS  # noqa: E402
from sb3_have.sensors import encode_depth  # noqa: E402
from sb3_have.sensors.representations import Representation  # noqa: E402

server, start = fake_carla_fixtures.server, fake_carla_fixtures.start

STRAIGHT = np.zeros(2, dtype=np.float32)
FULL = np.array([1.0, 0.0], dtype=np.float32)
DT = 0.05


def waypoint(server: Server, vehicle: Any) -> Any:
    return server.map.get_waypoint(vehicle.get_location())


# ---- the gymnasium contract ----


def test_checkers(server: Server) -> None:
    env = CarlaVisionEnv(**{**SMALL, "image_size": 36}, render_mode="rgb_array")
    check_gymnasium_env(env, skip_render_check=True)
    check_sb3_env(env)
    env.close()
    assert server.left_behind() == []


def test_one_set_of_options_runs_both_environments(server: Server) -> None:
    options = yaml.safe_load(
        """
        weather: [WetNoon, ClearNight]
        modalities: [rgb, event, depth]
        image_size: 20
        vehicles_count: 2
        traffic_speed: [20.0, 22.0]
        lanes_count: 3
        max_episode_steps: 4
        initial_speed: 12.0
        simulation_frequency: 20
        policy_frequency: 10
        steering_range: 0.05
        max_speed: 25.0
        steer_cost: 0.2
        brake_cost: 0.3
        crash_penalty: 5.0
        event: {bins: 3, representation: sbt, threshold: 0.25, threshold_sigma: 0.02, refractory: 0.001, log_eps: 0.002}
        depth: {encoding: clipped, max: 80.0}
        scenario: highway
        """
    )
    seen = []
    for name in ("HighwayVision-v0", "CarlaVision-v0"):
        env = gym.make(name, **options)
        _, info = env.reset(seed=0)
        infos = [info]
        done = False
        while not done:
            observation, _, terminated, truncated, info = env.step(STRAIGHT)
            infos.append(info)
            done = terminated or truncated
        assert env.observation_space.contains(observation) and list(observation) == ["rgb", "event", "depth"]
        assert truncated and info["end_reason"] == "timeout" and len(infos) == 5
        seen.append((env.observation_space, env.action_space, {frozenset(info) for info in infos}))
        env.close()
    assert seen[0] == seen[1]


def test_defaults_are_those_of_highway_vision(server: Server) -> None:
    ours, theirs = CarlaVisionEnv(), HighwayVisionEnv()
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    assert server.calls == []  # nothing connects before the first reset
    paper = CarlaVisionEnv(**PAPER)
    assert isinstance(paper.observation_space, spaces.Dict)
    assert {name: space.shape for name, space in paper.observation_space.items()} == {
        "rgb": (128, 128, 3),
        "event": (128, 128, 5),
    }


@pytest.mark.parametrize("representation", get_args(Representation))
def test_representations_have_the_same_space_in_both(server: Server, start: Start, representation: str) -> None:
    options: dict[str, Any] = {
        "image_size": 16,
        "modalities": ("event",),
        "event": {"representation": representation, "bins": 3},
    }
    env = start(**options, initial_speed=20.0)
    assert env.observation_space == HighwayVisionEnv(**options).observation_space
    observation, *_ = env.step(FULL)
    assert env.observation_space.contains(observation) and len(np.unique(observation["event"])) > 2
    env.render_mode = "rgb_array"
    np.testing.assert_array_equal(env.render(), compose(observation, representation=env._event["representation"]))


def test_options_of_the_event_camera_that_either_spells_out(server: Server, start: Start) -> None:
    for options in (vision.EVENT_DEFAULTS, sensors.EVENT_DEFAULTS):
        assert HighwayVisionEnv(event=options).observation_space == CarlaVisionEnv(event=options).observation_space
    seen = []
    for tau in (None, 0.2, 0.01):
        env = start(event={"representation": "time_surface", "tau": tau}, initial_speed=20.0)
        seen.append(env.step(FULL)[0]["event"])
    np.testing.assert_array_equal(seen[0], seen[1])
    assert (seen[2] <= seen[1]).all() and (seen[2] < seen[1]).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weather": "Fog"}, "Fog"),
        ({"modalities": ("rgb", "lidar")}, "lidar"),
        ({"image_size": 8}, "image_size"),
        ({"policy_frequency": 3}, "multiple"),
        ({"simulation_frequency": 5, "policy_frequency": 5}, "simulation_frequency"),
        ({"scenario": "merge"}, "merge"),
        ({"reward": "distance"}, "distance"),
        ({"collision_ticks": 0}, "collision_ticks"),
        ({"standstill_time": 0.0}, "standstill_time"),
        ({"initial_speed": 31.0}, "initial_speed"),
        ({"timeout": -1.0}, "timeout"),
        ({"event_grace": -1.0}, "event_grace"),
        ({"standstill_time": math.nan}, "standstill_time"),
        ({"event": {"representation": "time_surface", "tau": 0.0}}, "tau"),
        ({"event": {"shot_rate": 1.0}}, "shot_rate"),
        ({"event": {"treshold": 1.0}}, "treshold"),
        ({"event": {"mapping": "lin_log"}}, "lin_log"),
        ({"depth": {"maximum": 1.0}}, "maximum"),
        ({"depth": {"encoding": "linear"}}, "linear"),
        ({"render_mode": "human"}, "human"),
    ],
)
def test_bad_options_are_refused(server: Server, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CarlaVisionEnv(**options)
    assert server.calls == []


def test_bad_calls_are_refused_and_harmless(server: Server) -> None:
    env = CarlaVisionEnv(**ALONE)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(STRAIGHT)
    with pytest.raises(ValueError, match="Fog"):
        env.reset(options={"weather": "Fog"})
    with pytest.raises(ValueError, match="config"):
        env.reset(options={"config": 1})
    assert server.calls == []
    env.reset()
    for action in ([0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match="action"):
            env.step(np.array(action))
    assert env.step(FULL)[4]["distance"] > 0


def test_render(server: Server, start: Start) -> None:
    env = start(render_mode="rgb_array")
    picture = env.render()
    assert picture is not None and picture.shape == (64, 192, 3) and picture.dtype == np.uint8
    assert env.metadata["render_fps"] == 5


# ---- what is seen ----


def events_by_hand(server: Server, frames: range, size: int, bins: int, now: int) -> NDArray[np.uint8]:
    """Literal loop over the events of the ticks of one control step, which ends at ``now`` [ns]."""
    counts = np.zeros((size, size, bins), dtype=int)
    length = len(frames) * 50_000_000
    for frame in frames:
        for x, y, t, positive in server.sent["sensor.camera.dvs"][frame]:
            since = int(t) - (now - length)
            assert -1 <= since <= length + 1
            counts[y, x, min(max(0, since) * bins // length, bins - 1)] += 1 if positive else -1
    return (128 + np.clip(counts, -127, 127)).astype(np.uint8)


@pytest.mark.parametrize("threaded", [False, True])
@pytest.mark.parametrize(("frequency", "bins"), [(5, 5), (5, 3), (20, 5)])
def test_images_are_those_that_the_server_sent(server: Server, frequency: int, bins: int, threaded: bool) -> None:
    server.threaded = threaded
    options = {**SMALL, "policy_frequency": frequency, "event": {"bins": bins}, "initial_speed": 20.0}
    options.update(timeout=5.0, event_grace=5.0)  # a busy machine starts threads late
    env = CarlaVisionEnv(**options)
    observation, _ = env.reset(seed=0)
    assert (observation["event"] == 128).all() and observation["event"].shape == (16, 16, bins)
    for _ in range(4):
        first = server.frame + 1
        observation, *_ = env.step(FULL)
        pixels = {name: server.sent[f"sensor.camera.{name}"][server.frame] for name in ("rgb", "depth")}
        np.testing.assert_array_equal(observation["rgb"], pixels["rgb"][..., [2, 1, 0]])
        blue, green, red = (pixels["depth"][..., channel].astype(float) for channel in range(3))
        metres = 1000 * (red + 256 * green + 65536 * blue) / (256**3 - 1)
        metres[metres == 1000] = np.inf
        assert (observation["depth"][:5] == 0).all() and (observation["depth"][5:] > 0).all()
        np.testing.assert_array_equal(observation["depth"][..., 0], encode_depth(metres, "log"))
        now = round(server.elapsed * 1e9)
        by_hand = events_by_hand(server, range(first, server.frame + 1), 16, bins, now)
        np.testing.assert_array_equal(observation["event"], by_hand)
        assert (by_hand != 128).mean() > 0.1


@pytest.mark.parametrize("modalities", [("rgb",), ("event",), ("depth",), ("event", "rgb")])
def test_only_the_sensors_asked_for_are_there(server: Server, start: Start, modalities: tuple[str, ...]) -> None:
    env = start(modalities=modalities, initial_speed=10.0)
    observation, *_ = env.step(FULL)
    assert set(observation) == set(modalities) and env.observation_space.contains(observation)
    kinds = {"event": "dvs"}
    expected = {f"sensor.camera.{kinds.get(name, name)}" for name in modalities} | {"sensor.other.collision"}
    assert {sensor.type_id for sensor in server.sensors()} == expected
    if "event" in modalities:
        assert (observation["event"] != 128).any()


def test_cameras_sit_on_the_roof_with_the_options_given(server: Server, start: Start) -> None:
    event = {
        "threshold": (0.2, 0.4),
        "threshold_sigma": 0.03,
        "refractory": 1e-4,
        "mapping": "identity",
        "log_eps": 0.01,
    }
    start(event=event)
    cameras = {sensor.type_id: sensor for sensor in server.sensors() if "camera" in sensor.type_id}
    for camera in cameras.values():
        assert camera.parent is server.ego
        attributes = {name: camera.attributes[name] for name in ("image_size_x", "image_size_y", "fov")}
        assert {name: float(value) for name, value in attributes.items()} == {
            "image_size_x": 16,
            "image_size_y": 16,
            "fov": 60,
        }
        assert (camera._x, camera._y, camera._z) == (1.0, 0.0, 1.5) and camera._yaw == camera._pitch == 0
    chosen = cameras["sensor.camera.dvs"].attributes
    assert [float(chosen[f"{sign}_threshold"]) for sign in ("positive", "negative")] == [0.2, 0.4]
    assert [float(chosen[f"sigma_{sign}_threshold"]) for sign in ("positive", "negative")] == [0.03, 0.03]
    assert int(chosen["refractory_period_ns"]) == 100_000 and float(chosen["log_eps"]) == 0.01
    assert chosen["use_log"].lower() == "false"
    start()
    (dvs,) = (sensor for sensor in server.sensors() if sensor.type_id == "sensor.camera.dvs")
    assert float(dvs.attributes["positive_threshold"]) == 0.3 and dvs.attributes["use_log"] == "true"


@pytest.mark.parametrize("weather", WEATHERS)
def test_the_weather_is_set_on_the_world(server: Server, start: Start, weather: str) -> None:
    before = server.weather
    env = start(**{**ALONE, "weather": weather})
    assert server.weather == getattr(carla.WeatherParameters, weather)
    _, info = env.reset(options={"weather": "CloudyNoon"})
    assert server.weather == carla.WeatherParameters.CloudyNoon and info["weather"] == "CloudyNoon"
    assert env.reset()[1]["weather"] == weather
    env.close()
    assert server.weather == before


# ---- who is where ----


def test_cars_are_put_on_the_road(server: Server, start: Start) -> None:
    start(vehicles_count=20, traffic_speed=(10.0, 11.0))
    ego = waypoint(server, server.ego)
    assert ego.road_id == 45 and -4 <= ego.lane_id <= -1 and 100 <= ego.s <= 110
    assert server.ego.get_velocity().length() == 0
    others = [vehicle for vehicle in server.vehicles() if vehicle is not server.ego]
    assert len(others) == 20 and {vehicle._autopilot for vehicle in others} == {8000}
    places = [waypoint(server, vehicle) for vehicle in others]
    assert {place.lane_id for place in places} == {-1, -2, -3, -4} and {place.road_id for place in places} == {45}
    assert min(place.s for place in places) >= 114 and max(place.s for place in places) <= 300 + 0.5 * 12
    assert len({vehicle.type_id for vehicle in others}) > 1
    assert {vehicle.attributes["base_type"] for vehicle in others} == {"car"}
    manager = server.traffic_managers[8000]
    assert manager._synchronous and set(manager._speeds) == {vehicle.id for vehicle in others}
    assert all(36 <= speed <= 39.6 for speed in manager._speeds.values())
    start(vehicles_count=20, traffic_speed=None, lanes_count=1, tm_port=8100)
    others = [vehicle for vehicle in server.vehicles() if vehicle is not server.ego]
    assert {waypoint(server, vehicle).lane_id for vehicle in others} == {-1}
    assert not server.traffic_managers[8100]._speeds


def test_without_traffic_there_is_no_traffic_manager(server: Server, start: Start) -> None:
    start(**ALONE)
    assert not server.traffic_managers and server.vehicles() == [server.ego]


def test_the_world_runs_synchronously_at_the_frequency_given(server: Server, start: Start) -> None:
    env = start(**ALONE, simulation_frequency=40, policy_frequency=10)
    assert server.settings.synchronous_mode and server.settings.fixed_delta_seconds == pytest.approx(0.025)
    frame, elapsed = server.frame, server.elapsed
    env.step(FULL)
    assert server.frame == frame + 4 and server.elapsed == pytest.approx(elapsed + 0.1)
