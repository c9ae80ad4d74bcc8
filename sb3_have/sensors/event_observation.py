"""An event camera for any environment, from its rendering or from an image in its observation."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.checks import check_whole, describe, is_finite, parse_size, pick
from sb3_have.sensors.event_camera import EventCamera
from sb3_have.sensors.rendering import (
    COLOUR_MODES,
    Array,
    IntermediateFrames,
    Observation,
    SensorWrapper,
    check_render_mode,
    is_highway_env,
    resize,
    step_duration,
)
from sb3_have.sensors.representations import EVENT_ZERO, Representation, channels, encode_events, represent
from sb3_have.sensors.wrappers import image_fault

CAMERA_DEFAULTS: Final[Mapping[str, Any]] = {
    "threshold": 0.2,
    "threshold_sigma": 0.03,
    "mapping": "lin_log",
    "seed": 0,
}
"""
Default camera of :class:`EventObservation`: v2e's mapping of 8-bit frames, in which the step from black to one digital
number is not a flash, with v2e's contrast threshold and mismatch.
"""
# ITU-R BT.601 luma
LUMA = np.array([[0.299, 0.587, 0.114]])

FrameSource = Callable[[gym.Env[Any, Any]], "Array | Sequence[Array]"]


class EventObservation(SensorWrapper):
    """
    Adds the image of an event camera that looks at the rendering, at an image of the observation, or at the frames
    that a function returns.

    Colours become grey = 0.299 R + 0.587 G + 0.114 B, neither rounded nor clipped. With the mapping "log" (presets
    "ideal" and "carla") the camera sees grey / 255, as CARLA's event camera does; with "lin_log" (the default and
    preset "noisy") and "identity" it sees 0..255.

    Brightness is taken as linear in time between two frames, so more frames per step give better time stamps. All
    frames since the previous step are used where there are several: highway-env's top view renders each of its
    simulation steps, the render modes ``..._list`` and a function may return a list. In any environment,
    ``RepeatAction(RenderCollection(env), n)`` (both of Gymnasium) gives n frames per step.

    The first image of an episode has no events (all 128). ``reset(seed=...)`` seeds the noise. Thresholds and other
    properties of the chip are fixed by the camera's own ``seed``.

    :param env: Any environment. A process that has rendered MuJoCo must not be forked, see
        :mod:`sb3_have.sensors.rendering`. highway-env renders nothing with SDL_VIDEODRIVER=dummy.
    :param source: ``"render"``. Or a key of the observation, a uint8 image (H, W, 3), (H, W, 1) or (H, W). Or a
        ``function(env)``, called after every reset and step, that returns a frame or a list of frames, oldest first,
        equally spaced in time up to now. A frame is a uint8 image as above, or a float array (H, W) of intensities
        >= 0, which reaches the camera unchanged. Its scale must suit the mapping: 0..255 for "lin_log" (a change from
        0 to 1 is less than one threshold), linear light with white at about 1 for "log", the unit of the threshold for
        "identity".
    :param bins: Number of time slices per step, as in :func:`~sb3_have.sensors.stack_by_time`.
    :param representation: ``"sbt"``, ``"voxel"``, ``"count"``, ``"polarity"`` or ``"time_surface"``, see
        :func:`~sb3_have.sensors.represent`; the image has ``channels(representation, bins)`` channels.
    :param camera: Parameters of :class:`~sb3_have.sensors.EventCamera` that override :data:`CAMERA_DEFAULTS`, or the
        preset named by ``"preset"`` among them. Or the name of a preset. Or a camera of the right size, which is
        copied.
    :param image_size: Rows and columns of the camera in pixels, one number for both or a pair. Each pixel sees the mean
        of the area that it covers. By default the size of the frames; unless the source is a key or MuJoCo's rendering,
        the environment is reset once to find it out. A function needs it in a MuJoCo environment.
    :param key: Key of the event image.
    :param dt: Duration of a step in seconds; in the render modes ``..._list``, of a frame. By default that of the
        environment (:func:`~sb3_have.sensors.rendering.step_duration`). With an action repeat between the environment
        and this wrapper, and no list, give the duration of all repetitions.
    :param tau: Time constant of a time surface in seconds, one step by default. The surface always holds the events of
        the current step only.
    :raises ValueError: If the render mode, the source or an option does not fit, if the key already exists, or if the
        environment does not state how long a step takes.
    :raises KeyError: If the observation has no key ``source``.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        source: str | FrameSource = "render",
        bins: int = 5,
        representation: Representation = "sbt",
        camera: Mapping[str, Any] | str | EventCamera | None = None,
        image_size: int | tuple[int, int] | None = None,
        key: str = "event",
        dt: float | None = None,
        tau: float | None = None,
    ) -> None:
        camera = copy.deepcopy(dict(camera) if isinstance(camera, Mapping) else camera)
        # No deep copies, because a function may be a method of the environment
        gym.utils.RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,
            source=source,
            bins=bins,
            representation=representation,
            camera=camera,
            image_size=image_size,
            key=key,
            dt=dt,
            tau=tau,
        )
        SensorWrapper.__init__(self, env, key)
        self.source, self.bins, self.representation, self.tau = source, bins, representation, tau
        check_whole("bins", bins, 1)
        if dt is not None and not (is_finite(dt) and dt > 0):
            raise ValueError(f"dt must be a finite number of seconds > 0, got {dt!r}")
        if dt is None and step_duration(env) is None:
            raise ValueError(
                'the environment does not state how long a step takes: it has no dt and no metadata["render_fps"]; '
                "pass dt=<seconds>"
            )
        self._dt = dt
        self._intermediate = IntermediateFrames(env.unwrapped) if source == "render" and is_highway_env(env) else None
        height, width = self.image_size = self._check_source(parse_size(image_size))
        self.camera = make_camera(camera, height, width)
        # Seconds since the reset
        self.time = 0.0
        self._scale_known = False
        # Check the options now instead of at the first step
        represent(np.empty(0, np.int64), np.empty(0), np.empty(0), bins, 0, 1, height, width, representation, tau)
        self._add_space(height, width, channels(representation, bins))

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Step the environment and read the sensor."""
        if self._intermediate is None:
            return super().step(action)
        with self._intermediate:
            return super().step(action)

    def sense(self, observation: Observation, start: bool) -> NDArray[np.uint8]:
        """Return the events since the previous step, uint8 (H, W, channels)."""
        frames = [self._intensity(frame) for frame in self._frames(observation)]
        if start:
            self.camera.reset()
            self.camera.detect(frames[-1], 0.0)
            self.time = 0.0
            return np.full((*self.image_size, channels(self.representation, self.bins)), EVENT_ZERO, np.uint8)
        begin = self.time
        times = np.linspace(begin, begin + self._duration(len(frames)), len(frames) + 1)[1:]
        parts = []
        for frame, t in zip(frames, times, strict=True):
            parts.append(self.camera.detect(frame, float(t), self._rng))
            # Keep up with the camera even if it refuses the next frame
            self.time = float(t)
        pixel, time, polarity = (np.concatenate(part) for part in zip(*parts, strict=True))
        image = represent(
            pixel, time, polarity, self.bins, begin, self.time, *self.image_size, self.representation, self.tau
        )
        return encode_events(image, self.representation)

    def _frames(self, observation: Observation) -> Sequence[Array]:
        """Frames since the previous step, oldest first; after a reset only the last one counts."""
        if self.source == "render":
            between = [] if self._intermediate is None else self._intermediate.frames
            return [*between, *self.look().colour]
        seen = observation[self.source] if isinstance(self.source, str) else self.source(self.env)
        frames = [seen] if isinstance(seen, np.ndarray) else seen
        if not isinstance(frames, Sequence) or not frames:
            raise ValueError(f"EventObservation: source(env) must return a frame or a list of frames, got {frames!r}")
        for frame in frames:
            if not isinstance(frame, np.ndarray) or not _is_frame(frame.shape, frame.dtype):
                raise ValueError(
                    "EventObservation: a frame must be uint8 (H, W, 3), (H, W, 1) or (H, W), or float (H, W), got "
                    f"{describe(frame)}"
                )
        return frames

    def _intensity(self, frame: Array) -> Array:
        """Intensity that the camera is exposed to, float (H, W)."""
        if frame.dtype.kind == "f":
            self._check_scale(frame)
            return resize(frame.astype(np.float64), self.image_size)
        grey: Array = frame.astype(np.float64)
        if frame.ndim == 3 and frame.shape[2] == 3:
            grey = cv2.transform(grey, LUMA)
        grey = resize(grey.reshape(frame.shape[:2]), self.image_size)
        return grey / 255 if self.camera.mapping == "log" else grey

    def _check_scale(self, frame: Array) -> None:
        """Warn once if the first float frame that is not black is in 0..1 where 0..255 is expected."""
        if self._scale_known or self.camera.mapping != "lin_log" or not frame.max(initial=0) > 0:
            return
        self._scale_known = True
        if frame.max() <= 1:
            gym.logger.warn(
                f"EventObservation: float frames only reach {frame.max():.3g}, but mapping 'lin_log' expects 0..255, "
                "so there will be hardly any events. Multiply them by 255, or use camera='ideal' for frames in 0..1"
            )

    def _duration(self, frames: int) -> float:
        """Duration of a step in seconds."""
        dt = self._dt if self._dt is not None else step_duration(self.env)
        assert dt is not None
        in_list = self.source == "render" and str(self.env.render_mode).endswith("_list")
        return dt * frames if in_list else dt

    def _check_source(self, size: tuple[int, int] | None) -> tuple[int, int]:
        """Rows and columns of the camera."""
        if self.source == "render":
            check_render_mode(self.env, COLOUR_MODES, self.class_name())
            return size or self._rendered_size()
        if callable(self.source):
            return size or self._first_size(lambda: self._frames({})[-1])
        space = pick(self.inner_spaces, self.source, self.class_name())
        fits = isinstance(space, spaces.Box) and space.dtype == np.uint8 and _is_frame(space.shape, space.dtype)
        if not fits or (space.low != 0).any() or (space.high != 255).any():
            shape = space.shape or ()
            convertible = image_fault(space) is None and (len(shape) == 2 or min(shape) in (1, 3))
            remedy = "ChannelLastImages" if convertible else "gymnasium.wrappers.TransformObservation"
            raise ValueError(
                f"EventObservation: {self.source!r} must be a uint8 image (H, W, 3), (H, W, 1) or (H, W) in 0..255, "
                f"got {space}; convert it first with {remedy}"
            )
        return size or (space.shape[0], space.shape[1])


def make_camera(camera: Mapping[str, Any] | str | EventCamera | None, height: int, width: int) -> EventCamera:
    """
    Create the camera of an :class:`EventObservation`.

    :param camera: As there.
    :param height: Rows in pixels.
    :param width: Columns in pixels.
    :raises ValueError: If a camera has another size, or if a preset or a value is wrong.
    """
    if isinstance(camera, EventCamera):
        if (camera.height, camera.width) != (height, width):
            raise ValueError(
                f"the camera has {camera.height} x {camera.width} pixels, the image {height} x {width}; pass "
                f"image_size=({camera.height}, {camera.width})"
            )
        return copy.deepcopy(camera)
    options: dict[str, Any] = {"preset": camera} if isinstance(camera, str) else dict(camera or {})
    preset = options.pop("preset", None)
    if preset is None:
        return EventCamera(height, width, **{**CAMERA_DEFAULTS, **options})
    return EventCamera.preset(preset, height, width, **{"seed": 0, **options})


def _is_frame(shape: tuple[int, ...], dtype: Any) -> bool:
    if dtype == np.uint8:
        return len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3))
    return len(shape) == 2 and np.dtype(dtype).kind == "f"
