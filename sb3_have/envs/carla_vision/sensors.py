"""From CARLA's sensors to images: callbacks that copy and never raise, a queue each, frames that match, decoding."""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sb3_have.envs.vision import EVENT_DEFAULTS as HIGHWAY_DEFAULTS
from sb3_have.sensors.checks import check_whole, is_finite, positive_pair
from sb3_have.sensors.event_camera import EVENT_DTYPE
from sb3_have.sensors.representations import encode_events, represent

T = TypeVar("T")
Bytes = NDArray[np.uint8]

#: One event as CARLA sends it; ``t`` is simulation time in nanoseconds.
DVS_DTYPE: Final = np.dtype([("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("pol", "?")])
#: CARLA's depth ends here [m]; what lies beyond, the sky, reads as this.
DEPTH_FAR: Final = 1000.0

#: Defaults of the event camera. Threshold and mismatch are those of the paper's experiments.
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
# Options of HighwayVision-v0's event camera that CARLA's has no counterpart for, with a remedy.
_ABSENT: Final[Mapping[str, str]] = MappingProxyType(
    {
        "subframes": "it renders once per simulation tick; raise simulation_frequency instead",
        "leak_rate": "it has no leak noise; leave it out",
        "shot_rate": "it has no shot noise; leave it out",
        "cutoff_hz": "its photoreceptor has no bandwidth; leave it out",
        "cutoff_intensity": "its photoreceptor has no bandwidth; leave it out",
        "seed": "its noise takes no seed; leave it out",
    }
)


class _Data(Protocol):
    @property
    def frame(self) -> int: ...


class Inbox(Generic[T]):
    """
    What one sensor has sent. An instance is the callback to give to ``sensor.listen``.

    CARLA calls it from a thread of its own, frees the buffer when it returns, and swallows what it raises: so it copies
    at once, and keeps an exception for whoever reads next.

    :param name: Of the sensor, for messages.
    :param read: Copies what is wanted out of the data.
    """

    def __init__(self, name: str, read: Callable[[Any], T]) -> None:
        self.name = name
        self._read = read
        self._items: queue.SimpleQueue[tuple[int, T] | Exception] = queue.SimpleQueue()

    def __call__(self, data: _Data) -> None:
        try:
            self._items.put((data.frame, self._read(data)))
        except Exception as error:
            self._items.put(error)

    def at(self, frame: int, timeout: float) -> T:
        """
        The data of one frame; older data is dropped.

        :param frame: As ``world.tick`` returned it.
        :param timeout: In seconds.
        :raises TimeoutError: if it does not come in time.
        :raises RuntimeError: if a later frame comes instead, or the callback has failed.
        """
        deadline = time.monotonic() + timeout
        while True:
            item = self._next(deadline)
            if item is None:
                raise TimeoutError(
                    f"no data of frame {frame} from the {self.name} sensor within {timeout} s although the server "
                    "ticks; raise `timeout` if it renders slower than that"
                )
            got, data = item
            if got == frame:
                return data
            if got > frame:
                raise RuntimeError(
                    f"the {self.name} sensor sent frame {got} when frame {frame} was due: does another client tick "
                    "this server too? Give each environment a server of its own"
                )

    def drain(self, frame: int = -1, grace: float = 0.0) -> list[tuple[int, T]]:
        """
        All that has come, with the frames it belongs to, for sensors that send only when there is something to tell.

        :param frame: Wait until something of this frame has come ...
        :param grace: ... for so many seconds at most.
        :raises RuntimeError: if the callback has failed.
        """
        items: list[tuple[int, T]] = []
        deadline = time.monotonic() + grace
        while (item := self._next(deadline)) is not None:
            items.append(item)
            if item[0] >= frame:
                deadline = 0.0  # complete: take what is there, wait no longer
        return items

    def _next(self, deadline: float) -> tuple[int, T] | None:
        try:
            item = self._items.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            return None
        if isinstance(item, Exception):
            raise RuntimeError(f"the callback of the {self.name} sensor failed: {item!r}") from item
        return item


def copy_image(image: Any) -> Bytes:
    """The pixels of a ``carla.Image``: blue, green, red, alpha, uint8 (height, width, 4)."""
    return np.frombuffer(image.raw_data, dtype=np.uint8).reshape(image.height, image.width, 4).copy()


def copy_events(events: Any) -> NDArray[np.void]:
    """The events of a ``carla.DVSEventArray``, of :data:`DVS_DTYPE`."""
    return np.frombuffer(events.raw_data, dtype=DVS_DTYPE).copy()


def impulse(collision: Any) -> float:
    """The size of the impulse of a ``carla.CollisionEvent`` [N s]."""
    force = collision.normal_impulse
    return math.sqrt(force.x**2 + force.y**2 + force.z**2)


def decode_rgb(pixels: Bytes) -> Bytes:
    """
    Colours of a camera's pixels.

    :param pixels: uint8 (H, W, 4): blue, green, red, alpha.
    :return: uint8 (H, W, 3): red, green, blue.
    """
    return np.ascontiguousarray(pixels[..., 2::-1])


def decode_depth_image(pixels: Bytes) -> NDArray[np.float32]:
    """
    Distance along the optical axis in a depth camera's pixels: 1000 (R + 256 G + 65536 B) / (256^3 - 1) metres.

    :param pixels: uint8 (H, W, 4): blue, green, red, alpha.
    :return: float32 (H, W) metres; infinite where the code is the greatest of all, in the sky.
    """
    blue, green, red = (pixels[..., channel].astype(np.uint32) for channel in range(3))
    code = red + 256 * green + 65536 * blue
    metres = DEPTH_FAR * code / (256**3 - 1)
    return np.where(code == 256**3 - 1, np.inf, metres).astype(np.float32)


def decode_dvs(arrays: Iterable[NDArray[np.void]], start: int, duration: float) -> NDArray[np.void]:
    """
    Events of the ticks of one control step, in the package's own form.

    :param arrays: Of :data:`DVS_DTYPE`, an array for each tick that had events.
    :param start: Simulation time at the start of the step [ns].
    :param duration: Length of the step [s].
    :return: Of :data:`sb3_have.sensors.EVENT_DTYPE`; ``t`` in seconds since the start, within 0..``duration`` also
        where CARLA's rounding to nanoseconds leaves it a little outside.
    """
    raw = np.concatenate([np.empty(0, dtype=DVS_DTYPE), *arrays])
    events = np.empty(len(raw), dtype=EVENT_DTYPE)
    events["x"], events["y"] = raw["x"], raw["y"]
    events["t"] = np.clip((raw["t"] - start) * 1e-9, 0.0, duration)
    events["p"] = np.where(raw["pol"], 1, -1)
    return events


def event_image(
    arrays: Iterable[NDArray[np.void]], start: int, duration: float, size: int, options: Mapping[str, Any]
) -> Bytes:
    """
    The events of a control step as an image.

    :param arrays: See :func:`decode_dvs`, as are ``start`` and ``duration``.
    :param size: Rows and columns of the sensor.
    :param options: As :func:`event_options` returns them.
    :return: uint8 (size, size, C), see :func:`~sb3_have.sensors.representations.encode_events`.
    """
    events = decode_dvs(arrays, start, duration)
    pixel, polarity = events["y"].astype(np.int64) * size + events["x"], events["p"].astype(np.float64)
    bins, kind, tau = (options[name] for name in ("bins", "representation", "tau"))
    values = represent(pixel, events["t"], polarity, bins, 0.0, duration, size, size, kind, tau)
    return encode_events(values, kind)


def event_options(given: Mapping[str, Any] | None) -> dict[str, Any]:
    """
    :data:`EVENT_DEFAULTS` with overrides.

    :param given: Options as HighwayVision-v0 takes them. Those that CARLA's sensor has no counterpart for may be given
        only as None or as they are there by default (``leak_rate=0``, ``subframes=5``), and mean nothing.
    :raises ValueError: on an unknown option, or one that CARLA cannot honour.
    """
    given = dict(given or {})
    for name, remedy in _ABSENT.items():
        if (value := given.pop(name, None)) not in (None, HIGHWAY_DEFAULTS[name]):
            raise ValueError(f"event {name}={value!r} means nothing to CARLA's event camera: {remedy}")
    unknown = set(given) - set(EVENT_DEFAULTS)
    if unknown:
        raise ValueError(f"unknown event option {sorted(unknown)}; the options are {', '.join(EVENT_DEFAULTS)}")
    options = {**EVENT_DEFAULTS, **given}
    check_whole("event bins", options["bins"], 1)
    return options


def dvs_attributes(options: Mapping[str, Any]) -> dict[str, str]:
    """
    Attributes of the blueprint ``sensor.camera.dvs``.

    :param options: As :func:`event_options` returns them.
    :raises ValueError: on a value that the sensor cannot have.
    """
    positive, negative = positive_pair("event threshold", options["threshold"])
    for name in ("threshold_sigma", "refractory", "log_eps"):
        if not (is_finite(options[name]) and options[name] >= 0):
            raise ValueError(f"event {name} must be a number >= 0, got {options[name]!r}")
    if options["mapping"] not in ("log", "identity"):
        raise ValueError(f"CARLA's event camera maps light by 'log' or 'identity', got {options['mapping']!r}")
    if options["mapping"] == "log" and options["log_eps"] == 0:
        raise ValueError("event log_eps must be > 0 with mapping 'log', got 0: black has no logarithm")
    return {
        "positive_threshold": str(positive),
        "negative_threshold": str(negative),
        "sigma_positive_threshold": str(float(options["threshold_sigma"])),
        "sigma_negative_threshold": str(float(options["threshold_sigma"])),
        "refractory_period_ns": str(round(1e9 * options["refractory"])),
        "use_log": "true" if options["mapping"] == "log" else "false",
        "log_eps": str(float(options["log_eps"])),
    }
