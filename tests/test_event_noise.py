"""What keeps an event camera from being ideal: mismatch, dead time, leaks and shot noise, each at its rate."""

import numpy as np
import pytest
from test_event_camera import EVERYTHING, film, run

from sb3_have.sensors import EVENT_DTYPE, EventCamera


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


def test_shot_noise_is_even_and_leaves_the_signal_alone() -> None:
    quiet, noisy = (EventCamera(40, 40, shot_rate=rate, mapping="identity", seed=0) for rate in (0.0, 5.0))
    frames = film(height=40, width=40)
    signal, everything = run(quiet, frames), run(noisy, frames)
    noise = np.setdiff1d(everything, signal)
    assert len(np.intersect1d(everything, signal)) == len(signal)
    error = 5 * np.sqrt(0.25 / len(noise))
    for share in (noise["x"] / 40, noise["y"] / 40, noise["t"] / 1.1, noise["t"] / 0.1 % 1):
        np.testing.assert_allclose(np.histogram(share, bins=4, range=(0, 1))[0] / len(noise), 0.25, atol=error)
    assert np.mean(noise["p"] > 0) == pytest.approx(0.5, abs=error)


def test_shot_noise_is_poisson() -> None:
    camera = EventCamera(10, 10, shot_rate=2.0, seed=0)
    counts = [len(camera.step(np.ones((10, 10)), 0.1 * k)) for k in range(1001)][1:]
    assert np.mean(counts) == pytest.approx(20, abs=5 * np.sqrt(20 / 1000))
    assert np.var(counts) == pytest.approx(20, rel=5 * np.sqrt(2 / 1000))


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
        assert np.sum(events["p"] == sign) == pytest.approx(expected, abs=5 * np.sqrt(expected))
    assert camera.thresholds.std() == pytest.approx(0.05, rel=0.1)
    quiet = {"threshold_sigma": 0.0, "leak_rate": 0.0, "shot_rate": 0.0}
    flash = np.where(np.arange(21) < 1, 100.0, 150.0)[:, None, None] * np.ones((21, 6, 5))
    first = [
        run(EventCamera.preset("noisy", 6, 5, **quiet, **wide), flash, 1e-3)["t"][0]
        for wide in ({}, {"cutoff_hz": None})
    ]
    change, tau = np.log(1.5), 1 / (2 * np.pi * 30)
    assert first == pytest.approx([5e-4 + tau * np.log(change / (change - 0.2)), 1e-3 * 0.2 / change], rel=0.02)
