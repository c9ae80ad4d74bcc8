"""
Sensors that look at what an environment renders. Any number of them share one rendering per step.

MuJoCo: a process that has rendered with MuJoCo must not be forked, because its children hang at their first rendering.
These wrappers do not render MuJoCo when they are created. If the parent process has rendered, start the workers with
``AsyncVectorEnv(..., context="spawn")`` or ``SubprocVecEnv(..., start_method="forkserver")`` (the default).
"""

from __future__ import annotations

import copy
import zlib
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, NamedTuple

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.checks import describe, is_number, parse_size

Array = NDArray[Any]
Observation = dict[str, Any]

# Key of the original observation if it is not a Dict
STATE = "state"
# Render modes that show colours, and those that show depth; Gymnasium's RenderCollection returns the lists
COLOUR_MODES = ("rgb_array", "rgbd_tuple", "rgb_array_list", "rgbd_tuple_list")
DEPTH_MODES = ("depth_array", "rgbd_tuple", "depth_array_list", "rgbd_tuple_list")


class Frames(NamedTuple):
    """Frames rendered since the previous step, oldest first; the last of each list is the current one."""

    colour: list[Array]
    depth: list[Array]


class SensorWrapper(gym.Wrapper[Observation, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """
    Base class of the wrappers that add an image to the observation.

    A Dict observation gets one more key. Any other observation becomes a Dict with the keys ``"state"`` and ``key``.

    The environment is rendered once per step, however many sensors it has: until the next step or reset, ``render()``
    returns a copy of the rendering that the observation was made from.

    :param env: Environment to wrap.
    :param key: Key of the image.
    :param replaces: Existing key that the image may replace.
    :raises ValueError: If the key already exists.
    """

    def __init__(self, env: gym.Env[Any, Any], key: str, replaces: str | None = None) -> None:
        gym.Wrapper.__init__(self, env)
        space = env.observation_space
        # Spaces of the wrapped environment by key
        self.inner_spaces: dict[str, spaces.Space[Any]] = (
            dict(space.spaces) if isinstance(space, spaces.Dict) else {STATE: space}
        )
        if key in self.inner_spaces and key != replaces:
            raise ValueError(
                f"{self.class_name()}: the observation already has the key {key!r}, among {list(self.inner_spaces)}; "
                "choose another with key=..."
            )
        self.key = key
        # The sensor's own generator, so that the environment behaves the same with and without the sensor
        self._rng = np.random.default_rng()
        self._rendered: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Reset the environment and the sensor; the seed is also that of the sensor's noise."""
        if seed is not None:
            self._rng = np.random.default_rng((seed, zlib.crc32(self.key.encode())))
        self._rendered = None
        observation, info = self.env.reset(seed=seed, options=options)
        return self._extend(observation, start=True), info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Step the environment and read the sensor."""
        self._rendered = None
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._extend(observation, start=False), reward, terminated, truncated, info

    def render(self) -> Any:
        """Render the environment, or return a copy of what the sensor has already rendered in this step."""
        return self.env.render() if self._rendered is None else copy.deepcopy(self._rendered)

    def sense(self, observation: Observation, start: bool) -> Array:
        """
        Return the image of this sensor.

        :param observation: Observation of the wrapped environment as a dict.
        :param start: Whether an episode begins.
        """
        raise NotImplementedError

    def look(self) -> Frames:
        """Render the environment and sort the frames into colour and depth."""
        self._rendered = self.env.render()
        viewer = getattr(self.env.unwrapped, "viewer", None)
        if is_highway_env(self.env) and getattr(viewer, "enabled", None) is False:
            raise ValueError(
                f"{self.class_name()}: highway-env renders only black frames with SDL_VIDEODRIVER=dummy; unset it, or "
                "set it to 'offscreen', before creating the environment"
            )
        return sort_frames(str(self.env.render_mode), self._rendered)

    def _extend(self, observation: Any, start: bool) -> Observation:
        inner = dict(observation) if isinstance(self.env.observation_space, spaces.Dict) else {STATE: observation}
        return {**inner, self.key: self.sense(inner, start)}

    def _add_space(self, height: int, width: int, channels: int) -> None:
        inner = self.env.observation_space
        image = spaces.Box(0, 255, (height, width, channels), np.uint8)
        self.observation_space = spaces.Dict(
            {**self.inner_spaces, self.key: image},
            sort_keys=inner.sort_keys if isinstance(inner, spaces.Dict) else True,
        )

    def _rendered_size(self) -> tuple[int, int]:
        """Rows and columns of the rendering. Only MuJoCo's are known without rendering a first frame."""
        renderer = getattr(self.env.unwrapped, "mujoco_renderer", None)
        if renderer is not None:
            return int(renderer.height), int(renderer.width)

        def see() -> Array:
            frames = self.look()
            return (frames.colour or frames.depth)[-1]

        return self._first_size(see)

    def _first_size(self, see: Callable[[], Array]) -> tuple[int, int]:
        """Rows and columns of a first image, for which the environment is reset."""
        if hasattr(self.env.unwrapped, "mujoco_renderer"):
            # AsyncVectorEnv creates one environment in the parent process and then forks
            raise ValueError(
                f"{self.class_name()}: a function as source needs image_size= in a MuJoCo environment, because a "
                "process that has rendered MuJoCo cannot be forked"
            )
        self.env.reset()
        height, width = see().shape[:2]
        self._rendered = None
        return height, width


class RenderObservation(SensorWrapper):
    """
    Adds the rendering to the observation, as a uint8 (H, W, 3) image.

    Unlike ``gymnasium.wrappers.AddRenderObservation`` it can resize the rendering, shares it with the other sensors,
    and accepts render modes with depth and lists of frames.

    :param env: Environment with ``render_mode="rgb_array"``, or ``"rgbd_tuple"`` to get depth from the same rendering.
    :param key: Key of the image.
    :param image_size: Rows and columns in pixels, one number for both or a pair. Each pixel is the mean of the area
        that it covers. By default the size of the rendering; unless that is MuJoCo's, the environment is reset once to
        find it out.
    :raises ValueError: If the render mode does not show colours or the key already exists.
    """

    def __init__(
        self, env: gym.Env[Any, Any], key: str = "rgb", image_size: int | tuple[int, int] | None = None
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, key=key, image_size=image_size)
        SensorWrapper.__init__(self, env, key)
        check_render_mode(env, COLOUR_MODES, self.class_name())
        self.image_size = parse_size(image_size) or self._rendered_size()
        self._add_space(*self.image_size, 3)

    def sense(self, observation: Observation, start: bool) -> NDArray[np.uint8]:
        """Return the latest frame, uint8 (H, W, 3)."""
        # Copy, because other sensors use the same rendering
        return np.array(resize(self.look().colour[-1], self.image_size), order="C")


class IntermediateFrames:
    """
    Collects the frames that highway-env renders between two decisions.

    highway-env passes these frames to its ``RecordVideo`` wrapper. Inside a ``with`` block this object takes the place
    of the recorder, and forwards the frames to it.

    :param env: Unwrapped environment of highway-env.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._recorder: Any = None
        self.frames: list[Array] = []

    def __enter__(self) -> None:
        self._recorder, self._env._record_video_wrapper = self._env._record_video_wrapper, self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._env._record_video_wrapper = self._recorder
        self.frames = []

    def _capture_frame(self) -> None:
        self.frames.append(self._env.render())
        if self._recorder is not None:
            self._recorder._capture_frame()


def is_highway_env(env: gym.Env[Any, Any]) -> bool:
    """Check for an environment of highway-env, by what :class:`IntermediateFrames` relies on."""
    return hasattr(env.unwrapped, "set_record_video_wrapper") and hasattr(env.unwrapped, "_record_video_wrapper")


def step_duration(env: gym.Env[Any, Any]) -> float | None:
    """
    Return the duration of a step in seconds.

    This is highway-env's decision interval, else the attribute ``dt`` of the environment, else
    1 / ``metadata["render_fps"]``. The frame rate comes last because it is that of a video, which need not run in real
    time: Pendulum's and highway-env's do not.

    :param env: Environment, wrapped or not.
    :return: Seconds; None if the environment states none of them.
    """
    if is_highway_env(env):
        return 1 / float(env.unwrapped.config["policy_frequency"])  # type: ignore[attr-defined]
    dt: Any = getattr(env.unwrapped, "dt", None)
    rate = env.metadata.get("render_fps")
    if is_number(dt) and 0 < dt < np.inf:
        return float(dt)
    return 1 / float(rate) if rate else None


def check_render_mode(env: gym.Env[Any, Any], modes: Sequence[str], wrapper: str) -> None:
    """
    Check the render mode of an environment.

    :param env: Environment to check.
    :param modes: Render modes that the wrapper accepts.
    :param wrapper: Name of the wrapper, for the message.
    :raises ValueError: If the environment was created with another mode; the message lists what it offers.
    """
    if env.render_mode in modes:
        return
    available = env.metadata.get("render_modes", [])
    offered = [mode for mode in available if mode in modes]
    remedy = (
        f"pass render_mode={offered[0]!r} to gym.make"
        if offered
        else f"this environment only offers {available}: use an observation key or a function as source"
    )
    raise ValueError(f"{wrapper} needs render_mode {' or '.join(modes[:2])}, got {env.render_mode!r}; {remedy}")


def sort_frames(mode: str, rendered: Any) -> Frames:
    """
    Sort what ``render()`` returned into colour and depth frames.

    :param mode: Render mode, one of :data:`COLOUR_MODES` or :data:`DEPTH_MODES`.
    :param rendered: Return value of ``render()``.
    :raises ValueError: If there is no frame, or if a frame has the wrong shape or dtype.
    """
    frames = list(rendered or ()) if mode.endswith("_list") else [rendered]
    if not frames:
        raise ValueError(f"render() in mode {mode!r} returned no frame; is it also called elsewhere between two steps?")
    if mode.startswith("rgbd"):
        colour, depth = ([frame[i] for frame in frames] for i in (0, 1))
    else:
        colour, depth = (frames, []) if mode.startswith("rgb") else ([], frames)
    for frame in colour:
        if not isinstance(frame, np.ndarray) or frame.shape[2:] != (3,) or frame.dtype != np.uint8:
            raise ValueError(f"render() in mode {mode!r} must return uint8 (H, W, 3), got {describe(frame)}")
    for frame in depth:
        if not isinstance(frame, np.ndarray) or frame.ndim != 2 or frame.dtype.kind != "f":
            raise ValueError(f"render() in mode {mode!r} must return float depth (H, W), got {describe(frame)}")
    return Frames(colour, depth)


def resize(image: Array, size: tuple[int, int], interpolation: int = cv2.INTER_AREA) -> Array:
    """Resize an image (H, W) or (H, W, C) to these rows and columns; its channels stay."""
    if image.shape[:2] == size:
        return image
    return cv2.resize(np.ascontiguousarray(image), size[::-1], interpolation=interpolation)
