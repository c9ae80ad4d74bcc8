"""From a list of events to an image that a network can read, and its 8-bit form in observations."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_have.sensors.checks import is_finite

Representation = Literal["sbt", "voxel", "count", "polarity", "time_surface"]

#: The code of "no event" in an 8-bit event image. Code 0 never occurs in data: it says that there is no data.
EVENT_ZERO = 128
EVENT_LIMIT = 127


def stack_by_time(
    events: NDArray[np.void], bins: int, t0: float, t1: float, height: int, width: int
) -> NDArray[np.float64]:
    """
    Stacking by time (SBT): the sum of polarities in each of ``bins`` equal slices of [t0, t1], V[b] = sum p over the
    events with b = floor(bins (t - t0) / (t1 - t0)); an event at t1 belongs to the last slice
    (Wang et al., "Event-based High Dynamic Range Image and Very High Frame Rate Video Generation", CVPR 2019).

    :param events: Structured array with fields x, y, t (seconds) and p (+1 or -1), in any order.
    :param bins: Number of slices.
    :param t0: Start of the window in seconds.
    :param t1: End of the window; events outside [t0, t1] are left out.
    :param height: Rows.
    :param width: Columns.
    :return: (height, width, bins), signed counts.
    :raises ValueError: on an empty or endless window, no bins, events outside the image, or other polarities.
    """
    return represent(*_flatten(events, height, width), bins, t0, t1, height, width, "sbt")


def voxel_grid(
    events: NDArray[np.void], bins: int, t0: float, t1: float, height: int, width: int
) -> NDArray[np.float64]:
    """
    Voxel grid: each polarity is shared linearly between the two nearest of ``bins`` instants, tau = (bins - 1)
    (t - t0) / (t1 - t0), ``V[b] = sum p max(0, 1 - |b - tau|)`` (Zhu et al., "Unsupervised Event-based Learning of
    Optical Flow, Depth, and Egomotion", CVPR 2019). Parameters, return and errors as :func:`stack_by_time`.
    """
    return represent(*_flatten(events, height, width), bins, t0, t1, height, width, "voxel")


def count_frames(
    events: NDArray[np.void], bins: int, t0: float, t1: float, height: int, width: int, polarity: int = 0
) -> NDArray[np.float64]:
    """
    The number of events in each of ``bins`` equal slices of [t0, t1], whatever their sign.

    Parameters, return and errors as :func:`stack_by_time`, and:

    :param polarity: +1 or -1 counts the events of that polarity only; 0 counts both.
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
    The number of events of each polarity in each of ``bins`` equal slices of [t0, t1], so that nothing cancels
    (per-polarity histograms: Maqueda et al., "Event-based Vision meets Deep Learning on Steering Prediction for
    Self-driving Cars", CVPR 2018). Parameters and errors as :func:`stack_by_time`.

    :return: (height, width, 2 * bins): channel b counts the positive events of slice b, channel bins + b its negative.
    """
    return represent(*_flatten(events, height, width), bins, t0, t1, height, width, "polarity")


def time_surface(
    events: NDArray[np.void], t1: float, tau: float, height: int, width: int, t0: float = -np.inf
) -> NDArray[np.float64]:
    """
    How recent the last event of each polarity is, exp(-(t1 - t_last) / tau) (Lagorce et al., "HOTS: A Hierarchy of
    Event-Based Time-Surfaces for Pattern Recognition", TPAMI 2017).

    :param events: Structured array with fields x, y, t (seconds) and p (+1 or -1), in any order.
    :param t1: Now, in seconds; later events are left out.
    :param tau: Time constant in seconds, > 0.
    :param height: Rows.
    :param width: Columns.
    :param t0: Earlier events are left out.
    :return: (height, width, 2), positive and negative: 1 for an event right now, 0 where there was none.
    :raises ValueError: on a time constant that is not positive, t0 >= t1, or events outside the image.
    """
    return represent(*_flatten(events, height, width), 1, t0, t1, height, width, "time_surface", tau)


def channels(representation: Representation, bins: int) -> int:
    """
    The number of channels of a representation: ``bins``, twice that for ``"polarity"``, 2 for ``"time_surface"``.

    :param representation: As in :func:`represent`.
    :param bins: Number of slices, >= 1.
    :raises ValueError: on an unknown representation or no bins.
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
    Any of the representations from flat arrays, as :meth:`EventCamera.detect` returns them.

    :param pixel: Pixel index of every event, row * width + column.
    :param times: Time of every event in seconds.
    :param polarity: +1 or -1 of every event.
    :param bins: Number of slices, >= 1; a time surface has none and takes no notice.
    :param t0: Start of the window in seconds.
    :param t1: End of the window; events outside [t0, t1] are left out.
    :param height: Rows.
    :param width: Columns.
    :param representation: ``"sbt"`` (:func:`stack_by_time`), ``"voxel"`` (:func:`voxel_grid`), ``"count"``
        (:func:`count_frames`), ``"polarity"`` (:func:`polarity_counts`) or ``"time_surface"`` (:func:`time_surface`).
    :param tau: Time constant of ``"time_surface"`` in seconds; by default the length of the window, so that all of its
        events lie between 1/e and 1. Whatever it is, events before t0 are left out: images of one step after the other
        hold the events of their own step only.
    :return: (height, width, C) with C as :func:`channels` has it.
    """
    depth = channels(representation, bins)
    # A time surface looks back as far as it likes; slices need two ends.
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
    8-bit form of an event image: 128 + count, the count rounded and clipped to -127..127. A time surface, between 0
    and 1, is 128 + 127 * value. In either form 128 is "no event" and the code grows with what there was; events older
    than 5.5 time constants are rounded to it.

    :param values: Array of any shape.
    :param representation: What the values are; all but ``"time_surface"`` are counts.
    :return: uint8 of the same shape, 1..255.
    """
    scaled = np.asarray(values, dtype=np.float64) * _unit(representation)
    return np.asarray(EVENT_ZERO + np.clip(np.rint(scaled), -EVENT_LIMIT, EVENT_LIMIT), dtype=np.uint8)


def decode_events(codes: ArrayLike, representation: Representation = "sbt") -> NDArray[np.float32]:
    """
    Inverse of :func:`encode_events`. Code 0 is "no data" (a padded or failed frame) and decodes to 0, no event.

    :param codes: uint8 array of any shape.
    :param representation: What the codes stand for.
    :return: float32 of the same shape: counts -127..127, or a time surface 0..1.
    """
    codes = np.asarray(codes)
    if codes.dtype != np.uint8:
        raise ValueError(f"event codes must be uint8, got {codes.dtype}")
    return np.where(codes == 0, np.float32(0), (codes.astype(np.float32) - EVENT_ZERO) / _unit(representation))


def _unit(representation: Representation) -> np.float32:
    """The number of codes that a value of 1 takes."""
    channels(representation, 1)  # complains about an unknown one
    return np.float32(EVENT_LIMIT if representation == "time_surface" else 1)


def _flatten(
    events: NDArray[np.void], height: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    x, y = events["x"].astype(np.int64), events["y"].astype(np.int64)
    if len(events) and (x.min() < 0 or y.min() < 0 or x.max() >= width or y.max() >= height):
        raise ValueError(f"events lie outside an image of {height} rows and {width} columns")
    polarity = events["p"].astype(np.float64)
    if (np.abs(polarity) != 1).any():
        raise ValueError("polarities p must be +1 or -1; turn 0 and 1, as most files have them, into 2 * p - 1")
    return y * width + x, events["t"].astype(np.float64), polarity
