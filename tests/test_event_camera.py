"""The event camera against known answers and against a pixel-by-pixel loop."""

import copy
import pickle
from itertools import pairwise
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.sensors import EVENT_DTYPE, PRESETS, EventCamera
from sb3_have.sensors.event_camera import Mapping

Event = tuple[int, int, float, int]
# Every part of the model at once
EVERYTHING: dict[str, Any] = {
    "threshold": (0.15, 0.3),
    "threshold_sigma": 0.03,
    "refractory": 0.01,
    "leak_rate": 2.0,
    "shot_rate": 1.0,
    "cutoff_hz": 2.0,
}


def film(seed: int = 0, frames: int = 12, height: int = 6, width: int = 5) -> NDArray[Any]:
    """Random log intensities that wander over many thresholds."""
    rng = np.random.default_rng(seed)
    return np.asarray(np.cumsum(rng.normal(0, 0.6, (frames, height, width)), axis=0))


def run(camera: EventCamera, frames: NDArray[Any], dt: float = 0.1) -> NDArray[Any]:
    return np.concatenate([camera.step(frame, k * dt) for k, frame in enumerate(frames)])


def loop(frames: NDArray[Any], thresholds: NDArray[Any], dt: float = 0.1) -> list[Event]:
    """The model as a loop: one pixel and one crossing at a time."""
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


def net(events: NDArray[Any], height: int = 6, width: int = 5) -> NDArray[Any]:
    """Sum of polarities of every pixel."""
    total = np.zeros((height, width), int)
    np.add.at(total, (events["y"], events["x"]), events["p"])
    return total


@pytest.mark.parametrize("change", [1.1, -1.1, 0.249, -1.0])
def test_ramp_fires_at_every_threshold(change: float) -> None:
    camera = EventCamera(1, 1, threshold=0.25, mapping="identity")
    camera.step([[0.0]], 0.0)
    events = camera.step([[change]], 2.0)
    assert events.dtype == EVENT_DTYPE
    count = int(abs(change) / 0.25)
    np.testing.assert_array_equal(events["p"], np.full(count, np.sign(change)))
    np.testing.assert_allclose(events["t"], 2.0 * np.arange(1, count + 1) * 0.25 / abs(change), rtol=1e-12)


def test_each_polarity_has_its_threshold() -> None:
    camera = EventCamera(1, 1, threshold=(0.2, 0.5), mapping="identity")
    camera.step([[0.0]], 0.0)
    up, down = camera.step([[1.1]], 1.0), camera.step([[-0.6]], 2.0)
    np.testing.assert_allclose(up["t"], np.arange(1, 6) * 0.2 / 1.1)  # the reference is now at 1.0
    assert down["p"].tolist() == [-1, -1, -1]
    np.testing.assert_allclose(down["t"], 1 + (1.1 - np.array([0.5, 0.0, -0.5])) / 1.7)


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


@pytest.mark.parametrize("start, count", [(-6.0, 3), (-2.0, 11)])
def test_a_level_on_a_threshold_reaches_it_and_one_bit_below_does_not(start: float, count: int) -> None:
    # The quotient of change and threshold rounds down in the first case, and up in the second.
    on = start + count * 0.1
    for level, expected in ((on, count), (np.nextafter(on, -9.0), count - 1)):
        camera = EventCamera(1, 1, threshold=0.1, mapping="identity")
        camera.step([[start]], 0.0)
        assert len(camera.step([[level]], 1.0)) == expected


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


@pytest.mark.parametrize("part", [{}, {"leak_rate": 3.0}, {"threshold_sigma": 0.03}, {"refractory": 0.013}])
def test_sub_steps_change_nothing(part: dict[str, Any]) -> None:
    coarse_events = run(EventCamera(6, 5, mapping="identity", seed=0, **part), film(), 0.1)
    fine_events = run(EventCamera(6, 5, mapping="identity", seed=0, **part), refined(film()), 0.025)
    assert len(coarse_events) == len(fine_events) > 500
    np.testing.assert_allclose(coarse_events["t"], fine_events["t"], atol=1e-9)
    np.testing.assert_array_equal(coarse_events["p"], fine_events["p"])


def refined(frames: NDArray[Any]) -> NDArray[Any]:
    """Four times as many frames, on the straight lines between the given ones."""
    between = [a + (b - a) * np.arange(4)[:, None, None] / 4 for a, b in pairwise(frames)]
    return np.concatenate((*between, frames[-1:]))


