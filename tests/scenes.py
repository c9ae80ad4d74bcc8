"""An environment of random images and vectors, and helpers for failures of its sensors."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
from envs import image, vector
from gymnasium import spaces
from numpy.typing import NDArray

Array = NDArray[Any]
Env = gym.Env[Any, Any]
SPACE = spaces.Dict({"rgb": image(3, 20), "event": image(5, 20), "depth": image(1, 20), "state": vector(6)})


class Scenes(gym.Env[Any, Any]):
    """Random images and vectors, written into the same arrays step after step as some simulators do."""

    def __init__(self, space: spaces.Space[Any] = SPACE, length: int = 12) -> None:
        self.observation_space = space
        self.action_space = spaces.Discrete(2)
        self.length = length
        self.buffers: dict[str, Array] = {
            key: np.zeros(box.shape, box.dtype) for key, box in SPACE.items() if isinstance(box, spaces.Box)
        }

    def observe(self) -> Any:
        for key, buffer in self.buffers.items():
            uniform = self.np_random.uniform(-1, 1, buffer.shape)
            buffer[...] = uniform if key == "state" else 128 + 127 * uniform
        return self.buffers if isinstance(self.observation_space, spaces.Dict) else self.buffers["rgb"]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {"own": 1}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self.observe(), 1.0, False, self.steps == self.length, {"own": 2}


class Remembers(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps a copy of what goes by, to compare with what comes out further up."""

    def reset(self, **kwargs: Any) -> Any:
        self.given, info = self.env.reset(**kwargs)
        self.seen = copy.deepcopy(self.given)
        return self.given, info

    def step(self, action: Any) -> Any:
        self.given, *rest = self.env.step(action)
        self.seen = copy.deepcopy(self.given)
        return self.given, *rest


def rollout(env: Env, steps: int = 12, seed: int | None = 0) -> tuple[list[Any], list[Any]]:
    """Observations and the truths of ``steps`` steps, a new episode whenever one is over."""
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    observations, truths = [copy.deepcopy(observation)], [info["sensor_failure"]]
    for _ in range(steps):
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            observation, info = env.reset()
        observations.append(copy.deepcopy(observation))
        truths.append(info["sensor_failure"])
    return observations, truths


def active(truths: list[Any], modality: str = "rgb", name: str = "black") -> Array:
    return np.array([truth[modality][name]["active"] for truth in truths])


def same(a: dict[str, Array], b: dict[str, Array]) -> bool:
    return all((a[key] == b[key]).all() for key in b)
