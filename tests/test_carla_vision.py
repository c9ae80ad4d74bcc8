"""CarlaVision-v0 on the fake server: interface, observations, and where the vehicles are."""

import hashlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as check_sb3_env

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla_fixtures  # noqa: E402
from fake_carla_fixtures import ALONE, FULL, SMALL, STRAIGHT, Start, fresh, release_to_readers  # noqa: E402
from fake_carla_server import COLLISION, DEPTH, DVS, RGB, Server  # noqa: E402

from sb3_have.envs.carla_vision import CarlaVisionEnv  # noqa: E402
from sb3_have.envs.vision import compose  # noqa: E402
from sb3_have.envs.weather import WEATHERS  # noqa: E402
from sb3_have.sensors import encode_depth  # noqa: E402

server, start = fake_carla_fixtures.server, fake_carla_fixtures.start

# ---- interface ----


def test_checkers(server: Server) -> None:
    env = CarlaVisionEnv(**{**SMALL, "image_size": 36}, render_mode="rgb_array")
    check_gymnasium_env(env, skip_render_check=True)
    check_sb3_env(env)
    env.close()


def test_the_same_options_run_highway_vision(server: Server) -> None:
    options: dict[str, Any] = {
        "weather": ["WetNoon", "ClearNight"],
        "modalities": ["rgb", "event", "depth"],
        "image_size": 20,
        "vehicles_count": 2,
        "traffic_speed": [20.0, 22.0],
        "lanes_count": 3,
        "max_episode_steps": 4,
        "initial_speed": 12.0,
        "simulation_frequency": 20,
        "policy_frequency": 10,
        "steering_range": 0.05,
        "max_speed": 25.0,
        "steer_cost": 0.2,
        "brake_cost": 0.3,
        "crash_penalty": 5.0,
        "event": {"bins": 3, "threshold": 0.25, "threshold_sigma": 0.02, "refractory": 0.001, "log_eps": 0.002},
        "depth": {"encoding": "clipped", "max": 80.0},
        "scenario": "highway",
    }
    seen = []
    for name in ("HighwayVision-v0", "CarlaVision-v0"):
        env = gym.make(name, **options)
        infos = [env.reset(seed=0)[1]]
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


