"""The pictures of scenarios "merge" and "curves": markings, pavement and cars are drawn where the lanes are."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from highway_env.road.lane import AbstractLane
from numpy.typing import NDArray

from sb3_have.envs.camera import Camera
from sb3_have.envs.lanes import FORWARD, ONCOMING, ShapedNetwork
from sb3_have.envs.road import ROAD_LENGTH
from sb3_have.envs.road_shape import PERIOD, RAMP_ENDS, RAMP_JOINS, RAMP_TAPERS, SCENARIOS, SHOULDER_WIDTH, road_shape
from sb3_have.envs.rule_driven import RuleDrivenEnv
from sb3_have.envs.scene import DASH_LENGTH, LINE_WIDTH, RAIL_PIECE, RAMP_DASH_PERIOD, STEEL, WORLD_PERIOD
from sb3_have.envs.vision import VisionSensors

Array = NDArray[Any]
SIZE = 256
FOCAL = SIZE / 2 / np.tan(np.radians(30))
RAMP_START = 4 * PERIOD
NEW = ("merge", "curves")


def road(scenario: str) -> tuple[Camera, ShapedNetwork]:
    shape = road_shape(scenario, 4)
    return Camera(SIZE, shape), ShapedNetwork(shape)


def on_lane(lane: AbstractLane, x: float, lateral: float = 0.0) -> tuple[float, float, float]:
    """Pose of a car that follows the lane at x."""
    along = x if lane.sign > 0 else ROAD_LENGTH - x
    return (*lane.position(along, lateral).tolist(), lane.heading_at(along))


def in_image(pose: tuple[float, float, float], points: Array) -> tuple[Array, Array]:
    """Distance ahead and image column of points (n, 2) on the ground, for a camera 1 m ahead of the ego."""
    x, y, heading = pose
    ahead = np.array([np.cos(heading), np.sin(heading)])
    offset = points - (np.array([x, y]) + ahead)
    forward, right = offset @ ahead, offset @ np.array([-ahead[1], ahead[0]])
    return forward, SIZE / 2 + FOCAL * right / np.maximum(forward, 1e-9)


def column_of_line(pose: tuple[float, float, float], lane: AbstractLane, lateral: float, distance: float) -> float:
    """Image column at which a line along a lane crosses the ground at this distance ahead."""
    s = np.arange(-5.0, 120.0, 0.02) + pose[0]
    points = np.array([lane.position(u if lane.sign > 0 else ROAD_LENGTH - u, lateral) for u in s])
    forward, column = in_image(pose, points)
    return float(np.interp(distance, forward, column))


def paint_near(row: Array, column: float, reach: float) -> tuple[float, float]:
    """Sum of a row's paint within so many pixels of a column, and its centroid."""
    u = np.arange(SIZE) + 0.5
    near = np.abs(u - column) < reach
    total = float(row[near].sum())
    return total, float((row * u)[near].sum() / max(total, 1e-9))


@pytest.mark.parametrize("x", [1000.0, 1111.0, 1205.0, 1330.0, 1421.0])
def test_lines_of_the_curves_lie_on_the_borders_of_the_lanes(x: float) -> None:
    camera, network = road("curves")
    ego = on_lane(network.get_lane((*FORWARD, 0)), x)
    ground = camera.ground(np.array([[ego]]))
    checked = 0
    # The right edge, the double line in the middle and the left edge, which is the right edge of oncoming traffic
    for index, lateral, lines in [((*FORWARD, 1), 2.0, 1), ((*FORWARD, 0), -2.0, 2), ((*ONCOMING, 1), 2.0, 1)]:
        lane = network.get_lane(index)
        for row in range(4, len(camera.ground_forward), 4):
            distance = float(camera.ground_forward[row, 0])
            column = column_of_line(ego, lane, lateral, distance)
            reach = 0.9 * FOCAL / distance + 3
            if not reach < column < SIZE - reach:
                continue
            total, centroid = paint_near(ground.marking[0, row], column, reach)
            assert centroid == pytest.approx(column, abs=0.25)
            if distance < 25:
                # Along a row the paint is as wide as the line, over the cosine of the angle between line and view.
                next_column = column_of_line(ego, lane, lateral, distance * 1.05)
                slant = ((next_column - SIZE / 2) * 1.05 - (column - SIZE / 2)) / 0.05 / FOCAL
                expected = lines * LINE_WIDTH * np.hypot(1, slant) * FOCAL / distance
                assert total == pytest.approx(expected, rel=0.05)
            checked += 1
    assert checked > 22


