"""What an environment renders, as a sensor of its agent. Any number of sensors share one rendering a step.

MuJoCo: a process that has rendered with it must not be forked, its children hang in their first rendering. Making an
environment with these wrappers does not render MuJoCo. After a rendering in the parent, start the workers with
``AsyncVectorEnv(..., context="spawn")`` or ``SubprocVecEnv(..., start_method="forkserver")``, its default.
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

#: Key under which an observation that is no Dict appears beside the sensors.
STATE = "state"
#: Render modes that show colours, and those that show depth. gymnasium's ``RenderCollection`` makes the lists.
COLOUR_MODES = ("rgb_array", "rgbd_tuple", "rgb_array_list", "rgbd_tuple_list")
DEPTH_MODES = ("depth_array", "rgbd_tuple", "depth_array_list", "rgbd_tuple_list")


class Frames(NamedTuple):
    """What a sensor sees since the previous step, oldest first; the last of each list is now."""

    colour: list[Array]
    depth: list[Array]


class SensorWrapper(gym.Wrapper[Observation, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """
    Base of the wrappers that add one modality. A Dict observation gets one more key; any other observation becomes a
    Dict with the keys ``"state"`` and ``key``.

    The environment is rendered once a step, however many wrappers look: ``render()`` of this wrapper returns a copy of
    the rendering that the observation was made from until the next step or reset.

    :param env: Environment to wrap.
    :param key: Key of the modality.
    :param replaces: A key that the modality may take the place of.
    :raises ValueError: if the key exists already or is no string.
    """

    def __init__(self, env: gym.Env[Any, Any], key: str, replaces: str | None = None) -> None:
        gym.Wrapper.__init__(self, env)
        space = env.observation_space
        #: The spaces of the wrapped environment by key.
        self.inner_spaces: dict[str, spaces.Space[Any]] = (
            dict(space.spaces) if isinstance(space, spaces.Dict) else {STATE: space}
        )
        if not isinstance(key, str):
            raise ValueError(f"{self.class_name()}: key must be a string, got {key!r}")
        if key in self.inner_spaces and key != replaces:
            raise ValueError(
                f"{self.class_name()}: the observation has a key {key!r} already, among {list(self.inner_spaces)}; "
                "choose another with key=..."
            )
        self.key = key
        # Its own generator: an environment behaves the same with and without the sensor.
        self._rng = np.random.default_rng()
        self._rendered: Any = None
        # Rows and columns of the source, None until they are known.
        self._source_size: tuple[int, ...] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """As the environment; a seed also seeds the noise of the sensor."""
        if seed is not None:
            self._rng = np.random.default_rng((seed, zlib.crc32(self.key.encode())))
        self._rendered = None
        observation, info = self.env.reset(seed=seed, options=options)
        return self._extend(observation, start=True), info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """As the environment."""
        self._rendered = None
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._extend(observation, start=False), reward, terminated, truncated, info

    def render(self) -> Any:
        """As the environment, without rendering the same instant a second time."""
        return self.env.render() if self._rendered is None else copy.deepcopy(self._rendered)

    def sense(self, observation: Observation, start: bool) -> Array:
        """
        The image of this sensor.

        :param observation: Of the wrapped environment, as a dict.
        :param start: Whether an episode begins.
        """
        raise NotImplementedError

    def look(self) -> Frames:
        """The frames that the environment renders now, sorted and checked."""
        self._rendered = self.env.render()
        viewer = getattr(self.env.unwrapped, "viewer", None)
        if is_highway_env(self.env) and getattr(viewer, "enabled", None) is False:
            raise ValueError(
                f"{self.class_name()}: with SDL_VIDEODRIVER=dummy highway-env draws nothing and every frame is black; "
                "unset it, or set it to 'offscreen', before the environment is made"
            )
        return sort_frames(self.env.render_mode, self._rendered)

    def fit(self, image: Array, size: tuple[int, int], interpolation: int = cv2.INTER_AREA) -> Array:
        """
        An image of the source in the size of the sensor.

        :raises ValueError: if the source has another size than before.
        """
        shape = image.shape[:2]
        if self._source_size not in (None, shape):
            raise ValueError(
                f"{self.class_name()}: the source of {self.key!r} had {self._source_size} rows and columns, and now "
                f"has {shape}; its size may not change, so resize its images before this wrapper"
            )
        self._source_size = shape
        return resize(image, size, interpolation)

    def _extend(self, observation: Any, start: bool) -> Observation:
        inner = dict(observation) if isinstance(self.env.observation_space, spaces.Dict) else {STATE: observation}
        return {**inner, self.key: self.sense(inner, start)}

    def _announce(self, height: int, width: int, channels: int) -> None:
        """Put the modality into the observation space."""
        inner = self.env.observation_space
        image = spaces.Box(0, 255, (height, width, channels), np.uint8)
        self.observation_space = spaces.Dict(
            {**self.inner_spaces, self.key: image},
            sort_keys=inner.sort_keys if isinstance(inner, spaces.Dict) else True,
        )

    def _rendered_size(self, modes: Sequence[str]) -> tuple[int, int]:
        """Rows and columns of the rendering; where they cannot be known, from a first one."""
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
            # AsyncVectorEnv makes one environment in the parent and then forks.
            raise ValueError(
                f"{self.class_name()} of a MuJoCo environment needs image_size= with a function as source: to find the "
                "size it would have to render, and a process that has rendered MuJoCo cannot be forked"
            )
        self.env.reset()
        height, width = self._source_size = see().shape[:2]
        self._rendered = None
        return height, width


class RenderObservation(SensorWrapper):
    """
    Adds what the environment renders to the observation, as a colour image.

    :param env: Any environment made with ``render_mode="rgb_array"`` or, for depth from the same rendering,
        ``"rgbd_tuple"``. A process that has rendered MuJoCo must not be forked, see the top of this module.
    :param key: Key of the image.
    :param image_size: Rows and columns, one number for both or a pair. Each pixel is the mean of the area it covers.
        None keeps the rendering's own, which takes a first rendering (MuJoCo says it without): the environment is
        reset when it is wrapped, which ends an episode under way and takes a draw from its generator.
    :raises ValueError: on another render mode, a key that exists already, an impossible size, or a rendering whose
        size changes.
    """

    def __init__(
        self, env: gym.Env[Any, Any], key: str = "rgb", image_size: int | tuple[int, int] | None = None
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, key=key, image_size=image_size)
        SensorWrapper.__init__(self, env, key)
        check_render_mode(env, COLOUR_MODES, self.class_name())
        self.image_size = parse_size(image_size) or self._rendered_size(COLOUR_MODES)
        self._announce(*self.image_size, 3)

    def sense(self, observation: Observation, start: bool) -> NDArray[np.uint8]:
        """The latest frame, uint8 (H, W, 3)."""
        # A copy: other sensors look at the rendering too.
        return np.array(self.fit(self.look().colour[-1], self.image_size), order="C")


class IntermediateFrames:
    """
    The frames that highway-env renders between two decisions. It hands them to the ``RecordVideo`` that it was told
    of; inside a ``with`` block this object is in its place, and passes the word on.

    :param env: A highway-env environment, unwrapped.
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
    """Whether this is one of highway-env's environments, told by what :class:`IntermediateFrames` relies on."""
    return hasattr(env.unwrapped, "set_record_video_wrapper") and hasattr(env.unwrapped, "_record_video_wrapper")


