"""An event camera: brightness frames in, asynchronous signed events out.

Every pixel remembers a reference level of log brightness. Whenever the brightness has moved away from it by one
contrast threshold the pixel fires an event, and the reference moves by that threshold. Between two frames the
brightness is taken as linear in time, so a fast change gives several events, each with its own time stamp
(Rebecq et al., "ESIM: an Open Event Camera Simulator", CoRL 2018). Noise follows Hu et al., "v2e: From Video
Frames to Realistic DVS Events", CVPRW 2021.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

Mapping = Literal["log", "lin_log", "identity"]

#: One event: column, row, time in seconds, polarity +1 (brighter) or -1 (darker).
EVENT_DTYPE = np.dtype([("x", np.uint16), ("y", np.uint16), ("t", np.float64), ("p", np.int8)])

#: v2e's lin-log mapping is linear below this many digital numbers, where the noise of an 8-bit frame is one threshold.
LIN_LOG_KNEE = 20.0

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
#: Events as three flat arrays: pixel index (row * width + column), time, polarity.
Events = tuple[IntArray, FloatArray, FloatArray]


class EventCamera:
    """
    Simulated event camera with exact multiple crossings per pixel and frame.

    :param height: Rows of the sensor.
    :param width: Columns of the sensor.
    :param threshold: Contrast threshold C in units of the mapped intensity (log units for ``mapping="log"``),
        one number or ``(positive, negative)``.
    :param threshold_sigma: Standard deviation of C over the pixels, in the same units. Drawn once per pixel: it is a
        property of the chip. Draws are floored at a tenth of the nominal threshold.
    :param refractory: Dead time of a pixel after an event, in seconds. A crossing in the dead time is lost, and the
        reference moves all the same (as in ESIM).
    :param leak_rate: Rate of spurious positive events per pixel, in Hz, from the drift of the reference. Every pixel
        leaks at its own phase, drawn once: at a reset its reference lies that share of a threshold below the level.
    :param shot_rate: Rate of random events per pixel, in Hz, half of them positive. They leave the reference alone.
    :param mapping: ``"log"``: log(log_eps + I); ``"lin_log"``: v2e's mapping of numbers 0..255, linear below 20;
        ``"identity"``: the frame is taken as it is (it may already be a logarithm).
    :param log_eps: Added to the intensity before the logarithm; it sets how dark the sensor still sees.
    :param seed: Seed of the threshold mismatch, the leak phases and the noise.
    :raises ValueError: on a parameter out of its range.
    """

    def __init__(
        self,
        height: int,
        width: int,
        threshold: float | tuple[float, float] = 0.2,
        threshold_sigma: float = 0.0,
        refractory: float = 0.0,
        leak_rate: float = 0.0,
        shot_rate: float = 0.0,
        mapping: Mapping = "log",
        log_eps: float = 1e-3,
        seed: int | None = None,
    ) -> None:
        if height < 1 or width < 1 or max(height, width) > np.iinfo(np.uint16).max:
            raise ValueError(f"height and width must lie in 1..65535, got {height} and {width}")
        nominal = np.array(
            threshold if isinstance(threshold, (tuple, list)) else (threshold, threshold), dtype=np.float64
        )
        if nominal.shape != (2,) or not np.all(nominal > 0):
            raise ValueError(f"threshold must be one positive number or a pair (positive, negative), got {threshold!r}")
        for name, value in (
            ("threshold_sigma", threshold_sigma),
            ("refractory", refractory),
            ("leak_rate", leak_rate),
            ("shot_rate", shot_rate),
        ):
            if not 0 <= value < np.inf:
                raise ValueError(f"{name} must be a finite number >= 0, got {value!r}")
        if mapping not in get_args(Mapping):
            raise ValueError(f"mapping must be one of {get_args(Mapping)}, got {mapping!r}")
        if mapping == "log" and not log_eps > 0:
            raise ValueError(f"log_eps must be > 0, got {log_eps!r}")

        self.height, self.width = height, width
        self.threshold_sigma = threshold_sigma
        self.refractory = refractory
        self.leak_rate = leak_rate
        self.shot_rate = shot_rate
        self.mapping = mapping
        self.log_eps = log_eps
        self._rng = np.random.default_rng(seed)
        mismatch = self._rng.standard_normal((2, height * width)) * threshold_sigma
        #: Thresholds of every pixel, shape (2, height * width): positive, negative.
        self.thresholds: FloatArray = np.maximum(nominal[:, None] + mismatch, 0.1 * nominal[:, None])
        # Shares of a threshold; without a phase the whole sensor would flash at once.
        self._leak_phase: FloatArray = self._rng.random(height * width) if leak_rate else np.zeros(height * width)
        self.reset()

    def reset(self) -> None:
        """Forget the scene: the next frame only sets the reference. The thresholds and leak phases stay."""
        self._time: float | None = None
        self._start = 0.0
        self._level: FloatArray = np.zeros(self.height * self.width)
        self._reference: FloatArray = np.zeros(self.height * self.width)
        self._last_event: FloatArray = np.full(self.height * self.width, -np.inf)

    def step(self, frame: ArrayLike, t: float) -> NDArray[np.void]:
        """
        Events between the previous frame and this one.

        :param frame: Intensity >= 0 of shape (height, width) (any real number for ``mapping="identity"``).
        :param t: Time of the frame in seconds, later than the previous one.
        :return: Structured array with fields x, y, t, p, sorted by time; empty for the first frame after a reset.
        :raises ValueError: on a wrong shape, a negative or non-finite intensity, or a time that does not advance.
        """
        pixel, times, polarity = self.detect(frame, t)
        order = np.argsort(times, kind="stable")
        events = np.empty(len(order), dtype=EVENT_DTYPE)
        events["y"], events["x"] = np.divmod(pixel[order], self.width)
        events["t"] = times[order]
        events["p"] = polarity[order]
        return events

    def detect(self, frame: ArrayLike, t: float, rng: np.random.Generator | None = None) -> Events:
        """
        The events of :meth:`step` as flat arrays and in no particular order, which is all that binning needs.

        :param frame: As in :meth:`step`.
        :param t: As in :meth:`step`.
        :param rng: Source of the shot noise in place of the camera's own.
        :return: Pixel index (row * width + column), time in seconds and polarity (+1.0 or -1.0) of every event.
        """
        level = self._map(frame)
        if self._time is None:
            self._time = self._start = t
            self._level, self._reference = level, level - self._leak_phase * self.thresholds[0]
            return np.empty(0, np.int64), np.empty(0), np.empty(0)
        if not t > self._time:
            raise ValueError(f"time must advance: got t={t!r} after t={self._time!r}; call reset() to start anew")
        if self.leak_rate:
            # A reference that sinks steadily is the same as a brightness that rises steadily.
            level = level + self.thresholds[0] * (self.leak_rate * (t - self._start))
        events = self._crossings(level, self._time, t)
        if self.shot_rate:
            noise = self._shot_noise(self._time, t, self._rng if rng is None else rng)
            events = (
                np.concatenate((events[0], noise[0])),
                np.concatenate((events[1], noise[1])),
                np.concatenate((events[2], noise[2])),
            )
        if self.refractory:
            events = self._drop_refractory(*events)
        self._level, self._time = level, t
        return events

    def _map(self, frame: ArrayLike) -> FloatArray:
        intensity = np.asarray(frame, dtype=np.float64)
        if intensity.shape != (self.height, self.width):
            raise ValueError(f"frame must have shape {(self.height, self.width)}, got {intensity.shape}")
        intensity = intensity.reshape(-1)
        if not np.isfinite(intensity).all():
            raise ValueError("frame holds NaN or infinite intensities")
        if self.mapping == "identity":
            return intensity.copy()
        if intensity.min() < 0:
            raise ValueError(
                f"frame must be >= 0, got a minimum of {intensity.min()!r}; use mapping='identity' for logs"
            )
        if self.mapping == "log":
            return np.log(intensity + self.log_eps)
        linear = intensity * (np.log(LIN_LOG_KNEE) / LIN_LOG_KNEE)
        return np.where(intensity <= LIN_LOG_KNEE, linear, np.log(np.maximum(intensity, LIN_LOG_KNEE)))

    def _crossings(self, level: FloatArray, t0: float, t1: float) -> Events:
        """Every threshold crossing on the straight line from the previous level to this one."""
        gap = level - self._reference
        # The slack keeps pixels that sit on a threshold: the exact comparison below decides about them.
        pixel = np.flatnonzero((gap > self.thresholds[0] * (1 - 1e-9)) | (gap < self.thresholds[1] * (1e-9 - 1)))
        gap, start, end, reference = gap[pixel], self._level[pixel], level[pixel], self._reference[pixel]
        sign = np.sign(gap)
        step = np.where(gap > 0, self.thresholds[0][pixel], self.thresholds[1][pixel]) * sign

        # Division may be off by one at a boundary; the comparison that defines a crossing settles it.
        count = np.floor(gap / step)
        count += sign * (reference + (count + 1) * step) <= sign * end
        count -= sign * (reference + count * step) > sign * end
        # The moved reference is rounded: it may leave a level that has come to rest on a threshold just beyond it.
        fired = (count > 0) & (end != start)
        pixel, start, end, reference = pixel[fired], start[fired], end[fired], reference[fired]
        sign, step, repeats = sign[fired], step[fired], count[fired].astype(np.int64)

        index = np.repeat(np.arange(len(pixel)), repeats)
        nth = np.arange(1, len(index) + 1) - (np.cumsum(repeats) - repeats)[index]
        times = t0 + (reference[index] + nth * step[index] - start[index]) / (end - start)[index] * (t1 - t0)
        self._reference[pixel] = reference + repeats * step
        return pixel[index], np.clip(times, t0, t1), sign[index]

    def _shot_noise(self, t0: float, t1: float, rng: np.random.Generator) -> Events:
        size = self.height * self.width
        total = int(rng.poisson(self.shot_rate * (t1 - t0) * size))
        polarity = np.where(rng.random(total) < 0.5, 1.0, -1.0)
        return rng.integers(size, size=total), rng.uniform(t0, t1, total), polarity

    def _drop_refractory(self, pixel: IntArray, times: FloatArray, polarity: FloatArray) -> Events:
        """Drop the events that fall into their pixel's dead time; only an event that is kept starts a new one."""
        order = np.lexsort((times, pixel))
        pixel, times, polarity = pixel[order], times[order], polarity[order]
        first = np.flatnonzero(np.diff(pixel, prepend=-1))
        rank = np.arange(len(pixel)) - np.repeat(first, np.diff(np.append(first, len(pixel))))
        keep = np.zeros(len(pixel), dtype=bool)
        for nth in range(int(rank.max(initial=-1)) + 1):
            nth_event = np.flatnonzero(rank == nth)
            alive = nth_event[times[nth_event] - self._last_event[pixel[nth_event]] >= self.refractory]
            keep[alive] = True
            self._last_event[pixel[alive]] = times[alive]
        return pixel[keep], times[keep], polarity[keep]
