"""The camera against pinhole geometry and against a ray caster."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.envs.camera import FAR, SUPERSAMPLING, Camera, Objects
from sb3_have.envs.road_shape import RoadShape
from sb3_have.envs.scene import ASPHALT, DASH_LENGTH, DASH_PERIOD, LINE_WIDTH, PAINTS, VEHICLE_HEIGHT, WORLD_PERIOD
from sb3_have.envs.weather import LUMA

Array = NDArray[Any]
SIZE = 128
FOCAL = SIZE / 2 / np.tan(np.radians(30))


def road_camera(size: int = SIZE) -> Camera:
    return Camera(size, RoadShape(lanes_count=4))


def poses(*vehicles: tuple[float, float, float]) -> Array:
    return np.array([vehicles])


def sizes(count: int) -> Array:
    return np.tile((5.0, 2.0), (count, 1))


def look(camera: Camera, at: Array) -> tuple[Array, Array]:
    """Depth and vehicle number of every pixel, from one instant."""
    objects = camera.objects(at, sizes(at.shape[1]))
    return camera.depth(objects), vehicle_mask(camera, objects)


def vehicle_mask(camera: Camera, objects: Objects) -> Array:
    mask = np.full(camera.size**2, -1)
    far_to_near = np.argsort(-objects.depth)
    mask[objects.pixel[far_to_near]] = objects.vehicle[objects.face[far_to_near]]
    return mask.reshape(camera.size, camera.size)


@pytest.mark.parametrize("distance", [10.0, 26.5, 60.0])
def test_car_dead_ahead(distance: float) -> None:
    # The camera stands 1 m ahead of the ego's centre, the rear of a car 2.5 m behind its own.
    depth, vehicle = look(road_camera(), poses((100, 4, 0), (100 + 1 + distance + 2.5, 4, 0)))
    rows, columns = np.nonzero(vehicle == 0)
    np.testing.assert_allclose(depth[rows, columns], distance, rtol=1e-5)
    assert np.ptp(columns) + 1 == pytest.approx(FOCAL * 2 / distance, abs=1.5)
    assert columns.mean() + 0.5 == pytest.approx(SIZE / 2, abs=0.5)
    assert rows.min() == SIZE // 2  # as high as the camera: its roof lies on the horizon
    assert rows.max() + 1 == pytest.approx(SIZE / 2 + FOCAL * 1.5 / distance, abs=1)


@pytest.mark.parametrize("lateral", [-4.0, 4.0])
def test_right_is_to_the_right(lateral: float) -> None:
    _, vehicle = look(road_camera(), poses((0, 6, 0), (43.5, 6 + lateral, 0)))
    columns = np.nonzero(vehicle == 0)[1]
    assert columns.mean() + 0.5 == pytest.approx(SIZE / 2 + FOCAL * lateral / 40, abs=2)
    assert np.sign(columns.mean() - SIZE / 2) == np.sign(lateral)


def test_turning_right_moves_the_scene_to_the_left() -> None:
    heading = 0.1
    depth, vehicle = look(road_camera(), poses((0, 6, heading), (43.5, 6, 0)))
    columns = np.nonzero(vehicle == 0)[1]
    assert columns.mean() + 0.5 == pytest.approx(SIZE / 2 - FOCAL * np.tan(heading), abs=3)
    # The middle of its rear in the turned camera.
    forward = np.cos(heading) * (41 - np.cos(heading)) - np.sin(heading) ** 2
    middle = np.round(SIZE / 2 - FOCAL * np.tan(heading)).astype(int)
    assert depth[SIZE // 2 + 1, middle] == pytest.approx(forward, rel=5e-3)


@pytest.mark.parametrize("size", [63, 64])
def test_ground_depth(size: int) -> None:
    camera = road_camera(size)
    depth, vehicle = look(camera, poses((0, 6, 0)))
    focal = size / 2 / np.tan(np.radians(30))
    rows = np.arange(size * 5 // 8, size)
    np.testing.assert_allclose(depth[rows, size // 2], focal * 1.5 / (rows + 0.5 - size / 2), rtol=1e-5)
    assert np.isinf(depth[: size // 2, size // 2]).all() and (vehicle == -1).all()
    assert not np.isnan(depth).any() and (depth > 0).all()


def test_nearer_hides_farther_and_behind_is_not_seen() -> None:
    at = poses((0, 4, 0), (60, 4, 0), (20, 4, 0), (-20, 4, 0), (3000, 4, 0))
    _, vehicle = look(road_camera(), at)
    assert set(np.unique(vehicle)) == {-1, 1}


def test_car_alongside_is_clipped_at_the_image_plane() -> None:
    for x in np.linspace(-3, 8, 12):
        depth, vehicle = look(road_camera(), poses((0, 4, 0.02), (x, 7.0, -0.02), (x + 3, 1.0, 0.0)))
        assert np.isfinite(depth[vehicle >= 0]).all() and (depth > 0).all()
        assert (np.nonzero(vehicle == 0)[1] > SIZE / 2).all() and (np.nonzero(vehicle == 1)[1] < SIZE / 2).all()


def cast(at: Array, size: int) -> Array:
    """Depth of the nearest vehicle in the centre of each pixel, by cutting rays with boxes; infinite for none."""
    x, y, heading = at[0]
    origin = np.array([x + np.cos(heading), y + np.sin(heading), 1.5])
    slope = (np.arange(size) + 0.5 - size / 2) * (2 * np.tan(np.radians(30)) / size)
    right, down = np.meshgrid(slope, slope)
    direction = np.stack(
        (np.cos(heading) - right * np.sin(heading), np.sin(heading) + right * np.cos(heading), -down), axis=-1
    )
    nearest = np.full((size, size), np.inf)
    for cx, cy, turn in at[1:]:
        turned = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        start, ray = turned @ (origin - (cx, cy, 0)), direction @ turned.T
        low, high = np.array([-2.5, -1.0, 0.0]), np.array([2.5, 1.0, VEHICLE_HEIGHT])
        with np.errstate(divide="ignore"):
            first, second = (low - start) / ray, (high - start) / ray
        enter, leave = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
        hit = (enter < leave) & (enter > 0)
        nearest = np.where(hit, np.minimum(nearest, enter), nearest)
    return nearest


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_a_ray_caster(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 12
    at = np.zeros((1, 1 + count, 3))
    at[0, 0] = 200.0, 6.0, rng.uniform(-0.1, 0.1)
    at[0, 1:] = np.stack(
        (212 + 8 * rng.permutation(count), 4.0 * rng.integers(4, size=count), rng.normal(0, 0.05, count)), axis=-1
    )
    depth, vehicle = look(road_camera(), at)
    fine = cast(at[0], SUPERSAMPLING * SIZE)
    expected = fine.reshape(SIZE, SUPERSAMPLING, SIZE, SUPERSAMPLING).min(axis=(1, 3))
    seen = np.isfinite(expected)
    both = seen & (vehicle >= 0)
    assert both.sum() > 300
    # A sample on an outline may fall on either side of it.
    assert both.sum() / (seen | (vehicle >= 0)).sum() > 0.98
    assert (np.abs(depth[both] / expected[both] - 1) < 0.01).mean() > 0.99


def test_instants_in_one_pass_equal_one_at_a_time() -> None:
    # The last car drives out of view; with the ego the tree and the joint of the rail that come next change.
    at = np.repeat(poses((35, 4, 0.01), (60, 4, 0), (75, 8, 0), (100, 0, 0), (36 + FAR, 12, 0)), 3, axis=0)
    at[:, 0, 0] = 35, 38, 41
    at[:, 4, 0] += 0, 7, 14
    camera = road_camera(64)
    together, ground = camera.objects(at, sizes(5)), camera.ground(at)
    for k in range(3):
        alone, last = camera.objects(at[k : k + 1], sizes(5)), camera.objects(at[: k + 1], sizes(5)).last(k + 1, 64**2)
        here = together.pixel // 64**2 == k
        for pixel, part in ((last.pixel, last), (together.pixel[here] - k * 64**2, together)):
            rows = here if part is together else slice(None)
            np.testing.assert_array_equal(alone.pixel, pixel)
            np.testing.assert_array_equal(alone.depth, part.depth[rows])
            np.testing.assert_array_equal(alone.material, part.material[rows])
            np.testing.assert_array_equal(alone.vehicle[alone.face], part.vehicle[part.face[rows]])
        for name in ("road", "marking", "verge"):
            np.testing.assert_array_equal(getattr(ground, name)[k], getattr(camera.ground(at[k : k + 1]), name)[0])


def test_markings_lie_where_the_lanes_end() -> None:
    camera = road_camera()
    ground = camera.ground(poses((0, 12, 0)))  # the right-most lane: its solid edge lies 2 m to the right
    row = 12
    forward, pixel = float(camera.ground_forward[row, 0]), float(camera.ground_forward[row, 0]) / FOCAL
    marking = ground.marking[0, row]
    across = camera.ground_right[row]
    edge = np.abs(across - 2) < 1
    assert forward == pytest.approx(1.5 * FOCAL / 12.5)
    assert marking[edge].sum() * pixel == pytest.approx(LINE_WIDTH, rel=1e-3)
    assert (marking * across)[edge].sum() / marking[edge].sum() == pytest.approx(2, abs=0.02)
    assert marking[np.abs(across) < 1].max() == 0  # nothing in the middle of the lane


def test_lane_lines_are_dashed() -> None:
    camera = road_camera()
    share = []
    for x in np.arange(0, DASH_PERIOD, 0.5):
        marking = camera.ground(poses((x, 12, 0))).marking[0, 12]
        line = np.abs(camera.ground_right[12] + 2) < 1
        share.append(marking[line].sum() * camera.ground_forward[12, 0] / FOCAL / LINE_WIDTH)
    assert np.mean(share) == pytest.approx(DASH_LENGTH / DASH_PERIOD, rel=0.02)
    assert min(share) == pytest.approx(0, abs=1e-3) and max(share) == pytest.approx(1, rel=1e-2)


def test_looks_the_same_far_down_the_road() -> None:
    camera = road_camera(64)
    here, there = camera.ground(poses((3.0, 4, 0))), camera.ground(poses((3.0 + WORLD_PERIOD * 12, 4, 0)))
    np.testing.assert_allclose(here.marking, there.marking, atol=1e-4)
    at = poses((3.0, 4, 0), (30, 4, 0))
    far = at + np.array((WORLD_PERIOD * 12, 0, 0))
    np.testing.assert_allclose(look(camera, at)[0], look(camera, far)[0], rtol=1e-5)


@pytest.mark.parametrize("period", range(4))
def test_the_verge_does_not_jump(period: int) -> None:
    # A centimetre across each place where the old position could be taken modulo a period, the picture stays.
    camera = road_camera(64)
    for border in (240.0 * (period + 1), WORLD_PERIOD * (period + 1)):
        before, after = (camera.ground(poses((border - 1 + side, 4, 0))).verge for side in (-0.005, 0.005))
        assert (before == after).mean() > 0.9
        assert before[:, -16:].std() > 0.1


def test_the_verge_has_no_double_patch_at_zero() -> None:
    camera = road_camera(65)
    # The number of the patch across the road.
    camera.ground_view.patchwork = np.tile(np.arange(64, dtype=np.float32), (64, 1))
    # The middle column looks along the road: it sees the ground at the ego's own y.
    patches = [camera.ground(poses((0, y, 0))).verge[0, -1, 32] for y in (-1.5, -0.5, 0.5, 1.5)]
    np.testing.assert_array_equal(patches, [62, 63, 0, 1])


def test_every_paint_stands_out_from_the_road_by_its_brightness() -> None:
    # A vertical face gets about half the light of the road; an event camera needs a contrast of its threshold, 0.2.
    contrast = np.log(0.55 * (PAINTS @ LUMA) / (ASPHALT @ LUMA))
    assert np.abs(contrast).min() > 0.25


def test_the_last_instant_begins_with_its_first_pixel() -> None:
    pixel, one = np.array([3, 0, 4, 5]), np.ones(4, int)
    objects = Objects(pixel, 1.0 * pixel, one, 0 * one, np.zeros((1, 2)), np.zeros(1, int))
    last = objects.last(2, 4)
    np.testing.assert_array_equal(np.sort(last.pixel), [0, 1])
    np.testing.assert_array_equal(last.depth, last.pixel + 4)
