"""The event camera against a literal loop in every combination of settings, and its laws."""

import itertools
import math
import pickle
from collections import Counter
from functools import partial
from typing import Any

import numpy as np
import pytest
from event_reference import Event, after_dead_time, pixel_events
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sb3_have.sensors import EVENT_DTYPE, PRESETS, EventCamera

Array = NDArray[Any]
Options = dict[str, Any]
PixelEvents = list[list[list[Event]]]  # [pixel][frame][event]

# Every setting with its values: all 192 combinations run.
SETTINGS: dict[str, tuple[Any, ...]] = {
    "mapping": ("log", "lin_log", "identity"),
    "threshold": (0.25, (0.2, 0.3)),
    "threshold_sigma": (0.0, 0.04),
    "refractory": (0.0, 0.03),
    "leak_rate": (0.0, 7.0),
    "shot_rate": (0.0, 12.0),
    "cutoff_hz": (None, 9.0),
}
GRID: list[Options] = [dict(zip(SETTINGS, values, strict=True)) for values in itertools.product(*SETTINGS.values())]
RANDOM_CASES = 64
MODEL = ("mapping", "log_eps", "leak_rate", "cutoff_hz", "cutoff_intensity")  # what the loop needs to know


def random_options(rng: np.random.Generator) -> Options:
    def maybe(value: float, off: Any = 0.0) -> Any:
        return value if rng.random() < 0.5 else off

    threshold = rng.uniform(0.05, 0.5, 2).tolist()
    mapping = rng.choice(SETTINGS["mapping"]).item()
    cutoff_hz = maybe(10 ** rng.uniform(-1, 4), None)
    return {
        "mapping": mapping,
        "threshold": maybe(threshold[0], tuple(threshold)),
        "threshold_sigma": maybe(rng.uniform(0.01, 0.2)),
        "refractory": maybe(10 ** rng.uniform(-4, 0)),
        "leak_rate": maybe(10 ** rng.uniform(-1, 2)),
        "shot_rate": maybe(10 ** rng.uniform(-1, 2)),
        "cutoff_hz": cutoff_hz,
        "cutoff_intensity": None if mapping == "identity" or cutoff_hz is None else maybe(rng.uniform(1, 100), None),
        "log_eps": 10 ** rng.uniform(-4, 0),
    }


