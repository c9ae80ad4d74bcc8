"""The colour, event and depth camera of a car: poses in, observation out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.envs.camera import Camera, Objects
from sb3_have.envs.road_shape import RoadShape
from sb3_have.envs.scene import PAINTS, Array
from sb3_have.envs.weather import Illumination, rain_events, take_picture, weather_by_name
from sb3_have.sensors.checks import check_whole
from sb3_have.sensors.depth import encode_depth
from sb3_have.sensors.event_camera import EventCamera
from sb3_have.sensors.representations import (
    EVENT_ZERO,
    Representation,
    channels,
    decode_events,
    encode_events,
    represent,
)

Observation = dict[str, NDArray[np.uint8]]

MODALITIES: Final = ("rgb", "event", "depth")
EVENT_DEFAULTS: Final[Mapping[str, Any]] = {
    "bins": 5,
    "subframes": 5,
    "representation": "sbt",
    "threshold": 0.2,
    "threshold_sigma": 0.03,
    "refractory": 0.0,
    "leak_rate": 0.0,
    "shot_rate": 0.0,
    "mapping": "log",
    "log_eps": 1e-7,
    "cutoff_hz": None,
    "cutoff_intensity": None,
    "tau": None,
    "seed": 0,
}
"""Default event camera. ``log_eps`` is far below the light at night; light at noon is about 1."""
DEPTH_DEFAULTS: Final[Mapping[str, Any]] = {"encoding": "log", "max": 100.0}


class VisionSensors:
    """
    Roof camera, event camera and depth camera of the ego vehicle.

    Only what the chosen modalities need is computed: the event camera needs several instants of each control step, the
    other cameras only the last one.

    :param image_size: Rows and columns of every image in pixels, at least 16.
    :param modalities: Non-empty subset of ``"rgb"``, ``"event"``, ``"depth"``.
    :param event: Overrides of :data:`EVENT_DEFAULTS`: ``bins`` per control step, ``subframes`` (instants rendered per
        control step), ``representation`` and ``tau`` in seconds as in :func:`~sb3_have.sensors.represent` (always of
        the events of one control step), and the parameters of :class:`~sb3_have.sensors.EventCamera`. ``seed`` fixes
        the threshold mismatch of the chip; all noise comes from the generators passed to :meth:`reset` and
        :meth:`observe`. With a ``mapping`` other than "log" the event camera sees the digital numbers of the colour
        camera, neither clipped nor rounded.
    :param depth: Overrides of :data:`DEPTH_DEFAULTS`: ``encoding`` ("log", "clipped" or "inverse") and, except for
        "log", the maximum ``max`` in metres.
    :param shape: Shape of the road, see :func:`~sb3_have.envs.road_shape.road_shape`; by default 4 straight lanes.
    :raises ValueError: If a modality, an option or a value is unknown or out of range.
    """

    def __init__(
        self,
        image_size: int = 84,
        modalities: Sequence[str] = MODALITIES,
        event: Mapping[str, Any] | None = None,
        depth: Mapping[str, Any] | None = None,
        shape: RoadShape | None = None,
    ) -> None:
        if isinstance(modalities, str) or not modalities or not set(modalities) <= set(MODALITIES):
            raise ValueError(f"modalities must be a non-empty subset of {MODALITIES}, got {modalities!r}")
        check_whole("image_size", image_size, 16)
        self.image_size = image_size = int(image_size)
        self.modalities = tuple(name for name in MODALITIES if name in modalities)
        self.event_options = _options("event", EVENT_DEFAULTS, event)
        self.depth_options = depth_options(depth)
        self.camera = Camera(image_size, shape or RoadShape(4))

        chip = dict(self.event_options)
        for name in ("bins", "subframes"):
            check_whole(f"event {name}", chip[name], 1)
        self.bins, self.subframes = int(chip.pop("bins")), int(chip.pop("subframes"))
        # Representation of the event image
        self.representation: Representation = chip.pop("representation")
        self._tau = chip.pop("tau")
        event_channels = channels(self.representation, self.bins)
        self._represent(np.empty(0, np.int64), np.empty(0), np.empty(0), 0.0, 1.0)  # check tau now
        self.event_camera = EventCamera(image_size, image_size, **chip)

        depths = {"rgb": 3, "event": event_channels, "depth": 1}
        # Space of each modality: uint8 (image_size, image_size, channels)
        self.spaces: dict[str, spaces.Box] = {
            name: spaces.Box(0, 255, (image_size, image_size, depths[name]), np.uint8) for name in self.modalities
        }
        self._sizes: Array = np.empty((0, 2))
        self._view: Objects
        self._time = 0.0

    def reset(self, weather: str, poses: Array, sizes: Array, rng: np.random.Generator) -> Observation:
        """
        Start an episode.

        :param weather: One of :data:`~sb3_have.envs.weather.WEATHERS`.
        :param poses: x [m], y [m] and heading [rad], (1 + vehicles, 3); row 0 is the ego vehicle.
        :param sizes: Length and width in metres for the whole episode, (1 + vehicles, 2).
        :param rng: Generator of the vehicles' paints and of the noise.
        :return: Image of each modality; the event image is empty (all 128).
        :raises ValueError: If the weather is unknown, or if the poses and sizes do not match.
        """
        self.weather = weather_by_name(weather)
        self._sizes = sizes = np.asarray(sizes, dtype=np.float64)
        poses = self._check(np.asarray(poses)[None])
        paint = rng.integers(len(PAINTS), size=len(sizes) - 1)
        self._colour = Illumination(self.weather, self.camera, paint, colour=True)
        self._brightness = Illumination(self.weather, self.camera, paint, colour=False)
        self._time = 0.0
        self.event_camera.reset()
        return self._sense(poses, 0.0, rng)

    def observe(self, poses: Array, duration: float, rng: np.random.Generator) -> Observation:
        """
        Return the images at the end of a control step.

        :param poses: Poses at two or more equally spaced instants from the start to the end of the step, (instants,
            1 + vehicles, 3). Vehicles keep their row during the episode.
        :param duration: Duration of the step in seconds.
        :param rng: Generator of the noise.
        :return: Image of each modality.
        :raises ValueError: If the number of vehicles is not that of the reset.
        """
        poses = self._check(np.asarray(poses))
        if "event" in self.modalities:
            at = np.arange(1, self.subframes + 1) * (len(poses) - 1) / self.subframes  # ends exactly on the last
            before = np.minimum(at.astype(int), len(poses) - 2)
            share = (at - before)[:, None, None]
            poses = (1 - share) * poses[before] + share * poses[before + 1]
        else:
            poses = poses[-1:]
        return self._sense(poses, duration, rng)

    @property
    def last_truth(self) -> dict[str, NDArray[Any]]:
        """
        Ground truth of the last observation, (image_size, image_size) each.

        ``depth`` is in float32 metres, infinite in the sky; ``vehicle`` is the number of the vehicle that a pixel sees
        (its row in the poses minus one), or -1.
        """
        last = self._view
        far_to_near = np.argsort(-last.depth, kind="stable")
        vehicle = np.full(self.image_size**2, -1)
        vehicle[last.pixel[far_to_near]] = last.vehicle[last.face[far_to_near]]
        return {
            "depth": self.camera.depth(last),
            "vehicle": vehicle.reshape(self.image_size, self.image_size),
        }

    def _check(self, poses: Array) -> Array:
        poses = np.asarray(poses, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (len(self._sizes), 3):
            raise ValueError(f"poses must have shape (..., {len(self._sizes)}, 3) as at reset, got {poses.shape[-2:]}")
        return poses

    def _sense(self, poses: Array, duration: float, rng: np.random.Generator) -> Observation:
        objects = self.camera.objects(poses, self._sizes)
        self._view = last = objects.last(len(poses), self.image_size**2)
        # Always draw a seed for each sensor, so that its noise does not depend on the other modalities
        picture_seed, event_seed = rng.integers(2**63, size=2)
        observation: Observation = {}
        if "rgb" in self.modalities or "event" in self.modalities:
            ground = self.camera.ground(poses)
        if "rgb" in self.modalities:
            picture = self._colour.render(ground.last(), last)[0]
            observation["rgb"] = take_picture(picture, self.weather, np.random.default_rng(picture_seed))
        if "event" in self.modalities:
            frames = self._brightness.render(ground, objects)[..., 0]
            observation["event"] = self._events(frames, duration, np.random.default_rng(event_seed))
        if "depth" in self.modalities:
            depth = self.camera.depth(last)
            observation["depth"] = encode_depth(depth, *self.depth_options.values())[..., None]
        return observation

    def _events(self, frames: Array, duration: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Event image of the brightness frames of one step. At a reset (duration 0) there is one frame and no event."""
        if self.event_options["mapping"] != "log":
            frames = frames * (255 * self.weather.exposure)
        size, start = self.image_size, self._time
        times = [start + duration * (k + 1) / len(frames) for k in range(len(frames))]
        parts = [self.event_camera.detect(frame, t, rng) for frame, t in zip(frames, times, strict=True)]
        if duration == 0:
            return np.full(self.spaces["event"].shape, EVENT_ZERO, dtype=np.uint8)
        self._time = times[-1]
        if self.weather.rain:
            parts.append(rain_events(self.weather, start, self._time, size, size, rng))
        pixel, time, polarity = (np.concatenate(part) for part in zip(*parts, strict=True))
        return self._represent(pixel, time, polarity, start, self._time)

    def _represent(
        self,
        pixel: NDArray[np.int64],
        times: NDArray[np.float64],
        polarity: NDArray[np.float64],
        start: float,
        end: float,
    ) -> NDArray[np.uint8]:
        size, kind = self.image_size, self.representation
        values = represent(pixel, times, polarity, self.bins, start, end, size, size, kind, self._tau)
        return encode_events(values, kind)


