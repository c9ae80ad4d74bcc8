"""Event representations, and the 8-bit codes of events and depth."""

from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.sensors import (
    EVENT_DTYPE,
    EventCamera,
    Representation,
    channels,
    count_frames,
    decode_depth,
    decode_events,
    encode_depth,
    encode_events,
    polarity_counts,
    represent,
    stack_by_time,
    time_surface,
    voxel_grid,
)
from sb3_have.sensors.depth import DepthEncoding

HEIGHT, WIDTH, BINS, T0, T1 = 4, 6, 5, 1.0, 3.0
Represent = Callable[..., NDArray[np.float64]]
FUNCTIONS: dict[Representation, Represent] = {
    "sbt": stack_by_time,
    "voxel": voxel_grid,
    "count": count_frames,
    "polarity": polarity_counts,
}


def events(number: int = 500, seed: int = 0) -> NDArray[Any]:
    rng = np.random.default_rng(seed)
    result = np.empty(number, EVENT_DTYPE)
    result["x"], result["y"] = rng.integers(WIDTH, size=number), rng.integers(HEIGHT, size=number)
    result["t"], result["p"] = np.sort(rng.uniform(T0, T1, number)), rng.choice([-1, 1], number)
    return result


def test_stack_by_time_by_hand() -> None:
    some = np.array([(0, 0, 1.0, 1), (0, 0, 1.39, 1), (0, 0, 1.41, -1), (5, 3, 3.0, -1), (1, 0, 3.1, 1)], EVENT_DTYPE)
    expected = np.zeros((HEIGHT, WIDTH, BINS))
    expected[0, 0, 0], expected[0, 0, 1], expected[3, 5, 4] = 2, -1, -1  # the last event lies outside the window
    np.testing.assert_array_equal(stack_by_time(some, BINS, T0, T1, HEIGHT, WIDTH), expected)


@pytest.mark.parametrize("bins", [1, 2, 5])
def test_equal_to_a_loop(bins: int) -> None:
    stacked, voxels, counts = np.zeros((3, HEIGHT, WIDTH, bins))
    by_polarity = np.zeros((HEIGHT, WIDTH, 2 * bins))
    for x, y, t, p in events().tolist():
        slot = int(bins * (t - T0) / (T1 - T0))
        stacked[y, x, slot] += p
        counts[y, x, slot] += 1
        by_polarity[y, x, slot if p > 0 else bins + slot] += 1
        tau = (bins - 1) * (t - T0) / (T1 - T0)
        for b in range(bins):
            voxels[y, x, b] += p * max(0.0, 1 - abs(b - tau))
    np.testing.assert_array_equal(stack_by_time(events(), bins, T0, T1, HEIGHT, WIDTH), stacked)
    np.testing.assert_array_equal(count_frames(events(), bins, T0, T1, HEIGHT, WIDTH), counts)
    np.testing.assert_array_equal(polarity_counts(events(), bins, T0, T1, HEIGHT, WIDTH), by_polarity)
    np.testing.assert_allclose(voxel_grid(events(), bins, T0, T1, HEIGHT, WIDTH), voxels, atol=1e-12)


@pytest.mark.parametrize("function", [stack_by_time, voxel_grid])
def test_sum_over_bins_is_the_sum_of_polarities(function: Represent) -> None:
    total = np.zeros((HEIGHT, WIDTH))
    np.add.at(total, (events()["y"], events()["x"]), events()["p"])
    np.testing.assert_allclose(function(events(), BINS, T0, T1, HEIGHT, WIDTH).sum(axis=-1), total, atol=1e-12)


def test_counts_split_by_polarity() -> None:
    window = (BINS, T0, T1, HEIGHT, WIDTH)
    positive, negative = (count_frames(events(), *window, polarity=p) for p in (1, -1))
    np.testing.assert_array_equal(positive + negative, count_frames(events(), *window))
    np.testing.assert_array_equal(positive - negative, stack_by_time(events(), *window))
    np.testing.assert_array_equal(np.concatenate((positive, negative), axis=-1), polarity_counts(events(), *window))


def test_time_surface_by_hand() -> None:
    some = np.array([(1, 0, 0.5, 1), (1, 0, 0.2, 1), (1, 0, 0.4, -1), (5, 3, 1.0, 1), (0, 0, 1.1, 1)], EVENT_DTYPE)
    expected = np.zeros((HEIGHT, WIDTH, 2))
    expected[0, 1], expected[3, 5, 0] = np.exp([-2.5, -3]), 1  # the last event is yet to come
    np.testing.assert_allclose(time_surface(some, 1.0, 0.2, HEIGHT, WIDTH), expected, rtol=1e-12)
    expected[0, 1, 1] = 0
    np.testing.assert_allclose(time_surface(some, 1.0, 0.2, HEIGHT, WIDTH, t0=0.45), expected, rtol=1e-12)


