"""A literal event camera, one pixel and one event at a time, against which the vectorised one is held.

It is plain Python in double precision and has no randomness: the thresholds and leak phases of a pixel and the noise
events that hit it are arguments.
"""

import math
from collections.abc import Sequence

import numpy as np

Event = tuple[float, int]  # time in seconds, polarity +1 or -1


def mapped(intensity: float, mapping: str, log_eps: float) -> float:
    """The brightness that a pixel sees. NumPy's logarithm, as Python's may differ in the last bit."""
    if mapping == "identity":
        return intensity
    if mapping == "lin_log":
        return float(np.log(intensity)) if intensity > 20 else intensity * math.log(20) / 20
    return float(np.log(log_eps + intensity))


def crossings(reference: float, before: float, after: float, threshold: float, polarity: int) -> list[float]:
    """
    The shares of the step at which the line from ``before`` to ``after`` meets reference + polarity * k * C.

    A threshold that the step before missed by the last bit lies on the other side of ``before``: it is met at once.
    """
    shares: list[float] = []
    while polarity * (reference + polarity * (len(shares) + 1) * threshold) <= polarity * after:
        met = reference + polarity * (len(shares) + 1) * threshold
        shares.append(min(max((met - before) / (after - before), 0.0), 1.0))
    return shares


def pixel_events(
    intensities: Sequence[float],
    times: Sequence[float],
    thresholds: tuple[float, float],
    leak_phase: float = 0.0,
    mapping: str = "log",
    log_eps: float = 1e-3,
    leak_rate: float = 0.0,
    cutoff_hz: float | None = None,
    cutoff_intensity: float | None = None,
) -> list[list[Event]]:
    """The threshold crossings of one pixel in the step up to each frame, before noise and dead time.

    :param intensities: What the pixel sees in each frame.
    :param times: Times of the frames in seconds.
    :param thresholds: Positive and negative contrast threshold of the pixel.
    :param leak_phase: Share of the positive threshold by which the reference starts below the level.
    :param mapping: As in ``EventCamera``, like all that follow.
    :return: One list for each frame, the first one empty.
    """
    positive, negative = thresholds
    bright = filtered = level = mapped(intensities[0], mapping, log_eps)
    reference = level - leak_phase * positive
    found: list[list[Event]] = [[]]
    for i in range(1, len(times)):
        duration, bright_before, level_before = times[i] - times[i - 1], bright, level
        bright = mapped(intensities[i], mapping, log_eps)
        if cutoff_hz is None:
            filtered = bright
        else:
            dimmed = 1.0 if cutoff_intensity is None else min(max(intensities[i] / cutoff_intensity, 0.1), 1.0)
            tau = 1 / (2 * math.pi * cutoff_hz * dimmed)
            slope = (bright - bright_before) / duration
            filtered = bright - slope * tau + (filtered - bright_before + slope * tau) * math.exp(-duration / tau)
        level = filtered + positive * leak_rate * (times[i] - times[0])

        events: list[Event] = []
        if level != level_before:  # a constant level crosses nothing, whatever the rounding of the reference
            polarity, threshold = (1, positive) if level > reference else (-1, negative)
            shares = crossings(reference, level_before, level, threshold, polarity)
            events = [(times[i - 1] + share * duration, polarity) for share in shares]
            reference = reference + polarity * len(shares) * threshold
        found.append(events)
    return found


def after_dead_time(steps: Sequence[Sequence[Event]], refractory: float) -> list[list[Event]]:
    """The events of one pixel that do not come earlier than ``refractory`` after the last event that was kept."""
    last, kept = -math.inf, []
    for events in steps:
        kept.append(list[Event]())
        for t, polarity in sorted(events):
            if t - last >= refractory:
                kept[-1].append((t, polarity))
                last = t
    return kept
