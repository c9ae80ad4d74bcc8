"""
Eight weathers: the light on a scene, its way through the air, and its capture by a colour camera.

Light is linear and not clipped, in units in which a white surface under a clear noon sky has irradiance 1. Nights are
three to four orders of magnitude darker. The colour camera needs an exposure, clips and quantises; an event camera
works on the logarithm and is hardly affected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sb3_have.envs.camera import SUPERSAMPLING, Camera, Objects
from sb3_have.envs.ground import Ground
from sb3_have.envs.scene import ALBEDO, ASPHALT, HEADLAMP, LAMP, MARKING, PAINTS, VERGE, Array

Colour = tuple[float, float, float]

# Weights of red, green and blue in the brightness of a monochrome (event) pixel
LUMA: Final = np.array((0.299, 0.587, 0.114), dtype=np.float32)


@dataclass(frozen=True)
class Weather:
    """
    A weather.

    :param sun: Irradiance from the sun (or moon) on a surface that faces it.
    :param ambient: Irradiance from the sky on a horizontal surface.
    :param zenith: Radiance of the sky at the zenith.
    :param horizon: Radiance of the sky at the horizon, and of fog.
    :param exposure: Share of the colour camera's full well per unit of radiance. Nights are exposed 40 times as long as
        a clear noon, the longest that a moving camera can afford, and stay dark.
    :param wetness: 0 (dry) to 1 (standing water). A wet road is darker and mirrors the sky.
    :param extinction: Share of the light lost to rain and mist per metre.
    :param rain: 0 (none) to 1 (hard). Rain causes streaks in the colour image and false events.
    :param night: Whether the ego vehicle's headlights and all tail lights are on.
    """

    sun: Colour
    ambient: Colour
    zenith: Colour
    horizon: Colour
    exposure: float
    wetness: float = 0.0
    extinction: float = 0.0
    rain: float = 0.0
    night: bool = False


def _night(level: float, warmth: float = 0.0) -> Colour:
    """Faint light, bluish under a clear sky and warmer where clouds reflect the light of towns."""
    return (level * (0.75 + 0.45 * warmth), level * (0.9 + 0.1 * warmth), level * (1.25 - 0.45 * warmth))


_WEATHERS: Final = {
    "ClearNight": Weather(
        sun=_night(1.2e-4),
        ambient=_night(1.5e-4),
        zenith=_night(5e-5),
        horizon=_night(1.5e-4),
        exposure=40.0,
        night=True,
    ),
    "CloudyNight": Weather(
        sun=(0.0, 0.0, 0.0),
        ambient=_night(2.0e-4, 1.0),
        zenith=_night(2.0e-4, 1.0),
        horizon=_night(4e-4, 1.0),
        exposure=40.0,
        night=True,
    ),
    "HardRainNight": Weather(
        sun=(0.0, 0.0, 0.0),
        ambient=_night(1.4e-4, 0.5),
        zenith=_night(1.2e-4, 0.5),
        horizon=_night(2e-4, 0.5),
        exposure=40.0,
        wetness=1.0,
        extinction=0.005,
        rain=1.0,
        night=True,
    ),
    "WetNight": Weather(
        sun=_night(0.8e-4),
        ambient=_night(1.5e-4, 0.2),
        zenith=_night(1e-4, 0.2),
        horizon=_night(2.5e-4, 0.2),
        exposure=40.0,
        wetness=0.7,
        night=True,
    ),
    "ClearNoon": Weather(
        sun=(0.82, 0.80, 0.74),
        ambient=(0.17, 0.20, 0.27),
        zenith=(0.16, 0.30, 0.58),
        horizon=(0.44, 0.54, 0.66),
        exposure=1.0,
    ),
    "CloudyNoon": Weather(
        sun=(0.0, 0.0, 0.0),
        ambient=(0.40, 0.41, 0.43),
        zenith=(0.36, 0.37, 0.40),
        horizon=(0.44, 0.45, 0.47),
        exposure=1.5,
    ),
    "HardRainNoon": Weather(
        sun=(0.0, 0.0, 0.0),
        ambient=(0.19, 0.20, 0.22),
        zenith=(0.15, 0.16, 0.18),
        horizon=(0.22, 0.23, 0.25),
        exposure=2.2,
        wetness=1.0,
        extinction=0.006,
        rain=1.0,
    ),
    "WetNoon": Weather(
        sun=(0.50, 0.48, 0.42),
        ambient=(0.22, 0.24, 0.28),
        zenith=(0.24, 0.33, 0.50),
        horizon=(0.50, 0.52, 0.53),
        exposure=1.15,
        wetness=0.7,
        extinction=0.001,
    ),
}
WEATHERS: Final[tuple[str, ...]] = tuple(_WEATHERS)
"""Names of the eight weathers, as in the paper."""


def weather_by_name(name: str) -> Weather:
    """
    Return a weather.

    :param name: One of :data:`WEATHERS`.
    :raises ValueError: If the name is unknown.
    """
    if name not in _WEATHERS:
        raise ValueError(f"unknown weather {name!r}; the weathers are {', '.join(WEATHERS)}")
    return _WEATHERS[name]


def weather_choices(weather: str | Sequence[str]) -> tuple[str, ...]:
    """
    Return the weathers to draw from, given the option ``weather`` of an environment.

    :param weather: One of :data:`WEATHERS`, a list of them, or "random" for all.
    :raises ValueError: If a name is unknown or the list is empty.
    """
    if isinstance(weather, str) and weather == "random":
        return WEATHERS
    choices = (weather,) if isinstance(weather, str) or weather is None else tuple(weather)
    unknown = [name for name in choices if name not in WEATHERS]
    if unknown or not choices:
        raise ValueError(f"weather must be 'random' or among {', '.join(WEATHERS)}; got {weather!r}")
    return choices


# Unit vector towards the sun (forward, right, up). It is high and behind the ego vehicle, so that rear faces are lit.
SUN_DIRECTION: Final = np.array((-0.45, -0.30, 0.84))
# Share of the sky's light that reaches a vertical face
SKY_ON_WALLS: Final = 0.55
# Low beam: irradiance at the lamp, reach [m] (nothing is left at 30 m), tangent of its half-width
HEADLIGHT: Final = 0.08
HEADLIGHT_COLOUR: Final[Colour] = (1.0, 0.94, 0.80)
HEADLIGHT_REACH: Final = 13.0
HEADLIGHT_WIDTH: Final = 0.28
# Radiance of a tail light
TAIL_LIGHT: Final[Colour] = (6e-4, 4e-5, 3e-5)
# Radiance of an oncoming low beam, seen from outside its cone
LOW_BEAM: Final[Colour] = (2e-2, 1.9e-2, 1.6e-2)
# False events per pixel and second in the hardest rain
RAIN_EVENT_RATE: Final = 1.5


class Illumination:
    """
    A weather seen by a camera. Whatever does not depend on the vehicles is computed once per episode.

    :param weather: Weather.
    :param camera: Camera.
    :param paint: Index into ``PAINTS`` of every traffic vehicle.
    :param colour: Whether to compute red, green and blue, or only brightness.
    """

    def __init__(self, weather: Weather, camera: Camera, paint: NDArray[np.int64], colour: bool) -> None:
        self.weather, self.camera, self.colour = weather, camera, colour
        self.sun, self.ambient, self.horizon = map(self._light, (weather.sun, weather.ambient, weather.horizon))
        self.beam = self._light(HEADLIGHT_COLOUR) * np.float32(HEADLIGHT * weather.night)
        self.tail, self.head = (self._light(lamp) * np.float32(weather.night) for lamp in (TAIL_LIGHT, LOW_BEAM))
        self.albedo = self._light(np.concatenate((ALBEDO, PAINTS[paint])))
        wet = np.float32(1 - 0.45 * weather.wetness)
        self.asphalt, self.marking = self._light(ASPHALT) * wet, self._light(MARKING) * (0.5 + 0.5 * wet)
        self.verge = self._light(VERGE) * (0.5 + 0.5 * wet)

        # Sky: darker or bluer towards the zenith
        zenith = self._light(weather.zenith)
        up = np.clip(-camera.slope[: camera.horizon] / 0.6, 0, 1)[:, None] ** np.float32(0.7)
        self.sky = self.horizon[..., None] + up * (zenith - self.horizon)[..., None]

        # Ground: incident light, and the haze and the reflection of the sky on top of it
        forward = camera.ground_forward
        haze = np.exp(-np.float32(weather.extinction) * forward)
        self.fog = self.horizon[..., None] * (1 - haze)
        flat = self.ambient + self.sun * np.float32(SUN_DIRECTION[2])
        beam = self._beam(forward, camera.slope) * np.minimum(1, 6 / forward)
        self.ground_light = (flat[..., None] + beam * self.beam[..., None]) * haze
        grazing = camera.height / np.hypot(camera.height, forward)
        mirror = np.float32(weather.wetness) * (0.02 + 0.6 * (1 - grazing) ** 5)
        self.mirror = self.horizon[..., None] * mirror * haze * np.float32(0.6)

    def _light(self, value: Array | Colour) -> Array:
        """Colour channels, or their brightness, along the first axis, on which NumPy is fastest: (C, n)."""
        channels = np.atleast_2d(np.asarray(value, dtype=np.float32))
        return np.ascontiguousarray(channels.T) if self.colour else (channels @ LUMA)[None]

    def _beam(self, forward: Array, tangent: Array) -> Array:
        """Share of the headlights' light on a surface facing them, by distance [m] and tangent of the angle."""
        reach = np.exp(-((forward / np.float32(HEADLIGHT_REACH)) ** 2)) / (1 + (forward / 6) ** 2)
        return np.asarray(reach * np.exp(-((tangent / np.float32(HEADLIGHT_WIDTH)) ** 2)))

    def render(self, ground: Ground, objects: Objects) -> Array:
        """
        Compute the light that reaches every pixel.

        :param ground: Ground from :meth:`Camera.ground`.
        :param objects: Objects from :meth:`Camera.objects` at the same instants.
        :return: Linear light >= 0, not clipped, float32 (instants, height, width, 3 or 1).
        """
        camera = self.camera
        size, horizon = camera.size, camera.horizon
        image = np.empty((len(self.sky), len(ground.road), size, size), dtype=np.float32)
        image[:, :, :horizon] = self.sky[:, None]
        asphalt, paint, verge = (value[..., None, None] for value in (self.asphalt, self.marking, self.verge))
        surface = asphalt + ground.marking * (paint - asphalt)
        verge = ground.verge * verge
        below = (verge + ground.road * (surface - verge)) * self.ground_light[:, None]
        below += ground.road * self.mirror[:, None] + self.fog[:, None]
        image[:, :, horizon:] = below

        share = np.float32(SUPERSAMPLING**-2)  # of a pixel that one sample covers
        cover = np.bincount(objects.pixel, minlength=image[0].size)
        hit = np.flatnonzero(cover != 0)
        uncovered = 1 - cover[hit].astype(np.float32) * share
        for channel, shade in zip(image.reshape(len(image), -1), self._shade(objects), strict=True):
            total = np.bincount(objects.pixel, weights=shade, minlength=len(channel))
            channel[hit] = channel[hit] * uncovered + total[hit].astype(np.float32) * share
        return np.stack(tuple(image), axis=-1)

    def _shade(self, objects: Objects) -> Array:
        """Radiance of the object samples, (channels, samples)."""
        facing = np.clip(objects.normal @ SUN_DIRECTION[:2], 0, None).astype(np.float32)
        light = self.ambient * np.float32(SKY_ON_WALLS) + facing * self.sun
        haze = np.exp(-np.float32(self.weather.extinction) * objects.depth)
        received = light.take(objects.face, axis=1)
        if self.weather.night:
            column = objects.pixel - self.camera.size * (objects.pixel // self.camera.size)
            tangent = self.camera.slope[column]
            received += self._beam(objects.depth, tangent) * self.beam
        radiance = self.albedo.take(objects.material, axis=1) * received
        if self.weather.night:
            radiance[:, np.flatnonzero(objects.material == LAMP)] += self.tail
            # Only oncoming cars show their headlights
            if self.camera.shape.oncoming:
                radiance[:, np.flatnonzero(objects.material == HEADLAMP)] += self.head
        return np.asarray(radiance * haze + self.horizon * (1 - haze))


# Colour camera: electrons in a full pixel, read noise [electrons], steps of the converter, exponent of the gamma
FULL_WELL: Final = 9000.0
READ_NOISE: Final = 6.0
ADC_STEPS: Final = 4095
GAMMA: Final = 2.2
_GAMMA_TABLE: Final = np.rint(255 * (np.arange(ADC_STEPS + 1) / ADC_STEPS) ** (1 / GAMMA)).astype(np.uint8)


def take_picture(radiance: Array, weather: Weather, rng: np.random.Generator) -> NDArray[np.uint8]:
    """
    Take a picture with the colour camera: exposure, photon and read noise, 12-bit conversion, gamma, rain streaks.

    :param radiance: Linear light, float32 (height, width, 3).
    :param weather: Weather, for exposure and rain.
    :param rng: Generator of the noise.
    :return: uint8 (height, width, 3).
    """
    if weather.rain:
        streaks = _streaks(radiance.shape[0], weather, rng)
        wet = np.flatnonzero(streaks != 0)
        brightness, radiance = radiance.mean(axis=(0, 1)), radiance.copy()
        radiance.reshape(-1, 3)[wet] += streaks.take(wet)[:, None] * brightness
    electrons = radiance * np.float32(weather.exposure * FULL_WELL)
    noise = rng.standard_normal(electrons.shape, dtype=np.float32)
    electrons += noise * np.sqrt(electrons + np.float32(READ_NOISE**2))
    digital = np.clip(electrons * np.float32(ADC_STEPS / FULL_WELL), 0, ADC_STEPS).astype(np.int16)
    return np.asarray(_GAMMA_TABLE.take(digital))


def _streaks(size: int, weather: Weather, rng: np.random.Generator) -> NDArray[np.float32]:
    """Faint lines of falling drops, blurred by the exposure: added brightness as a share of the mean."""
    streaks = np.zeros((size, size), dtype=np.float32)
    count = rng.poisson(0.5 * size * weather.rain)
    start = rng.uniform(0, size, (count, 2))
    length = rng.uniform(0.05, 0.15, count) * size
    end = start + np.stack((0.15 * length, length), axis=-1)
    strength = rng.uniform(0.03, 0.12, count)
    for (x0, y0), (x1, y1), brightness in zip(
        start.astype(int).tolist(), end.astype(int).tolist(), strength.tolist(), strict=True
    ):
        cv2.line(streaks, (x0, y0), (x1, y1), brightness)
    return streaks


def rain_events(
    weather: Weather, t0: float, t1: float, height: int, width: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """
    Draw the false events of drops that cross the view within milliseconds, short vertical runs of one polarity.

    :param weather: Weather; without rain there are no events.
    :param t0: Start of the interval in seconds.
    :param t1: End of the interval in seconds.
    :param height: Rows of the camera in pixels.
    :param width: Columns of the camera in pixels.
    :param rng: Generator of the drops.
    :return: Pixel index, time in seconds and polarity, as :meth:`EventCamera.detect` returns them.
    """
    run = max(2, height // 24)
    rate = weather.rain * RAIN_EVENT_RATE * (height + run - 1) * width / run
    drops = int(rng.poisson(rate * (t1 - t0))) if rate else 0
    column = rng.integers(width, size=drops)
    row = rng.integers(1 - run, height, size=drops)
    time = rng.uniform(t0, t1, drops)
    # A drop is a lens that shows the sky, so it brightens more often than it darkens
    polarity = np.where(rng.random(drops) < 0.65, 1.0, -1.0)
    rows = row[:, None] + np.arange(run)
    inside = (rows >= 0) & (rows < height)
    pixel = (rows * width + column[:, None])[inside]
    repeats = inside.sum(axis=1)
    return pixel, np.repeat(time, repeats), np.repeat(polarity, repeats)
