"""An event camera for any environment, from what it renders or from an image in its observation."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.checks import check_whole, describe, is_number, parse_size, pick
from sb3_have.sensors.event_camera import EventCamera
from sb3_have.sensors.rendering import (
    COLOUR_MODES,
    Array,
    IntermediateFrames,
    Observation,
    SensorWrapper,
    check_render_mode,
    is_highway_env,
    step_duration,
)
from sb3_have.sensors.representations import EVENT_ZERO, Representation, channels, encode_events, represent
from sb3_have.sensors.wrappers import image_fault

#: The camera of :class:`EventObservation` unless told otherwise: v2e's mapping of 8-bit frames, which does not take the
#: step from black to one digital number for a flash, and its contrast threshold and mismatch.
CAMERA_DEFAULTS: Final[Mapping[str, Any]] = {
    "threshold": 0.2,
    "threshold_sigma": 0.03,
    "mapping": "lin_log",
    "seed": 0,
}
#: ITU-R BT.601 luma.
LUMA = np.array([[0.299, 0.587, 0.114]])

FrameSource = Callable[[gym.Env[Any, Any]], "Array | Sequence[Array]"]


class EventObservation(SensorWrapper):
    """
    Adds the image of an event camera that looks at what the environment renders, at an image of its observation, or
    at what a function returns.

    Colours become grey = 0.299 R + 0.587 G + 0.114 B, neither rounded nor clipped. Mapping "log" (presets "ideal" and
    "carla") sees grey / 255, as CARLA's event camera does; "lin_log" (the default and preset "noisy") and "identity"
    see 0..255.

    Between two frames the brightness is taken as linear in time, so the more frames a step has, the better the time
    stamps. Every frame since the previous step is used where there are several: from highway-env's top view, which
    renders each of its simulation steps; in the render modes ``..._list``; from a function that returns a list. For
    any environment: ``RepeatAction(RenderCollection(env), n)``, both of gymnasium, gives n frames a step.

    The first image of an episode has no events (all 128). ``reset(seed=...)`` seeds the noise; thresholds and other
    properties of the chip are fixed by the camera's own ``seed``.

    :param env: Any environment. A process that has rendered MuJoCo must not be forked, see
        :mod:`sb3_have.sensors.rendering`; highway-env draws nothing with SDL_VIDEODRIVER=dummy.
    :param source: ``"render"``; or a key of the observation, a uint8 image (H, W, 3), (H, W, 1) or (H, W); or
        ``function(env)``, called after every reset and step, which returns a frame, or several, oldest first, equally
        spaced in time and ending now. A frame is a uint8 image as above, or a float array (H, W) >= 0: an intensity,
        which reaches the camera as it is. Its scale must suit the mapping: "lin_log" expects digital numbers 0..255
        (from 0 to 1 is less than one threshold there), "log" linear light with white at about 1, of which ``log_eps``
        is the darkest it tells apart; with "identity" frames have the unit of the threshold.
    :param bins: Slices of time in a step, as in :func:`~sb3_have.sensors.stack_by_time`.
    :param representation: ``"sbt"``, ``"voxel"``, ``"count"``, ``"polarity"`` or ``"time_surface"``, see
        :func:`~sb3_have.sensors.represent`; the number of channels is ``channels(representation, bins)``.
    :param camera: Overrides of :data:`CAMERA_DEFAULTS` with parameters of :class:`~sb3_have.sensors.EventCamera`; with
        ``"preset"`` among them, overrides of that preset; the name of a preset; or a camera of the right size, which
        is copied.
    :param image_size: Rows and columns of the camera, one number for both or a pair. Each pixel sees the mean of the
        area it covers. None takes the frame's own; unless the source is a key or MuJoCo's rendering, that takes a first
        frame: the environment is reset when it is wrapped, which ends an episode under way and takes a draw from its
        generator. With a function over MuJoCo a size must be given.
    :param key: Key of the event image.
    :param dt: Seconds that a step takes; in the render modes ``..._list``, seconds between two frames of the list. None
        asks the environment (:func:`~sb3_have.sensors.rendering.step_duration`). With an action repeat between the
        environment and this wrapper, and no list, give the time of all the repetitions.
    :param tau: Time constant of a time surface in seconds; None is one step. Whatever it is, the surface holds the
        events of the current step only.
    :raises ValueError: on a wrong render mode, an observation that is not such an image, an unknown option, a key that
        exists already, a source whose size changes, or if the environment does not say how long a step takes.
    :raises KeyError: if the observation has no key ``source``.
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
        # No deep copies: a function may be a method of the environment.
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
        if dt is not None and not (is_number(dt) and 0 < dt < np.inf):
            raise ValueError(f"dt must be a finite number of seconds > 0, got {dt!r}")
        if dt is None and step_duration(env) is None:
            raise ValueError(
                'the environment does not say how long a step takes: it has no dt and no metadata["render_fps"]; '
                "pass dt=<seconds>"
            )
        self._dt = dt
        self._intermediate = IntermediateFrames(env.unwrapped) if source == "render" and is_highway_env(env) else None
        height, width = self.image_size = self._check_source(parse_size(image_size))
        self.camera = make_camera(camera, height, width)
        #: Seconds since the reset.
        self.time = 0.0
        self._scale_known = False
        # Complains about a wrong option now, not at the first step.
        represent(np.empty(0, np.int64), np.empty(0), np.empty(0), bins, 0, 1, height, width, representation, tau)
        self._announce(height, width, channels(representation, bins))

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """As the environment."""
        if self._intermediate is None:
            return super().step(action)
        with self._intermediate:
            return super().step(action)

    def sense(self, observation: Observation, start: bool) -> NDArray[np.uint8]:
        """The events since the previous step, uint8 (H, W, channels)."""
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
            self.time = float(t)  # the camera's, also after a frame that it refuses
        pixel, time, polarity = (np.concatenate(part) for part in zip(*parts, strict=True))
        image = represent(
            pixel, time, polarity, self.bins, begin, self.time, *self.image_size, self.representation, self.tau
        )
        return encode_events(image, self.representation)

    def _frames(self, observation: Observation) -> Sequence[Array]:
        """The frames since the previous step, oldest first; after a reset only the last counts."""
        if self.source == "render":
            between = [] if self._intermediate is None else self._intermediate.frames
            return [*between, *self.look().colour]
        seen = observation[self.source] if isinstance(self.source, str) else self.source(self.env)
        frames = [seen] if isinstance(seen, np.ndarray) else seen
        if not isinstance(frames, Sequence) or not frames:
            raise ValueError(f"EventObservation: source(env) must return a frame or a list of them, got {frames!r}")
        for frame in frames:
            if not isinstance(frame, np.ndarray) or not _is_frame(frame.shape, frame.dtype):
                raise ValueError(
                    "EventObservation: a frame must be uint8 (H, W, 3), (H, W, 1) or (H, W), or float (H, W), got "
                    f"{describe(frame)}"
                )
        return frames

    def _intensity(self, frame: Array) -> Array:
        """What the camera is exposed to: float (H, W)."""
        if frame.dtype.kind == "f":
            self._check_scale(frame)
            return self.fit(frame.astype(np.float64), self.image_size)
        grey: Array = frame.astype(np.float64)
        if frame.ndim == 3 and frame.shape[2] == 3:
            grey = cv2.transform(grey, LUMA)
        grey = self.fit(grey.reshape(frame.shape[:2]), self.image_size)
        return grey / 255 if self.camera.mapping == "log" else grey

    def _check_scale(self, frame: Array) -> None:
        """Warn once if the first float frame that is not black has the scale 0..1 where 0..255 is expected."""
        if self._scale_known or self.camera.mapping != "lin_log" or not frame.max(initial=0) > 0:
            return
        self._scale_known = True
        if frame.max() <= 1:
            gym.logger.warn(
                f"EventObservation: a float frame reaches {frame.max():.3g} only, and mapping 'lin_log' expects "
                "0..255: hardly anything will be an event. Return 255 times it, or take camera='ideal' for frames in "
                "0..1"
            )

    def _duration(self, frames: int) -> float:
        dt = self._dt if self._dt is not None else step_duration(self.env)
        assert dt is not None
        in_list = self.source == "render" and str(self.env.render_mode).endswith("_list")
        return dt * frames if in_list else dt

    def _check_source(self, size: tuple[int, int] | None) -> tuple[int, int]:
        """Rows and columns of the camera."""
        if self.source == "render":
            check_render_mode(self.env, COLOUR_MODES, self.class_name())
            return size or self._rendered_size(COLOUR_MODES)
        if callable(self.source):
            return size or self._first_size(lambda: self._frames({})[-1])
        if not isinstance(self.source, str):
            raise ValueError(f"EventObservation: source must be 'render', a key or function(env), got {self.source!r}")
        space = pick(self.inner_spaces, self.source, self.class_name())
        fits = isinstance(space, spaces.Box) and space.dtype == np.uint8 and _is_frame(space.shape, space.dtype)
        if not fits or (space.low != 0).any() or (space.high != 255).any():
            raise ValueError(
                f"EventObservation: {self.source!r} must be a uint8 image (H, W, 3), (H, W, 1) or (H, W) in 0..255, "
                f"got {space}; {_remedy(space)}"
            )
        self._source_size = space.shape[:2]
        return size or (space.shape[0], space.shape[1])


