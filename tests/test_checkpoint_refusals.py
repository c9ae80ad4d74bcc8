"""What checkpoints refuse, and what they leave alone."""

import fcntl
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from resuming import Drifting, assert_same, everything
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_have.checkpoint import (
    ResumableCheckpointCallback,
    checkpoints,
    load_checkpoint,
    save_checkpoint,
)
from sb3_have.checkpoint import callback as callback_module
from sb3_have.checkpoint.files import locked
from sb3_have.checkpoint.random_state import random_states, set_random_states


def make_model(env: Any = None, algorithm: Any = SAC, **kwargs: Any) -> Any:
    defaults: dict[str, Any] = {"buffer_size": 60, "learning_starts": 8, "batch_size": 8, "seed": 0, "device": "cpu"}
    policy_kwargs = {"net_arch": [8]}
    return algorithm("MlpPolicy", env or Drifting(), policy_kwargs=policy_kwargs, **{**defaults, **kwargs})


def test_folder_of_another_training(tmp_path: Path) -> None:
    """`load_checkpoint` would load its checkpoints."""
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
    with pytest.raises(ValueError, match=r"checkpoint-20 is later than this training, which has 0 steps"):
        model.learn(10, callback)
    model.num_timesteps = 20
    model.learn(10, callback, reset_num_timesteps=False)
    assert checkpoints(tmp_path)[-1].name == "checkpoint-30"


def test_damaged_later_checkpoints_are_ignored(tmp_path: Path) -> None:
    (tmp_path / "checkpoint-20").write_bytes(b"damaged")
    make_model().learn(9, ResumableCheckpointCallback(tmp_path, 10))
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-9", "checkpoint-20"]
    with pytest.raises(ValueError, match="checkpoint-9 is later than this training, which has 0 steps"):
        make_model().learn(9, ResumableCheckpointCallback(tmp_path, 10))


class Fails(BaseCallback):
    def _on_step(self) -> bool:
        raise ZeroDivisionError


class Watches(BaseCallback):
    """Asserts that no other process could train in the folder."""

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
    monkeypatch.setattr(callback_module, "locked", lambda folder: locked(folder, patience=0.0))
    callback = ResumableCheckpointCallback(tmp_path, 10)
    with (tmp_path / ".lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        (tmp_path / "checkpoint-20").write_bytes(b"unfinished, of the other process")
        with pytest.raises(BlockingIOError, match="another process is using"):
            make_model().learn(9, callback)
    with pytest.raises(ZeroDivisionError):
        make_model().learn(9, [callback, Fails()])
    # Run the cell of a notebook again
    make_model().learn(9, [callback, Watches(tmp_path)])
    take(tmp_path)
    with pytest.raises(ValueError, match="checkpoint-9 is later"):
        make_model().learn(9, callback)
    take(tmp_path)


def test_on_policy_algorithm(tmp_path: Path) -> None:
    model = PPO("MlpPolicy", Drifting(), n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(TypeError, match="PPO is on-policy, and checkpoints are for off-policy algorithms; use SB3's"):
        model.learn(8, ResumableCheckpointCallback(tmp_path, 8))


def test_cuda_is_not_initialized(monkeypatch: pytest.MonkeyPatch) -> None:
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
    """Each begins by resetting it, and so does one after loading."""

    def make_env() -> DummyVecEnv:
        return DummyVecEnv([lambda: Monitor(Drifting(100))] * n_envs)

    model = make_model(make_env(), TD3, action_noise=noise()).learn(20)
    save_checkpoint(model, tmp_path / "mine")
    save_checkpoint(load_checkpoint(tmp_path / "mine", make_env()), tmp_path / "copy")
    expected = everything(model.learn(20, reset_num_timesteps=False))
    again = load_checkpoint(tmp_path / "copy", make_env(), device="cpu").learn(20, reset_num_timesteps=False)
    assert_same(everything(again), expected)