@pytest.mark.parametrize("x", [0.0, 111.0, 250.0])
def test_lines_between_lanes_are_dashed_in_curves(x: float) -> None:
    camera, network = road("curves")
    lane = network.get_lane((*FORWARD, 0))
    shares = []
    for step in np.arange(0, 12, 0.5):
        ego = on_lane(lane, WORLD_PERIOD + x + step)
        row = 40
        distance = float(camera.ground_forward[row, 0])
        column = column_of_line(ego, lane, 2.0, distance)
        total, _ = paint_near(camera.ground(np.array([[ego]])).marking[0, row], column, 1.0 * FOCAL / distance)
        shares.append(total * distance / FOCAL / LINE_WIDTH)
    assert np.mean(shares) == pytest.approx(DASH_LENGTH / 12, rel=0.1)
    assert min(shares) < 0.01 and max(shares) > 0.95


@pytest.mark.parametrize("u", [150.0, 200.0, 225.0, 300.0, 395.0])
def test_lines_of_a_ramp_lie_on_its_borders(u: float) -> None:
    camera, network = road("merge")
    ego = on_lane(network.get_lane((*FORWARD, 3)), RAMP_START + u)
    ground = camera.ground(np.array([[ego]]))
    ramp = network.get_lane((*FORWARD, 4))
    checked = 0
    for row in range(6, len(camera.ground_forward), 3):
        distance = float(camera.ground_forward[row, 0])
        reach = 0.5 * FOCAL / distance + 3
        for lateral in (-2.0, 2.0):
            column = column_of_line(ego, ramp, lateral, distance)
            # Where it is, along the road, and whether it is alone there.
            at = u + 1 + distance
            apart = at < 190 if lateral < 0 else at < RAMP_TAPERS - 1
            if not apart or not reach < column < SIZE - reach:
                continue
            total, centroid = paint_near(ground.marking[0, row], column, reach)
            assert centroid == pytest.approx(column, abs=0.3) and total > 0.5 * LINE_WIDTH * FOCAL / distance
            checked += 1
    assert checked > (3 if u < 380 else 1)


def test_the_edge_line_opens_beside_the_acceleration_lane_and_closes_behind_it() -> None:
    camera, network = road("merge")
    lane = network.get_lane((*FORWARD, 3))

    def paint(u: float) -> float:
        """Paint on the road's right edge, averaged over a period of its dashes, as a share of a solid line."""
        shares = []
        for step in np.arange(0, RAMP_DASH_PERIOD, 0.5):
            ego = on_lane(lane, RAMP_START + u + step)
            row = 50
            distance = float(camera.ground_forward[row, 0])
            column = column_of_line(ego, lane, 2.0, distance)
            total, _ = paint_near(camera.ground(np.array([[ego]])).marking[0, row], column, 0.6 * FOCAL / distance)
            shares.append(total * distance / FOCAL / LINE_WIDTH)
        return float(np.mean(shares))

    assert paint(150.0) == pytest.approx(1, rel=0.05) and paint(465.0) == pytest.approx(1, rel=0.05)
    assert paint(300.0) == pytest.approx(DASH_LENGTH / RAMP_DASH_PERIOD, rel=0.05)


@pytest.mark.parametrize("place", [0.0, RAMP_JOINS, RAMP_ENDS])
def test_nothing_of_a_ramp_begins_or_ends_within_a_pixel(place: float) -> None:
    camera, _ = road("merge")
    halves = 0
    for row in range(1, 10):
        distance, length = float(camera.ground_forward[row, 0]), float(camera.ground_view.long[row, 0])
        at = [
            camera.ground(np.array([[(RAMP_START + place - 1 - distance + share * length, 12.0, 0.0)]]))
            for share in (-0.51, -0.001, 0.0, 0.001, 0.51)
        ]
        for name in ("road", "marking"):
            before, *middle, after = (getattr(ground, name)[0, row] for ground in at)
            # 1 / 1000 of its length brings hardly any change.
            assert np.abs(np.diff(middle, axis=0)).max() < 0.04, (row, name)
            right = before < 0.01  # where there is no ramp yet
            if place == 0 and name == "road" and after[right].max() > 0.99:
                assert middle[1][right].max() == pytest.approx(0.5, abs=0.02)
                halves += 1
    assert halves > 0 or place > 0


def test_footprints_that_reach_back_into_the_period_before() -> None:
    camera, _ = road("merge")
    distance, length = float(camera.ground_forward[0, 0]), float(camera.ground_view.long[0, 0])
    assert length > 100  # so the first row sees the end of one ramp and the beginning of the next
    at = [
        camera.ground(np.array([[(RAMP_START - 1 - distance + offset, 12.0, 0.0)]])).marking[0, 0]
        for offset in (-0.1, 0.1)
    ]
    assert np.abs(at[1] - at[0]).max() < 1e-3


