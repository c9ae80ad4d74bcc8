"""Corrupted images: contract, severities, and the numbers that the table promises."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.sensors import FAILURES, SENSORS, decode_events, failures_for
from sb3_have.sensors import failures as f

Array = NDArray[Any]
PAIRS = [(kind, sensor) for sensor in SENSORS for kind in failures_for(sensor)]
LOW, HIGH = np.array([-2.0, 0.0, -np.inf, 5.0] * 4, np.float32), np.array([2.0, 1.0, np.inf, 9.0] * 4, np.float32)
SIZE = 48


def example(sensor: str, seed: int = 0) -> Array:
    """An image with structure at several scales, some of it "no data" where the sensor has that; or a vector."""
    rng = np.random.default_rng(seed)
    if sensor == "vector":
        return np.clip(rng.normal(size=16), LOW, HIGH).astype(np.float32)
    y, x = np.mgrid[:SIZE, :SIZE]
    if sensor == "event":
        image = 128 + rng.poisson(0.3, (SIZE, SIZE, 5)) * rng.choice((-1, 1), (SIZE, SIZE, 5))
        image[:4, :4] = 0
        return np.asarray(image, np.uint8)
    waves = 100 + 60 * np.sin((x + seed) / 5) * np.cos(y / 7) + 20 * np.sin((x + 2 * y) / 2)
    image = np.repeat(waves[..., None], 3 if sensor == "rgb" else 1, axis=-1)
    if sensor == "depth":
        image[:8] = 0  # the sky
    return np.asarray(image, np.uint8)


def corrupt(kind: str, sensor: str, severity: int, image: Array | None = None, seed: int = 0) -> Array:
    failure = FAILURES[kind][sensor]
    extra: dict[str, Any] = {}
    if kind in ("frozen", "lag"):
        extra["past"] = example(sensor, seed + 4)
    elif sensor == "vector":
        extra.update(low=LOW, high=HIGH)
    image = example(sensor) if image is None else image
    return failure.function(image, np.random.default_rng(seed), **extra, **failure.at(severity))


@pytest.mark.parametrize("severity", [1, 2, 3])
@pytest.mark.parametrize("kind, sensor", PAIRS)
def test_shape_dtype_and_input_are_kept(kind: str, sensor: str, severity: int) -> None:
    image = example(sensor)
    image.setflags(write=False)
    failed = corrupt(kind, sensor, severity, image)
    assert failed.dtype == image.dtype and failed.shape == image.shape
    assert not np.shares_memory(failed, image)
    assert (failed != image).any()
    np.testing.assert_array_equal(failed, corrupt(kind, sensor, severity, image))
    if sensor == "vector":
        assert np.isfinite(failed).all() and (failed >= LOW).all() and (failed <= HIGH).all()


@pytest.mark.parametrize("kind, sensor", [(kind, sensor) for kind, sensor in PAIRS if kind != "lag"])
def test_severity_grows(kind: str, sensor: str) -> None:
    image = example(sensor).astype(float)
    distances = [
        np.mean([np.abs(corrupt(kind, sensor, severity, seed=seed) - image).mean() for seed in range(8)])
        for severity in (1, 2, 3)
    ]
    assert 0 < 1.05 * distances[0] < distances[1] < 0.95 * distances[2]


@pytest.mark.parametrize("kind", failures_for("event"))
def test_no_events_are_made_where_there_is_no_data(kind: str) -> None:
    image = np.zeros((SIZE, SIZE, 5), np.uint8)
    if kind in ("noise", "event_storm", "salt_and_pepper", "misalignment"):
        assert (corrupt(kind, "event", 3, image) == 0).all()
    image[...] = 128
    assert corrupt(kind, "event", 3, image).min() > 0 or kind in ("frozen", "lag")


@pytest.mark.parametrize("severity", [1, 2, 3])
def test_depth_returns_come_and_go_only_where_the_failure_says_so(severity: int) -> None:
    image = example("depth")
    image[20] = 1
    image[21] = 255
    there = image > 0
    for kind in ("noise", "salt_and_pepper"):
        np.testing.assert_array_equal(corrupt(kind, "depth", severity, image) > 0, there)
    for kind in ("black", "depth_dropout"):
        failed = corrupt(kind, "depth", severity, image)
        np.testing.assert_array_equal(failed[failed > 0], image[failed > 0])
        assert (failed > 0).sum() < there.sum()


def test_dead_banks_lose_or_hold_the_last_columns() -> None:
    for sensor, blank in (("rgb", 0), ("event", 128), ("depth", 0)):
        image = np.full((30, 48, 5), 77, np.uint8)
        for severity, kept in ((1, 32), (2, 16), (3, 0)):
            failed = corrupt("black", sensor, severity, image)
            assert (failed[:, :kept] == 77).all() and (failed[:, kept:] == blank).all()
            past = np.full_like(image, 5)
            held = f.hold(image, np.random.default_rng(0), past, **FAILURES["frozen"][sensor].at(severity))
            assert (held[:, :kept] == 77).all() and (held[:, kept:] == 5).all()
    vector, past = example("vector"), example("vector", 4)
    for severity, kept in ((1, 11), (2, 5), (3, 0)):
        lost, held = corrupt("black", "vector", severity), corrupt("frozen", "vector", severity)
        np.testing.assert_array_equal(lost[:kept], vector[:kept])
        np.testing.assert_array_equal(lost[kept:], np.clip(np.zeros(16), LOW, HIGH)[kept:])  # of 5..9, 5 is nearest 0
        np.testing.assert_array_equal(held, np.r_[vector[:kept], past[kept:]])


def test_noise_of_colour_and_depth_has_its_sigma() -> None:
    for sensor in ("rgb", "depth"):
        image = np.full((200, 200, 1), 128, np.uint8)
        for severity, sigma in enumerate(FAILURES["noise"][sensor].parameters["sigma"], 1):  # type: ignore[arg-type]
            error = corrupt("noise", sensor, severity, image).astype(float) - 128
            assert error.std() == pytest.approx(sigma, rel=0.05)
            assert abs(error.mean()) < 4 * sigma / 200


def test_spurious_events_have_their_rate_and_either_sign() -> None:
    image = np.full((200, 200, 5), 128, np.uint8)
    for severity, rate in enumerate((0.05, 0.2, 0.8), 1):
        counts = decode_events(corrupt("noise", "event", severity, image))
        # A difference of two Poisson counts with rate / 2 each
        assert counts.var() == pytest.approx(rate, rel=0.05)
        assert abs(counts.mean()) < 4 * np.sqrt(rate / counts.size)


def test_a_storm_alternates_from_bin_to_bin_and_is_everywhere() -> None:
    image = np.full((100, 100, 5), 128, np.uint8)
    starts = set()
    for seed in range(20):
        bins = decode_events(corrupt("event_storm", "event", 2, image, seed)).mean(axis=(0, 1))
        np.testing.assert_allclose(np.abs(bins), 4, rtol=0.05)
        assert (np.sign(bins[1:]) == -np.sign(bins[:-1])).all()
        starts.add(np.sign(bins[0]))
    assert starts == {-1, 1}
    assert (decode_events(corrupt("event_storm", "event", 3, image)) != 0).mean() > 0.99
    flood = f.storm(image, np.random.default_rng(0), 500.0)
    assert set(np.unique(flood)) == {1, 255}  # full scale, and never "no data"


def test_unsigned_spurious_events_have_their_rate_too() -> None:
    image = np.full((200, 200, 5), 128, np.uint8)
    for kind, rates in (("noise", (0.05, 0.2, 0.8)), ("event_storm", (1.0, 4.0, 16.0))):
        failure = FAILURES[kind]["event"]
        for severity, rate in enumerate(rates, 1):
            parameters = failure.at(severity, signed=False)
            counts = decode_events(failure.function(image, np.random.default_rng(severity), **parameters))
            assert counts.min() >= 0
            np.testing.assert_allclose(counts.mean(axis=(0, 1)), rate, rtol=0.1)
            assert counts.var() == pytest.approx(rate, rel=0.05)  # Poisson


def test_salt_and_pepper_hit_their_share_of_pixels_in_all_channels() -> None:
    image = np.full((200, 200, 3), 100, np.uint8)
    for severity, share in enumerate((0.03, 0.1, 0.3), 1):
        failed = corrupt("salt_and_pepper", "rgb", severity, image)
        assert (failed == failed[..., :1]).all()
        for value in (0, 255):
            assert (failed == value).mean() == pytest.approx(share / 2, rel=0.1)
        assert set(np.unique(failed)) == {0, 100, 255}
    assert set(np.unique(corrupt("salt_and_pepper", "depth", 3, image))) == {1, 100, 255}


def test_exposure_is_a_power_of_two_of_light() -> None:
    image = np.array([[[0, 10, 100], [200, 255, 1]]], np.uint8)
    for kind in ("overexposure", "underexposure"):
        for severity, stops in enumerate(FAILURES[kind]["rgb"].parameters["stops"], 1):  # type: ignore[arg-type]
            light = (image / 255.0) ** 2.2 * 2.0**stops
            expected = np.clip(255 * light ** (1 / 2.2), 0, 255)
            np.testing.assert_allclose(corrupt(kind, "rgb", severity, image), expected, atol=0.51)


def test_blur_is_a_straight_smear_of_its_length_and_keeps_the_light() -> None:
    point = np.zeros((101, 101, 3), np.uint8)
    point[50, 50] = 255
    turned = []
    for seed in range(10):
        for length, pixels in ((0.05, 5), (0.1, 10), (0.2, 20)):
            smear = f.blur(point, np.random.default_rng(seed), length).astype(float)[..., 0]
            assert smear.sum() == pytest.approx(255, rel=0.1)  # rounding of 8-bit numbers
            y, x = np.nonzero(smear)
            assert np.average(y, weights=smear[y, x]) == pytest.approx(50, abs=0.5)
            assert np.average(x, weights=smear[y, x]) == pytest.approx(50, abs=0.5)
            spread = np.linalg.svd(np.stack((y - 50.0, x - 50.0)), compute_uv=False) / np.sqrt(len(x))
            assert spread[0] == pytest.approx(pixels / np.sqrt(12), rel=0.2)  # a uniform line
            assert spread[1] < 0.6  # and thin
        turned.append(abs(x[-1] - x[0]) > abs(y[-1] - y[0]))
    assert 0 < sum(turned) < 10
    flat = np.full((20, 30, 3), 90, np.uint8)
    np.testing.assert_array_equal(f.blur(flat, np.random.default_rng(0), 0.2), flat)


@pytest.mark.parametrize("sensor, dark, bright", [("rgb", 0, 255), ("event", 128, 148), ("depth", 0, 1)])
def test_dead_pixels_are_the_same_for_the_same_generator(sensor: str, dark: int, bright: int) -> None:
    dead: list[Array] = []
    for severity, share in enumerate((0.01, 0.05, 0.2), 1):
        for value in (50, 60):
            failed = corrupt("dead_pixels", sensor, severity, np.full((100, 100, 3), value, np.uint8))
            assert (failed == dark).all(axis=-1).sum() == (failed == bright).all(axis=-1).sum() == 10000 * share / 2
            assert (failed == value).all(axis=-1).sum() == 10000 * (1 - share)
            dead.append((failed != value).any(axis=-1))
    for one, two, same in ((0, 1, True), (2, 3, True), (0, 2, False), (2, 4, False)):
        assert dead[two][dead[one]].all() and (dead[one] == dead[two]).all() == same
    other = corrupt("dead_pixels", sensor, 1, np.full((100, 100, 3), 50, np.uint8), seed=1)
    assert ((other != 50).any(axis=-1) != dead[0]).any()


def test_misalignment_moves_the_image_and_repeats_the_edge() -> None:
    y, x = np.mgrid[:50, :100]
    image = np.stack((y, x), axis=-1).astype(np.uint8)
    directions = set()
    for seed in range(20):
        moved = corrupt("misalignment", "rgb", 3, image, seed).astype(int)
        dy, dx = moved[25, 50] - (25, 50)
        assert np.hypot(dy, dx) == pytest.approx(12, abs=1)
        np.testing.assert_array_equal(moved[..., 0], np.clip(y + dy, 0, 49))
        np.testing.assert_array_equal(moved[..., 1], np.clip(x + dx, 0, 99))
        directions.add((np.sign(dy), np.sign(dx)))
    assert len(directions) > 3
    for seed in range(20):  # never less than a pixel
        assert (f.shift(image, np.random.default_rng(seed), 1e-9) != image).any()


def test_depth_drops_out_in_patches() -> None:
    image = np.full((160, 160, 1), 200, np.uint8)
    for severity, share in enumerate((0.1, 0.3, 0.6), 1):
        lost = np.mean([corrupt("depth_dropout", "depth", severity, image, seed) == 0 for seed in range(40)])
        assert lost == pytest.approx(share, rel=0.1)
    patches = corrupt("depth_dropout", "depth", 2, image).reshape(16, 10, 16, 10)
    assert (patches == patches[:, :1, :, :1]).all()
    odd = corrupt("depth_dropout", "depth", 3, np.full((33, 57, 1), 9, np.uint8))  # no multiple of the patch
    assert odd.shape == (33, 57, 1) and 0 < (odd == 0).sum() < odd.size


def test_vectors_fail_in_units_of_their_range() -> None:
    low = np.array([-10.0, -np.inf, 3.0] * 2000)
    high = np.array([10.0, np.inf, 3.5] * 2000)
    middle = np.array([0.0, 7.0, 3.25] * 2000)
    noise = (f.vector_noise(middle, np.random.default_rng(0), low, high, 0.05) - middle).reshape(-1, 3)
    np.testing.assert_allclose(noise.std(axis=0), [1.0, 0.05, 0.025], rtol=0.06)

    rng = np.random.default_rng(0)
    stuck = f.stick_entries(middle, rng, low, high, 1.0).reshape(-1, 3)
    assert stuck[:, 0].min() < -9 and stuck[:, 0].max() > 9
    assert stuck[:, 2].min() >= 3 and stuck[:, 2].max() <= 3.5
    assert np.abs(stuck[:, 1]).max() <= 0.5
    for severity, count in ((1, 2), (2, 4), (3, 8)):
        assert (corrupt("dead_pixels", "vector", severity) != example("vector")).sum() == count
    huge = np.finfo(np.float32).max  # "no bound" of older environments
    for least, most in ((-huge, huge), (-huge, 1.0), (-1.0, huge), (3.0, np.inf), (-np.inf, -3.0)):
        start = np.full(2000, np.clip(0, least, most), np.float32)
        bounds = np.full(2000, least, np.float32), np.full(2000, most, np.float32)
        assert 0.2 < np.abs(f.vector_noise(start, rng, *bounds, 0.1) - start).max() < 0.6
        entries = f.stick_entries(start, rng, *bounds, 1.0)
        assert entries.min() >= least and entries.max() <= most and np.abs(entries - start).max() <= 0.5


def test_the_table_is_complete() -> None:
    for kind, sensors in FAILURES.items():
        assert sensors and set(sensors) <= set(SENSORS)
        for failure in sensors.values():
            triples = [value for value in failure.parameters.values() if isinstance(value, tuple)]
            assert len(triples) == 1 and len(set(triples[0])) == 3, kind
            assert [failure.at(severity).keys() == failure.parameters.keys() for severity in (1, 2, 3)] == [True] * 3
            assert failure.unsigned.keys() <= {*failure.parameters, "signed"}
    assert "event_storm" in failures_for("event") and "event_storm" not in failures_for("rgb")
    assert "motion_blur" not in failures_for("event") and "depth_dropout" in failures_for("depth")
    assert failures_for("vector") == ("black", "frozen", "noise", "lag", "dead_pixels")
    with pytest.raises(ValueError, match=r"lidar"):
        failures_for("lidar")
