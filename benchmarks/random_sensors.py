"""Random images in the shapes of a driving agent's sensors, wrapped as SB3 does, to measure speed with."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecTransposeImage

# Colour camera, event camera (time bins), depth camera and two more colour cameras
CHANNELS = {"rgb": 3, "event": 5, "depth": 1, "left": 3, "right": 3}
Images = dict[str, NDArray[np.uint8]]


class RandomSensors(gym.Env[Any, NDArray[np.float32]]):
    """
    Random images and rewards; episodes are truncated after a fixed number of steps.

    :param channels: Channels of each observation key.
    :param image_size: Height and width in pixels.
    :param episode_length: Steps per episode.
    :param seed: Seed of the generator.
    """

    def __init__(self, channels: Mapping[str, int], image_size: int, episode_length: int = 100, seed: int = 0):
        self.shapes = {key: (image_size, image_size, count) for key, count in channels.items()}
        self.observation_space = spaces.Dict(
            {key: spaces.Box(0, 255, shape, np.uint8) for key, shape in self.shapes.items()}
        )
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.episode_length = episode_length
        self.rng = np.random.default_rng(seed)

    def observe(self) -> Images:
        return {key: self.rng.integers(256, size=shape, dtype=np.uint8) for key, shape in self.shapes.items()}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Images, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[Images, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self.observe(), float(self.rng.normal()), False, self.steps == self.episode_length, {}


def make_env(
    channels: Mapping[str, int], image_size: int, n_stack: int = 3, episode_length: int = 100, n_envs: int = 1
) -> VecEnv:
    """The observations of SB3's agents: stacked frames (zeros after a reset), channels first."""

    def make(seed: int) -> RandomSensors:
        return RandomSensors(channels, image_size, episode_length, seed)

    env = DummyVecEnv([lambda seed=seed: make(seed) for seed in range(n_envs)])  # type: ignore[misc]
    return VecTransposeImage(VecFrameStack(env, n_stack))


def transitions(env: VecEnv, steps: int, seed: int = 0) -> Iterator[tuple[Any, ...]]:
    """Arguments of ``ReplayBuffer.add``, as SB3's agents pass them, for ``steps`` random actions."""
    rng = np.random.default_rng(seed)
    observations = env.reset()
    assert isinstance(observations, dict)
    for _ in range(steps):
        actions = rng.uniform(-1, 1, (env.num_envs, 2)).astype(np.float32)
        next_observations, rewards, dones, infos = env.step(actions)
        assert isinstance(next_observations, dict)
        last = copy.deepcopy(next_observations)  # keeps the strides of the transposed view, as SB3 does
        for index in np.flatnonzero(dones):
            for key, value in infos[index]["terminal_observation"].items():
                last[key][index] = value
        yield observations, last, actions, rewards, dones, infos
        observations = next_observations