def depth_options(given: Mapping[str, Any] | None) -> dict[str, Any]:
    """
    Return :data:`DEPTH_DEFAULTS` with overrides.

    :param given: ``encoding`` and, except for "log", ``max`` in metres.
    :raises ValueError: If an option is unknown, out of range or without effect.
    """
    options = _options("depth", DEPTH_DEFAULTS, given)
    encode_depth(np.empty(0), *options.values())  # check the values now
    if options["encoding"] == "log" and "max" in (given or {}):
        raise ValueError(
            f"depth max={options['max']!r} has no effect with encoding 'log', which has a fixed range; leave it out "
            "or choose encoding 'clipped' or 'inverse'"
        )
    return options


def _options(name: str, defaults: Mapping[str, Any], given: Mapping[str, Any] | None) -> dict[str, Any]:
    unknown = set(given or {}) - set(defaults)
    if unknown:
        raise ValueError(f"unknown {name} option {sorted(unknown)}; the options are {', '.join(defaults)}")
    return {**defaults, **(given or {})}


def compose(
    observation: Mapping[str, NDArray[np.uint8]], scale: int = 4, representation: Representation = "sbt"
) -> NDArray[np.uint8]:
    """
    Compose a picture of an observation for people, with RGB, events and depth from left to right.

    Brighter events are red and darker ones blue, on white. Depth goes from yellow (near) to violet (far), black where
    there is nothing.

    :param observation: Any non-empty subset of the modalities, uint8 (H, W, C) each.
    :param scale: Size of a pixel in the picture.
    :param representation: Representation of the events.
    :return: uint8 (H * scale, W * scale * modalities, 3).
    :raises ValueError: If the observation has none of the modalities.
    """
    shown = [_paint(name, np.asarray(observation[name]), representation) for name in MODALITIES if name in observation]
    if not shown:
        raise ValueError(f"observation has none of {MODALITIES}, only {sorted(observation)}")
    return np.concatenate(shown, axis=1).repeat(scale, axis=0).repeat(scale, axis=1)


def _paint(name: str, image: NDArray[np.uint8], representation: Representation) -> NDArray[np.uint8]:
    if name == "rgb":
        return image[..., -3:]
    return _paint_depth(image) if name == "depth" else _paint_events(image, representation)


def _paint_events(codes: NDArray[np.uint8], representation: Representation) -> NDArray[np.uint8]:
    values, full = decode_events(codes, representation), 1.0 if representation == "time_surface" else 4.0
    if representation in ("polarity", "time_surface"):  # positive channels first, then as many negative ones
        values[..., values.shape[-1] // 2 :] *= -1
    total = values.sum(axis=-1)
    strength = np.clip(np.abs(total) / full, 0, 1)[..., None]
    colour = np.where(total[..., None] > 0, (214.0, 39.0, 40.0), (31.0, 119.0, 220.0))
    return np.asarray(255 + strength * (colour - 255)).astype(np.uint8)


def _paint_depth(codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    coloured = cv2.applyColorMap(255 - codes[..., -1], cv2.COLORMAP_INFERNO)[..., ::-1]
    return np.asarray(np.where(codes[..., -1:] == 0, 0, coloured)).astype(np.uint8)
