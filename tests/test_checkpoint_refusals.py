"""What checkpoints refuse, by name and with the remedy, and what they leave alone."""

import copy
import fcntl
import gc
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit, TransformReward
from resuming import Drifting, assert_same, everything
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_have.checkpoint import checkpoint, files
from sb3_have.checkpoint.checkpoint import (
    ResumableCheckpointCallback,
    checkpoints,
    load_checkpoint,
    random_states,
    save_checkpoint,
    set_random_states,
)
from sb3_have.checkpoint.env_state import environments_state, restore_environments


def make_model(env: Any = None, algorithm: Any = SAC, **kwargs: Any) -> Any:
    defaults: dict[str, Any] = {"buffer_size": 60, "learning_starts": 8, "batch_size": 8, "seed": 0, "device": "cpu"}
    policy_kwargs = {"net_arch": [8]}
    return algorithm("MlpPolicy", env or Drifting(), policy_kwargs=policy_kwargs, **{**defaults, **kwargs})


def test_folder_of_another_training(tmp_path: Path) -> None:
    """Else `load_checkpoint` would take the other one's."""
    callback = ResumableCheckpointCallback(tmp_path, 10)
    make_model().learn(20, callback)
    for each in (callback, ResumableCheckpointCallback(tmp_path, 10)):
        with pytest.raises(ValueError, match=r"checkpoint-20 is later than this training, which has 0 steps.*another"):
            make_model().learn(5, each)
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-10", "checkpoint-20"]
    load_checkpoint(tmp_path, Drifting(), callback, device="cpu").learn(5, callback, reset_num_timesteps=False)
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-20", "checkpoint-25"]
    earlier = load_checkpoint(tmp_path / "checkpoint-20", Drifting(), device="cpu")
    with pytest.raises(ValueError, match=r"checkpoint-25 is later .* 20 steps"):
        earlier.learn(5, callback, reset_num_timesteps=False)


def test_second_call_of_learn(tmp_path: Path) -> None:
    """By default SB3 counts the steps from 0 again."""
    callback = ResumableCheckpointCallback(tmp_path, 10)
    model = make_model().learn(20, callback)
    told = (
        r"to train the same model on, `learn\(..., reset_num_timesteps=False\)`, after `model.num_timesteps = 20` where"
    )
    with pytest.raises(ValueError, match=told):
        model.learn(10, callback)
    model.num_timesteps = 20
    model.learn(10, callback, reset_num_timesteps=False)
    assert checkpoints(tmp_path)[-1].name == "checkpoint-30"


def test_damaged_later_checkpoints_are_in_nobodys_way(tmp_path: Path) -> None:
    (tmp_path / "checkpoint-20").write_bytes(b"damaged")
    make_model().learn(9, ResumableCheckpointCallback(tmp_path, 10))
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-9", "checkpoint-20"]
    with pytest.raises(ValueError, match="checkpoint-9 is later than this training, which has 0 steps"):
        make_model().learn(9, ResumableCheckpointCallback(tmp_path, 10))


class Fails(BaseCallback):
    def _on_step(self) -> bool:
        raise ZeroDivisionError


class Watches(BaseCallback):
    """Whether another process could begin in a folder now."""

    def __init__(self, folder: Path):
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        with pytest.raises(BlockingIOError):
            take(self.folder)
        return True


