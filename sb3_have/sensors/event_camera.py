"""
A simulated event camera: it takes frames of intensity and returns asynchronous signed events.

Each pixel remembers a reference level of log brightness. Whenever the brightness has moved away from it by one contrast
threshold, the pixel fires an event and the reference moves by that threshold. Between two frames the brightness is
linear in time, so a fast change gives several events, each with its own time stamp (Rebecq et al., "ESIM: an Open Event
Camera Simulator", CoRL 2018). The noise follows Hu et al., "v2e: From Video Frames to Realistic DVS Events",
CVPRW 2021.

Each frame passes these stages in order: mapping of the intensity, low-pass filter of the photoreceptor, leak, threshold
crossings on the straight line between the two levels, shot noise, refractory period.
"""

from __future__ import annotations

from collections import abc
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_have.sensors.checks import check_whole, is_finite, positive_pair

Mapping = Literal["log", "lin_log", "identity"]

EVENT_DTYPE = np.dtype([("x", np.uint16), ("y", np.uint16), ("t", np.float64), ("p", np.int8)])
"""
An event: column x and row y in pixels, time t in seconds, polarity p +1 (brighter) or -1 (darker). Neighbouring float64
times lie less than a nanosecond apart for the first 97 days.
"""

# v2e's lin-log mapping is linear below this digital number, where the noise of an 8-bit frame is one threshold
LIN_LOG_KNEE = 20.0

PRESETS: Final[abc.Mapping[str, abc.Mapping[str, Any]]] = MappingProxyType(
    {
        "ideal": MappingProxyType({"threshold": 0.2, "mapping": "log", "log_eps": 1e-3}),
        "carla": MappingProxyType({"threshold": (0.3, 0.3), "mapping": "log", "log_eps": 1e-3}),
        "noisy": MappingProxyType(
            {
                "threshold": 0.2,
                "threshold_sigma": 0.05,
                "leak_rate": 0.1,
                "shot_rate": 5.0,
                "mapping": "lin_log",
                "cutoff_hz": 30.0,
            }
        ),
    }
)
"""
Parameters of :class:`EventCamera` by name, for :meth:`EventCamera.preset`.

- ``"ideal"``: no noise, no mismatch. Expects frames of linear light with white at about 1.
- ``"carla"``: the defaults of ``sensor.camera.dvs`` in CARLA 0.9.16. Expects the 8-bit grey image divided by 255, with
  grey = 0.2989 R + 0.5870 G + 0.1140 B. The time stamps are those of this module.
- ``"noisy"``: v2e's option ``--dvs_params noisy``. Expects frames in digital numbers 0..255. Unlike in v2e, shot noise
  does not depend on the light, leaks have no jitter, and the bandwidth does not shrink in the dark unless
  ``cutoff_intensity=255`` is added.
"""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# Events as three flat arrays: pixel index (row * width + column), time [s], polarity
Events = tuple[IntArray, FloatArray, FloatArray]