def test_time_surface_is_equal_to_a_loop_in_any_order() -> None:
    tau, now = 0.7, 2.5
    expected = np.zeros((HEIGHT, WIDTH, 2))
    for x, y, t, p in events().tolist():
        if t <= now:
            cell = (y, x, 0 if p > 0 else 1)
            expected[cell] = max(expected[cell], np.exp((t - now) / tau))
    shuffled = np.random.default_rng(1).permutation(events())
    assert (expected > 0).all()
    np.testing.assert_allclose(time_surface(shuffled, now, tau, HEIGHT, WIDTH), expected, rtol=1e-12)


def test_time_surface_of_a_window_and_its_time_constant() -> None:
    one = np.array([9]), np.array([T0 + 0.5]), np.array([-1.0])
    for tau, expected in ((None, np.exp(-0.75)), (0.5, np.exp(-3))):  # by default the window's length, 2 s
        surface = represent(*one, BINS, T0, T1, HEIGHT, WIDTH, "time_surface", tau)
        assert surface[1, 3, 1] == pytest.approx(expected) and np.count_nonzero(surface) == 1
    for tau in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="tau must be"):
            time_surface(events(), T1, tau, HEIGHT, WIDTH)
    with pytest.raises(ValueError, match="'time_surface'; leave it out for 'sbt'"):
        represent(*one, BINS, T0, T1, HEIGHT, WIDTH, "sbt", 0.5)


@pytest.mark.parametrize("name", get_args(Representation))
def test_number_of_channels(name: Representation) -> None:
    flat = (np.array([3]), np.array([T0]), np.array([1.0]))
    expected = {"sbt": 5, "voxel": 5, "count": 5, "polarity": 10, "time_surface": 2}[name]
    assert channels(name, BINS) == expected
    assert represent(*flat, BINS, T0, T1, HEIGHT, WIDTH, name).shape == (HEIGHT, WIDTH, expected)
    with pytest.raises(ValueError, match="bins >= 1"):
        channels(name, 0)
    with pytest.raises(ValueError, match=r"'time_surface'.*got 'image'"):
        channels("image", BINS)  # type: ignore[arg-type]


@pytest.mark.parametrize("function", FUNCTIONS.values())
def test_no_events_is_zero_and_bad_windows_raise(function: Represent) -> None:
    none = function(np.empty(0, EVENT_DTYPE), BINS, T0, T1, HEIGHT, WIDTH)
    depth = 2 * BINS if function is polarity_counts else BINS
    assert none.shape == (HEIGHT, WIDTH, depth) and not none.any() and none.dtype == np.float64
    assert not time_surface(np.empty(0, EVENT_DTYPE), T1, 0.1, HEIGHT, WIDTH).any()
    for t0, t1 in ((T1, T1), (-np.inf, T1), (T0, np.inf), (np.nan, T1)):
        with pytest.raises(ValueError, match="finite times t0 < t1"):
            function(events(), BINS, t0, t1, HEIGHT, WIDTH)
    recorded = events()
    recorded["p"] = recorded["p"] > 0
    with pytest.raises(ValueError, match=r"\+1 or -1.*2 \* p - 1"):
        function(recorded, BINS, T0, T1, HEIGHT, WIDTH)
    with pytest.raises(ValueError, match="outside an image"):
        function(events(), BINS, T0, T1, HEIGHT, WIDTH - 1)


@pytest.mark.parametrize("name, function", [*FUNCTIONS.items(), ("time_surface", None)])
def test_unsorted_path_gives_the_same_image(name: Representation, function: Represent | None) -> None:
    frames = np.exp(np.cumsum(np.random.default_rng(0).normal(0, 0.5, (6, HEIGHT, WIDTH)), axis=0))
    sorted_camera, fast_camera = (EventCamera(HEIGHT, WIDTH, threshold_sigma=0.03, seed=1) for _ in range(2))
    slow = np.concatenate([sorted_camera.step(frame, 0.04 * k) for k, frame in enumerate(frames)])
    pixel, time, polarity = (
        np.concatenate(part)
        for part in zip(*[fast_camera.detect(frame, 0.04 * k) for k, frame in enumerate(frames)], strict=True)
    )
    window = (BINS, 0.0, 0.2, HEIGHT, WIDTH)
    fast = represent(pixel, time, polarity, *window, name)
    assert len(slow) > 100
    if function is None:
        np.testing.assert_array_equal(fast, time_surface(slow, 0.2, 0.2, HEIGHT, WIDTH))
    elif name == "voxel":  # a sum of fractions depends on their order in its last bit
        np.testing.assert_allclose(fast, function(slow, *window), atol=1e-12)
    else:
        np.testing.assert_array_equal(fast, function(slow, *window))


