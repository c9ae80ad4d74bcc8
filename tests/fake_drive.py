"""A small stand-in for HighwayVision-v0: two image modalities, fast, and known in advance."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import register

ENV_ID = "fake_drive:FakeDrive-v0"

#: A short training of a small model on it.
CONFIG: dict[str, Any] = {
    "n_timesteps": 100,
    "frame_stack": 2,
    "env_kwargs": {"weather": "fast"},
    "policy": "MultiInputPolicy",
    "buffer_size": 50,
    "batch_size": 4,
    "learning_starts": 5,
    "policy_kwargs": {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}},
}


class FakeDrive(gym.Env[Any, np.ndarray]):
    """Drives ``seed % 5 + 4`` steps; return and distance follow from the weather, the seed and the throttle.

    :param weather: "slow" (1 m a step) or any other (2 m a step)
    :param image_size: [px]
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(self, weather: str = "slow", image_size: int = 36, render_mode: str | None = None) -> None:
        self.metres = 1.0 if weather == "slow" else 2.0
        self.weather, self.image_size, self.render_mode = weather, image_size, render_mode
        self.shapes = {key: (image_size, image_size, channels) for key, channels in {"rgb": 3, "depth": 1}.items()}
        self.observation_space = spaces.Dict({key: spaces.Box(0, 255, s, np.uint8) for key, s in self.shapes.items()})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _observe(self) -> dict[str, np.ndarray]:
        value = 10 * self.steps + self.length
        return {key: np.full(shape, value, np.uint8) for key, shape in self.shapes.items()}

    def _info(self) -> dict[str, Any]:
        return {"distance": self.steps * self.metres, "speed": 5.0 * self.steps, "crashed": False, "offroad": False}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        self.length = 4 + (int(self.np_random.integers(5)) if seed is None else seed % 5)
        self.steps = 0
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        self.steps += 1
        info = self._info()
        done = self.steps == self.length
        info["crashed"] = done and self.length == 8
        return self._observe(), self.metres + float(action[0]), done, False, info

    def render(self) -> np.ndarray:
        return np.full((self.image_size, 2 * self.image_size, 3), 20 * self.steps, np.uint8)


register(id="FakeDrive-v0", entry_point="fake_drive:FakeDrive")