def _remedy(space: spaces.Space[Any]) -> str:
    """What to do about a key that is not such an image."""
    shape = space.shape or ()
    if image_fault(space) is None and (len(shape) == 2 or min(shape) in (1, 3)):
        return "ChannelLastImages brings it into this form"
    return (
        "make one of it with gymnasium.wrappers.TransformObservation, name another key, or give source='render' or a "
        "function(env) that returns an image"
    )


def make_camera(camera: Mapping[str, Any] | str | EventCamera | None, height: int, width: int) -> EventCamera:
    """
    The camera that :class:`EventObservation` is asked for.

    :param camera: As there.
    :param height: Rows.
    :param width: Columns.
    :raises ValueError: on anything else, an unknown preset or parameter, or a camera of another size.
    """
    if isinstance(camera, EventCamera):
        if (camera.height, camera.width) != (height, width):
            raise ValueError(
                f"the camera has {camera.height} x {camera.width} pixels, the image {height} x {width}; pass "
                f"image_size=({camera.height}, {camera.width})"
            )
        return copy.deepcopy(camera)
    if camera is not None and not isinstance(camera, (str, Mapping)):
        raise ValueError(
            f"camera must be None, the name of a preset, a dict of parameters or an EventCamera, got {camera!r}"
        )
    options: dict[str, Any] = {"preset": camera} if isinstance(camera, str) else dict(camera or {})
    known = [name for name in inspect.signature(EventCamera).parameters if name not in ("height", "width")]
    unknown = set(options) - {*known, "preset"}
    if unknown:
        raise ValueError(f"unknown camera option {sorted(unknown)}; the options are preset, {', '.join(known)}")
    preset = options.pop("preset", None)
    if preset is None:
        return EventCamera(height, width, **{**CAMERA_DEFAULTS, **options})
    return EventCamera.preset(preset, height, width, **{"seed": 0, **options})


def _is_frame(shape: tuple[int, ...], dtype: Any) -> bool:
    if dtype == np.uint8:
        return len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3))
    return len(shape) == 2 and np.dtype(dtype).kind == "f"