def test_event_codes() -> None:
    counts = np.array([-500.0, -127, -1, 0, 1, 127, 500])
    codes = encode_events(counts)
    np.testing.assert_array_equal(codes, [1, 1, 127, 128, 129, 255, 255])
    np.testing.assert_array_equal(decode_events(codes), np.clip(counts, -127, 127))
    assert decode_events(np.zeros(3, np.uint8)).tolist() == [0, 0, 0]  # padding is no data, never -128 events
    assert decode_events(np.arange(256, dtype=np.uint8)).min() == -127
    with pytest.raises(ValueError, match="float64"):
        decode_events(counts)


def test_event_codes_of_a_time_surface() -> None:
    surface = np.array([0.0, 1e-3, 0.25, 0.5, 1.0])
    codes = encode_events(surface, "time_surface")
    np.testing.assert_array_equal(codes, [128, 128, 160, 192, 255])
    np.testing.assert_allclose(decode_events(codes, "time_surface"), surface, atol=0.5 / 127)
    np.testing.assert_array_equal(encode_events(decode_events(codes, "time_surface"), "time_surface"), codes)
    assert decode_events(np.zeros(1, np.uint8), "time_surface").tolist() == [0]
    for name in ("sbt", "voxel", "count", "polarity"):
        np.testing.assert_array_equal(encode_events([-3.0, 200.0], name), encode_events([-3.0, 200.0]))
    with pytest.raises(ValueError, match="representation must be one of"):
        encode_events(surface, "surface")  # type: ignore[arg-type]


@pytest.mark.parametrize("encoding, tolerance", [("log", 0.012), ("clipped", 0.2)])
def test_depth_round_trip(encoding: DepthEncoding, tolerance: float) -> None:
    metres = np.linspace(4, 100, 500, dtype=np.float32)
    decoded = decode_depth(encode_depth(metres, encoding), encoding)
    error = np.abs(decoded - metres) / (metres if encoding == "log" else 1)
    assert error.max() < tolerance


def test_clipped_depth_begins_at_the_camera() -> None:
    np.testing.assert_allclose(decode_depth(encode_depth([0.4], "clipped"), "clipped"), 0.4, atol=0.2)


def test_inverse_depth_is_fine_near_by() -> None:
    metres = np.array([1.0, 2.0, 5.0, 10.0, 100.0], dtype=np.float32)
    decoded = decode_depth(encode_depth(metres, "inverse"), "inverse")
    np.testing.assert_allclose(decoded, metres, rtol=0.03)


def test_log_depth_is_carlas_formula() -> None:
    metres = np.array([5.0, 20.0, 300.0, 1000.0])
    fraction = np.clip(1 + np.log(metres / 1000) / 5.70378, 0, 1)
    np.testing.assert_array_equal(encode_depth(metres), 1 + np.rint(254 * fraction))


@pytest.mark.parametrize("encoding", get_args(DepthEncoding))
def test_depth_code_zero_is_no_data(encoding: DepthEncoding) -> None:
    nothing = np.array([np.inf, np.nan, 0.0, -1.0])
    assert encode_depth(nothing, encoding).tolist() == [0, 0, 0, 0]
    assert decode_depth(np.zeros(2, np.uint8), encoding).tolist() == [0.0, 0.0]
    assert encode_depth(np.array([1e-3, 1.0, 50.0, 1e6]), encoding).min() >= 1
    decoded = decode_depth(np.arange(1, 256, dtype=np.uint8), encoding)
    assert np.isfinite(decoded).all() and len(np.unique(decoded)) == 255


def test_bad_depth_options() -> None:
    with pytest.raises(ValueError, match="'log', 'clipped', 'inverse'"):
        encode_depth(np.ones(1), "cubic")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="maximum depth"):
        encode_depth(np.ones(1), "clipped", maximum=0.0)