class EventCamera:
    """
    Simulated event camera that finds every threshold crossing between two frames.

    :param height: Rows of the sensor in pixels.
    :param width: Columns of the sensor in pixels.
    :param threshold: Contrast threshold C in units of the mapped intensity, one number or ``(positive, negative)``.
        For the logarithmic mappings these are natural log units: 0.2 is a change by 22%.
    :param threshold_sigma: Standard deviation of C over the pixels, in the same units. It is a property of the chip,
        drawn once per pixel; draws are floored at a tenth of the nominal threshold.
    :param refractory: Dead time of a pixel after an event in seconds. Crossings during the dead time are lost, but the
        reference still moves (as in ESIM).
    :param leak_rate: Rate of spurious positive events per pixel in Hz, caused by the drift of the reference. Each pixel
        leaks at its own phase, drawn once: at a reset its reference lies that share of a threshold below the level.
    :param shot_rate: Rate of random events per pixel in Hz, half of them positive. They do not move the reference.
    :param mapping: ``"log"``: log(log_eps + I). ``"lin_log"``: v2e's mapping of digital numbers 0..255, linear below
        20. ``"identity"``: the frame itself (which may already be a logarithm).
    :param log_eps: Intensity added before the logarithm; it sets how dark the sensor can still see.
    :param cutoff_hz: Bandwidth of the photoreceptor in Hz. The mapped intensity passes a first-order low-pass filter
        with time constant 1 / (2 pi cutoff_hz), solved exactly for an input that is linear in time between the frames.
        None means unlimited bandwidth.
    :param cutoff_intensity: Intensity above which the bandwidth is ``cutoff_hz``. In less light it shrinks in
        proportion, to a tenth at least, much as in v2e. Because the intensity of the new frame counts, the number of
        frames then makes a small difference. None means the same bandwidth in any light.
    :param seed: Seed of the threshold mismatch, the leak phases and the noise.
    :raises ValueError: If a parameter is out of range.
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
        cutoff_hz: float | None = None,
        cutoff_intensity: float | None = None,
        seed: int | None = None,
    ) -> None:
        check_whole("height", height, 1, np.iinfo(np.uint16).max)
        check_whole("width", width, 1, np.iinfo(np.uint16).max)
        nominal = np.array(positive_pair("threshold", threshold))
        for name, value in (
            ("threshold_sigma", threshold_sigma),
            ("refractory", refractory),
            ("leak_rate", leak_rate),
            ("shot_rate", shot_rate),
        ):
            if not is_finite(value) or value < 0:
                raise ValueError(f"{name} must be a finite number >= 0, got {value!r}")
        if mapping not in get_args(Mapping):
            raise ValueError(f"mapping must be one of {get_args(Mapping)}, got {mapping!r}")
        if mapping == "log" and not (is_finite(log_eps) and log_eps > 0):
            raise ValueError(f"log_eps must be a finite number > 0, got {log_eps!r}")
        if cutoff_hz is not None and not (is_finite(cutoff_hz) and cutoff_hz > 0):
            raise ValueError(f"cutoff_hz must be a finite number > 0, or None for no filter, got {cutoff_hz!r}")
        if cutoff_intensity is not None and (
            cutoff_hz is None or mapping == "identity" or not is_finite(cutoff_intensity) or cutoff_intensity <= 0
        ):
            raise ValueError(
                f"cutoff_intensity must be a finite number > 0, got {cutoff_intensity!r}, and needs a cutoff_hz and a "
                f"mapping of intensities ('log' or 'lin_log'), got {cutoff_hz!r} and {mapping!r}"
            )

        self.height, self.width = height, width
        self.threshold_sigma = threshold_sigma
        self.refractory = refractory
        self.leak_rate = leak_rate
        self.shot_rate = shot_rate
        self.mapping = mapping
        self.log_eps = log_eps
        self.cutoff_hz = cutoff_hz
        self.cutoff_intensity = cutoff_intensity
        self._rng = np.random.default_rng(seed)
        mismatch = self._rng.standard_normal((2, height * width)) * threshold_sigma
        # Thresholds of every pixel, shape (2, height * width): positive, negative
        self.thresholds: FloatArray = np.maximum(nominal[:, None] + mismatch, 0.1 * nominal[:, None])
        # Phases as shares of a threshold; without them the whole sensor would flash at once
        self._leak_phase: FloatArray = self._rng.random(height * width) if leak_rate else np.zeros(height * width)
        self.reset()

    @classmethod
    def preset(cls, name: str, height: int, width: int, **overrides: Any) -> EventCamera:
        """
        Create a camera with the parameters of :data:`PRESETS`, which states the frames that each preset expects.

        :param name: ``"ideal"``, ``"carla"`` or ``"noisy"``.
        :param height: Rows of the sensor in pixels.
        :param width: Columns of the sensor in pixels.
        :param overrides: Parameters of :class:`EventCamera` that replace or extend those of the preset.
        :raises ValueError: If the name is unknown or a parameter is out of range.
        """
        if name not in PRESETS:
            raise ValueError(f"preset must be one of {tuple(PRESETS)}, got {name!r}")
        return cls(height, width, **{**PRESETS[name], **overrides})

    def reset(self) -> None:
        """Forget the scene, so that the next frame only sets the reference. Thresholds and leak phases stay."""
        self._time: float | None = None
        self._start = 0.0
        # Mapped intensity, its low-pass filtered value, and that plus the leak, which crosses the thresholds
        self._input: FloatArray = np.zeros(self.height * self.width)
        self._filtered: FloatArray = np.zeros(self.height * self.width)
        self._level: FloatArray = np.zeros(self.height * self.width)
        self._reference: FloatArray = np.zeros(self.height * self.width)
        self._last_event: FloatArray = np.full(self.height * self.width, -np.inf)

    def step(self, frame: ArrayLike, t: float) -> NDArray[np.void]:
        """
        Return the events between the previous frame and this one.

        :param frame: Intensity >= 0, shape (height, width); any real number with ``mapping="identity"``.
        :param t: Time of the frame in seconds, later than that of the previous frame.
        :return: Array of :data:`EVENT_DTYPE`, sorted by time; empty for the first frame after a reset.
        :raises ValueError: If the shape is wrong, an intensity is negative or not finite, or the time does not advance.
            The camera is then in the same state as before the call.
        """
        pixel, times, polarity = self.detect(frame, t)
        order = _by_time(times)
        events = np.empty(len(order), dtype=EVENT_DTYPE)
        events["y"], events["x"] = np.divmod(pixel[order], self.width)
        events["t"] = times[order]
        events["p"] = polarity[order]
        return events

    def detect(self, frame: ArrayLike, t: float, rng: np.random.Generator | None = None) -> Events:
        """
        Return the events of :meth:`step` as flat arrays in no particular order, which is all that binning needs.

        :param frame: As in :meth:`step`.
        :param t: As in :meth:`step`.
        :param rng: Generator of the shot noise, instead of the camera's own.
        :return: Pixel index (row * width + column), time in seconds and polarity (+1.0 or -1.0) of every event.
        """
        intensity = self._check(frame)
        level = mapped = self._map(intensity)
        if self._time is None:
            if not np.isfinite(t):
                raise ValueError(f"t must be a finite number of seconds, got {t!r}")
            self._time = self._start = t
            self._input = self._filtered = self._level = level
            self._reference = level - self._leak_phase * self.thresholds[0]
            return np.empty(0, np.int64), np.empty(0), np.empty(0)
        if not self._time < t < np.inf:
            raise ValueError(f"time must advance: got t={t!r} after t={self._time!r}; call reset() first")
        if self.cutoff_hz is not None:
            level = self._low_pass(mapped, intensity, t - self._time)
            self._input, self._filtered = mapped, level
        if self.leak_rate:
            # A steadily sinking reference is equivalent to a steadily rising brightness
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

    def _check(self, frame: ArrayLike) -> FloatArray:
        """Check a frame and return it flat."""
        intensity = np.asarray(frame, dtype=np.float64)
        if intensity.shape != (self.height, self.width):
            raise ValueError(f"frame must be a grey image of shape {(self.height, self.width)}, got {intensity.shape}")
        if not np.isfinite(intensity).all():
            raise ValueError("frame holds NaN or infinite intensities")
        if self.mapping != "identity" and intensity.min() < 0:
            raise ValueError(
                f"frame must be >= 0, got a minimum of {intensity.min()!r}; use mapping='identity' for logarithms"
            )
        return intensity.reshape(-1)

    def _map(self, intensity: FloatArray) -> FloatArray:
        if self.mapping == "identity":
            return intensity.copy()
        if self.mapping == "log":
            return np.log(intensity + self.log_eps)
        linear = intensity * (np.log(LIN_LOG_KNEE) / LIN_LOG_KNEE)
        return np.where(intensity <= LIN_LOG_KNEE, linear, np.log(np.maximum(intensity, LIN_LOG_KNEE)))

    def _low_pass(self, mapped: FloatArray, intensity: FloatArray, dt: float) -> FloatArray:
        """Output of the filter after its input went from its previous value to ``mapped`` in a straight line."""
        assert self.cutoff_hz is not None
        tau: float | FloatArray = 1 / (2 * np.pi * self.cutoff_hz)
        if self.cutoff_intensity is not None:
            tau = tau / np.clip(intensity / self.cutoff_intensity, 0.1, 1)
        lag = (mapped - self._input) / dt * tau  # steady-state lag behind a ramp
        return np.asarray(mapped - lag + (self._filtered - self._input + lag) * np.exp(-dt / tau))

    def _crossings(self, level: FloatArray, t0: float, t1: float) -> Events:
        """Every threshold crossing on the straight line from the previous level to this one."""
        gap = level - self._reference
        # The slack keeps pixels close to a threshold, for the exact comparison below to decide
        pixel = np.flatnonzero((gap > self.thresholds[0] * (1 - 1e-9)) | (gap < self.thresholds[1] * (1e-9 - 1)))
        gap = gap[pixel]
        sign, step = np.sign(gap), np.where(gap > 0, *self.thresholds[:, pixel])
        # Negate the levels of falling pixels, which is exact, so that every pixel rises
        start, end, reference = sign * self._level[pixel], sign * level[pixel], sign * self._reference[pixel]

        # The division may be off by one at a boundary, so compare with the definition of a crossing
        count = np.floor(np.abs(gap) / step)
        count += reference + (count + 1) * step <= end
        count -= reference + count * step > end
        # A level at rest on a threshold may lie just beyond the rounded reference, and must not fire again
        count *= (count > 0) & (end != start)
        repeats = count.astype(np.int64)
        self._reference[pixel] = sign * (reference + count * step)

        index = np.repeat(np.arange(len(pixel)), repeats)
        nth = np.arange(1, len(index) + 1) - (np.cumsum(repeats) - repeats)[index]
        times = t0 + (reference[index] + nth * step[index] - start[index]) / (end - start)[index] * (t1 - t0)
        return pixel[index], np.clip(times, t0, t1), sign[index]

    def _shot_noise(self, t0: float, t1: float, rng: np.random.Generator) -> Events:
        size = self.height * self.width
        total = int(rng.poisson(self.shot_rate * (t1 - t0) * size))
        polarity = np.where(rng.random(total) < 0.5, 1.0, -1.0)
        return rng.integers(size, size=total), rng.uniform(t0, t1, total), polarity

    def _drop_refractory(self, pixel: IntArray, times: FloatArray, polarity: FloatArray) -> Events:
        """Drop events in the dead time of their pixel. Only events that are kept start a new dead time."""
        order = _by_pixel(pixel, times)
        pixel, times, polarity = pixel[order], times[order], polarity[order]
        another = np.diff(pixel, append=-1) == 0  # the next event is in the same pixel
        keep = np.zeros(len(pixel), dtype=bool)
        # Visit the first event of every pixel, then the second of those that have one, and so on
        nth = np.flatnonzero(np.diff(pixel, prepend=-1))
        while len(nth):
            alive = nth[times[nth] - self._last_event[pixel[nth]] >= self.refractory]
            keep[alive] = True
            self._last_event[pixel[alive]] = times[alive]
            nth = nth[another[nth]] + 1
        return pixel[keep], times[keep], polarity[keep]


def _by_time(times: FloatArray) -> IntArray:
    """Stable order of the times. Without ties the unstable sort gives the same and is several times faster."""
    order = np.argsort(times)
    if (np.diff(times[order]) == 0).any():
        order = np.argsort(times, kind="stable")
    return order


def _by_pixel(pixel: IntArray, times: FloatArray) -> IntArray:
    """``np.lexsort((times, pixel))``, but faster if the events of most pixels are already sorted, as crossings are."""
    order = np.argsort(pixel, kind="stable")
    pixel, times = pixel[order], times[order]
    late = (np.diff(times) < 0) & (np.diff(pixel) == 0)
    if late.any():
        disordered = np.zeros(pixel[-1] + 1, dtype=bool)
        disordered[pixel[1:][late]] = True
        part = np.flatnonzero(disordered[pixel])
        order[part] = order[part][np.lexsort((times[part], pixel[part]))]
    return order
