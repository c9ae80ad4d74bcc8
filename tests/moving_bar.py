"""An environment that renders a bar moving over a grey ground, in every render mode and at a known distance."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import register
from numpy.typing import NDArray

Array = NDArray[Any]
HEIGHT, WIDTH, LENGTH = 36, 40, 12


def picture(step: int, brightness: int = 200) -> Array:
    """A bar four pixels wide that goes two to the right in every step."""
    frame = np.full((HEIGHT, WIDTH, 3), (40, 60, 80), np.uint8)
    frame[:, 2 * step : 2 * step + 4] = brightness
    return frame


def metres(step: int) -> Array:
    """The bar stands 5 m away, half of the ground 20 m, and beyond the other half there is nothing."""
    depth = np.full((HEIGHT, WIDTH), 20.0, np.float32)
    depth[: HEIGHT // 2] = np.inf
    depth[:, 2 * step : 2 * step + 4] = 5.0
    return depth


def frame_now(env: Any) -> Array:
    """What a :class:`MovingBar` shows, for a wrapper whose source is a function."""
    return picture(env.unwrapped.steps)


def metres_now(env: Any) -> Array:
    return metres(env.unwrapped.steps)


class MovingBar(gym.Env[Any, Any]):
    """
    :param render_mode: As in gymnasium; a list holds the frame of every step since the last call.
    :param observation: "state" (a vector), "dict" (with channel-last images and metres) or a Box for random samples.
    :param brightness: Of the bar.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array", "rgb_array_list", "depth_array", "rgbd_tuple"],
        "render_fps": 10,
    }

    def __init__(
        self, render_mode: str | None = None, observation: str | spaces.Box = "state", brightness: int = 200
    ) -> None:
        self.render_mode, self.brightness = render_mode, brightness
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        vector = spaces.Box(0.0, float(LENGTH), (2,), np.float32)
        self.kind = observation
        self.observation_space = vector
        if isinstance(observation, spaces.Box):
            self.observation_space = observation
        elif observation == "dict":
            self.observation_space = spaces.Dict(
                {
                    "position": vector,
                    "camera": spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
                    "grey": spaces.Box(0, 255, (HEIGHT, WIDTH), np.uint8),
                    "lidar": spaces.Box(0.0, np.inf, (HEIGHT, WIDTH, 1), np.float32),
                }
            )
        self.steps = 0
        self.renderings = 0
        self._list: list[Any] = []

    def observe(self) -> Any:
        if isinstance(self.kind, spaces.Box):
            return self.observation_space.sample()
        vector = np.full(2, self.steps, np.float32)
        if self.kind == "state":
            return vector
        frame = picture(self.steps, self.brightness)
        return {
            "position": vector,
            "camera": frame,
            "grey": frame[..., 1].copy(),
            "lidar": metres(self.steps)[..., None],
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        self._list = [picture(0, self.brightness)]
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self._list.append(picture(self.steps, self.brightness))
        return self.observe(), 1.0, False, self.steps == LENGTH, {}

    def render(self) -> Any:
        self.renderings += 1
        frame, depth = picture(self.steps, self.brightness), metres(self.steps)
        if self.render_mode == "rgb_array_list":
            frames, self._list = self._list, []
            return frames
        return {"rgb_array": frame, "depth_array": depth, "rgbd_tuple": (frame, depth)}.get(str(self.render_mode))


class Timeless(MovingBar):
    """Says nothing of time."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012


if "MovingBar-v0" not in gym.registry:
    register("MovingBar-v0", f"{__name__}:MovingBar")


def actions(n: int = LENGTH) -> list[Array]:
    return [np.zeros(2, np.float32)] * n


def episode(env: gym.Env[Any, Any], steps: int = 6, seed: int | None = 0) -> list[Any]:
    """Observations of the reset and of the steps after it."""
    observations = [env.reset(seed=seed)[0]]
    observations += [env.step(action)[0] for action in actions(steps)]
    return observations
