"""What can go wrong with a sensor: pure functions that corrupt one image or vector, and the table of their severities.

Every function has the form ``f(image, rng, **parameters) -> new image``: it leaves its input alone and keeps shape and
dtype. The kinds follow the common-corruption benchmarks of robust perception (Hendrycks and Dietterich, "Benchmarking
Neural Network Robustness to Common Corruptions and Perturbations", ICLR 2019) and what event and depth cameras add;
the numbers are our own. Images are uint8 (H, W, C) as everywhere in this package: events 128 + signed count with 0 for
"no data", depth 1..255 with 0 for "nothing there".
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

#: What a sensor can be; it decides what each failure looks like.
SENSORS: Final = ("rgb", "event", "depth", "vector")
#: Exponent between the digital numbers of a colour camera and light.
GAMMA: Final = 2.2
#: Events per bin of a hot pixel of an event camera.
HOT_COUNT: Final = 20
#: Bounds of a vector farther apart than this say nothing about its scale.
UNBOUNDED: Final = 1e6


class Failure:
    """
    One kind of failure on one sort of sensor.

    :param function: ``f(image, rng, **parameters)``, a function of this module.
    :param parameters: Its named parameters: a triple for the three severities, or one number for all of them.
    """

    def __init__(self, function: Callable[..., Array], **parameters: float | tuple[float, float, float]) -> None:
        self.function = function
        self.parameters = parameters

    def at(self, severity: int) -> dict[str, float]:
        """The parameters at severity 1, 2 or 3."""
        return {
            name: value[severity - 1] if isinstance(value, tuple) else value for name, value in self.parameters.items()
        }


def lose(image: Array, rng: Rng, share: float, blank: int) -> Array:
    """
    A bank of columns is no longer read: the last ``share`` of them is ``blank``. Columns, because in most scenes the
    rows of the sky would not be missed.
    """
    lost = image.copy()
    lost[:, _first_lost(image.shape[1], share) :] = blank
    return lost


def hold(image: Array, rng: Rng, past: Array, share: float) -> Array:
    """A bank of columns is no longer read: the last ``share`` of them keeps what it showed in ``past``."""
    held = image.copy()
    first = _first_lost(image.shape[1], share)
    held[:, first:] = past[:, first:]
    return held


def lose_entries(vector: Array, rng: Rng, low: Array, high: Array, share: float) -> Array:
    """The last ``share`` of the entries of a vector reads zero, or the bound nearest to it."""
    lost = vector.copy()
    lost[_first_lost(len(vector), share) :] = 0
    return np.clip(lost, low, high)


def hold_entries(vector: Array, rng: Rng, past: Array, share: float) -> Array:
    """The last ``share`` of the entries of a vector keeps what it showed in ``past``."""
    first = _first_lost(len(vector), share)
    return np.concatenate((vector[:first], past[first:]))


def delay(image: Array, rng: Rng, past: Array, steps: float) -> Array:
    """The image of ``steps`` steps ago, ``past``."""
    return past.copy()


def gaussian_noise(image: Image, rng: Rng, sigma: float) -> Image:
    """Normal noise on every digital number. ``sigma`` of 255."""
    return _codes(image + sigma * rng.standard_normal(image.shape, np.float32), 0)


def spurious_events(image: Image, rng: Rng, rate: float, signed: bool = True) -> Image:
    """
    Events out of thin air, of either sign or, if not ``signed``, counted up. ``rate`` expected per pixel and bin; where
    there is no data stays 0.
    """
    entries = rng.integers(image.size, size=rng.poisson(rate * image.size))
    signs = rng.choice((-1.0, 1.0), len(entries)) if signed else np.ones(len(entries))
    return _add_events(image, np.bincount(entries, signs, image.size).reshape(image.shape))


def depth_noise(image: Image, rng: Rng, sigma: float) -> Image:
    """
    Normal noise on the code of every valid pixel; "nothing there" stays. ``sigma`` in codes, in the logarithmic
    encoding 2.3% of the distance each.
    """
    return np.where(image > 0, _codes(image + sigma * rng.standard_normal(image.shape, np.float32), 1), image)


def vector_noise(vector: Array, rng: Rng, low: Array, high: Array, sigma: float) -> Array:
    """Normal noise, clipped to the bounds. ``sigma`` of the width of each entry's range, or of 1 without bounds."""
    _, width = _range(low, high)
    noisy = vector + sigma * width * rng.standard_normal(vector.shape)
    return np.clip(noisy, low, high).astype(vector.dtype)


