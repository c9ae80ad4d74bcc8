"""The event camera against known answers and against a pixel-by-pixel loop."""

import pickle
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.sensors import EVENT_DTYPE, EventCamera

Event = tuple[int, int, float, int]


def film(seed: int = 0, frames: int = 12, height: int = 6, width: int = 5) -> NDArray[Any]:
    """Random log intensities that wander over many thresholds."""
    rng = np.random.default_rng(seed)
    return np.asarray(np.cumsum(rng.normal(0, 0.6, (frames, height, width)), axis=0))


def run(camera: EventCamera, frames: NDArray[Any], dt: float = 0.1) -> NDArray[Any]:
    return np.concatenate([camera.step(frame, k * dt) for k, frame in enumerate(frames)])


def loop(frames: NDArray[Any], thresholds: NDArray[Any], dt: float = 0.1) -> list[Event]:
    """The model word by word: one pixel, one crossing at a time."""
    _, height, width = frames.shape
    events = []
    for y in range(height):
        for x in range(width):
            reference = float(frames[0, y, x])
            for k in range(1, len(frames)):
                before, now = float(frames[k - 1, y, x]), float(frames[k, y, x])
                polarity = 1 if now > reference else -1
                step = float(thresholds[0 if polarity > 0 else 1, y * width + x])
                crossings = 0
                while polarity * (reference + polarity * (crossings + 1) * step) <= polarity * now:
                    crossings += 1
                    level = reference + polarity * crossings * step
                    events.append((x, y, (k - 1 + (level - before) / (now - before)) * dt, polarity))
                reference += polarity * crossings * step
    return sorted(events, key=lambda event: event[2])


def test_ramp_fires_at_every_threshold() -> None:
    camera = EventCamera(1, 1, threshold=0.25, mapping="identity")
    camera.step([[0.0]], 0.0)
    events = camera.step([[-1.1]], 1.0)
    assert events.dtype == EVENT_DTYPE
    np.testing.assert_array_equal(events["p"], [-1, -1, -1, -1])
    np.testing.assert_allclose(events["t"], np.array([0.25, 0.5, 0.75, 1.0]) / 1.1, rtol=1e-12)


def test_remainder_carries_over() -> None:
    camera = EventCamera(1, 1, threshold=0.25, mapping="identity")
    levels = [0.0, 0.2, 0.4, 0.1]
    counts = [camera.step([[level]], t)["p"].sum() for t, level in enumerate(levels)]
    assert counts == [0, 0, 1, 0]  # 0.1 is less than a threshold below the reference, now at 0.25
    assert camera.step([[-0.05]], 4.0)["p"].tolist() == [-1]


def test_nothing_moves_nothing_fires() -> None:
    camera = EventCamera(4, 4, threshold_sigma=0.05, seed=1)
    frame = np.random.default_rng(0).random((4, 4))
    assert len(run(camera, np.repeat(frame[None], 5, axis=0))) == 0


@pytest.mark.parametrize("threshold, level", [(0.2, 1.2), (0.1, 0.6)])
def test_a_level_at_rest_on_a_threshold_fires_no_more(threshold: float, level: float) -> None:
    # The last of the crossings rounds to just beyond the level, and the reference that has moved to just below it.
    camera = EventCamera(1, 1, threshold=threshold, mapping="identity")
    camera.step([[0.0]], 0.0)
    assert len(camera.step([[level]], 1.0)) == 5
    assert [len(camera.step([[level]], t)) for t in (2.0, 3.0)] == [0, 0]


@pytest.mark.parametrize("sigma", [0.0, 0.05])
@pytest.mark.parametrize("threshold", [0.2, (0.15, 0.3)])
def test_equals_a_loop_over_pixels(sigma: float, threshold: float | tuple[float, float]) -> None:
    camera = EventCamera(6, 5, threshold=threshold, threshold_sigma=sigma, mapping="identity", seed=3)
    events = run(camera, film())
    expected = loop(film(), camera.thresholds)
    assert len(events) == len(expected) > 500
    assert np.all(np.diff(events["t"]) >= 0)
    by_pixel = np.lexsort((events["t"], events["x"], events["y"]))
    expected_by_pixel = sorted(expected, key=lambda event: (event[1], event[0], event[2]))
    for field, column in (("x", 0), ("y", 1), ("p", 3)):
        np.testing.assert_array_equal(events[field][by_pixel], [event[column] for event in expected_by_pixel])
    np.testing.assert_allclose(events["t"][by_pixel], [event[2] for event in expected_by_pixel], atol=1e-12)


def test_sub_steps_change_nothing() -> None:
    frames = film()
    between = [a + (b - a) * np.arange(4)[:, None, None] / 4 for a, b in pairwise(frames)]
    fine = np.concatenate((*between, frames[-1:]))
    coarse_events = run(EventCamera(6, 5, mapping="identity"), frames, 0.1)
    fine_events = run(EventCamera(6, 5, mapping="identity"), fine, 0.025)
    assert len(coarse_events) == len(fine_events)
    np.testing.assert_allclose(coarse_events["t"], fine_events["t"], atol=1e-9)
    np.testing.assert_array_equal(coarse_events["p"], fine_events["p"])


