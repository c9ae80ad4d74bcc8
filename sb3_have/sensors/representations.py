"""Images made from events, and their 8-bit codes in observations."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_have.sensors.checks import is_finite

Representation = Literal["sbt", "voxel", "count", "polarity", "time_surface"]

# Code of "no event" in an 8-bit event image. Code 0 never occurs in data and means that there is no data.
EVENT_ZERO = 128
EVENT_LIMIT = 127


def stack_by_time(
    events: NDArray[np.void], bins: int, t0: float, t1: float, height: int, width: int
) -> NDArray[np.float64]:
    """
    Stack events by time (SBT): sum the polarities in each of ``bins`` equal slices of the window.

    V[b] = sum p over the events with b = floor(bins (t - t0) / (t1 - t0)); an event at t1 belongs to the last slice
    (Wang et al., "Event-based High Dynamic Range Image and Very High Frame Rate Video Generation", CVPR 2019).

    :param events: Structured array with fields x, y (pixels), t (seconds) and p (+1 or -1), in any order.
    :param bins: Number of slices.
    :param t0: Start of the window in seconds.
    :param t1: End of the window in seconds. Events outside [t0, t1] are left out.
    :param height: Rows in pixels.
    :param width: Columns in pixels.
    :return: Signed counts, (height, width, bins).
    :raises ValueError: If the window is empty or infinite, there are no bins, an event lies outside the image, or a
        polarity is not +1 or -1.
    """
    return represent(*_flatten(events, height, width), bins, t0, t1, height, width, "sbt")


def voxel_grid(
    events: NDArray[np.void], bins: int, t0: float, t1: float, height: int, width: int
) -> NDArray[np.float64]:
    """
    Make a voxel grid: share each polarity linearly between the two nearest of ``bins`` instants.

    ``V[b] = sum p max(0, 1 - |b - tau|)`` with tau = (bins - 1) (t - t0) / (t1 - t0) (Zhu et al., "Unsupervised
    Event-based Learning of Optical Flow, Depth, and Egomotion", CVPR 2019). Parameters, return value and errors are
    those of :func:`stack_by_time`.
    """
    return represent(*_flatten(events, height, width), bins, t0, t1, height, width, "voxel")


def count_frames(
    events: NDArray[np.void], bins: int, t0: float, t1: float, height: int, width: int, polarity: int = 0
) -> NDArray[np.float64]:
    """
    Count the events in each of ``bins`` equal slices of the window.

    The other parameters, the return value and the errors are those of :func:`stack_by_time`.

    :param polarity: +1 or -1 to count only the events of that polarity, 0 for both.
    """
    if polarity not in (-1, 0, 1):
        raise ValueError(f"polarity must be -1, 0 or +1, got {polarity!r}")
    if polarity:
        events = events[events["p"] == polarity]
    return represent(*_flatten(events, height, width), bins, t0, t1, height, width, "count")


def polarity_counts(
    events: NDArray[np.void], bins: int, t0: float, t1: float, height: int, width: int
) -> NDArray[np.float64]:
    """
    Count the events of each polarity in each of ``bins`` equal slices of the window, so that none cancel.

    These are the histograms of Maqueda et al., "Event-based Vision meets Deep Learning on Steering Prediction for
    Self-driving Cars", CVPR 2018. Parameters and errors are those of :func:`stack_by_time`.

    :return: Counts, (height, width, 2 * bins). Channel b holds the positive events of slice b, channel bins + b the
        negative ones.
    """
    return represent(*_flatten(events, height, width), bins, t0, t1, height, width, "polarity")


def time_surface(
    events: NDArray[np.void], t1: float, tau: float, height: int, width: int, t0: float = -np.inf
) -> NDArray[np.float64]:
    """
    Show how recent the last event of each polarity is: exp(-(t1 - t_last) / tau).

    See Lagorce et al., "HOTS: A Hierarchy of Event-Based Time-Surfaces for Pattern Recognition", TPAMI 2017.

    :param events: Structured array with fields x, y (pixels), t (seconds) and p (+1 or -1), in any order.
    :param t1: Current time in seconds. Later events are left out.
    :param tau: Time constant in seconds, > 0.
    :param height: Rows in pixels.
    :param width: Columns in pixels.
    :param t0: Start of the window in seconds. Earlier events are left out.
    :return: (height, width, 2), positive and negative polarity: 1 for an event at t1, 0 where there was none.
    :raises ValueError: If the time constant is not positive, t0 >= t1, or an event lies outside the image.
    """
    return represent(*_flatten(events, height, width), 1, t0, t1, height, width, "time_surface", tau)


def channels(representation: Representation, bins: int) -> int:
    """
    Return the number of channels: ``bins``, twice that for ``"polarity"``, 2 for ``"time_surface"``.

    :param representation: As in :func:`represent`.
    :param bins: Number of slices, >= 1.
    :raises ValueError: If the representation is unknown or there are no bins.
    """
    if representation not in get_args(Representation):
        raise ValueError(f"representation must be one of {get_args(Representation)}, got {representation!r}")
    if bins < 1:
        raise ValueError(f"need bins >= 1, got {bins}")
    return {"polarity": 2 * bins, "time_surface": 2}.get(representation, bins)


def represent(
    pixel: NDArray[np.int64],
    times: NDArray[np.float64],
    polarity: NDArray[np.float64],
    bins: int,
    t0: float,
    t1: float,
    height: int,
    width: int,
    representation: Representation = "sbt",
    tau: float | None = None,
) -> NDArray[np.float64]:
    """
    Make an image of any representation from flat arrays, as :meth:`EventCamera.detect` returns them.

    :param pixel: Pixel index of every event, row * width + column.
    :param times: Time of every event in seconds.
    :param polarity: +1 or -1 of every event.
    :param bins: Number of slices, >= 1; a time surface ignores it.
    :param t0: Start of the window in seconds.
    :param t1: End of the window in seconds. Events outside [t0, t1] are left out.
    :param height: Rows in pixels.
    :param width: Columns in pixels.
    :param representation: ``"sbt"`` (:func:`stack_by_time`), ``"voxel"`` (:func:`voxel_grid`), ``"count"``
        (:func:`count_frames`), ``"polarity"`` (:func:`polarity_counts`) or ``"time_surface"`` (:func:`time_surface`).
    :param tau: Time constant of ``"time_surface"`` in seconds; by default the length of the window, so that all events
        lie between 1/e and 1.
    :return: (height, width, ``channels(representation, bins)``).
    :raises ValueError: If the window is empty or infinite, or an option does not fit the representation.
    """
    depth = channels(representation, bins)
    # Slices need a finite window, a time surface only its end
    if not t0 < t1 < np.inf or (t0 == -np.inf and representation != "time_surface"):
        raise ValueError(f"need finite times t0 < t1, got t0={t0}, t1={t1}")
    if tau is not None and representation != "time_surface":
        raise ValueError(f"tau is the time constant of 'time_surface'; leave it out for {representation!r}")
    inside = (times >= t0) & (times <= t1)
    if not inside.all():
        pixel, times, polarity = pixel[inside], times[inside], polarity[inside]
    if representation == "time_surface":
        return _time_surface(2 * pixel + (polarity < 0), times, t1, t1 - t0 if tau is None else tau, height, width)
    if representation == "voxel":
        at = (bins - 1) * (times - t0) / (t1 - t0)
        below = np.minimum(at.astype(np.int64), max(bins - 2, 0))
        above = np.minimum(below + 1, bins - 1)
        share = at - below
        index = np.concatenate((pixel * bins + below, pixel * bins + above))
        weight = np.concatenate((polarity * (1 - share), polarity * share))
    else:
        index = pixel * depth + np.minimum((bins * (times - t0) / (t1 - t0)).astype(np.int64), bins - 1)
        if representation == "polarity":
            index += bins * (polarity < 0)
        weight = polarity if representation == "sbt" else np.ones(len(index))
    summed = np.bincount(index, weights=weight, minlength=height * width * depth)
    return summed.astype(np.float64, copy=False).reshape(height, width, depth)


def _time_surface(
    index: NDArray[np.int64], times: NDArray[np.float64], now: float, tau: float, height: int, width: int
) -> NDArray[np.float64]:
    if not is_finite(tau) or tau <= 0:
        raise ValueError(f"tau must be a finite number of seconds > 0, got {tau!r}")
    last = np.full(height * width * 2, -np.inf)
    np.maximum.at(last, index, times)
    return np.exp((last - now) / tau).reshape(height, width, 2)


def encode_events(values: ArrayLike, representation: Representation = "sbt") -> NDArray[np.uint8]:
    """
    Encode an event image in 8 bits.

    Counts become 128 + count, rounded and clipped to -127..127. A time surface (0..1) becomes 128 + 127 * value. Both
    have 128 for "no event"; events older than 5.5 time constants are rounded to it.

    :param values: Array of any shape.
    :param representation: Representation of the values; all but ``"time_surface"`` are counts.
    :return: uint8 of the same shape, 1..255.
    """
    scaled = np.asarray(values, dtype=np.float64) * _unit(representation)
    return np.asarray(EVENT_ZERO + np.clip(np.rint(scaled), -EVENT_LIMIT, EVENT_LIMIT), dtype=np.uint8)


def decode_events(codes: ArrayLike, representation: Representation = "sbt") -> NDArray[np.float32]:
    """
    Invert :func:`encode_events`. Code 0 means "no data" (a padded or failed frame) and decodes to 0, no event.

    :param codes: uint8 array of any shape.
    :param representation: Representation of the codes.
    :return: float32 of the same shape: counts -127..127, or a time surface 0..1.
    """
    codes = np.asarray(codes)
    if codes.dtype != np.uint8:
        raise ValueError(f"event codes must be uint8, got {codes.dtype}")
    return np.where(codes == 0, np.float32(0), (codes.astype(np.float32) - EVENT_ZERO) / _unit(representation))


def _unit(representation: Representation) -> np.float32:
    """Return the number of codes between the values 0 and 1."""
    channels(representation, 1)  # raises if the representation is unknown
    return np.float32(EVENT_LIMIT if representation == "time_surface" else 1)


def _flatten(
    events: NDArray[np.void], height: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    x, y = events["x"].astype(np.int64), events["y"].astype(np.int64)
    if len(events) and (x.min() < 0 or y.min() < 0 or x.max() >= width or y.max() >= height):
        raise ValueError(f"events lie outside an image of {height} rows and {width} columns")
    polarity = events["p"].astype(np.float64)
    if (np.abs(polarity) != 1).any():
        raise ValueError("polarities p must be +1 or -1; convert 0 and 1, common in files, with 2 * p - 1")
    return y * width + x, events["t"].astype(np.float64), polarity