@pytest.mark.parametrize("scenario", NEW)
def test_what_is_road_for_cars_is_pavement_and_little_else(scenario: str) -> None:
    """Every near pixel of the ground against the lanes: on a lane there is road, beyond the shoulder there is none."""
    camera, network = road(scenario)
    lanes = [lane for ends in network.graph.values() for part in ends.values() for lane in part]
    right = camera.ground_right / camera.ground_forward
    inside = outside = 0
    for x in np.arange(4 * PERIOD + 5, 5 * PERIOD, 38.0):
        ego = on_lane(lanes[3] if scenario == "merge" else lanes[1], x)
        ground = camera.ground(np.array([[ego]]))
        ahead = np.array([np.cos(ego[2]), np.sin(ego[2])])
        aside = np.array([-ahead[1], ahead[0]])
        for row in range(20, len(camera.ground_forward), 12):
            distance = float(camera.ground_forward[row, 0])
            for column in range(0, SIZE, 7):
                slope = float(right[row, column])
                point = np.array(ego[:2]) + ahead * (1 + distance) + aside * distance * slope
                if any(lane.on_lane(point, margin=-0.3) for lane in lanes):
                    assert ground.road[0, row, column] > 0.99
                    inside += 1
                elif not any(lane.on_lane(point, margin=SHOULDER_WIDTH + 0.5) for lane in lanes):
                    assert ground.road[0, row, column] < 0.01
                    outside += 1
    assert inside > 1000 and outside > 50