def scene(rng: np.random.Generator, options: Options, times: Array, pixels: int) -> Array:
    """Frames (len(times), pixels): a random walk, and among the first pixels the hard cases.

    A level that comes back to where it was is a tie, decided by the last bit. All agree on it in ``log`` and
    ``identity``; the formula of ``lin_log`` can be rounded in two ways, so there it comes back to zero and white only.
    """
    frames, mapping = len(times), options["mapping"]
    walk = rng.normal(0, 0.8, (frames, pixels)).cumsum(axis=0)
    if mapping == "identity":
        intensity, highest = walk, 30.0
    elif mapping == "log":
        intensity, highest = np.exp(walk), 1e6
    else:
        intensity, highest = np.clip(20 * np.exp(walk), 0, 255), 255.0
    odd = np.arange(frames) % 2 == 1
    threshold = np.max(options["threshold"]) if np.ndim(options["threshold"]) else options["threshold"]
    steps = threshold * np.array([0, 1, 3, 3, 10, 0])[np.arange(frames) % 6]  # exactly on multiples of C

    hard = [
        intensity[:1, 0].repeat(frames),  # nothing happens
        np.zeros(frames),
        np.where(odd, highest, 0),  # from darkness to the brightest and back
        np.where(np.arange(frames) < frames // 2, intensity[0, 0], intensity[1, 0]),  # one edge
    ]
    if mapping == "identity":
        hard += [steps, -steps, np.where(odd, *rng.normal(size=2))]
    elif mapping == "log":
        hard += [np.exp(steps) - options.get("log_eps", 1e-3), np.where(odd, *rng.uniform(0, 9, 2))]
    else:
        hard += [np.where(odd, 20, 0), np.where(odd, 20, 21)]  # the end of the linear part
    for pixel, values in enumerate(hard[:pixels]):
        intensity[:, pixel] = values
    return intensity


def per_pixel(steps: list[Array], height: int, width: int) -> PixelEvents:
    found: PixelEvents = [[[] for _ in steps] for _ in range(height * width)]
    for i, events in enumerate(steps):
        for x, y, t, p in events.tolist():
            found[y * width + x][i].append((t, p))
    return found


def without(events: list[Event], crossings: list[Event]) -> list[Event]:
    """What is left of ``events`` after each crossing has been found in it."""
    left = list(events)
    for t, polarity in crossings:
        same = [event for event in left if event[1] == polarity]
        nearest = min(same, key=lambda event: abs(event[0] - t), default=(math.inf, 0))
        assert abs(nearest[0] - t) <= 1e-9, f"no event of polarity {polarity} at {t}, only {events}"
        left.remove(nearest)
    return left


def assert_close(expected: list[list[Event]], found: list[list[Event]]) -> None:
    """The same number of events of the same polarities in each step of a pixel, at the same times to 1e-9 s."""
    assert [[p for _, p in events] for events in found] == [[p for _, p in events] for events in expected]
    for (ours, _), (theirs, _) in zip(itertools.chain(*expected), itertools.chain(*found), strict=True):
        assert abs(ours - theirs) <= 1e-9, f"an event at {theirs} instead of {ours}"


def compare(options: Options, seed: int, height: int, width: int) -> Counter[str]:
    """Hold one random sequence against the loop; returns how many events of each sort it had.

    The noise events are what a twin camera with the same seed and no dead time fires beyond the loop's crossings.
    """
    rng = np.random.default_rng(seed)
    times = rng.uniform(-5, 5) + rng.uniform(0.004, 0.15, 6).cumsum()
    frames = scene(rng, options, times, height * width)
    camera = EventCamera(height, width, **options, seed=seed)
    twin = EventCamera(height, width, **{**options, "refractory": 0.0}, seed=seed)
    np.testing.assert_array_equal(camera.thresholds, twin.thresholds)
    phases = camera._leak_phase.ravel() if options["leak_rate"] else np.zeros(height * width)

    steps = [camera.step(frame.reshape(height, width), t) for frame, t in zip(frames, times, strict=True)]
    for events in steps:
        assert events.dtype == EVENT_DTYPE
        assert (np.diff(events["t"]) >= 0).all()
    found = per_pixel(steps, height, width)
    candidates = per_pixel(
        [twin.step(frame.reshape(height, width), t) for frame, t in zip(frames, times, strict=True)], height, width
    )

    total: Counter[str] = Counter()
    model = {key: options[key] for key in MODEL if key in options}
    for pixel in range(height * width):
        positive, negative = camera.thresholds[:, pixel].tolist()
        crossings = pixel_events(
            frames[:, pixel].tolist(), times.tolist(), (positive, negative), float(phases[pixel]), **model
        )
        noise = [without(*both) for both in zip(candidates[pixel], crossings, strict=True)]
        for before, after, surplus in zip(times, times[1:], noise[1:], strict=False):
            assert all(before < t <= after for t, _ in surplus)
        assert not noise[0]
        assert options["shot_rate"] or not any(noise)

        both = [a + b for a, b in zip(crossings, noise, strict=True)]
        expected = after_dead_time(both, options["refractory"])
        assert_close(expected, found[pixel])
        kept = sum(map(len, expected))
        total.update(
            crossings=sum(map(len, crossings)),
            noise=sum(map(len, noise)),
            lost=sum(map(len, both)) - kept,
            several=sum(len(step) > 1 for step in crossings),
            negative=sum(p < 0 for step in crossings for _, p in step),
        )
    return total


def test_equality_with_the_loop_in_every_combination_of_settings() -> None:
    ran, combinations = 0, set()
    for seed, options in enumerate(GRID):
        total = compare(options, seed, 5, 7)
        # No case passes for want of events.
        assert total["crossings"] > 100 and total["several"] > 20 and total["negative"] > 20, options
        assert (total["noise"] > 20) == bool(options["shot_rate"]), options
        assert (total["lost"] > 20) == bool(options["refractory"]), options
        combinations.add(tuple(options.values()))
        ran += 1
    assert ran == len(combinations) == 3 * 2**6


def test_equality_with_the_loop_at_random_settings_and_sizes() -> None:
    ran, total = 0, Counter[str]()
    for seed in range(1000, 1000 + RANDOM_CASES):
        rng = np.random.default_rng(seed)
        height, width = rng.integers(1, 8, 2).tolist()
        total += compare(random_options(rng), seed, height, width)
        ran += 1
    assert ran == RANDOM_CASES and len(GRID) + ran >= 200
    assert min(total[kind] for kind in ("crossings", "noise", "lost", "several", "negative")) > 1000, total


@pytest.mark.parametrize("name", PRESETS)
def test_equality_with_the_loop_for_every_preset(name: str) -> None:
    off = {key: values[0] for key, values in SETTINGS.items()}
    assert compare({**off, **PRESETS[name]}, 2, 5, 7)["crossings"] > 100
    cameras = EventCamera.preset(name, 4, 5, seed=1), EventCamera(4, 5, **PRESETS[name], seed=1)
    bits = [stream(camera, *film(4)).tobytes() for camera in cameras]
    assert bits[0] and bits[0] == bits[1]


@pytest.mark.parametrize("threshold", [0.05, 0.1, 0.2, 0.3, 1 / 3, 0.7])
def test_equality_with_the_loop_within_a_few_bits_of_a_threshold(threshold: float) -> None:
    """Sums of multiples of C, up to three bits off: rounding decides here whether an event comes now or later."""
    rng = np.random.default_rng(0)
    frames = rng.choice([0, 0.1, 1 / 3, -0.7], 900) + threshold * rng.integers(-8, 9, (5, 900)).cumsum(axis=0)
    frames[3] = frames[2]  # but for the bits
    frames += rng.integers(-3, 4, frames.shape) * np.spacing(np.abs(frames))
    camera, times = EventCamera(30, 30, threshold=threshold, mapping="identity"), np.arange(5.0)
    steps = [camera.step(frame.reshape(30, 30), t) for frame, t in zip(frames, times, strict=True)]
    assert len(steps[3])  # an event for a few bits
    for t, events in zip(times, steps, strict=True):
        assert ((t - 1 <= events["t"]) & (events["t"] <= t)).all()
    for pixel, found in enumerate(per_pixel(steps, 30, 30)):
        expected = pixel_events(frames[:, pixel].tolist(), times.tolist(), (threshold,) * 2, mapping="identity")
        assert_close(expected, found)


# --- The loop itself, on answers known without it ---------------------------------------------------------------------


def test_the_loop_on_known_answers() -> None:
    ramp = pixel_events([0, 1], [2, 4], (0.25, 0.5), mapping="identity")
    assert ramp == [[], [(2.5, 1), (3.0, 1), (3.5, 1), (4.0, 1)]]
    assert pixel_events([1, 0], [2, 4], (0.25, 0.5), mapping="identity") == [[], [(3.0, -1), (4.0, -1)]]
    assert pixel_events([0.0] * 3, [0, 1, 2], (0.25, 0.25)) == [[], [], []]
    leak = pixel_events([5.0] * 3, [0, 1, 2], (0.25, 0.5), 0.5, "identity", leak_rate=1.0)
    assert leak == [[], [(0.5, 1)], [(1.5, 1)]]
    # A step at once under a filter: y reaches the share 1 - tau (1 - exp(-1 / tau)) of a ramp of one second.
    tau = 1 / (2 * math.pi)
    reached = 1 - tau * (1 - math.exp(-1 / tau))
    (_, (event,)) = pixel_events([0, 1], [0, 1], (0.5, 0.5), mapping="identity", cutoff_hz=1.0)
    assert event == pytest.approx((0.5 / reached, 1))
    assert after_dead_time([[(0.0, 1), (0.2, 1)], [(0.25, -1), (0.3, 1), (0.5, 1)]], 0.25) == [
        [(0.0, 1)],
        [(0.25, -1), (0.5, 1)],
    ]


# --- Laws ------------------------------------------------------------------------------------------------------------

# Dyadic numbers: sums and products of these are exact, so that ties are ties.
levels = st.integers(-256, 256).map(lambda k: k / 64)
thresholds = st.integers(1, 64).map(lambda k: k / 64)
seeds = st.integers(0, 2**16)
fixed = partial(settings, deadline=None, derandomize=True, database=None)


def stream(camera: EventCamera, frames: Array, times: Array) -> Array:
    return np.concatenate([camera.step(frame, t) for frame, t in zip(frames, times, strict=True)])


def assert_same_events(ours: Array, theirs: Array) -> None:
    ours, theirs = (np.sort(events, order=("y", "x", "t")) for events in (ours, theirs))
    for field in ("x", "y", "p"):
        np.testing.assert_array_equal(ours[field], theirs[field])
    np.testing.assert_allclose(ours["t"], theirs["t"], rtol=0, atol=1e-9)


@fixed(max_examples=60)
@given(
    knots=st.lists(st.tuples(levels, levels, levels), min_size=2, max_size=4),
    threshold=st.tuples(thresholds, thresholds),
    cuts=st.sets(st.integers(1, 15), max_size=6),
    leak_rate=st.sampled_from([0.0, 4.0]),
    refractory=st.sampled_from([0.0, 0.03125]),
    mismatch=st.sampled_from([0.0, 0.1]),
    seed=seeds,
)
def test_splitting_a_ramp_into_steps_changes_no_event(
    knots: list[tuple[float, ...]],
    threshold: tuple[float, float],
    cuts: set[int],
    leak_rate: float,
    refractory: float,
    mismatch: float,
    seed: int,
) -> None:
    options: Options = {"threshold": threshold, "leak_rate": leak_rate, "refractory": refractory}
    sigma = mismatch * min(threshold)  # far from the floor of the draws, a tenth of C, at which ties would be rounded
    cameras = [EventCamera(1, 3, **options, threshold_sigma=sigma, mapping="identity", seed=seed) for _ in range(2)]
    coarse = np.array(knots)[:, None]
    shares = np.array([0, *sorted(cuts)]) / 16
    fine = np.concatenate([a + shares[:, None, None] * (b - a) for a, b in itertools.pairwise(coarse)] + [coarse[-1:]])
    fine_times = np.concatenate([*(i + shares for i in range(len(coarse) - 1)), [len(coarse) - 1]])
    assert_same_events(
        stream(cameras[0], coarse, np.arange(len(coarse), dtype=float)), stream(cameras[1], fine, fine_times)
    )


@fixed(max_examples=40)
@given(height=st.floats(-4, 4), cutoff_hz=st.floats(0.05, 50), cuts=st.sets(st.integers(1, 15), max_size=6))
def test_splitting_a_ramp_changes_no_count_behind_the_filter(height: float, cutoff_hz: float, cuts: set[int]) -> None:
    counts = []
    for times in (np.array([0.0, 1.0, 2.0]), np.array(sorted({0, 16, 32, *cuts, *(16 + c for c in cuts)})) / 16):
        camera = EventCamera(1, 1, threshold=0.0371, mapping="identity", cutoff_hz=cutoff_hz)
        counts.append(stream(camera, height * np.minimum(times, 1)[:, None, None], times)["p"].sum())
    assert counts[0] == counts[1]


@fixed(max_examples=60)
@given(
    frames=st.lists(st.tuples(*[st.floats(0, 1e6)] * 4), min_size=2, max_size=5),
    threshold=st.tuples(st.floats(0.05, 1), st.floats(0.05, 1)),
    leak_rate=st.sampled_from([0.0, 3.0]),
    seed=seeds,
)
def test_the_reference_follows_the_level_within_a_threshold(
    frames: list[tuple[float, ...]], threshold: tuple[float, float], leak_rate: float, seed: int
) -> None:
    camera = EventCamera(2, 2, threshold=threshold, threshold_sigma=0.02, leak_rate=leak_rate, seed=seed)
    positive, negative = camera.thresholds
    phase = camera._leak_phase.ravel() if leak_rate else np.zeros(4)
    reference = np.log(1e-3 + np.array(frames[0])) - phase * positive
    for t, frame in enumerate(frames):
        pixels, times, polarity = camera.detect(np.reshape(frame, (2, 2)), float(t))
        assert ((t - 1 <= times) & (times <= t)).all()
        np.add.at(reference, pixels, np.where(polarity > 0, positive[pixels], -negative[pixels]))
        level = np.log(1e-3 + np.array(frame)) + positive * leak_rate * t
        assert (level - reference < positive + 1e-9).all() and (reference - level < negative + 1e-9).all()


NOISY: Options = {
    "threshold": (0.2, 0.3),
    "threshold_sigma": 0.03,
    "refractory": 0.01,
    "leak_rate": 2.0,
    "shot_rate": 10.0,
    "cutoff_hz": 20.0,
}


def film(seed: int, frames: int = 6) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return np.exp(rng.normal(0, 1, (frames, 4, 5))), rng.uniform(0.01, 0.1, frames).cumsum()


@fixed(max_examples=20)
@given(seed=seeds, frames=st.integers(0, 6))
def test_a_pickle_goes_on_bit_by_bit(seed: int, frames: int) -> None:
    images, times = film(seed)
    camera = EventCamera(4, 5, **NOISY, seed=seed)
    stream(camera, images[:1], times[:1] - 1)
    for image, t in zip(images[:frames], times, strict=False):
        camera.step(image, t)
    copy: EventCamera = pickle.loads(pickle.dumps(camera))
    for image, t in zip(images[frames:], times[frames:], strict=True):
        assert camera.step(image, t).tobytes() == copy.step(image, t).tobytes()
    last = images[0], times[-1] + 1
    events = camera.step(*last)
    assert len(events) and events.tobytes() == copy.step(*last).tobytes()


@fixed(max_examples=20)
@given(seed=seeds, start=st.sampled_from([-100.0, 0.0, 100.0]))
def test_reset_forgets_the_scene(seed: int, start: float) -> None:
    """Time may start again; the chip, with its thresholds and leak phases, stays."""
    used, new = (EventCamera(4, 5, **NOISY, seed=seed) for _ in range(2))
    images, times = film(seed + 1)
    stream(used, images, times)
    used.reset()
    images, times = film(seed)
    sources = np.random.default_rng(seed), np.random.default_rng(seed)
    fired = 0
    for image, t in zip(images, times, strict=True):
        ours, theirs = (camera.detect(image, start + t, rng) for camera, rng in zip((used, new), sources, strict=True))
        fired += len(ours[0])
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)
    assert fired > 20


@fixed(max_examples=20)
@given(seed=seeds)
def test_the_seed_decides_every_bit(seed: int) -> None:
    images, times = film(3)

    def fired(seed: int, **options: Any) -> bytes:
        return stream(EventCamera(4, 5, **options, seed=seed), images, times).tobytes()

    assert fired(seed, **NOISY) == fired(seed, **NOISY)
    for option in ("threshold_sigma", "leak_rate", "shot_rate"):
        assert fired(seed, **{option: NOISY[option]}) != fired(seed + 1, **{option: NOISY[option]}), option
    assert fired(seed) == fired(seed + 1)


def test_an_event_at_the_end_of_the_dead_time_is_kept() -> None:
    camera = EventCamera(1, 1, threshold=0.25, refractory=0.5, mapping="identity")
    events = stream(camera, np.array([0.0, 1.0, 1.0, 0.5]).reshape(-1, 1, 1), np.array([0.0, 1.0, 1.25, 2.25]))
    # Crossings at .25 .5 .75 1 (the second and the fourth are lost) and at 1.75 and 2.25.
    assert events["t"].tolist() == [0.25, 0.75, 1.75, 2.25]
    assert events["p"].tolist() == [1, 1, -1, -1]
