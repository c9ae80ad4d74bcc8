"""Small environments and helpers for the tests of HAVESAC: random observations of any space, known dynamics."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_have import HAVESAC

IMAGE_SIZE = 36


def image(channels: int, size: int = IMAGE_SIZE) -> spaces.Box:
    return spaces.Box(0, 255, (size, size, channels), np.uint8)


def vector(size: int) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (size,), np.float32)


def sensors_space() -> spaces.Dict:
    """Images and a vector mixed; the event key holds signed counts."""
    return spaces.Dict({"rgb": image(3), "event": image(5), "state": vector(4)})


def vectors_space(n_modalities: int = 2) -> spaces.Dict:
    """Vectors "a", "b", ... of different sizes."""
    return spaces.Dict({name: vector(2 + size) for size, name in enumerate("abcd"[:n_modalities])})


class RandomSensors(gym.Env[Any, np.ndarray]):
    """
    Observations drawn from ``space``; the reward falls with the squared action; an episode has ``length`` steps.

    :param space: observation space
    :param length: steps of an episode
    :param timeout: whether it ends by truncation rather than by termination
    :param action_dim: A
    """

    def __init__(self, space: spaces.Space[Any], length: int = 10, timeout: bool = False, action_dim: int = 2):
        self.observation_space = space
        self.action_space = spaces.Box(-1.0, 1.0, (action_dim,), np.float32)
        self.length, self.timeout = length, timeout

    def observe(self) -> Any:
        return self.observation_space.sample()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        over = self.steps == self.length
        return self.observe(), -float(np.square(action).sum()), over and not self.timeout, over and self.timeout, {}


TINY: dict[str, Any] = {"features_dim": 8, "net_arch": [16], "precision": "float32"}


def tiny_model(space: spaces.Space[Any], policy_kwargs: dict[str, Any] | None = None, **kwargs: Any) -> HAVESAC:
    """A small model on :class:`RandomSensors` whose replay buffer is still empty."""
    defaults: dict[str, Any] = {"buffer_size": 200, "learning_starts": 8, "batch_size": 8, "seed": 0, "device": "cpu"}
    env = kwargs.pop("env", None) or RandomSensors(space)
    return HAVESAC("MultiInputPolicy", env, policy_kwargs={**TINY, **(policy_kwargs or {})}, **{**defaults, **kwargs})


def fill_buffer(model: HAVESAC, n_transitions: int, seed: int = 0) -> None:
    """Random transitions into the replay buffer, one in five a termination, and a quiet logger: ready for ``train``."""
    rng = np.random.default_rng(seed)
    space = model.observation_space
    space.seed(seed)
    model.set_logger(quiet_logger())
    assert model.replay_buffer is not None
    for _ in range(n_transitions):
        observation, next_observation = batched(space.sample()), batched(space.sample())
        action = rng.uniform(-1, 1, (1, *model.action_space.shape)).astype(np.float32)  # type: ignore[misc]
        done = np.array([rng.uniform() < 0.2])
        model.replay_buffer.add(observation, next_observation, action, rng.normal(size=1), done, [{}])


def batched(observation: Any) -> Any:
    """One observation with a batch dimension."""
    if isinstance(observation, dict):
        return {key: value[None] for key, value in observation.items()}
    return observation[None]


def quiet_logger() -> Logger:
    return Logger(folder=None, output_formats=[])


class FixedBatch(DictReplayBuffer):
    """A replay buffer that always gives the batch ``model.replay_buffer.batch``."""

    batch: DictReplayBufferSamples

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> DictReplayBufferSamples:  # type: ignore[override]
        return self.batch


def clone_parameters(module: th.nn.Module) -> dict[str, th.Tensor]:
    return {name: parameter.detach().clone() for name, parameter in module.named_parameters()}


def changed(before: dict[str, th.Tensor], module: th.nn.Module) -> set[str]:
    """Names of the parameters of ``module`` that differ from ``before``."""
    return {name for name, parameter in module.named_parameters() if not th.equal(before[name], parameter)}
