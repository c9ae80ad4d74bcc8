"""The noise of the event camera: each source has its rate, its distribution and nothing else."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.sensors import EventCamera

Array = NDArray[Any]
SIGMAS = 5  # every bound is this many standard deviations of the statistic


def stream(camera: EventCamera, frames: Array, times: Array) -> Array:
    return np.concatenate([camera.step(frame, t) for frame, t in zip(frames, times, strict=True)])


@pytest.mark.parametrize("rate", [0.05, 0.1, 1.3, 40.0])
@pytest.mark.parametrize("sigma", [0.0, 0.04])
@pytest.mark.parametrize("duration", [0.37, 20.0])
def test_the_leak_has_its_rate_whatever_the_mismatch(rate: float, sigma: float, duration: float) -> None:
    camera = EventCamera(60, 70, threshold=(0.2, 0.3), threshold_sigma=sigma, leak_rate=rate, seed=11)
    times = np.linspace(3, 3 + duration, 5)
    events = stream(camera, np.full((5, 60, 70), 0.4), times)
    assert (events["p"] == 1).all()
    expected = 60 * 70 * rate * duration
    share = rate * duration % 1  # a pixel fires floor(rate duration + phase) times, a binomial variable
    assert abs(len(events) - expected) <= SIGMAS * math.sqrt(60 * 70 * share * (1 - share)) + 1e-6 * expected
    # Phases spread the events evenly over time.
    mean_error = SIGMAS * duration / math.sqrt(12 * min(len(events), 60 * 70))
    assert abs(events["t"].mean() - times.mean()) < mean_error


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

    # As much variance as mean, from step to step and from pixel to pixel; even over the step.
    per_step = np.array([len(step) for step in steps[1:]])
    assert not len(steps[0])
    assert_dispersion(per_step)
    assert_dispersion(np.bincount(events["y"].astype(int) * width + events["x"], minlength=height * width))
    phase = events["t"] / dt % 1
    assert_dispersion(np.histogram(phase, 20, (0, 1))[0])


def assert_dispersion(counts: Array) -> None:
    """The chi-squared statistic of Poisson counts of one mean: as much variance as mean."""
    statistic = ((counts - counts.mean()) ** 2).sum() / counts.mean()
    spread = math.sqrt(len(counts) * (2 + 1 / counts.mean()))  # Var[(n - m)^2 / m] = 2 + 1 / m
    assert abs(statistic - (len(counts) - 1)) < SIGMAS * spread


@pytest.mark.parametrize("refractory", [0.01, 0.1])
def test_dead_time_thins_the_shot_noise(refractory: float) -> None:
    """A pixel that is dead for d after each kept event passes r / (1 + r d) of a Poisson rate r."""
    rate, duration, pixels = 20.0, 30.0, 600
    camera = EventCamera(20, 30, shot_rate=rate, refractory=refractory, seed=8)
    events = stream(camera, np.ones((101, 20, 30)), np.linspace(0, duration, 101))
    busy = 1 + rate * refractory
    # A renewal process of variance mean / busy^2; every pixel starts awake, which is worth (1 - 1 / busy)^2 / 2 events.
    expected = pixels * (rate * duration / busy + (1 - 1 / busy) ** 2 / 2)
    assert abs(len(events) - expected) < SIGMAS * math.sqrt(expected) / busy


def test_shot_noise_leaves_the_reference_alone() -> None:
    rng = np.random.default_rng(9)
    images, times = np.exp(rng.normal(0, 1, (12, 4, 5))), rng.uniform(0.01, 0.1, 12).cumsum()
    clean = EventCamera(4, 5)
    noisy = EventCamera(4, 5, shot_rate=300.0, seed=1)
    ours, theirs = (set(stream(camera, images, times).tolist()) for camera in (clean, noisy))
    assert len(ours) > 100 and len(theirs) - len(ours) > 1000
    assert ours < theirs


def test_the_mismatch_is_drawn_once_and_is_as_wide_as_asked() -> None:
    camera = EventCamera(80, 80, threshold=(0.2, 0.3), threshold_sigma=0.03, seed=2)
    drawn = camera.thresholds.copy()
    assert drawn.shape == (2, 80 * 80)
    error = 0.03 / math.sqrt(80 * 80)
    np.testing.assert_allclose(drawn.mean(axis=1), (0.2, 0.3), rtol=0, atol=SIGMAS * error)
    np.testing.assert_allclose(drawn.std(axis=1), 0.03, rtol=0, atol=SIGMAS * error / math.sqrt(2))
    for t in range(3):
        camera.step(np.full((80, 80), 1.0 + t), float(t))
        camera.reset()
    np.testing.assert_array_equal(camera.thresholds, drawn)
