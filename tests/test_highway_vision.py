"""HighwayVision-v0: the gymnasium contract, known answers of dynamics and reward, traffic, determinism."""

import hashlib
import itertools
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from highway_env.vehicle.behavior import IDMVehicle
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from benchmarks.road_identity import BlindEnv
from sb3_have.envs import HighwayVisionEnv, traffic
from sb3_have.envs.road import LANE_WIDTH
from sb3_have.envs.vision import VisionSensors
from sb3_have.envs.weather import WEATHERS

MODALITIES = ("rgb", "event", "depth")
SUBSETS = [subset for n in (1, 2, 3) for subset in itertools.combinations(MODALITIES, n)]
INFO_KEYS = {"distance", "speed", "crashed", "offroad", "weather", "end_reason"}
STRAIGHT = np.zeros(2, dtype=np.float32)


def rollout_digest(seed: int, steps: int, **kwargs: Any) -> str:
    """Hash of every bit an agent gets to see over several short episodes."""
    env = gym.make("HighwayVision-v0", image_size=36, max_episode_steps=8, **kwargs)
    env.action_space.seed(seed)
    digest = hashlib.sha256()
    observation, info = env.reset(seed=seed)
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            observation, _ = env.reset()
        for key in sorted(observation):
            digest.update(observation[key].tobytes())
        digest.update(repr((reward, terminated, truncated, sorted(info.items()))).encode())
    env.close()
    return digest.hexdigest()


# ---- the gymnasium contract ----


@pytest.mark.parametrize("weather", WEATHERS)
def test_checkers_accept_every_weather(weather: str) -> None:
    env = gym.make("HighwayVision-v0", weather=weather, image_size=36, render_mode="rgb_array")
    check_gymnasium_env(env.unwrapped)
    check_sb3_env(env)
    assert env.reset()[1]["weather"] == weather


@pytest.mark.parametrize("modalities", SUBSETS)
def test_checkers_accept_every_set_of_modalities(modalities: tuple[str, ...]) -> None:
    env = gym.make("HighwayVision-v0", modalities=modalities, image_size=36, render_mode="rgb_array")
    check_gymnasium_env(env.unwrapped)
    check_sb3_env(env)
    assert set(env.reset()[0]) == set(modalities)


def test_spaces() -> None:
    env = HighwayVisionEnv(image_size=40)
    assert isinstance(env.observation_space, spaces.Dict)
    shapes = {key: (space.shape, space.dtype) for key, space in env.observation_space.spaces.items()}
    u8 = np.dtype(np.uint8)
    assert shapes == {"rgb": ((40, 40, 3), u8), "event": ((40, 40, 5), u8), "depth": ((40, 40, 1), u8)}
    assert env.action_space == spaces.Box(-1, 1, (2,), np.float32)


