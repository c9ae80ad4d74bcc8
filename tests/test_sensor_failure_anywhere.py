"""SensorFailure in vector environments, checkers, real environments and learning; and bad input."""

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs import TINY, RandomSensors, image, vector
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from scenes import SPACE, Env, Scenes, rollout, same
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack

from benchmarks import failure_picture
from sb3_have import HAVESAC
from sb3_have.sensors import SensorFailure, failures_for


def make_failing() -> Env:
    env = SensorFailure(Scenes(length=4), "rgb", "black", 3, schedule=(1, 3))
    env = SensorFailure(env, "rgb", "noise", probability=0.5)
    return SensorFailure(env, "event", "frozen", probability=0.5, per="episode")


@pytest.mark.parametrize("vector_env", [SyncVectorEnv, AsyncVectorEnv])
def test_gymnasium_vector_envs_pass_the_truth_on(
    vector_env: Callable[..., gym.vector.VectorEnv[Any, Any, Any]],
) -> None:
    envs = vector_env([make_failing] * 3)
    _, info = envs.reset(seed=1)
    coins = set()
    for step in range(9):
        truth = info["sensor_failure"]["rgb"]
        expected = step % 5 in (1, 2)  # the reset of gymnasium's vector environments takes a step of its own
        assert truth["black"]["active"].dtype == bool
        assert truth["black"]["active"].tolist() == [expected] * 3
        assert truth["black"]["severity"].tolist() == [3] * 3 and list(truth["black"]["kind"]) == ["black"] * 3
        coins.add(tuple(truth["noise"]["active"]))
        assert info["sensor_failure"]["event"]["frozen"]["active"].shape == (3,)
        observation, _, _, _, info = envs.step(np.zeros(3, int))
        assert envs.observation_space.contains(observation)
    assert len(coins) > 2
    envs.close()


@pytest.mark.parametrize("vec_env, number", [(DummyVecEnv, 2), (SubprocVecEnv, 1)])
def test_sb3_vec_envs_pass_the_truth_on_and_stack_outside(vec_env: Any, number: int) -> None:
    envs = VecFrameStack(vec_env([make_failing] * number), 2)
    envs.seed(0)
    observation: Any = envs.reset()
    assert isinstance(observation, dict) and observation["rgb"].shape == (number, 20, 20, 6)
    for step in range(1, 4):
        observation, _, _, infos = envs.step(np.zeros(number, int))
        assert [info["sensor_failure"]["rgb"]["black"]["active"] for info in infos] == [step < 3] * number
    envs.close()


def test_environment_checkers_pass() -> None:
    highway = gym.make("HighwayVision-v0", image_size=36)
    for env in (SensorFailure(highway, "event", "noise"), SensorFailure(gym.make("MountainCar-v0"), None, "lag")):
        check_env_sb3(env)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*different from the unwrapped version")
            warnings.filterwarnings("ignore", message=".*not able to test alternative render modes")
            check_env(env, skip_render_check=True)


def test_a_spec_makes_the_wrappers_again() -> None:
    env = gym.make("HighwayVision-v0", image_size=32)
    env = SensorFailure(env, "depth", "depth_dropout", 3, probability=0.5, duration=4)
    assert env.spec is not None
    again = gym.make(env.spec)
    assert same(rollout(env, 3)[0][-1], rollout(again, 3)[0][-1])
    assert rollout(env, 8)[1] == rollout(again, 8)[1]


@pytest.mark.parametrize("modality", ["rgb", "event", "depth"])
def test_sensors_of_highway_vision_fail_alone(modality: str) -> None:
    for kind in failures_for(modality):
        env = SensorFailure(gym.make("HighwayVision-v0", image_size=32, weather="ClearNoon"), modality, kind, 3)
        plain = gym.make("HighwayVision-v0", image_size=32, weather="ClearNoon")
        env.reset(seed=0)
        plain.reset(seed=0)
        for _ in range(3):
            action = np.array([0.8, 0.1], np.float32)
            (failed, *_, info), (clean, *_) = env.step(action), plain.step(action)
            assert env.observation_space.contains(failed) and info["weather"] == "ClearNoon"
            for key in clean:
                assert (failed[key] == clean[key]).all() == (key != modality), (kind, key)


def test_the_contact_sheet_has_a_cell_for_every_kind_that_a_sensor_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failure_picture, "STEPS", 4)
    monkeypatch.setattr(failure_picture, "SIZE", 36)
    paper = failure_picture.sheet(("black", "event_storm"))

    def cell(row: int, block: int, column: int) -> Any:
        y, x = failure_picture.HEADER + row * 40, failure_picture.LABELS + block * (3 * 40 + 4) + column * 40
        return paper[y : y + 36, x : x + 36]

    assert (cell(1, 0, 2) == 0).all() and (cell(1, 2, 2) == 0).all()  # black: rgb, depth
    assert (cell(1, 1, 2) == 255).all()  # and no event
    assert (cell(1, 0, 0)[:, :24] == cell(0, 0, 0)[:, :24]).all()  # a third lost, the rest intact
    assert (cell(2, 1, 2) != cell(0, 1, 0)).any() and (cell(2, 0, 2) == 255).all() and (cell(2, 2, 2) == 255).all()


def test_havesac_learns_with_a_failing_sensor() -> None:
    space = spaces.Dict({"rgb": image(3), "event": image(5), "state": vector(4)})
    env: Env = RandomSensors(space)
    for key, kind in (("rgb", "black"), ("event", "event_storm"), ("state", "lag")):
        env = SensorFailure(env, key, kind, probability=0.5, duration=3)
    model = HAVESAC(
        "MultiInputPolicy",
        env,
        policy_kwargs=TINY,
        buffer_size=50,
        learning_starts=8,
        batch_size=8,
        seed=0,
        device="cpu",
    )
    model.learn(20)
    assert model.num_timesteps == 20 and model._n_updates > 0
    observation, _ = env.reset(seed=0)
    assert np.isfinite(model.predict(observation)[0]).all()


