"""Training that is stopped and resumed, and everything that must be the same afterwards."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_have import ModalityReplayBuffer
from sb3_have.checkpoint import ResumableCheckpointCallback, checkpoints, load_checkpoint
from sb3_have.checkpoint.random_state import random_states


def leaves(value: Any, path: str = "") -> dict[str, np.ndarray]:
    """Return all arrays and numbers in nested containers by their path."""
    if isinstance(value, dict):
        return {name: leaf for key, each in value.items() for name, leaf in leaves(each, f"{path}/{key}").items()}
    if isinstance(value, list | tuple | deque):
        return leaves(dict(enumerate(value)), path)
    return {path: value.detach().cpu().numpy().copy() if isinstance(value, th.Tensor) else np.array(value)}


def everything(model: Any) -> dict[str, np.ndarray]:
    """Return weights, optimizers, counters, replay content, normalisation, episodes and random numbers."""
    env, buffer = model.get_env(), model.replay_buffer
    content = {name: value for name, value in vars(buffer).items() if isinstance(value, np.ndarray | dict | int)}
    if isinstance(buffer, ModalityReplayBuffer):
        content["frames"] = {key: buffer.pool.gather(key, buffer.slots.ravel()) for key in buffer.pool.shapes}
    normalizer = model.get_vec_normalize_env()
    counters = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining")
    return leaves(
        {
            "parameters": model.get_parameters(),
            "log_ent_coef": getattr(model, "log_ent_coef", None),
            "coefficients": getattr(model, "auxiliary_coefs", {}),
            "counters": {name: getattr(model, name) for name in counters},
            "replay": {name: value for name, value in content.items() if name != "dtypes"},
            "last_obs": [model._last_obs, model._last_original_obs],
            "episodes": [(info["r"], info["l"]) for info in model.ep_info_buffer],
            "normalize": vars(normalizer.obs_rms) if normalizer is not None else {},
            "returns": [normalizer.returns, vars(normalizer.ret_rms)] if normalizer is not None else [],
            "running": env.get_attr("rewards"),  # Monitor's, of the episode that is not over
            "random": random_states(),
        }
    )


def assert_same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    assert first.keys() == second.keys()
    different = [name for name, value in first.items() if not np.array_equal(value, second[name])]
    assert not different


def assert_resumes(
    folder: Path,
    make_model: Callable[[VecEnv], OffPolicyAlgorithm],
    make_env: Callable[[], Any],
    stop: int,
    steps: int,
    make_callback: Callable[[], list[BaseCallback]] = list,
) -> OffPolicyAlgorithm:
    """Assert that training to ``steps`` ends the same if it is resumed from a checkpoint at ``stop``.

    :return: Model of the resumed training
    """

    def callbacks() -> list[BaseCallback]:
        return [ResumableCheckpointCallback(folder, stop, keep=9), *make_callback()]

    first_env = make_env()
    first = make_model(first_env)
    first.learn(steps, callbacks())
    expected = everything(first)
    assert first._n_updates > 0 and first.get_env() is not None
    for env in (first.get_env(), first_env):
        env.close()  # type: ignore[union-attr]

    checkpoint, *later = checkpoints(folder)
    for path in later:
        path.unlink()
    np.random.rand(7), th.rand(7)  # as another process may
    going_on = callbacks()
    second: OffPolicyAlgorithm = load_checkpoint(checkpoint, make_env(), going_on, device="cpu")
    done = second.num_timesteps
    assert stop <= done < steps and str(done) == checkpoint.name.rpartition("-")[2]
    second.learn(steps - done, going_on, reset_num_timesteps=False)
    assert_same(everything(second), expected)
    second.get_env().close()  # type: ignore[union-attr]
    return second


class Drifting(gym.Env[np.ndarray, np.ndarray]):
    """A point that drifts, and draws from every source of random numbers that an environment may draw from.

    :param length: Steps of an episode
    """

    def __init__(self, length: int = 9):
        self.observation_space = spaces.Box(-10.0, 10.0, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.length = length

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps, self.point = 0, self.np_random.normal(size=2)
        return self.point.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.point = 0.8 * self.point + 0.1 * action + 0.1 * self.np_random.normal(size=2) + 0.1 * np.random.rand()
        self.point += 0.1 * self.action_space.sample()  # the same generator as the model's, in one process
        self.point += 0.1 * random.random()
        over = self.steps == self.length
        return self.point.astype(np.float32), -float(np.square(self.point).sum()), False, over, {}
