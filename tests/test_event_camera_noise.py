"""What keeps an event camera from being ideal, mismatch, dead time, leaks and shot noise: each has its rate, its
distribution and nothing else."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_event_camera import EVERYTHING, film, run

from sb3_have.sensors import EVENT_DTYPE, EventCamera

Array = NDArray[Any]
SIGMAS = 5  # every statistical bound is this many standard deviations of the statistic


def test_the_mismatch_is_drawn_once_and_is_as_wide_as_asked() -> None:
    camera = EventCamera(80, 80, threshold=(0.2, 0.3), threshold_sigma=0.03, seed=2)
    drawn = camera.thresholds.copy()
    assert drawn.shape == (2, 80 * 80)
    error = 0.03 / math.sqrt(80 * 80)
    np.testing.assert_allclose(drawn.mean(axis=1), (0.2, 0.3), rtol=0, atol=SIGMAS * error)
    np.testing.assert_allclose(drawn.std(axis=1), 0.03, rtol=0, atol=SIGMAS * error / math.sqrt(2))
    assert np.abs(np.corrcoef(drawn)).min() < SIGMAS / 80  # the two thresholds of a pixel
    for t in range(3):
        camera.step(np.full((80, 80), 1.0 + t), float(t))
        camera.reset()
    np.testing.assert_array_equal(camera.thresholds, drawn)


def test_the_mismatch_decides_how_often_a_pixel_fires() -> None:
    camera = EventCamera(20, 20, threshold=0.2, threshold_sigma=0.03, mapping="identity", seed=0)
    # A slow ramp over 10 log units: a pixel whose threshold changed from frame to frame would lose or gain events.
    counts = np.zeros(400)
    for t, level in enumerate(np.linspace(0, 10, 2001)):
        events = camera.step(np.full((20, 20), level), float(t))
        np.add.at(counts, events["y"].astype(int) * 20 + events["x"], 1)
    assert np.abs(counts - 10 / camera.thresholds[0]).max() <= 1


def test_refractory_period_thins_events() -> None:
    ramp = np.linspace(0, 4, 9)[:, None, None]
    camera = EventCamera(1, 1, threshold=0.1, refractory=0.05, mapping="identity")
    events = run(camera, ramp)  # crossings every 0.02 s: every third one survives
    np.testing.assert_allclose(events["t"], 0.02 + 0.06 * np.arange(len(events)), atol=1e-9)
    assert len(events) == 14
    # The reference went along with the lost crossings: nothing is left to fire.
    assert len(camera.step(ramp[-1], 10.0)) == 0


def test_refractory_period_keeps_what_a_loop_keeps() -> None:
    settings = {**EVERYTHING, "shot_rate": 30.0, "mapping": "identity", "seed": 0}
    everything = run(EventCamera(6, 5, **{**settings, "refractory": 0.0}), film())
    last: dict[tuple[int, int], float] = {}
    kept = []
    for event in everything:
        pixel = (event["x"], event["y"])
        if event["t"] - last.get(pixel, -np.inf) >= 0.01:
            last[pixel] = event["t"]
            kept.append(event)
    assert len(everything) - 100 > len(kept) > 500
    np.testing.assert_array_equal(run(EventCamera(6, 5, **settings), film()), np.array(kept, EVENT_DTYPE))


@pytest.mark.parametrize("refractory", [0.01, 0.1])
def test_dead_time_thins_the_shot_noise(refractory: float) -> None:
    """A pixel that is dead for d after each kept event passes r / (1 + r d) of a Poisson rate r."""
    rate, duration, pixels = 20.0, 30.0, 600
    camera = EventCamera(20, 30, shot_rate=rate, refractory=refractory, seed=8)
    events = run(camera, np.ones((101, 20, 30)), duration / 100)
    busy = 1 + rate * refractory
    # A renewal process of variance mean / busy^2; every pixel starts awake, which is worth (1 - 1 / busy)^2 / 2 events.
    expected = pixels * (rate * duration / busy + (1 - 1 / busy) ** 2 / 2)
    assert abs(len(events) - expected) < SIGMAS * math.sqrt(expected) / busy


def test_every_pixel_leaks_at_its_rate() -> None:
    camera = EventCamera(2, 2, leak_rate=4.0, threshold_sigma=0.03, seed=0)
    events = run(camera, np.ones((51, 2, 2)), 0.05)
    assert np.all(events["p"] == 1)
    for pixel in range(4):
        times = events["t"][2 * events["y"] + events["x"] == pixel]
        assert len(times) == 10 and times[0] < 0.25
        np.testing.assert_allclose(np.diff(times), 0.25, atol=1e-9)


def test_pixels_leak_at_phases_of_their_own() -> None:
    camera = EventCamera(30, 30, leak_rate=4.0, threshold_sigma=0.03, seed=0)
    events = run(camera, np.ones((51, 30, 30)), 0.05)
    shares = np.histogram(events["t"] % 0.25, bins=5, range=(0, 0.25))[0] / len(events)
    np.testing.assert_allclose(shares, 0.2, atol=SIGMAS * np.sqrt(0.2 * 0.8 / 900))
    camera.reset()
    np.testing.assert_array_equal(run(camera, np.ones((51, 30, 30)), 0.05), events)


@pytest.mark.parametrize("rate", [0.05, 0.1, 1.3, 40.0])
@pytest.mark.parametrize("sigma", [0.0, 0.04])
@pytest.mark.parametrize("duration", [0.37, 20.0])
def test_the_leak_has_its_rate_whatever_the_mismatch(rate: float, sigma: float, duration: float) -> None:
    camera = EventCamera(60, 70, threshold=(0.2, 0.3), threshold_sigma=sigma, leak_rate=rate, seed=11)
    times = np.linspace(3, 3 + duration, 5)
    events = np.concatenate([camera.step(np.full((60, 70), 0.4), t) for t in times])
    assert (events["p"] == 1).all()
    expected = 60 * 70 * rate * duration
    share = rate * duration % 1  # a pixel fires floor(rate duration + phase) times, a binomial variable
    assert abs(len(events) - expected) <= SIGMAS * math.sqrt(60 * 70 * share * (1 - share)) + 1e-6 * expected
    # Phases spread the events evenly over time.
    mean_error = SIGMAS * duration / math.sqrt(12 * min(len(events), 60 * 70))
    assert abs(events["t"].mean() - times.mean()) < mean_error


def assert_dispersion(counts: Array) -> None:
    """The chi-squared statistic of Poisson counts of one mean: as much variance as mean."""
    statistic = ((counts - counts.mean()) ** 2).sum() / counts.mean()
    spread = math.sqrt(len(counts) * (2 + 1 / counts.mean()))  # Var[(n - m)^2 / m] = 2 + 1 / m
    assert abs(statistic - (len(counts) - 1)) < SIGMAS * spread


@pytest.mark.parametrize("rate", [0.1, 1.0, 5.0, 200.0])
def test_shot_noise_is_poisson(rate: float) -> None:
    height, width, frames, dt = 30, 40, 400, 0.02
    camera = EventCamera(height, width, shot_rate=rate, seed=5)
    image = np.full((height, width), 0.7)
    steps = [camera.step(image, i * dt) for i in range(frames + 1)]
    events = np.concatenate(steps)
    count, expected = len(events), rate * dt * frames * height * width
    assert abs(count - expected) < SIGMAS * math.sqrt(expected)
    assert abs(int((events["p"] > 0).sum()) - count / 2) < SIGMAS * math.sqrt(count) / 2
    assert set(np.unique(events["p"])) == {-1, 1}
    assert (np.diff(events["t"]) >= 0).all()

    # As much variance as mean, from step to step and from pixel to pixel; even over the step.
    per_step = np.array([len(step) for step in steps[1:]])
    assert not len(steps[0])
    assert_dispersion(per_step)
    assert_dispersion(np.bincount(events["y"].astype(int) * width + events["x"], minlength=height * width))
    phase = events["t"] / dt % 1
    assert_dispersion(np.histogram(phase, 20, (0, 1))[0])


def test_shot_noise_is_even_and_leaves_the_signal_alone() -> None:
    quiet, noisy = (EventCamera(40, 40, shot_rate=rate, mapping="identity", seed=0) for rate in (0.0, 5.0))
    frames = film(height=40, width=40)
    signal, everything = run(quiet, frames), run(noisy, frames)
    noise = np.setdiff1d(everything, signal)
    assert len(np.intersect1d(everything, signal)) == len(signal)
    error = SIGMAS * np.sqrt(0.25 / len(noise))
    for share in (noise["x"] / 40, noise["y"] / 40, noise["t"] / 1.1, noise["t"] / 0.1 % 1):
        np.testing.assert_allclose(np.histogram(share, bins=4, range=(0, 1))[0] / len(noise), 0.25, atol=error)
    assert np.mean(noise["p"] > 0) == pytest.approx(0.5, abs=error)


def test_noise_from_a_given_generator() -> None:
    one, other = (EventCamera(40, 40, shot_rate=2.0, seed=seed) for seed in (0, 1))
    for camera in (one, other):
        camera.detect(np.ones((40, 40)), 0.0)
    parts = [camera.detect(np.ones((40, 40)), 1.0, np.random.default_rng(5)) for camera in (one, other)]
    assert len(parts[0][0]) > 3000
    for a, b in zip(*parts, strict=True):
        np.testing.assert_array_equal(a, b)
    fresh = EventCamera(40, 40, shot_rate=2.0, seed=0)
    fresh.step(np.ones((40, 40)), 1.0)
    np.testing.assert_array_equal(one.step(np.ones((40, 40)), 2.0), fresh.step(np.ones((40, 40)), 2.0))


def test_preset_noisy_has_its_rates_at_rest_and_its_bandwidth() -> None:
    camera = EventCamera.preset("noisy", 50, 50, seed=0)
    events = run(camera, np.full((41, 50, 50), 100.0), 0.1)
    for sign, rate in ((1, 2.6), (-1, 2.5)):
        expected = rate * 2500 * 4
        assert np.sum(events["p"] == sign) == pytest.approx(expected, abs=SIGMAS * np.sqrt(expected))
    assert camera.thresholds.std() == pytest.approx(0.05, rel=0.1)
    quiet = {"threshold_sigma": 0.0, "leak_rate": 0.0, "shot_rate": 0.0}
    flash = np.where(np.arange(21) < 1, 100.0, 150.0)[:, None, None] * np.ones((21, 6, 5))
    first = [
        run(EventCamera.preset("noisy", 6, 5, **quiet, **wide), flash, 1e-3)["t"][0]
        for wide in ({}, {"cutoff_hz": None})
    ]
    change, tau = np.log(1.5), 1 / (2 * np.pi * 30)
    assert first == pytest.approx([5e-4 + tau * np.log(change / (change - 0.2)), 1e-3 * 0.2 / change], rel=0.02)