FLOAT_IMAGE = spaces.Box(0.0, 1.0, (20, 20, 3), np.float32)
ODD = spaces.Dict(
    {
        "float": FLOAT_IMAGE, "first": spaces.Box(0, 255, (3, 20, 20), np.uint8), "n": spaces.Discrete(3),
        "stack": spaces.Box(0, 255, (4, 20, 20, 3), np.uint8), "grey": spaces.Box(0, 255, (20, 20), np.uint8),
        "dim": spaces.Box(0, 100, (20, 20, 3), np.uint8), "ints": spaces.Box(0, 255, (6,), np.uint8), "v": vector(3),
    }
)  # fmt: skip


@pytest.mark.parametrize(
    "space, args, kwargs, message",
    [
        (SPACE, ("lidar", "black"), {}, r"\['depth', 'event', 'rgb', 'state'\].*'lidar'"),
        (SPACE, (None, "black"), {}, r"modality must be a key"),
        (image(3), ("rgb", "black"), {}, r"modality=None.*'rgb'.*DictObservation"),
        (spaces.Discrete(3), (None, "black"), {}, r"Dict or Box.*Discrete"),
        (SPACE, ("rgb", "blck"), {}, r"'black', 'frozen'.*'rgb', got 'blck'"),
        (SPACE, ("rgb", "event_storm"), {}, r"motion_blur.*'rgb', got 'event_storm'.*sensor="),
        (SPACE, ("event", "overexposure"), {}, r"event_storm.*'event', got 'overexposure'"),
        (SPACE, ("state", "misalignment"), {}, r"dead_pixels.*'vector', got 'misalignment'"),
        (SPACE, ("rgb", "black"), {"sensor": "lidar"}, r"sensor must be one of.*'lidar'"),
        (SPACE, ("rgb", "black"), {"sensor": "vector"}, r"'rgb'.*'vector'.*uint8"),
        (SPACE, ("state", "black"), {"sensor": "depth"}, r"'state'.*'depth'.*float32"),
        (ODD, ("float", "black"), {}, r"'float'.*uint8 \(H, W, C\).*float32 \(20, 20, 3\) in 0.0..1.0"),
        (ODD, ("first", "black"), {}, r"'first'.*\(3, 20, 20\).*ChannelLastImages"),
        (ODD, ("stack", "black"), {}, r"'stack'.*stack frames outside"),
        (ODD, ("grey", "black"), {}, r"'grey'.*\(20, 20\)"),
        (ODD, ("dim", "black"), {}, r"'dim'.*0..100"),
        (ODD, ("ints", "black"), {}, r"'ints'.*float vector.*uint8 \(6,\)"),
        (ODD, ("n", "black"), {}, r"whose modality is a Box, got Discrete"),
        (SPACE, ("rgb", "black"), {"severity": 4}, r"severity.*4"),
        (SPACE, ("rgb", "black"), {"severity": 0}, r"severity.*0"),
        (SPACE, ("rgb", "black"), {"probability": 0.5, "schedule": (0, 2)}, r"either probability or schedule"),
        (SPACE, ("rgb", "black"), {"probability": 1.5}, r"0\.\.1.*1\.5"),
        (SPACE, ("rgb", "black"), {"probability": float("nan")}, r"0\.\.1.*nan"),
        (SPACE, ("rgb", "black"), {"severity": "2"}, r"severity.*'2'"),
        (SPACE, ("rgb", "black"), {"signed": False}, r"signed=False.*'event', got 'rgb'"),
        (SPACE, ("rgb", "black"), {"schedule": (False, 5)}, r"steps.*False"),
        (SPACE, ("rgb", "black"), {"probability": 0.5, "per": "day"}, r"per must be.*'day'"),
        (SPACE, ("rgb", "black"), {"per": "episode"}, r"per='episode'.*without a probability"),
        (SPACE, ("rgb", "black"), {"duration": 5, "schedule": (1, 2)}, r"duration=5.*without a probability"),
        (SPACE, ("rgb", "black"), {"probability": 0.5, "per": "episode", "duration": 5}, r"duration=5.*no effect"),
        (SPACE, ("rgb", "black"), {"probability": 1.0, "duration": 5}, r"duration=5 has no effect.*whole episode"),
        (SPACE, ("rgb", "black"), {"probability": 0.1, "duration": 0.5}, r"at least 1 steps.*0\.5"),
        (SPACE, ("rgb", "black"), {"probability": 0.8, "duration": 2}, r"0\.8.*at least 4 steps.*2"),
        (SPACE, ("rgb", "black"), {"schedule": (5, 5)}, r"start < stop.*\(5, 5\)"),
        (SPACE, ("rgb", "black"), {"schedule": (-1, 5)}, r"0 <= start.*\(-1, 5\)"),
        (SPACE, ("rgb", "black"), {"schedule": (0.5, 5)}, r"steps.*0\.5"),
        (SPACE, ("rgb", "black"), {"schedule": [(0, 1, 2)]}, r"pairs.*\(0, 1, 2\)"),
        (SPACE, ("rgb", "black"), {"schedule": []}, r"start < stop.*\[\]"),
        (SPACE, ("rgb", "black"), {"schedule": 7}, r"\(start, stop\).*7"),
    ],
)
def test_bad_input_is_named(space: Any, args: tuple[Any, ...], kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SensorFailure(Scenes(space), *args, **kwargs)