def take(folder: Path) -> None:
    with (folder / ".lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)  # as another process does


def test_folder_is_for_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "locked", partial(files.locked, patience=0.0))
    callback = ResumableCheckpointCallback(tmp_path, 10)
    with (tmp_path / ".lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        (tmp_path / "checkpoint-20").write_bytes(b"the other process's, in the midst of renaming")
        with pytest.raises(
            BlockingIOError, match=r"another process works in.*; a notebook .* until its kernel is rest"
        ):
            make_model().learn(9, callback)
    make_model().learn(9, [callback, Watches(tmp_path)])
    take(tmp_path)
    with pytest.raises(ValueError, match="checkpoint-9 is later"):
        make_model().learn(9, callback)
    take(tmp_path)


def test_folder_after_a_training_that_failed(tmp_path: Path) -> None:
    """The process keeps it, for itself alone, and gives it back when it has trained in it again."""
    callback = ResumableCheckpointCallback(tmp_path, 10)
    with pytest.raises(ZeroDivisionError):
        make_model().learn(9, [callback, Fails()])
    with pytest.raises(BlockingIOError):
        take(tmp_path)
    again = ResumableCheckpointCallback(tmp_path, 10)  # as when a cell of a notebook is run again

    class Forgets(BaseCallback):
        def _on_training_start(self) -> None:
            nonlocal callback
            del callback
            gc.collect()

        def _on_step(self) -> bool:
            return True

    make_model().learn(9, [again, Forgets(), Watches(tmp_path)])
    take(tmp_path)


def test_folder_made_anew_after_a_training_that_failed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(ZeroDivisionError):
        make_model().learn(9, [ResumableCheckpointCallback(folder, 10), Fails()])
    shutil.rmtree(folder)
    make_model().learn(9, [ResumableCheckpointCallback(folder, 10), Watches(folder)])
    take(folder)


def test_algorithm_that_is_on_policy(tmp_path: Path) -> None:
    model = PPO("MlpPolicy", Drifting(), n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(TypeError, match="PPO is on-policy, and checkpoints are of off-policy algorithms; use SB3's"):
        model.learn(8, ResumableCheckpointCallback(tmp_path, 8))
    with pytest.raises(TypeError, match="PPO is on-policy"):
        save_checkpoint(model, tmp_path / "mine")  # type: ignore[arg-type]


def test_folder_that_is_missing_is_made(tmp_path: Path) -> None:
    """As by SB3's `save`."""
    save_checkpoint(make_model(), tmp_path / "new" / "folder" / "mine")
    assert load_checkpoint(tmp_path / "new" / "folder" / "mine", Drifting()).num_timesteps == 0


def test_cuda_is_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(*args: Any) -> None:
        raise AssertionError

    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "is_initialized", lambda: False)
    monkeypatch.setattr(th.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(th.cuda, "get_rng_state_all", start)
    monkeypatch.setattr(th.cuda, "set_rng_state_all", start)
    set_random_states(random_states())


def noise() -> OrnsteinUhlenbeckActionNoise:
    return OrnsteinUhlenbeckActionNoise(np.zeros(2), np.full(2, 0.5))


@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_between_two_calls_of_learn(tmp_path: Path, n_envs: int) -> None:
    """Each begins by resetting it, and so does one after loading, however often it was loaded and saved."""

    def make_env() -> DummyVecEnv:
        return DummyVecEnv([lambda: Monitor(Drifting(100))] * n_envs)

    model = make_model(make_env(), TD3, action_noise=noise()).learn(20)
    save_checkpoint(model, tmp_path / "mine")
    save_checkpoint(load_checkpoint(tmp_path / "mine", make_env()), tmp_path / "copy")
    expected = everything(model.learn(20, reset_num_timesteps=False))
    again = load_checkpoint(tmp_path / "copy", make_env(), device="cpu").learn(20, reset_num_timesteps=False)
    assert_same(everything(again), expected)


def test_noise_that_goes_on_can_be_copied(tmp_path: Path) -> None:
    """What is skipped once is skipped once by each."""
    make_model(algorithm=TD3, action_noise=noise()).learn(20, ResumableCheckpointCallback(tmp_path, 20))
    first = load_checkpoint(tmp_path, Drifting(), device="cpu").action_noise
    second = copy.deepcopy(first)
    for each in (first, second):
        assert each.noise_prev.any()
        each.reset()
        assert each.noise_prev.any()
        each.reset()
        assert not each.noise_prev.any()


def limited(steps: int, **kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make("Pendulum-v1", max_episode_steps=steps, **kwargs)


def highway(**kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make("HighwayVision-v0", image_size=36, modalities=("rgb",), vehicles_count=2, **kwargs)


SETTINGS: dict[str, tuple[Any, Any, str]] = {
    "episodes": (
        partial(limited, 31),
        partial(limited, 40),
        "TimeLimit was made with max_episode_steps: 31, and it was given one with max_episode_steps: 40",
    ),
    "physics": (partial(limited, 31), partial(limited, 31, g=1.0), "PendulumEnv was made with g: 10.0, .* with g: 1.0"),
    "weather": (highway, partial(highway, weather="WetNight"), "with weather: 'random', .* with weather: 'WetNight'"),
    "wrapper": (
        lambda: TimeLimit(Drifting(), 5),
        lambda: TimeLimit(Drifting(), 6),
        "max_episode_steps: 5, .* max_episode_steps: 6",
    ),
}


@pytest.mark.parametrize("case", SETTINGS)
def test_settings_that_would_be_overridden(case: str, tmp_path: Path) -> None:
    make, make_other, told = SETTINGS[case]
    first = DummyVecEnv([make])
    first.reset()
    state = environments_state(first)
    assert state.lost == []
    with pytest.raises(ValueError, match=f"{told}, which its state would override; make it as .* by `set_env`"):
        restore_environments(DummyVecEnv([make_other]), state)
    restore_environments(DummyVecEnv([make]), state)


def test_settings_that_are_the_same() -> None:
    """Given or by default, and functions are the same by name; how it is drawn is the new environment's."""

    def make(**kwargs: Any) -> DummyVecEnv:
        return DummyVecEnv([lambda: TransformReward(limited(31, **kwargs), lambda reward: 2 * float(reward))])

    first, second = make(), make(g=10.0, render_mode="rgb_array")
    first.reset()
    restore_environments(second, environments_state(first))
    assert second.render_mode == "rgb_array" and second.render() is not None


class Made(Drifting):
    """Takes a setting of any kind, and writes into it where it can."""

    def __init__(self, setting: Any = ("rgb", "depth")):
        super().__init__()
        if isinstance(setting, dict):
            setting["level"] = id(self)


gym.register("Made-v0", lambda **kwargs: Made(**kwargs))

SAME: dict[str, tuple[Any, Any]] = {
    "list": (("rgb", "depth"), ["rgb", "depth"]),
    "nested": ([(1, "a"), [np.int64(2)]], ((1.0, "a"), (2,))),
    "float": (np.float64(1), 1),
    "NaN": (float("nan"), np.float32("nan")),
    "bool": (np.True_, True),
    "written dict": ({}, {}),
    "other dict": ({"a": 1}, {"b": 2}),
    "set": ({"a"}, {"b"}),
    "array": (np.zeros(3), [0, 0, 0]),
    "object": (object(), None),
}


@pytest.mark.parametrize("case", SAME)
def test_settings_that_are_the_same_or_cannot_be_compared(case: str, tmp_path: Path) -> None:
    """A file of another process writes what the same settings were in other types; some the environment has changed."""
    first, second = (DummyVecEnv([partial(gym.make, "Made-v0", setting=each)]) for each in SAME[case])
    first.reset()
    restore_environments(second, environments_state(first))
    restore_environments(first, environments_state(second))


@pytest.mark.parametrize(
    ("then", "now"), [(1, True), (True, 1), (1.0, 1.5), ("a", ["a"]), (None, 0), ((1, 2), (1,)), (["a"], ["b"])]
)
def test_plain_settings_that_differ(then: Any, now: Any) -> None:
    first, second = (DummyVecEnv([partial(gym.make, "Made-v0", setting=each)]) for each in (then, now))
    first.reset()
    with pytest.raises(
        ValueError, match=re.escape(f"with setting: {then!r}, and it was given one with setting: {now!r}")
    ):
        restore_environments(second, environments_state(first))


def test_other_environment_after_loading(tmp_path: Path) -> None:
    """What the message advises."""
    save_checkpoint(make_model(limited(31)).learn(20), tmp_path / "mine")
    with pytest.raises(ValueError, match="max_episode_steps"):
        load_checkpoint(tmp_path / "mine", limited(12), device="cpu")
    model = load_checkpoint(tmp_path / "mine", limited(31), device="cpu")
    model.set_env(limited(12))
    model.learn(30, reset_num_timesteps=False)
    assert model.replay_buffer.timeouts[20:50, 0].nonzero()[0].tolist() == [11, 23]