def test_wrong_calls_are_refused_and_harmless(server: Server) -> None:
    env = CarlaVisionEnv(**ALONE)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(STRAIGHT)
    for options in ({"weather": "Fog"}, {"config": 1}):
        with pytest.raises(ValueError, match=r"Fog|config"):
            env.reset(options=options)
    assert server.calls == []  # nothing connects before the first valid reset
    env.reset()
    for action in ([0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match="action"):
            env.step(np.array(action))
    assert env.step(FULL)[4]["distance"] > 0
    env.close()


def test_render(start: Start) -> None:
    env = start(render_mode="rgb_array", event={"representation": "polarity"}, initial_speed=20.0)
    observation, *_ = env.step(FULL)
    picture = env.render()
    assert picture is not None and picture.shape == (64, 192, 3) and env.metadata["render_fps"] == 5
    np.testing.assert_array_equal(picture, compose(observation, representation="polarity"))


# ---- seeds ----


def digest(monkeypatch: pytest.MonkeyPatch, seed: int, **options: Any) -> str:
    """Hash of everything that an agent sees in two episodes."""
    server, found = fresh(monkeypatch), hashlib.sha256()
    env = CarlaVisionEnv(**SMALL, **options)
    for episode in range(2):
        observation, info = env.reset(seed=None if episode else seed)
        for _ in range(3):
            found.update(b"".join(image.tobytes() for image in observation.values()) + repr(info).encode())
            observation, reward, *_, info = env.step(FULL)
            found.update(repr(reward).encode())
    env.close()
    assert server.left_behind() == []
    return found.hexdigest()


def test_same_seed_same_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    first = digest(monkeypatch, 5)
    assert digest(monkeypatch, 5) == first != digest(monkeypatch, 6)


def test_seeds_reach_the_traffic_manager(server: Server, start: Start) -> None:
    env = start(seed=1)
    seeds = [server.traffic_managers[8000]._seed]
    for seed in (None, 2, 1):
        env.reset(seed=seed)
        seeds.append(server.traffic_managers[8000]._seed)
    assert seeds[0] == seeds[3] and len(set(seeds)) == 3 and None not in seeds


def test_traffic_does_not_depend_on_weather_and_sensors(server: Server, start: Start) -> None:
    def traffic(**options: Any) -> list[Any]:
        start(**options)
        return [(v.type_id, v._x, v._y) for v in server.vehicles]

    assert traffic(weather="ClearNoon") == traffic(weather=["WetNight", "WetNoon"], modalities=("depth",))


# ---- observations ----


def events_by_hand(server: Server, frames: range, bins: int) -> NDArray[np.uint8]:
    """Event image of the ticks of a control step that has just ended, in a plain loop."""
    counts = np.zeros((16, 16, bins), dtype=int)
    length = len(frames) * 50_000_000
    start = round(server.elapsed * 1e9) - length
    for frame in frames:
        for x, y, t, positive in server.sent[DVS][frame]:
            assert -1 <= t - start <= length + 1
            counts[y, x, min(max(0, int(t) - start) * bins // length, bins - 1)] += 1 if positive else -1
    return (128 + np.clip(counts, -127, 127)).astype(np.uint8)


@pytest.mark.parametrize("hold", [False, True], ids=["prompt", "slow"])
@pytest.mark.parametrize(("frequency", "bins"), [(5, 5), (20, 3)])
def test_images_are_those_that_the_server_sent(
    server: Server, start: Start, monkeypatch: pytest.MonkeyPatch, frequency: int, bins: int, hold: bool
) -> None:
    if hold:
        for kind in (RGB, DEPTH, DVS):
            server.disturb(kind, hold=True)
        release_to_readers(server, monkeypatch)
    # A long timeout and grace, because a busy machine runs threads late
    env = start(policy_frequency=frequency, event={"bins": bins}, initial_speed=20.0, timeout=60.0, event_grace=60.0)
    observation, _ = env.reset(seed=0)
    assert (observation["event"] == 128).all() and observation["event"].shape == (16, 16, bins)
    for _ in range(3):
        first = server.frame + 1
        observation, *_ = env.step(FULL)
        np.testing.assert_array_equal(observation["rgb"], server.sent[RGB][server.frame][..., [2, 1, 0]])
        blue, green, red = (server.sent[DEPTH][server.frame][..., channel].astype(float) for channel in range(3))
        metres = 1000 * (red + 256 * green + 65536 * blue) / (256**3 - 1)
        metres[metres == 1000] = np.inf
        assert (observation["depth"][:5] == 0).all() and (observation["depth"][5:] > 0).all()
        np.testing.assert_array_equal(observation["depth"][..., 0], encode_depth(metres, "log"))
        by_hand = events_by_hand(server, range(first, server.frame + 1), bins)
        np.testing.assert_array_equal(observation["event"], by_hand)
        assert (by_hand != 128).mean() > 0.1
    server.join()


def test_tau_of_the_time_surface(start: Start) -> None:
    events = []
    for tau in (None, 0.2, 0.01):
        env = start(event={"representation": "time_surface", "tau": tau}, initial_speed=20.0)
        events.append(env.step(FULL)[0]["event"])
    np.testing.assert_array_equal(events[0], events[1])
    assert (events[2] <= events[1]).all() and (events[2] < events[1]).any()


@pytest.mark.parametrize(("modalities", "kinds"), [(("rgb",), {RGB}), (("event", "depth"), {DEPTH, DVS})])
def test_only_the_chosen_sensors_are_mounted(
    server: Server, start: Start, modalities: tuple[str, ...], kinds: set[str]
) -> None:
    env = start(modalities=modalities)
    observation, *_ = env.step(FULL)
    assert set(observation) == set(modalities) and env.observation_space.contains(observation)
    assert {sensor.type_id for sensor in server.sensors} == {*kinds, COLLISION}


def test_cameras_are_on_the_roof(server: Server, start: Start) -> None:
    start(event={"threshold": (0.2, 0.4)})
    cameras = {sensor.type_id: sensor for sensor in server.sensors if sensor.type_id != COLLISION}
    assert len(cameras) == 3
    for camera in cameras.values():
        assert camera._parent is server.ego
        attributes = {name: float(camera.attributes[name]) for name in ("image_size_x", "image_size_y", "fov")}
        assert attributes == {"image_size_x": 16, "image_size_y": 16, "fov": 60}
        assert (camera._x, camera._y, camera._z, camera._yaw) == (1.0, 0.0, 1.5, 0.0)
    chosen = cameras[DVS].attributes
    assert (chosen["positive_threshold"], chosen["negative_threshold"], chosen["use_log"]) == ("0.2", "0.4", "true")


@pytest.mark.parametrize("weather", WEATHERS)
def test_weather(server: Server, start: Start, weather: str) -> None:
    before = server.weather
    env = start(**{**ALONE, "weather": weather})
    assert server.weather == getattr(carla.WeatherParameters, weather)
    _, info = env.reset(options={"weather": "CloudyNoon"})
    assert server.weather == carla.WeatherParameters.CloudyNoon and info["weather"] == "CloudyNoon"
    assert env.reset()[1]["weather"] == weather
    env.close()
    assert server.weather == before


# ---- vehicles and time ----


def test_vehicles_start_on_the_road(server: Server, start: Start) -> None:
    def waypoints() -> list[Any]:
        return [server.map.get_waypoint(vehicle.get_location()) for vehicle in others]

    start(vehicles_count=20, traffic_speed=(10.0, 11.0))
    ego = server.map.get_waypoint(server.ego.get_location())
    assert ego.road_id == 45 and -4 <= ego.lane_id <= -1 and 100 <= ego.s <= 110
    assert server.ego.get_velocity().length() == 0 and server.ego.type_id == "vehicle.tesla.model3"
    others = [vehicle for vehicle in server.vehicles if vehicle is not server.ego]
    assert len(others) == 20 and {vehicle._autopilot for vehicle in others} == {8000}
    assert {place.lane_id for place in waypoints()} == {-1, -2, -3, -4}
    assert {place.road_id for place in waypoints()} == {45}
    assert min(place.s for place in waypoints()) >= 114 and max(place.s for place in waypoints()) <= 300 + 0.5 * 12
    assert len({vehicle.type_id for vehicle in others}) > 1
    assert {vehicle.attributes["base_type"] for vehicle in others} == {"car"}
    manager = server.traffic_managers[8000]
    assert manager._synchronous and set(manager._speeds) == {vehicle.id for vehicle in others}
    assert all(36 <= speed <= 39.6 for speed in manager._speeds.values())

    start(vehicles_count=8, traffic_speed=None, lanes_count=1, tm_port=8100)
    others = [vehicle for vehicle in server.vehicles if vehicle is not server.ego]
    assert {place.lane_id for place in waypoints()} == {-1} and not server.traffic_managers[8100]._speeds


def test_without_traffic_there_is_no_traffic_manager(server: Server, start: Start) -> None:
    start(**ALONE)
    assert not server.traffic_managers and server.vehicles == [server.ego]


def test_frequencies(server: Server, start: Start) -> None:
    env = start(**ALONE, simulation_frequency=40, policy_frequency=10)
    assert server.settings.synchronous_mode and server.settings.fixed_delta_seconds == pytest.approx(0.025)
    frame, elapsed = server.frame, server.elapsed
    env.step(FULL)
    assert server.frame == frame + 4 and server.elapsed == pytest.approx(elapsed + 0.1)