def step_duration(env: gym.Env[Any, Any]) -> float | None:
    """
    Seconds of one step: highway-env's decision interval, else the attribute ``dt`` of the environment, else
    1 / ``metadata["render_fps"]``; None if it says nothing. (The frame rate comes last: it is that of a video, and
    Pendulum's and highway-env's do not run in real time.)
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
    :raises ValueError: unless the environment was made with one of the render modes; says which it offers.
    """
    if env.render_mode in modes:
        return
    offered = [mode for mode in env.metadata.get("render_modes", ()) if mode in modes]
    remedy = (
        f"pass render_mode={offered[0]!r} to gym.make"
        if offered
        else f"this environment offers only {env.metadata.get('render_modes', [])}: give source= a key or a function"
    )
    raise ValueError(f"{wrapper} needs render_mode {' or '.join(modes[:2])}, got {env.render_mode!r}; {remedy}")


def sort_frames(mode: str | None, rendered: Any) -> Frames:
    """
    Colour and depth frames in what ``render()`` returned.

    :param mode: The render mode, one of :data:`COLOUR_MODES` or :data:`DEPTH_MODES`.
    :param rendered: What ``render()`` returned in that mode.
    :raises ValueError: if it is not what the mode promises.
    """
    mode = str(mode)
    several = list(rendered) if mode.endswith("_list") and rendered is not None else [rendered]
    frames = Frames([], [])
    for frame in several:
        parts = dict(zip(("rgb", "depth"), frame, strict=True)) if mode.startswith("rgbd") else {mode[:3]: frame}
        for name, part in parts.items():
            colour = name == "rgb"
            fits = isinstance(part, np.ndarray) and (
                part.ndim == 3 and part.shape[2] == 3 and part.dtype == np.uint8
                if colour
                else part.ndim == 2 and part.dtype.kind == "f"
            )
            if not fits:
                wanted = "uint8 (H, W, 3)" if colour else "float (H, W)"
                raise ValueError(f"render() in mode {mode!r} should return {wanted}, got {describe(part)}")
            (frames.colour if colour else frames.depth).append(part)
    if not several:
        raise ValueError(f"render() in mode {mode!r} returned no frame; is it called elsewhere between two steps?")
    return frames


def resize(image: Array, size: tuple[int, int], interpolation: int = cv2.INTER_AREA) -> Array:
    """The image with this many (rows, columns); the channels stay."""
    if image.shape[:2] == size:
        return image
    return cv2.resize(np.ascontiguousarray(image), size[::-1], interpolation=interpolation)
