"""Data of CARLA's sensors: callbacks and their queues, decoding, options of the event camera. Needs no client."""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sb3_have.envs.vision import EVENT_DEFAULTS as HIGHWAY_DEFAULTS
from sb3_have.sensors.representations import encode_events, represent

T = TypeVar("T")

# An event as CARLA sends it; t is the simulation time in nanoseconds
DVS_DTYPE: Final = np.dtype([("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("pol", "?")])
# Depth of the sky, the largest that CARLA encodes [m]
DEPTH_FAR: Final = 1000.0

EVENT_DEFAULTS: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "bins": 5,
        "representation": "sbt",
        "threshold": 0.3,
        "threshold_sigma": 0.05,
        "refractory": 0.0,
        "mapping": "log",
        "log_eps": 1e-3,
        "tau": None,
    }
)
"""Default options of the event camera; ``threshold`` and ``threshold_sigma`` are those of the paper's experiments."""

# Options of HighwayVision-v0's event camera that CARLA's event camera does not have
UNSUPPORTED: Final = ("subframes", "leak_rate", "shot_rate", "cutoff_hz", "cutoff_intensity", "seed")


class Inbox(Generic[T]):
    """
    Queue of the data of one sensor. The instance is the callback for ``sensor.listen``.

    CARLA runs callbacks in a thread of its own, frees the buffer when they return, and swallows their exceptions. The
    callback therefore copies the data at once and passes an exception on to the reader.

    :param name: Name of the sensor for error messages
    :param read: Function that copies the relevant part of the data
    """

    def __init__(self, name: str, read: Callable[[Any], T]) -> None:
        self.name = name
        self._read = read
        # Not a SimpleQueue: in Python 3.10, its get() can wait forever if the timeout is very short
        self._queue: queue.Queue[tuple[int, T] | Exception] = queue.Queue()

    def __call__(self, data: Any) -> None:
        try:
            self._queue.put((data.frame, self._read(data)))
        except Exception as error:
            self._queue.put(error)

    def at(self, frame: int, timeout: float) -> T:
        """Wait up to ``timeout`` seconds for the data of a frame, and discard older data."""
        deadline = time.monotonic() + timeout
        while (item := self._next(deadline)) is not None:
            if item[0] == frame:
                return item[1]
            if item[0] > frame:
                raise RuntimeError(
                    f"the {self.name} sensor sent frame {item[0]} instead of frame {frame}; another client may be "
                    "ticking this server, so give each environment a server of its own"
                )
        raise TimeoutError(
            f"no data for frame {frame} from the {self.name} sensor within {timeout} s, although the server ticks; "
            "increase `timeout` if rendering is slow"
        )

    def drain(self, frame: int = -1, grace: float = 0.0) -> list[tuple[int, T]]:
        """
        Take all pairs of frame and data that have arrived, from a sensor that sends nothing in some frames.

        :param frame: Wait until data of this frame has arrived, ...
        :param grace: ... but no longer than this [s]
        """
        items: list[tuple[int, T]] = []
        deadline = time.monotonic() + grace
        while (item := self._next(deadline)) is not None:
            items.append(item)
            if item[0] >= frame:
                deadline = 0.0  # complete: take what is there without waiting
        return items

    def _next(self, deadline: float) -> tuple[int, T] | None:
        try:
            item = self._queue.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            return None
        if isinstance(item, Exception):
            raise RuntimeError(f"the callback of the {self.name} sensor failed: {item!r}") from item
        return item


def copy_pixels(image: Any) -> NDArray[np.uint8]:
    """Copy the pixels of a ``carla.Image``: uint8 (height, width, 4) in the order blue, green, red, alpha."""
    return np.frombuffer(image.raw_data, dtype=np.uint8).reshape(image.height, image.width, 4).copy()


def copy_events(events: Any) -> NDArray[np.void]:
    """Copy the events of a ``carla.DVSEventArray``, an array of :data:`DVS_DTYPE`."""
    return np.frombuffer(events.raw_data, dtype=DVS_DTYPE).copy()


def impulse(collision: Any) -> float:
    """Compute the magnitude of the impulse of a ``carla.CollisionEvent`` [N s]."""
    vector = collision.normal_impulse
    return math.sqrt(vector.x**2 + vector.y**2 + vector.z**2)


def decode_rgb(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert pixels from BGRA, (H, W, 4), to RGB, (H, W, 3)."""
    return np.ascontiguousarray(pixels[..., 2::-1])


def decode_depth(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """
    Convert BGRA pixels of the depth camera to metres, 1000 (R + 256 G + 65536 B) / (256^3 - 1).

    The largest code, the sky, becomes infinite.
    """
    blue, green, red = (pixels[..., channel].astype(np.uint32) for channel in range(3))
    code = red + 256 * green + 65536 * blue
    metres = DEPTH_FAR * code / (256**3 - 1)
    return np.where(code == 256**3 - 1, np.inf, metres).astype(np.float32)


def event_image(
    arrays: Iterable[NDArray[np.void]], start: int, duration: float, size: int, options: Mapping[str, Any]
) -> NDArray[np.uint8]:
    """
    Build the event image of a control step.

    :param arrays: Arrays of :data:`DVS_DTYPE`, one per tick that had events
    :param start: Simulation time at the start of the step [ns]
    :param duration: Length of the step [s]
    :param size: Height and width of the image [px]
    :param options: Options as returned by :func:`event_options`
    :return: uint8 (size, size, C), see :func:`~sb3_have.sensors.representations.encode_events`
    """
    events = np.concatenate([np.empty(0, dtype=DVS_DTYPE), *arrays])
    pixel = events["y"].astype(np.int64) * size + events["x"]
    polarity = np.where(events["pol"], 1.0, -1.0)
    # Rounding to nanoseconds can put an event just outside of the step
    times = np.clip((events["t"] - start) * 1e-9, 0.0, duration)

    bins, kind, tau = (options[name] for name in ("bins", "representation", "tau"))
    return encode_events(represent(pixel, times, polarity, bins, 0.0, duration, size, size, kind, tau), kind)


def event_options(given: Mapping[str, Any] | None) -> dict[str, Any]:
    """
    Merge options of the event camera with :data:`EVENT_DEFAULTS`.

    :param given: Options under the names of HighwayVision-v0. Those that CARLA's sensor does not support are accepted,
        and ignored, if they are None or HighwayVision-v0's default (``leak_rate=0``).
    :return: All options
    :raises ValueError: If an option is unknown or not supported
    """
    given = dict(given or {})
    for name in UNSUPPORTED:
        if (value := given.pop(name, None)) not in (None, HIGHWAY_DEFAULTS[name]):
            raise ValueError(f"CARLA's event camera does not support {name}={value!r}; leave it out")
    if unknown := set(given) - set(EVENT_DEFAULTS):
        raise ValueError(f"unknown event option {sorted(unknown)}; the options are {', '.join(EVENT_DEFAULTS)}")
    return {**EVENT_DEFAULTS, **given}


def dvs_attributes(options: Mapping[str, Any]) -> dict[str, str]:
    """Convert options to attributes of the blueprint ``sensor.camera.dvs``. CARLA itself accepts any number."""
    positive, negative = (float(value) for value in np.broadcast_to(options["threshold"], 2))
    if not min(positive, negative) > 0:
        raise ValueError(f"event threshold must be positive, got {options['threshold']!r}")
    for name in ("threshold_sigma", "refractory", "log_eps"):
        if not options[name] >= 0:
            raise ValueError(f"event {name} must be at least 0, got {options[name]!r}")
    if options["mapping"] not in ("log", "identity"):
        raise ValueError(f"event mapping must be 'log' or 'identity' in CARLA, got {options['mapping']!r}")
    if options["mapping"] == "log" and options["log_eps"] == 0:
        raise ValueError("event log_eps must be positive with mapping 'log', got 0: the logarithm of black is infinite")
    return {
        "positive_threshold": str(positive),
        "negative_threshold": str(negative),
        "sigma_positive_threshold": str(float(options["threshold_sigma"])),
        "sigma_negative_threshold": str(float(options["threshold_sigma"])),
        "refractory_period_ns": str(round(1e9 * options["refractory"])),
        "use_log": str(options["mapping"] == "log").lower(),
        "log_eps": str(float(options["log_eps"])),
    }
