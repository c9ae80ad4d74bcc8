"""From a list of events to an image that a network can read, and its 8-bit form in observations."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

Representation = Literal["sbt", "voxel", "count"]

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
    :raises ValueError: on an empty window, no bins, or events outside the image.
    """
    return represent(*_flatten(events, height, width), bins, t0, t1, height, width, "sbt")


def voxel_grid(
    events: NDArray[np.void], bins: int, t0: float, t1: float, height: int, width: int
) -> NDArray[np.float64]:
    """
    Voxel grid: each polarity is shared linearly between the two nearest of ``bins`` instants, tau = (bins - 1)
    (t - t0) / (t1 - t0), V[b] = sum p max(0, 1 - |b - tau|) (Zhu et al., "Unsupervised Event-based Learning of
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
) -> NDArray[np.float64]:
    """
    Any of the three representations from flat arrays, as :meth:`EventCamera.detect` returns them.

    :param pixel: Pixel index of every event, row * width + column.
    :param times: Time of every event in seconds.
    :param polarity: +1 or -1 of every event.
    :param representation: ``"sbt"`` (:func:`stack_by_time`), ``"voxel"`` (:func:`voxel_grid`) or ``"count"``
        (:func:`count_frames`).
    :return: (height, width, bins).
    """
    if bins < 1 or not t1 > t0:
        raise ValueError(f"need bins >= 1 and t1 > t0, got bins={bins}, t0={t0}, t1={t1}")
    if representation not in get_args(Representation):
        raise ValueError(f"representation must be one of {get_args(Representation)}, got {representation!r}")
    inside = (times >= t0) & (times <= t1)
    if not inside.all():
        pixel, times, polarity = pixel[inside], times[inside], polarity[inside]
    if representation == "voxel":
        tau = (bins - 1) * (times - t0) / (t1 - t0)
        below = np.minimum(tau.astype(np.int64), max(bins - 2, 0))
        above = np.minimum(below + 1, bins - 1)
        share = tau - below
        index = np.concatenate((pixel * bins + below, pixel * bins + above))
        weight = np.concatenate((polarity * (1 - share), polarity * share))
    else:
        index = pixel * bins + np.minimum((bins * (times - t0) / (t1 - t0)).astype(np.int64), bins - 1)
        weight = np.ones(len(index)) if representation == "count" else polarity
    summed = np.bincount(index, weights=weight, minlength=height * width * bins)
    return summed.astype(np.float64, copy=False).reshape(height, width, bins)


def encode_events(counts: ArrayLike) -> NDArray[np.uint8]:
    """
    8-bit form of signed counts: 128 + count, the count rounded and clipped to -127..127.

    :param counts: Array of any shape.
    :return: uint8 of the same shape, 1..255; 128 is "no event".
    """
    clipped = np.clip(np.rint(np.asarray(counts, dtype=np.float64)), -EVENT_LIMIT, EVENT_LIMIT)
    return np.asarray(EVENT_ZERO + clipped, dtype=np.uint8)


def decode_events(codes: ArrayLike) -> NDArray[np.float32]:
    """
    Inverse of :func:`encode_events`. Code 0 is "no data" (a padded or failed frame) and decodes to 0, no event.

    :param codes: uint8 array of any shape.
    :return: float32 counts of the same shape, -127..127.
    """
    codes = np.asarray(codes)
    if codes.dtype != np.uint8:
        raise ValueError(f"event codes must be uint8, got {codes.dtype}")
    return np.where(codes == 0, np.float32(0), codes.astype(np.float32) - EVENT_ZERO)


def _flatten(
    events: NDArray[np.void], height: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    x, y = events["x"].astype(np.int64), events["y"].astype(np.int64)
    if len(events) and (x.min() < 0 or y.min() < 0 or x.max() >= width or y.max() >= height):
        raise ValueError(f"events lie outside an image of {height} rows and {width} columns")
    return y * width + x, events["t"].astype(np.float64), events["p"].astype(np.float64)