@pytest.mark.parametrize("scenario", NEW)
def test_ground_depth_knows_no_bends(scenario: str) -> None:
    camera, network = road(scenario)
    ego = on_lane(network.get_lane((*FORWARD, 0)), 1130.0)
    depth = camera.depth(camera.objects(np.array([[ego]]), np.array([[5.0, 2.0]])))
    rows = np.arange(SIZE * 5 // 8, SIZE)
    np.testing.assert_allclose(depth[rows, SIZE // 2], FOCAL * 1.5 / (rows + 0.5 - SIZE / 2), rtol=1e-5)


@pytest.mark.parametrize("index", [(*FORWARD, 0), (*FORWARD, 1), (*ONCOMING, 0), (*ONCOMING, 1)])
@pytest.mark.parametrize("distance", [15.0, 40.0])
def test_cars_stand_between_the_lines_of_their_lane(index: Any, distance: float) -> None:
    camera, network = road("curves")
    lane = network.get_lane(index)
    for x in (1000.0, 1111.0, 1330.0):
        ego = on_lane(network.get_lane((*FORWARD, 0)), x)
        car = on_lane(lane, x + distance)
        objects = camera.objects(np.array([[ego, car]]), np.tile((5.0, 2.0), (2, 1)))
        hit = objects.pixel[objects.vehicle[objects.face] == 0]
        if not len(hit):
            assert distance == 15.0 and index == (*ONCOMING, 1)  # out of view to the left
            continue
        columns = hit % SIZE
        near = distance - 1 - 2.5
        borders = sorted(column_of_line(ego, lane, lateral, near) for lateral in (-2.0, 2.0))
        front = columns[objects.depth[objects.vehicle[objects.face] == 0] < near + 1.0]
        assert len(front) and borders[0] - 1 < front.min() and front.max() < borders[1] + 1


def test_a_car_far_to_the_side_is_seen() -> None:
    camera, _ = road("merge")
    poses = np.array([[(1000.0, 12.0, 0.0), (1061.0, 48.0, 0.0)]])
    objects = camera.objects(poses, np.tile((5.0, 2.0), (2, 1)))
    assert (objects.vehicle[objects.face] == 0).sum() > 20


def hidden_but_painted(camera: Camera, poses: Array, sizes: Array) -> tuple[int, int]:
    """Samples that show a face 0.3 m or more behind another one there, and samples that show any."""
    faces = camera._project(poses, sizes)
    painted = camera._paint(1, faces)[0]
    u0, per_pixel, inverse, change = faces.plane[:4, :, None]
    depth = 1 / (inverse + np.clip((camera._sample_u - u0) * per_pixel, 0, 1) * change)
    nearest = np.full(painted.shape, np.inf)
    for number in range(len(faces.instant)):
        parts = {f.name: getattr(faces, f.name)[number : number + 1] for f in fields(faces) if f.name != "plane"}
        alone = camera._paint(1, replace(faces, plane=faces.plane[:, number : number + 1], **parts))[0] != 0
        nearest = np.where(alone, np.minimum(nearest, depth[number]), nearest)
    row, column = np.nonzero(painted)
    behind = depth[painted[row, column] - 1, column] - nearest[row, column]
    return int((behind > 0.3).sum()), len(row)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_sample_shows_what_is_nearest(scenario: str) -> None:
    env = RuleDrivenEnv(scenario=scenario, modalities=("depth",), image_size=16, initial_speed=20.0)
    camera = Camera(128, env.shape)
    wrong = shown = 0
    env.reset(seed=0)
    sizes = np.array([(v.LENGTH, v.WIDTH) for v in env.road.vehicles])
    for step in range(100):
        env.step(np.zeros(2))
        if step % 8 == 0:
            here = hidden_but_painted(camera, env._snapshot()[None], sizes)
            wrong, shown = wrong + here[0], shown + here[1]
    assert shown > 10_000 and wrong < 2e-4 * shown


@pytest.mark.parametrize("lane, u, ahead", [(0, 75.0, 50.0), (2, 110.0, 25.0), (3, 60.0, 15.0), (3, 90.0, 40.0)])
def test_every_sample_shows_what_is_nearest_at_any_phase_of_the_rail(lane: int, u: float, ahead: float) -> None:
    camera, network = road("merge")
    sizes = np.tile((5.0, 2.0), (3, 1))
    for phase in np.arange(0, RAIL_PIECE, 2.0):
        ego = on_lane(network.get_lane((*FORWARD, lane)), RAMP_START + u + phase)
        cars = [on_lane(network.get_lane((*FORWARD, i)), ego[0] + ahead) for i in (4, 3)]
        wrong, shown = hidden_but_painted(camera, np.array([[ego, *cars]]), sizes)
        assert shown > 5_000 and wrong < 2e-4 * shown


@pytest.mark.parametrize("phase", np.arange(-4.0, RAIL_PIECE - 4, 3.0))
def test_a_rail_hides_the_ramp_behind_it_and_is_hidden_by_a_car_before_it(phase: float) -> None:
    camera, network = road("merge")
    ego = on_lane(network.get_lane((*FORWARD, 0)), RAMP_START + phase + 75.0)
    on_ramp = on_lane(network.get_lane((*FORWARD, 4)), RAMP_START + phase + 125.0)
    beside = on_lane(network.get_lane((*FORWARD, 3)), RAMP_START + phase + 105.0, 3.0)
    for car, hidden in [(on_ramp, True), (beside, False)]:
        objects = camera.objects(np.array([[ego, car]]), np.tile((5.0, 2.0), (2, 1)))
        row, column = np.divmod(objects.pixel, SIZE)
        seen = objects.vehicle[objects.face] == 0
        left, right = np.quantile(column[seen], (0.2, 0.8))
        bottom = SIZE / 2 + FOCAL * 1.5 / (car[0] - ego[0] - 1 + 2.5)
        inside = (left < column) & (column < right) & (row > row[seen].min()) & (row + 1 < bottom)
        assert seen.sum() > 100 and (objects.material[inside] == STEEL).any() == hidden


@pytest.mark.parametrize("scenario", NEW)
def test_trees_and_rails_stand_beside_the_road_all_along(scenario: str) -> None:
    camera, network = road(scenario)
    lanes = [lane for ends in network.graph.values() for part in ends.values() for lane in part]

    def on_road(point: Array, margin: float) -> bool:
        return any(lane.on_lane(point, margin=margin) for lane in lanes)

    for x in np.arange(4 * PERIOD + 3, 5 * PERIOD + 3, 60.0):
        trees, rails = camera.roadside.faces(np.array([x]), 200.0)
        for point in np.concatenate((trees.start[0], trees.end[0])):
            assert not on_road(point, SHOULDER_WIDTH + 0.4)
        for start, end in zip(rails.start[0], rails.end[0], strict=True):
            if (start == end).all():
                continue
            for point in (start, 0.5 * (start + end), end):
                # In a piece the rail is straight, and a little nearer to the road or farther from it.
                assert not on_road(point, SHOULDER_WIDTH + 0.2)
        # What shines in the sun is the side that faces the road.
        for start, end, normal in zip(rails.start[0], rails.end[0], rails.normal[0], strict=True):
            if (start != end).any():
                assert np.hypot(*normal) == pytest.approx(1) and (end - start) @ normal == pytest.approx(0, abs=1e-9)
                assert on_road(0.5 * (start + end) + 4 * normal, 0.5)
        # Both sides have their rail everywhere: the outer one lies just behind the shoulder.
        near = [point for point in rails.start[0] if on_road(point, SHOULDER_WIDTH + 1.0)]
        assert len(near) >= 20


def test_far_lines_that_run_across_the_view_are_blurred_by_the_length_of_a_pixel() -> None:
    camera, network = road("curves")
    row = 2  # 120 m ahead, where the road has turned by 9 degrees and a pixel is 43 m long
    assert 100 < camera.ground_forward[row, 0] < 140
    bent = camera.ground(np.array([[on_lane(network.get_lane((*FORWARD, 0)), 3 * PERIOD)]])).marking[0, row]
    straight = Camera(SIZE, road_shape("highway", 4)).ground(np.array([[(0.0, 8.0, 0.0)]])).marking[0, row]
    assert straight.max() > 0.3 and 0 < bent.max() < 0.08
    assert bent.sum() > 0.5


@pytest.mark.parametrize("scenario", NEW)
def test_instants_in_one_pass_equal_one_at_a_time(scenario: str) -> None:
    camera, network = road(scenario)
    lane = network.get_lane((*FORWARD, 1))
    cars = [(x, network.get_lane((*FORWARD, i))) for i, x in enumerate((1935.0, 1960.0))]
    at = np.array(
        [
            [on_lane(lane, 1910.0 + 4 * k), *(on_lane(other, x + 3 * k) for x, other in cars), (1990.0, 40.0, 0.3)]
            for k in range(3)
        ]
    )
    sizes = np.tile((5.0, 2.0), (4, 1))
    together, ground = camera.objects(at, sizes), camera.ground(at)
    for k in range(3):
        alone, one = camera.objects(at[k : k + 1], sizes), camera.ground(at[k : k + 1])
        here = together.pixel // SIZE**2 == k
        np.testing.assert_array_equal(alone.pixel, together.pixel[here] - k * SIZE**2)
        np.testing.assert_array_equal(alone.depth, together.depth[here])
        np.testing.assert_array_equal(alone.material, together.material[here])
        for name in ("road", "marking", "verge"):
            np.testing.assert_array_equal(getattr(ground, name)[k], getattr(one, name)[0])


@pytest.mark.parametrize("scenario", NEW)
def test_looks_the_same_far_down_the_road(scenario: str) -> None:
    camera, network = road(scenario)
    lane = network.get_lane((*FORWARD, 0))
    here, there = (np.array([[on_lane(lane, x)]]) for x in (1010.0, 1010.0 + 40 * WORLD_PERIOD))
    for name in ("road", "marking"):
        np.testing.assert_allclose(getattr(camera.ground(here), name), getattr(camera.ground(there), name), atol=2e-3)
    sizes = np.array([[5.0, 2.0]])
    depths = [camera.depth(camera.objects(at, sizes))[SIZE // 2 :] for at in (here, there)]
    assert (np.abs(depths[0] / depths[1] - 1) < 1e-4).mean() > 0.999


def test_oncoming_cars_have_lights_at_night() -> None:
    seen = []
    for index in ((*ONCOMING, 0), (*FORWARD, 0)):
        _, network = road("curves")
        sensors = VisionSensors(96, ("rgb",), shape=road_shape("curves", 4))
        poses = np.array([on_lane(network.get_lane((*FORWARD, 0)), 1440.0), on_lane(network.get_lane(index), 1475.0)])
        image = sensors.reset("ClearNight", poses, np.tile((5.0, 2.0), (2, 1)), np.random.default_rng(0))["rgb"]
        seen.append(image[sensors.last_truth["vehicle"] == 0].min(axis=-1))
        assert len(seen[-1]) >= 15
    assert seen[0].max() > 200 > 100 > seen[1].max()  # white lamps; red ones
    assert np.median(seen[0]) < 60  # on a dark car


@pytest.mark.parametrize("scenario", NEW)
def test_a_standing_scene_makes_no_events_and_a_drive_does(scenario: str) -> None:
    _, network = road(scenario)
    lane = network.get_lane((*FORWARD, 1))
    sensors, rng = VisionSensors(48, ("event",), shape=road_shape(scenario, 4)), np.random.default_rng(0)
    poses, sizes = np.array([on_lane(lane, 1300.0), on_lane(lane, 1330.0)]), np.tile((5.0, 2.0), (2, 1))
    sensors.reset("ClearNoon", poses, sizes, rng)
    assert (sensors.observe(np.stack([poses, poses]), 0.2, rng)["event"] == 128).all()
    moved = poses.copy()
    moved[0] = on_lane(lane, 1304.0)
    assert (sensors.observe(np.stack([poses, moved]), 0.2, rng)["event"] != 128).mean() > 0.02