def impulses(image: Image, rng: Rng, share: float, dark: int, bright: int, void: int | None = None) -> Image:
    """
    Salt and pepper: other pixels each time read ``dark`` or ``bright`` in all channels. ``share`` of the pixels; those
    that read ``void`` are spared.
    """
    draw = rng.random(image.shape[:2])[..., None]
    spoilt = np.where(draw < share / 2, dark, np.where(draw < share, bright, image)).astype(np.uint8)
    return spoilt if void is None else np.where(image == void, image, spoilt)


def expose(image: Image, rng: Rng, stops: float) -> Image:
    """Wrong exposure: 2 ** ``stops`` times the light, in the gamma of the image; what leaves the range is clipped."""
    return _codes(image * np.float32(2 ** (stops / GAMMA)), 0)


def blur(image: Image, rng: Rng, length: float) -> Image:
    """
    The camera shakes during the exposure: a straight smear in a direction drawn each time, as one frame has no past to
    average. ``length`` of the image's width, 3 pixels at least.
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
    Dead pixels: half of them stuck at ``dark``, half at ``bright``, in all channels. ``share`` of the pixels, at least
    one. A generator in the same state gives the same pixels, and more of them at a larger share.
    """
    stuck = image.copy()
    pixels = stuck.reshape(-1, image.shape[-1])
    order = rng.permutation(len(pixels))[: max(1, round(share * len(pixels)))]
    pixels[order[::2]], pixels[order[1::2]] = dark, bright
    return stuck


def stick_entries(vector: Array, rng: Rng, low: Array, high: Array, share: float) -> Array:
    """Stuck entries, each at a value drawn from its range. ``share`` of the entries, at least one."""
    middle, width = _range(low, high)
    values = np.clip(middle + width * rng.uniform(-0.5, 0.5, vector.shape), low, high).astype(vector.dtype)
    order = rng.permutation(len(vector))[: max(1, round(share * len(vector)))]
    stuck = vector.copy()
    stuck[order] = values[order]
    return stuck


def shift(image: Image, rng: Rng, distance: float) -> Image:
    """
    The sensor sits askew: everything is moved in a direction drawn from ``rng``, the edge repeated. ``distance`` of the
    image's width, at least one pixel.
    """
    height, width = image.shape[:2]
    pixels, angle = max(1.0, distance * width), rng.uniform(0, 2 * np.pi)
    rows = np.clip(np.arange(height) - round(pixels * np.sin(angle)), 0, height - 1)
    columns = np.clip(np.arange(width) - round(pixels * np.cos(angle)), 0, width - 1)
    return np.asarray(image[rows[:, None], columns])


def storm(image: Image, rng: Rng, rate: float, signed: bool = True) -> Image:
    """
    A flickering light floods the sensor: all pixels fire together, brighter in one bin and darker in the next or, if
    not ``signed``, counted up in all. ``rate`` expected per pixel and bin; where there is no data stays 0.
    """
    signs = rng.choice((-1, 1)) * (-1) ** np.arange(image.shape[-1]) if signed else 1
    return _add_events(image, signs * rng.poisson(rate, image.shape))


