"""
Sensor failures: functions that corrupt one image or vector, and the table of their severities.

Each function is pure, ``f(image, rng, **parameters) -> new image``, and keeps shape and dtype. To add a failure, write
such a function and enter it into :data:`FAILURES`.

The kinds follow the common-corruption benchmarks of robust perception (Hendrycks and Dietterich, "Benchmarking Neural
Network Robustness to Common Corruptions and Perturbations", ICLR 2019), plus what is specific to event and depth
cameras; the severities are our own. Images are uint8 (H, W, C): events as 128 + signed count with 0 for "no data",
depth as 1..255 with 0 for "nothing there".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sb3_have.sensors.representations import EVENT_ZERO

Array = NDArray[Any]
Image = NDArray[np.uint8]
Rng = np.random.Generator

SENSORS: Final = ("rgb", "event", "depth", "vector")
"""Kinds of sensors, which determine what a failure looks like."""
# Exponent between the digital numbers of a colour camera and light
GAMMA: Final = 2.2
# Events per bin of a hot pixel of an event camera
HOT_COUNT: Final = 20
# Bounds of a vector beyond this do not indicate its scale
UNBOUNDED: Final = 1e6


class Failure:
    """
    One kind of failure of one kind of sensor.

    :param function: ``f(image, rng, **parameters)``, a function of this module.
    :param unsigned: Parameters that differ for event images whose codes never fall below "no event", as in the
        representations "count", "polarity" and "time_surface".
    :param parameters: Named parameters of the function, each a triple for the three severities or one value for all.
    """

    def __init__(
        self,
        function: Callable[..., Array],
        unsigned: Mapping[str, Any] | None = None,
        **parameters: float | tuple[float, float, float],
    ) -> None:
        self.function = function
        self.unsigned = dict(unsigned or {})
        self.parameters = parameters

    def at(self, severity: int, signed: bool = True) -> dict[str, Any]:
        """
        Return the parameters of the function.

        :param severity: 1, 2 or 3.
        :param signed: Whether the codes of an event image may fall below "no event".
        """
        parameters = {
            name: value[severity - 1] if isinstance(value, tuple) else value for name, value in self.parameters.items()
        }
        return parameters if signed else {**parameters, **self.unsigned}


def lose(image: Array, rng: Rng, share: float, blank: int) -> Array:
    """
    Stop reading a bank of columns: the last ``share`` of them becomes ``blank``.

    Columns instead of rows, because in most scenes the rows of the sky would not be missed.
    """
    lost = image.copy()
    lost[_last(image, share)] = blank
    return lost


def lose_entries(vector: Array, rng: Rng, low: Array, high: Array, share: float) -> Array:
    """Set the last ``share`` of the entries of a vector to zero, or to the bound closest to zero."""
    lost = vector.copy()
    lost[_last(vector, share)] = 0
    return np.clip(lost, low, high)


def hold(image: Array, rng: Rng, past: Array, share: float) -> Array:
    """Freeze the last ``share`` of the columns (of the entries of a vector) at their values in ``past``."""
    held = image.copy()
    last = _last(image, share)
    held[last] = past[last]
    return held


def delay(image: Array, rng: Rng, past: Array, steps: float) -> Array:
    """Show the image of ``steps`` steps ago, ``past``."""
    return past.copy()


def gaussian_noise(image: Image, rng: Rng, sigma: float) -> Image:
    """Add normal noise of standard deviation ``sigma`` (in codes) to all channels."""
    return _codes(image + sigma * rng.standard_normal(image.shape, np.float32), 0)


def spurious_events(image: Image, rng: Rng, rate: float, signed: bool = True) -> Image:
    """
    Add random events, ``rate`` per pixel and bin on average, of either polarity or, if not ``signed``, as counts.

    Pixels without data (0) stay so.
    """
    entries = rng.integers(image.size, size=rng.poisson(rate * image.size))
    signs = rng.choice((-1.0, 1.0), len(entries)) if signed else np.ones(len(entries))
    return _add_events(image, np.bincount(entries, signs, image.size).reshape(image.shape))


def depth_noise(image: Image, rng: Rng, sigma: float) -> Image:
    """
    Add normal noise of standard deviation ``sigma`` (in codes) to every valid pixel; "nothing there" stays.

    In the logarithmic encoding a code is 2.3% of the distance.
    """
    return np.where(image > 0, _codes(image + sigma * rng.standard_normal(image.shape, np.float32), 1), image)


def vector_noise(vector: Array, rng: Rng, low: Array, high: Array, sigma: float) -> Array:
    """Add normal noise, clipped to the bounds; ``sigma`` is relative to the range of each entry, 1 without bounds."""
    _, width = _range(low, high)
    noisy = vector + sigma * width * rng.standard_normal(vector.shape)
    return np.clip(noisy, low, high).astype(vector.dtype)


def impulses(image: Image, rng: Rng, share: float, dark: int, bright: int, void: int | None = None) -> Image:
    """
    Salt and pepper: set ``share`` of the pixels, different ones each time, to ``dark`` or ``bright`` in all channels.

    Values equal to ``void`` are kept.
    """
    draw = rng.random(image.shape[:2])[..., None]
    spoilt = np.where(draw < share / 2, dark, np.where(draw < share, bright, image)).astype(np.uint8)
    return spoilt if void is None else np.where(image == void, image, spoilt)


def expose(image: Image, rng: Rng, stops: float) -> Image:
    """Expose the image to 2 ** ``stops`` times the light, in its gamma; values out of range are clipped."""
    return _codes(image * np.float32(2 ** (stops / GAMMA)), 0)


def blur(image: Image, rng: Rng, length: float) -> Image:
    """
    Smear the image along a straight line in a random direction, as if the camera shook during the exposure.

    ``length`` is relative to the width of the image, 3 pixels at least.
    """
    pixels = max(3, round(length * image.shape[1]))
    angle = rng.uniform(0, np.pi)
    along = np.linspace(-(pixels - 1) / 2, (pixels - 1) / 2, 4 * pixels)
    x, y = along * np.cos(angle), along * np.sin(angle)
    middle = pixels // 2 + 1
    kernel = np.zeros((2 * middle + 1, 2 * middle + 1), np.float32)
    np.add.at(kernel, (np.rint(middle + y).astype(int), np.rint(middle + x).astype(int)), 1 / len(along))
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8).reshape(image.shape)


def stick(image: Image, rng: Rng, share: float, dark: int, bright: int) -> Image:
    """
    Dead pixels: ``share`` of them, at least one, are stuck in all channels, half at ``dark`` and half at ``bright``.

    A generator in the same state gives the same pixels, and a larger share includes those of a smaller one.
    """
    stuck = image.copy()
    pixels = stuck.reshape(-1, image.shape[-1])
    order = rng.permutation(len(pixels))[: max(1, round(share * len(pixels)))]
    pixels[order[::2]], pixels[order[1::2]] = dark, bright
    return stuck


def stick_entries(vector: Array, rng: Rng, low: Array, high: Array, share: float) -> Array:
    """Stuck entries: ``share`` of them, at least one, are stuck at random values within their range."""
    middle, width = _range(low, high)
    values = np.clip(middle + width * rng.uniform(-0.5, 0.5, vector.shape), low, high).astype(vector.dtype)
    order = rng.permutation(len(vector))[: max(1, round(share * len(vector)))]
    stuck = vector.copy()
    stuck[order] = values[order]
    return stuck


def shift(image: Image, rng: Rng, distance: float) -> Image:
    """
    Move the image in a random direction and repeat its edge, as if the sensor were mounted askew.

    ``distance`` is relative to the width of the image, one pixel at least.
    """
    height, width = image.shape[:2]
    pixels, angle = max(1.0, distance * width), rng.uniform(0, 2 * np.pi)
    rows = np.clip(np.arange(height) - round(pixels * np.sin(angle)), 0, height - 1)
    columns = np.clip(np.arange(width) - round(pixels * np.cos(angle)), 0, width - 1)
    return np.asarray(image[rows[:, None], columns])


def storm(image: Image, rng: Rng, rate: float, signed: bool = True) -> Image:
    """
    Flood the sensor with the events of a flickering light, ``rate`` per pixel and bin on average.

    All pixels fire together, with polarities that alternate by bin or, if not ``signed``, as counts. Pixels without
    data (0) stay so.
    """
    signs = rng.choice((-1, 1)) * (-1) ** np.arange(image.shape[-1]) if signed else 1
    return _add_events(image, signs * rng.poisson(rate, image.shape))


def drop_patches(image: Image, rng: Rng, share: float, patch: float) -> Image:
    """Drop the returns of ``share`` of the square patches, whose side is ``patch`` of the image's width."""
    height, width = image.shape[:2]
    side = max(1, round(patch * width))
    grid = rng.random((-(-height // side), -(-width // side))) < share
    lost = grid.repeat(side, axis=0).repeat(side, axis=1)[:height, :width, None]
    return np.where(lost, np.uint8(0), image)


def _last(image: Array, share: float) -> tuple[slice, ...]:
    """Index of the last columns of an image, or of the last entries of a vector; at least one."""
    axis = 1 if image.ndim == 3 else 0
    length = image.shape[axis]
    return (slice(None),) * axis + (slice(length - max(1, round(share * length)), None),)


def _codes(values: Array, least: int) -> Image:
    return np.clip(np.rint(values), least, 255).astype(np.uint8)


def _add_events(image: Image, counts: Array) -> Image:
    return np.where(image == 0, image, _codes(image + counts, 1))


def _range(low: Array, high: Array) -> tuple[Array, Array]:
    """Middle and width of the range of each entry; 0 and 1 for an entry without bounds."""
    low, high = low.astype(np.float64), high.astype(np.float64)
    bounded = (low > -UNBOUNDED) & (high < UNBOUNDED)
    low, high = np.where(bounded, low, -0.5), np.where(bounded, high, 0.5)
    return (low + high) / 2, high - low


_THIRDS: Final = (1 / 3, 2 / 3, 1.0)
_IMPULSES: Final = (0.03, 0.1, 0.3)
_DEAD: Final = (0.01, 0.05, 0.2)
_LAG: Final = (1, 2, 4)
_ASKEW: Final = (0.03, 0.06, 0.12)

FAILURES: Final[Mapping[str, Mapping[str, Failure]]] = {
    "black": {
        "rgb": Failure(lose, share=_THIRDS, blank=0),
        "event": Failure(lose, share=_THIRDS, blank=EVENT_ZERO),  # a silent chip
        "depth": Failure(lose, share=_THIRDS, blank=0),  # no return
        "vector": Failure(lose_entries, share=_THIRDS),
    },
    "frozen": {sensor: Failure(hold, share=_THIRDS) for sensor in SENSORS},
    "noise": {
        "rgb": Failure(gaussian_noise, sigma=(15.0, 30.0, 60.0)),
        "event": Failure(spurious_events, unsigned={"signed": False}, rate=(0.05, 0.2, 0.8)),
        "depth": Failure(depth_noise, sigma=(3.0, 8.0, 20.0)),
        "vector": Failure(vector_noise, sigma=(0.05, 0.1, 0.2)),
    },
    "salt_and_pepper": {
        "rgb": Failure(impulses, share=_IMPULSES, dark=0, bright=255),
        "event": Failure(impulses, unsigned={"dark": EVENT_ZERO}, share=_IMPULSES, dark=1, bright=255, void=0),
        "depth": Failure(impulses, share=_IMPULSES, dark=1, bright=255, void=0),
    },
    "overexposure": {"rgb": Failure(expose, stops=(1.0, 2.0, 4.0))},
    "underexposure": {"rgb": Failure(expose, stops=(-2.0, -4.0, -6.0))},
    "motion_blur": {"rgb": Failure(blur, length=(0.05, 0.1, 0.2))},
    "lag": {sensor: Failure(delay, steps=_LAG) for sensor in SENSORS},
    "dead_pixels": {
        "rgb": Failure(stick, share=_DEAD, dark=0, bright=255),
        "event": Failure(stick, share=_DEAD, dark=EVENT_ZERO, bright=EVENT_ZERO + HOT_COUNT),  # dead or hot
        "depth": Failure(stick, share=_DEAD, dark=0, bright=1),  # no return or the nearest distance
        "vector": Failure(stick_entries, share=(0.1, 0.25, 0.5)),
    },
    "misalignment": {sensor: Failure(shift, distance=_ASKEW) for sensor in ("rgb", "event", "depth")},
    "event_storm": {"event": Failure(storm, unsigned={"signed": False}, rate=(1.0, 4.0, 16.0))},
    "depth_dropout": {"depth": Failure(drop_patches, share=(0.1, 0.3, 0.6), patch=1 / 16)},
}
"""
All failures: kind -> sensor -> function and its parameters at severities 1, 2, 3. A kind lists the sensors that can
have it: event cameras, for example, have neither exposure nor motion blur. The parameters are

- ``share``: of the columns (black, frozen), pixels (salt_and_pepper, dead_pixels), patches (depth_dropout) or entries
  of a vector that fail; ``blank``, ``dark``, ``bright``: their values; ``void``: a code that is kept;
- ``sigma``: standard deviation of the noise, in codes (rgb, depth) or relative to the range (vector);
- ``rate``: additional events per pixel and bin;
- ``stops``: powers of two of light;
- ``length``, ``distance``, ``patch``: relative to the width of the image;
- ``steps``: steps of the environment.
"""


def failures_for(sensor: str) -> tuple[str, ...]:
    """
    List the kinds of failure of a sensor.

    :param sensor: "rgb", "event", "depth" or "vector".
    :return: Keys of :data:`FAILURES`, in its order.
    :raises ValueError: If the sensor is unknown.
    """
    if sensor not in SENSORS:
        raise ValueError(f"sensor must be one of {SENSORS}, got {sensor!r}")
    return tuple(kind for kind, sensors in FAILURES.items() if sensor in sensors)