def test_logarithm_sees_contrast_and_not_brightness() -> None:
    scene = np.exp(film(height=3, width=3))
    bright = run(EventCamera(3, 3, log_eps=1e-12), scene)
    dark = run(EventCamera(3, 3, log_eps=1e-12), 1e-4 * scene)
    assert len(bright) == len(dark) > 100
    np.testing.assert_array_equal(np.bincount(bright["x"]), np.bincount(dark["x"]))
    assert len(run(EventCamera(3, 3, log_eps=1.0), 1e-4 * scene)) == 0


def test_lin_log_is_linear_in_the_dark_and_continuous() -> None:
    camera = EventCamera(1, 1, threshold=0.01, mapping="lin_log")
    slope = np.log(20) / 20
    camera.step([[0.0]], 0.0)
    assert len(camera.step([[10.0]], 1.0)) == int(10 * slope / 0.01)
    assert len(camera.step([[20.0001]], 2.0)) == int(20 * slope / 0.01) - int(10 * slope / 0.01)
    assert len(camera.step([[200.0]], 3.0)) == pytest.approx(np.log(10) / 0.01, abs=1)


def test_mismatch_is_drawn_once() -> None:
    camera = EventCamera(20, 20, threshold=0.2, threshold_sigma=0.03, mapping="identity", seed=0)
    thresholds = camera.thresholds.copy()
    assert thresholds.std() == pytest.approx(0.03, rel=0.15)
    assert abs(np.corrcoef(thresholds[0], thresholds[1]).min()) < 0.2
    run(camera, film(height=20, width=20))
    camera.reset()
    np.testing.assert_array_equal(camera.thresholds, thresholds)
    # A slow ramp over 10 log units: a pixel whose threshold changed from frame to frame would lose or gain events.
    counts = np.zeros(400)
    for t, level in enumerate(np.linspace(0, 10, 2001)):
        events = camera.step(np.full((20, 20), level), float(t))
        np.add.at(counts, events["y"].astype(int) * 20 + events["x"], 1)
    assert np.abs(counts - 10 / thresholds[0]).max() <= 1


def test_refractory_period_thins_events() -> None:
    ramp = np.linspace(0, 4, 9)[:, None, None]
    camera = EventCamera(1, 1, threshold=0.1, refractory=0.05, mapping="identity")
    events = run(camera, ramp)  # crossings every 0.02 s: every third one survives
    np.testing.assert_allclose(events["t"], 0.02 + 0.06 * np.arange(len(events)), atol=1e-9)
    assert len(events) == 14
    # The reference went along with the lost crossings: nothing is left to fire.
    assert len(camera.step(ramp[-1], 10.0)) == 0


def test_leak_fires_at_its_rate() -> None:
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
    assert len(events) == pytest.approx(900 * 4.0 * 2.5, abs=900)
    shares = np.histogram(events["t"] % 0.25, bins=5, range=(0, 0.25))[0] / len(events)
    np.testing.assert_allclose(shares, 0.2, atol=5 * np.sqrt(0.2 * 0.8 / 900))
    camera.reset()
    np.testing.assert_array_equal(run(camera, np.ones((51, 30, 30)), 0.05), events)


def test_shot_noise_has_its_rate_and_no_preference() -> None:
    camera = EventCamera(40, 40, shot_rate=2.0, seed=0)
    events = run(camera, np.ones((11, 40, 40)))
    expected = 2.0 * 1600 * 1.0
    assert len(events) == pytest.approx(expected, abs=5 * np.sqrt(expected))
    assert abs(events["p"].astype(float).sum()) < 5 * np.sqrt(expected)
    assert np.all(np.diff(events["t"]) >= 0)
    again = EventCamera(40, 40, shot_rate=2.0, seed=0)
    np.testing.assert_array_equal(run(again, np.ones((11, 40, 40))), events)


def test_pickles_in_the_middle_of_a_film() -> None:
    camera = EventCamera(6, 5, threshold_sigma=0.03, refractory=0.01, shot_rate=1.0, mapping="identity", seed=0)
    run(camera, film()[:6])
    twin = pickle.loads(pickle.dumps(camera))
    for k, frame in enumerate(film()[6:], start=6):
        np.testing.assert_array_equal(camera.step(frame, 0.1 * k), twin.step(frame, 0.1 * k))


def test_first_frame_after_reset_is_silent() -> None:
    camera = EventCamera(6, 5, mapping="identity")
    assert len(run(camera, film())) > 0
    camera.reset()
    assert len(camera.step(film()[0], 0.0)) == 0


@pytest.mark.parametrize(
    "kwargs",
    [
        {"height": 0},
        {"threshold": 0.0},
        {"threshold": (0.2, -0.1)},
        {"threshold_sigma": -1.0},
        {"refractory": -0.1},
        {"leak_rate": float("nan")},
        {"shot_rate": -1.0},
        {"mapping": "sqrt"},
        {"log_eps": 0.0},
    ],
)
def test_bad_parameters(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        EventCamera(**{"height": 4, "width": 4, **kwargs})


def test_bad_frames() -> None:
    camera = EventCamera(2, 3)
    camera.step(np.ones((2, 3)), 0.0)
    with pytest.raises(ValueError, match=r"\(2, 3\), got \(3, 2\)"):
        camera.step(np.ones((3, 2)), 1.0)
    with pytest.raises(ValueError, match="NaN"):
        camera.step(np.full((2, 3), np.nan), 1.0)
    with pytest.raises(ValueError, match=">= 0"):
        camera.step(-np.ones((2, 3)), 1.0)
    with pytest.raises(ValueError, match="advance"):
        camera.step(np.ones((2, 3)), 0.0)