def test_info_keys_at_reset_and_every_step() -> None:
    env = BlindEnv()
    _, info = env.reset(seed=0)
    assert set(info) == INFO_KEYS and info["distance"] == 0 and info["speed"] == 0 and info["end_reason"] is None
    assert set(env.step(STRAIGHT)[4]) == INFO_KEYS


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weather": "Fog"}, "Fog"),
        ({"weather": []}, "weather"),
        ({"weather": ["WetNoon", "Fog"]}, "Fog"),
        ({"modalities": ("rgb", "lidar")}, "lidar"),
        ({"modalities": ()}, "modalit"),
        ({"image_size": 0}, "image_size"),
        ({"duration": 0.0}, "duration"),
        ({"config": {"vehicle_count": 3}}, r"\['vehicle_count'\] cannot be configured.*vehicles_count"),
        ({"config": {"screen_width": 100}}, r"\['screen_width'\]"),
        ({"config": {"image_size": 0}}, "image_size"),
        ({"policy_frequency": 0}, "policy_frequency"),
        ({"initial_speed": 31}, "initial_speed"),
        ({"initial_speed": float("nan")}, "initial_speed"),
        ({"vehicles_count": -1}, "vehicles_count"),
        ({"vehicles_count": 2.5}, "vehicles_count"),
        ({"lanes_count": 0}, "lanes_count"),
        ({"max_episode_steps": 0}, "max_episode_steps"),
        ({"steering_range": 0.0}, "steering_range"),
        ({"max_speed": -1.0}, "max_speed"),
        ({"traffic_speed": (0.0, 20.0)}, "traffic_speed"),
        ({"traffic_speed": (20.0, 40.0)}, "traffic_speed"),
        ({"traffic_speed": 20.0}, "traffic_speed"),
        ({"vehicles_count": float("nan")}, "vehicles_count"),
        ({"weather": None}, "weather"),
        ({"crash_penalty": -20.0}, "crash_penalty"),
        ({"render_mode": "human"}, "render_mode"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HighwayVisionEnv(**options)


def test_bad_reset_options_and_actions_are_refused() -> None:
    env = BlindEnv()
    with pytest.raises(ValueError, match="config"):
        env.reset(options={"config": {}})
    with pytest.raises(ValueError, match="Fog"):
        env.reset(options={"weather": "Fog"})
    env.reset()
    for action in ([0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match="action"):
            env.step(np.array(action))


def test_configuration_takes_effect_at_the_next_reset_after_the_same_checks() -> None:
    env = BlindEnv(initial_speed=30.0, vehicles_count=3, config={"lanes_count": 3})
    env.reset(seed=0)
    assert (len(env.road.vehicles), env.lanes_count) == (4, 3)
    # 20 Hz is no multiple of 15 Hz: two sub-steps of 1/30 s
    config = env.config
    config["policy_frequency"] = 15
    env.configure({"vehicles_count": 0, "duration": 0.2, "scenario": "curves", "lanes_count": 2})
    for _ in range(2):
        info = env.step(STRAIGHT)[4]
    assert info["distance"] == pytest.approx(2 * 30 / 5) and info["end_reason"] is None
    env.reset(seed=0)
    assert len(env.road.vehicles) == 1 and env.shape.oncoming == 1 and env.sub_steps == 2
    assert isinstance(env.sensors, VisionSensors) and env.sensors.camera.shape == env.shape
    ends = [env.step(STRAIGHT) for _ in range(3)]
    assert [end[4]["end_reason"] for end in ends] == [None, None, "timeout"]
    assert ends[0][4]["distance"] == pytest.approx(30 / 15, rel=0.01) and ends[0][1] == pytest.approx(1.0, rel=0.01)
    before = dict(config)
    for bad in ({"vehicle_count": 1}, {"image_size": 36}, {"initial_speed": 40.0}, {"lanes_count": 3}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            env.configure(bad)
    assert env.config == before
    config["crash_penalty"] = -1.0
    with pytest.raises(ValueError, match="crash_penalty"):
        env.reset()


def test_step_after_the_end_warns() -> None:
    env = BlindEnv(max_episode_steps=1)
    env.reset()
    env.step(STRAIGHT)
    with pytest.warns(UserWarning, match="after the end"):
        env.step(STRAIGHT)


def test_weather_options() -> None:
    env = BlindEnv(weather=["WetNoon", "ClearNight"])
    assert {env.reset(seed=seed)[1]["weather"] for seed in range(20)} == {"WetNoon", "ClearNight"}
    assert env.reset(options={"weather": "HardRainNoon"})[1]["weather"] == "HardRainNoon"
    assert env.reset()[1]["weather"] in ("WetNoon", "ClearNight")
    assert {BlindEnv().reset(seed=seed)[1]["weather"] for seed in range(60)} == set(WEATHERS)


def test_render_shows_what_is_there() -> None:
    env = HighwayVisionEnv(image_size=36, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture is not None and picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    assert picture.shape[1] >= 3 * picture.shape[0] * 0.9
    assert env.metadata["render_fps"] == 5
    only_depth = HighwayVisionEnv(image_size=36, modalities=("depth",), render_mode="rgb_array")
    only_depth.reset(seed=0)
    small = only_depth.render()
    assert small is not None and small.shape[1] < picture.shape[1]


# ---- dynamics, reward, ends ----


def test_reward_straight_at_constant_speed() -> None:
    env = BlindEnv(initial_speed=20.0, vehicles_count=0)
    env.reset(seed=0)
    for step in range(1, 6):
        _, reward, terminated, truncated, info = env.step(STRAIGHT)
        assert reward == pytest.approx(20 / 30) and info["distance"] == pytest.approx(4.0 * step)
        assert not terminated and not truncated and info["end_reason"] is None


def test_reward_of_steering_and_braking() -> None:
    env = BlindEnv(initial_speed=20.0, vehicles_count=0, steer_cost=0.5, brake_cost=0.25)
    env.reset(seed=0)
    x = env.vehicle.position[0]
    _, reward, *_ = env.step(np.array([-0.5, -1.0]))
    progress = (env.vehicle.position[0] - x) * 5
    # explicit Euler at -2.5 m/s^2 over four steps of 0.05 s, the slight turn aside
    assert progress == pytest.approx(20 - 2.5 * 0.05 * 1.5, abs=0.01)
    assert reward == pytest.approx(progress / 30 - 0.5 * 1.0 - 0.25 * 0.5)
    _, reward, *_ = env.step(np.array([0.7, 0.0]))
    assert reward > 0.6  # throttle costs nothing


def test_positive_steer_goes_right() -> None:
    for steer in (1.0, -1.0):
        env = BlindEnv(initial_speed=20.0, vehicles_count=0)
        env.reset(seed=0)
        y = env.vehicle.position[1]
        for _ in range(3):
            env.step(np.array([0.0, steer]))
        assert np.sign(env.vehicle.position[1] - y) == steer


def test_speed_stays_in_its_range() -> None:
    env = BlindEnv(vehicles_count=0, max_speed=10.0)
    env.reset(seed=0)
    for throttle, steps in [(-1.0, 3), (1.0, 12), (-1.0, 15)]:
        for _ in range(steps):
            info = env.step(np.array([throttle, 0.0]))[4]
            assert 0 <= info["speed"] <= 10
    assert info["speed"] == 0 and env.step(np.array([-1.0, 0.0]))[4]["distance"] == info["distance"]


def test_crash() -> None:
    env = BlindEnv(initial_speed=20.0, vehicles_count=0, crash_penalty=7.0)
    env.reset(seed=0)
    wall = IDMVehicle(env.road, env.vehicle.position + np.array([30.0, 0.0]), 0.0, 0.0)
    wall.COMFORT_ACC_MAX = 0.0  # does not drive
    env.road.vehicles.append(wall)
    for _ in range(10):
        _, reward, terminated, truncated, info = env.step(STRAIGHT)
        if terminated:
            break
        assert reward == pytest.approx(20 / 30)
    assert terminated and not truncated and info["crashed"] and not info["offroad"] and info["end_reason"] == "crash"
    assert 20 <= info["distance"] <= 30 and -7 <= reward <= -6


@pytest.mark.parametrize("steer", [1.0, -1.0])
def test_leaving_the_road(steer: float) -> None:
    env = BlindEnv(initial_speed=30.0, vehicles_count=0)
    env.reset(seed=0)
    for _ in range(60):
        _, reward, terminated, _, info = env.step(np.array([0.0, steer]))
        if terminated:
            break
    assert terminated and info["offroad"] and not info["crashed"] and info["end_reason"] == "offroad"
    y = env.vehicle.position[1]
    assert (y > 3.5 * LANE_WIDTH) if steer > 0 else (y < -0.5 * LANE_WIDTH)
    assert reward == pytest.approx(env._progress * 5 / 30 - 0.1 - 20)


@pytest.mark.parametrize("make", [BlindEnv, lambda **kw: gym.make("HighwayVision-v0", image_size=36, **kw)])
def test_timeout(make: Callable[..., Any]) -> None:
    env = make(max_episode_steps=4)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(STRAIGHT)[2:] for _ in range(4)]
        assert [truncated for _, truncated, _ in ends] == [False, False, False, True]
        assert not any(terminated for terminated, _, _ in ends)
        assert [info["end_reason"] for *_, info in ends] == [None, None, None, "timeout"]


def test_registered_limit_can_be_raised() -> None:
    assert gym.spec("HighwayVision-v0").max_episode_steps == 500
    env = gym.make("HighwayVision-v0", max_episode_steps=900, image_size=36, vehicles_count=0)
    assert isinstance(env.unwrapped, HighwayVisionEnv) and env.unwrapped.max_episode_steps is None
    assert env.spec is not None and env.spec.max_episode_steps == 900
    assert BlindEnv().max_episode_steps == 500


# ---- traffic ----


def gaps(env: HighwayVisionEnv) -> list[float]:
    """Bumper-to-bumper distances [m] between vehicles whose bodies share a lateral strip."""
    vehicles = env.road.vehicles
    pairs = itertools.combinations(vehicles, 2)
    return [
        abs(a.position[0] - b.position[0]) - a.LENGTH for a, b in pairs if abs(a.position[1] - b.position[1]) < a.WIDTH
    ]


@pytest.mark.parametrize("initial_speed", [0.0, 30.0])
def test_traffic_starts_with_room(initial_speed: float) -> None:
    for seed in range(5):
        env = BlindEnv(initial_speed=initial_speed)
        env.reset(seed=seed)
        x = np.array([v.position[0] for v in env.road.vehicles]) - env.vehicle.position[0]
        assert len(x) == 21 and min(gaps(env)) >= 5
        assert np.count_nonzero(x < 0) >= 1 and np.count_nonzero(x > 0) >= 8
        rear = env.road.neighbour_vehicles(env.vehicle)[1]
        if rear is not None:
            assert rear.lane_distance_to(env.vehicle) >= rear.desired_gap(rear, env.vehicle)


@pytest.mark.parametrize("speed", [5.0, 30.0])
def test_recycling_keeps_the_density_out_of_sight(speed: float) -> None:
    env = BlindEnv(initial_speed=speed, lanes_count=4, max_episode_steps=None)
    recycled, inside, hits = 0, [], 0
    for seed in range(2):
        env.reset(seed=seed)
        env.vehicle.collidable = False  # a ghost: keep straight for the whole test
        env.vehicle.position[1] = -0.4 * LANE_WIDTH
        for _ in range(200):
            before = list(env.road.vehicles)
            env.step(STRAIGHT)
            ego = env.vehicle
            start = env._poses[0]
            assert len(start) == 21
            x = start[:, 0] - start[0, 0]
            for i, (old, new) in enumerate(zip(before, env.road.vehicles, strict=True)):
                if old is not new:
                    recycled += 1
                    assert x[i] >= traffic.SIGHT or x[i] <= -100
                    gap = np.delete(np.hypot(*(start[:, :2] - start[i, :2]).T), i)
                    same_lane = np.abs(np.delete(start[:, 1], i) - start[i, 1]) < 3
                    assert gap[same_lane].min(initial=np.inf) >= 10
            assert before[0] is ego
            inside.append(np.count_nonzero((x >= -traffic.BEHIND - 10) & (x <= traffic.AHEAD + 10)))
            hits += sum(v.crashed for v in env.road.vehicles)
    assert recycled >= 10
    assert min(inside) >= 15 and hits == 0


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_a_slow_ego_is_not_hit_from_behind(speed: float) -> None:
    for seed in range(4):
        env = BlindEnv(max_episode_steps=150)
        env.reset(seed=seed)
        truncated = False
        while not truncated:
            throttle = 1.0 if env.vehicle.speed < speed else 0.0
            _, _, terminated, truncated, info = env.step(np.array([throttle, 0.0]))
            assert not terminated, info


def test_a_road_too_full_queues_out_of_sight() -> None:
    env = BlindEnv(vehicles_count=80, lanes_count=2)
    env.reset(seed=0)
    assert len(env.road.vehicles) == 81 and min(gaps(env)) >= 5
    for _ in range(30):
        env.step(STRAIGHT)
    assert not any(v.crashed for v in env.road.vehicles)


# ---- determinism, processes ----


def test_same_seed_same_bits_in_one_process_and_in_another() -> None:
    here = rollout_digest(3, 20)
    assert here == rollout_digest(3, 20)
    assert here != rollout_digest(4, 20)
    code = "from test_highway_vision import rollout_digest; print(rollout_digest(3, 20))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    there = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert there.stdout.strip() == here


def test_the_same_traffic_in_every_weather_and_with_every_modality() -> None:
    paths = []
    options: list[dict[str, Any]] = [{"weather": "ClearNoon"}, {"weather": "HardRainNight"}, {"modalities": ("depth",)}]
    for kwargs in options:
        env = HighwayVisionEnv(image_size=36, **kwargs)
        for seed in (5, None):
            env.reset(seed=seed)
            for _ in range(5):
                env.step(np.array([1.0, 0.1]))
            paths.append(env._snapshot())
    assert all(np.array_equal(path, paths[i % 2]) for i, path in enumerate(paths))
    assert not np.array_equal(paths[0], paths[1])


def test_reset_leaves_the_seeded_action_space_alone() -> None:
    env = BlindEnv()
    env.action_space.seed(0)
    expected = [env.action_space.sample() for _ in range(3)]
    env.action_space.seed(0)
    for action in expected:
        env.reset(seed=1)
        assert np.array_equal(action, env.action_space.sample())


def test_pickled_env_goes_on_alike() -> None:
    env = HighwayVisionEnv(image_size=36)
    env.reset(seed=0)
    env.step(STRAIGHT)
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        one, other = env.step(np.array([1.0, 0.2])), twin.step(np.array([1.0, 0.2]))
        assert all(np.array_equal(one[0][key], other[0][key]) for key in MODALITIES) and one[1] == other[1]
    env.close()
    env.close()


def test_subprocess_vec_env_equals_the_env() -> None:
    # the module in the id is imported by the workers, too, which may know nothing of this process's imports
    def make() -> gym.Env[Any, Any]:
        return gym.make("sb3_have:HighwayVision-v0", image_size=36, weather="WetNight")

    venv = SubprocVecEnv([make, make])
    try:
        venv.seed(7)
        observations: list[Any] = [venv.reset()]
        actions = np.random.default_rng(0).uniform(-1, 1, (3, 2, 2)).astype(np.float32)
        observations += [venv.step(action)[0] for action in actions]
    finally:
        venv.close()
    for i in range(2):
        env = make()
        seen = [env.reset(seed=7 + i)[0]]
        seen += [env.step(action[i])[0] for action in actions]
        for one, other in zip(observations, seen, strict=True):
            assert all(np.array_equal(one[key][i], other[key]) for key in MODALITIES)