def test_sub_steps_do_not_change_what_the_filter_lets_through() -> None:
    rising = np.cumsum(np.abs(np.diff(film(), axis=0)), axis=0)
    coarse, fine = (EventCamera(6, 5, threshold=0.05, mapping="identity", cutoff_hz=1.5) for _ in range(2))
    coarse.step(rising[0], 0.0), fine.step(rising[0], 0.0)
    for k, (frame, parts) in enumerate(zip(rising[1:], refined(rising)[1:].reshape(-1, 4, 6, 5), strict=True)):
        events = coarse.step(frame, 0.1 * (k + 1))
        in_parts = np.concatenate([fine.step(part, 0.1 * k + 0.025 * (n + 1)) for n, part in enumerate(parts)])
        assert len(events) > 50
        np.testing.assert_array_equal(net(events), net(in_parts))


def test_low_pass_answers_a_step_as_in_the_books() -> None:
    cutoff, rise = 4.0, 1e-4
    tau, dt = 1 / (2 * np.pi * cutoff), 5e-4
    camera = EventCamera(1, 1, threshold=0.05, mapping="identity", cutoff_hz=cutoff)
    camera.step([[0.0]], -rise)
    start = camera.step([[1.0]], 0.0)
    assert len(start) == 0  # a jump of 20 thresholds
    events = np.concatenate([camera.step([[1.0]], dt * k) for k in range(1, 1000)])
    reached = 1 - tau / rise * (1 - np.exp(-rise / tau))  # at the end of the ramp
    levels = 0.05 * np.arange(1, 20)
    expected = tau * np.log((1 - reached) / (1 - levels))
    np.testing.assert_allclose(events["t"], expected, atol=1.01 * dt**2 / (8 * tau))  # straight between frames
    assert np.all(events["p"] == 1)


def test_low_pass_damps_its_cutoff_frequency_by_3_db() -> None:
    camera = EventCamera(1, 1, threshold=0.001, mapping="identity", cutoff_hz=5.0)
    times = np.arange(0, 2, 1e-3)
    events = [camera.step([[np.sin(2 * np.pi * 5.0 * t)]], t)["p"].sum() for t in times]
    settled = 0.001 * np.cumsum(events, dtype=float)[times > 1]
    assert np.ptp(settled) / 2 == pytest.approx(np.sqrt(0.5), abs=0.002)
    delay = (times[times > 1][settled[:200].argmax()] - 0.05) % 0.2
    assert delay == pytest.approx(0.2 / 8, abs=0.003)  # 45 degrees


def test_a_wide_band_changes_nothing_and_a_scene_at_rest_stays_silent() -> None:
    plain, wide = (EventCamera(6, 5, mapping="identity", cutoff_hz=cutoff) for cutoff in (None, 1e9))
    np.testing.assert_array_equal(net(run(plain, film())), net(run(wide, film())))
    slow = EventCamera(6, 5, threshold=1e-9, mapping="identity", cutoff_hz=3.0)
    assert len(run(slow, np.repeat(film()[:1], 5, axis=0))) == 0


def test_dark_pixels_are_slow() -> None:
    def camera(cutoff: float, knee: float | None = None) -> EventCamera:
        return EventCamera(6, 5, threshold=0.005, log_eps=1e-12, cutoff_hz=cutoff, cutoff_intensity=knee)

    scene = np.exp(film())
    for brightest, factor in ((0.1, 0.1), (0.01, 0.1), (0.5, 0.5)):
        # One frame after the first: what counts is its own intensity.
        pair = brightest * np.stack((scene[0] / scene[1], np.ones((6, 5))))
        expected = run(camera(2.0 * factor), pair)
        assert len(expected) > 50
        np.testing.assert_allclose(run(camera(2.0, 1.0), pair)["t"], expected["t"], rtol=1e-9)
    bright = 1 / scene.min() * scene
    np.testing.assert_array_equal(run(camera(2.0, 1.0), bright), run(camera(2.0), bright))


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


@pytest.mark.parametrize("name", PRESETS)
def test_presets(name: str) -> None:
    camera = EventCamera.preset(name, 3, 4, seed=1)
    same = EventCamera(3, 4, **PRESETS[name], seed=1)
    np.testing.assert_array_equal(camera.thresholds, same.thresholds)
    assert (camera.height, camera.width) == (3, 4)
    for key, value in PRESETS[name].items():
        assert key == "threshold" or getattr(camera, key) == value
    assert EventCamera.preset(name, 3, 4, threshold=0.7, threshold_sigma=0.0).thresholds.max() == 0.7
    with pytest.raises(TypeError):
        PRESETS[name]["threshold"] = 1.0  # type: ignore[index]
    with pytest.raises(ValueError, match=r"ideal.*carla.*noisy.*'quiet'"):
        EventCamera.preset("quiet", 3, 4)


def test_preset_carla_sees_the_least_8_bit_step_in_the_dark_five_times() -> None:
    camera = EventCamera.preset("carla", 1, 1)
    camera.step([[0.0]], 0.0)
    events = camera.step([[1 / 255]], 1.0)  # log(0.001 + 1 / 255) - log(0.001) is 5.3 thresholds
    np.testing.assert_allclose(events["t"], 0.3 * np.arange(1, 6) / np.log(1 + 1000 / 255))