def drop_patches(image: Image, rng: Rng, share: float, patch: float) -> Image:
    """No return from square patches. ``share`` of the patches, each with sides of ``patch`` of the image's width."""
    height, width = image.shape[:2]
    side = max(1, round(patch * width))
    grid = rng.random((-(-height // side), -(-width // side))) < share
    lost = grid.repeat(side, axis=0).repeat(side, axis=1)[:height, :width, None]
    return np.where(lost, np.uint8(0), image)


def _first_lost(length: int, share: float) -> int:
    return length - max(1, round(share * length))


def _codes(values: Array, least: int) -> Image:
    return np.clip(np.rint(values), least, 255).astype(np.uint8)


def _add_events(image: Image, counts: Array) -> Image:
    return np.where(image == 0, image, _codes(image + counts, 1))


def _range(low: Array, high: Array) -> tuple[Array, Array]:
    """Middle and width of each entry's range; 0 and 1 for an entry without bounds."""
    low, high = low.astype(np.float64), high.astype(np.float64)
    bounded = (low > -UNBOUNDED) & (high < UNBOUNDED)
    low, high = np.where(bounded, low, -0.5), np.where(bounded, high, 0.5)
    return (low + high) / 2, high - low


_THIRDS: Final = (1 / 3, 2 / 3, 1.0)
_IMPULSES: Final = (0.03, 0.1, 0.3)
_DEAD: Final = (0.01, 0.05, 0.2)
_LAG: Final = (1, 2, 4)
_ASKEW: Final = (0.03, 0.06, 0.12)

#: Every failure: kind -> sensor -> function and parameters at severities 1, 2, 3. A sensor that is missing does not
#: know the kind: an event camera, for one, has no exposure and no motion blur. What the parameters mean:
#:
#: - ``share``: of the columns (black, frozen), pixels (salt_and_pepper, dead_pixels), patches (depth_dropout) or
#:   entries of a vector that fail; ``blank``, ``dark``, ``bright``: what they read; ``void``: a code that is spared
#: - ``sigma``: standard deviation of noise: rgb and depth in codes, vectors in widths of their range
#: - ``rate``: additional events per pixel and bin, see also :data:`UNSIGNED`
#: - ``stops``: powers of two of light
#: - ``length``, ``distance``, ``patch``: in widths of the image
#: - ``steps``: of the environment
FAILURES: Final[Mapping[str, Mapping[str, Failure]]] = {
    "black": {
        "rgb": Failure(lose, share=_THIRDS, blank=0),
        "event": Failure(lose, share=_THIRDS, blank=EVENT_ZERO),  # a silent chip
        "depth": Failure(lose, share=_THIRDS, blank=0),  # no return
        "vector": Failure(lose_entries, share=_THIRDS),
    },
    "frozen": {
        "rgb": Failure(hold, share=_THIRDS),
        "event": Failure(hold, share=_THIRDS),
        "depth": Failure(hold, share=_THIRDS),
        "vector": Failure(hold_entries, share=_THIRDS),
    },
    "noise": {
        "rgb": Failure(gaussian_noise, sigma=(15.0, 30.0, 60.0)),
        "event": Failure(spurious_events, rate=(0.05, 0.2, 0.8)),
        "depth": Failure(depth_noise, sigma=(3.0, 8.0, 20.0)),
        "vector": Failure(vector_noise, sigma=(0.05, 0.1, 0.2)),
    },
    "salt_and_pepper": {
        "rgb": Failure(impulses, share=_IMPULSES, dark=0, bright=255),
        "event": Failure(impulses, share=_IMPULSES, dark=1, bright=255, void=0),
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
    "event_storm": {"event": Failure(storm, rate=(1.0, 4.0, 16.0))},
    "depth_dropout": {"depth": Failure(drop_patches, share=(0.1, 0.3, 0.6), patch=1 / 16)},
}

#: What differs in event images of the representations "count", "polarity" and "time_surface", whose codes do not fall
#: below "no event": kind -> parameters.
UNSIGNED: Final[Mapping[str, Mapping[str, Any]]] = {
    "noise": {"signed": False},
    "salt_and_pepper": {"dark": EVENT_ZERO},
    "event_storm": {"signed": False},
}


def failures_for(sensor: str) -> tuple[str, ...]:
    """
    The kinds of failure that a sensor knows.

    :param sensor: "rgb", "event", "depth" or "vector".
    :return: Keys of :data:`FAILURES`, in its order.
    :raises ValueError: on another sensor.
    """
    if sensor not in SENSORS:
        raise ValueError(f"sensor must be one of {SENSORS}, got {sensor!r}")
    return tuple(kind for kind, sensors in FAILURES.items() if sensor in sensors)