@pytest.mark.parametrize("double", [copy.deepcopy, lambda camera: pickle.loads(pickle.dumps(camera))])
def test_pickles_in_the_middle_of_a_film(double: Any) -> None:
    camera = EventCamera(6, 5, **EVERYTHING, mapping="identity", seed=0)
    run(camera, film()[:6])
    twin = double(camera)
    for k, frame in enumerate(film()[6:], start=6):
        expected = camera.step(frame, 0.1 * k)
        assert len(expected) > 10
        np.testing.assert_array_equal(twin.step(frame, 0.1 * k), expected)


def test_after_a_reset_all_is_new_but_the_chip() -> None:
    settings = {**EVERYTHING, "shot_rate": 0.0, "mapping": "identity", "seed": 0}
    camera = EventCamera(6, 5, **settings)
    first = run(camera, film())
    camera.reset()
    np.testing.assert_array_equal(run(camera, film()), first)


def test_equal_times_come_row_by_row() -> None:
    camera = EventCamera(6, 5, mapping="identity")
    events = run(camera, np.array([0.0, 0.5])[:, None, None] * np.ones((2, 6, 5)))
    assert len(events) == 60
    np.testing.assert_array_equal(events, np.sort(events, order=("t", "y", "x")))


def test_whole_numbers_are_taken_as_they_are() -> None:
    frames = np.random.default_rng(0).integers(256, size=(5, 6, 5), dtype=np.uint8)
    for mapping in get_args(Mapping):
        whole, real = (EventCamera(6, 5, mapping=mapping) for _ in range(2))
        np.testing.assert_array_equal(run(whole, frames), run(real, 1.0 * frames))


def test_first_frame_after_reset_is_silent() -> None:
    camera = EventCamera(6, 5, mapping="identity")
    assert len(run(camera, film())) > 0
    camera.reset()
    assert len(camera.step(film()[0], 0.0)) == 0


@pytest.mark.parametrize(
    "kwargs",
    [
        {"height": 0},
        {"height": 65536},
        {"height": 2.0},
        {"width": 2.0},
        {"threshold": 0.0},
        {"threshold": (0.2, -0.1)},
        {"threshold": float("inf")},
        {"threshold": (0.2, float("nan"))},
        {"threshold": (0.1, 0.2, 0.3)},
        {"threshold": "x"},
        {"threshold_sigma": -1.0},
        {"refractory": -0.1},
        {"refractory": "x"},
        {"leak_rate": float("nan")},
        {"shot_rate": -1.0},
        {"mapping": "sqrt"},
        {"log_eps": 0.0},
        {"log_eps": float("inf")},
        {"cutoff_hz": 0.0},
        {"cutoff_intensity": 1.0},
        {"cutoff_intensity": -1.0, "cutoff_hz": 30.0},
        {"cutoff_intensity": 1.0, "cutoff_hz": 30.0, "mapping": "identity"},
    ],
)
def test_bad_parameters(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        EventCamera(**{"height": 4, "width": 4, **kwargs})


def test_numbers_of_numpy_are_parameters() -> None:
    plain = EventCamera(6, 5, (0.25, 0.5), refractory=0, log_eps=1)
    numpy = EventCamera(np.int64(6), np.uint8(5), [np.float32(0.25), 0.5], refractory=np.int32(0), log_eps=np.int8(1))  # type: ignore[arg-type]
    np.testing.assert_array_equal(numpy.thresholds, plain.thresholds)
    np.testing.assert_array_equal(run(numpy, np.exp(film())), run(plain, np.exp(film())))


def test_bad_frames_are_refused_and_leave_no_trace() -> None:
    good = np.exp(film())
    undisturbed, camera = (EventCamera(6, 5, **EVERYTHING, seed=0) for _ in range(2))
    with pytest.raises(ValueError, match="finite number of seconds"):
        camera.step(good[0], float("nan"))
    for k, frame in enumerate(good):
        events = camera.step(frame, 0.1 * k)
        np.testing.assert_array_equal(events, undisturbed.step(frame, 0.1 * k))
        for bad, t, message in (
            (frame.T, k + 1.0, r"\(6, 5\), got \(5, 6\)"),
            (np.stack([frame] * 3, axis=-1), k + 1.0, "grey image"),
            (np.full((6, 5), np.nan), k + 1.0, "NaN"),
            (-frame, k + 1.0, ">= 0.*identity"),
            (frame, 0.1 * k, r"advance.*reset\(\)"),
            (frame, float("inf"), "advance"),
        ):
            with pytest.raises(ValueError, match=message):
                camera.step(bad, t)
    assert len(events) > 10
