"""Poses and speeds on CARLA's real map, against roads whose lanes have closed forms."""

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fake_carla_road import HEADING, HEIGHT, LANE_WIDTH, LANES, START, opendrive, road

from sb3_have.envs.carla_vision.rules import EGO_RANGE, TRAFFIC_RANGE, draw_place

if TYPE_CHECKING:
    import carla
else:
    carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

from sb3_have.envs.carla_vision.episode import LIFT, MARGIN, lane_state, spawn_transform

LENGTH = 500.0
CURVATURE = {"straight": 0.0, "left": 0.004, "right": -0.006}


def centre(curvature: float, lane: int, s: float, aside: float = 0.0) -> tuple[float, float, float]:
    """x, y and heading of a point ``aside`` [m] to the right of the centre of a lane, in CARLA's axes."""
    heading = HEADING + curvature * s
    if curvature:
        x = START[0] + (math.sin(heading) - math.sin(HEADING)) / curvature
        y = START[1] - (math.cos(heading) - math.cos(HEADING)) / curvature
    else:
        x, y = START[0] + s * math.cos(HEADING), START[1] + s * math.sin(HEADING)
    left = math.copysign(abs(lane) - 0.5, lane) * LANE_WIDTH - aside
    x, y = x - left * math.sin(heading), y + left * math.cos(heading)
    return x, -y, -heading


def location(curvature: float, lane: int, s: float, aside: float = 0.0) -> "carla.Location":
    x, y, _ = centre(curvature, lane, s, aside)
    return carla.Location(x, y, HEIGHT)


@pytest.fixture(params=CURVATURE, scope="module")
def curvature(request: pytest.FixtureRequest) -> float:
    return CURVATURE[request.param]


@pytest.fixture(scope="module")
def road_map(curvature: float) -> "carla.Map":
    return carla.Map("test", opendrive(road(45, LENGTH, curvature=curvature, left=1)))


@pytest.mark.parametrize("lane", [-1, -4, 1])
@pytest.mark.parametrize("s", [100.0, 237.5, 300.0])
def test_spawn_transform(road_map: "carla.Map", curvature: float, lane: int, s: float) -> None:
    transform = spawn_transform(road_map, 45, lane, s)
    x, y, heading = centre(curvature, lane, s)
    found, forward = transform.location, transform.get_forward_vector()
    np.testing.assert_allclose((found.x, found.y, found.z), (x, y, HEIGHT + LIFT), atol=0.02)
    sign = 1.0 if lane < 0 else -1.0  # lanes on the left run against the road
    np.testing.assert_allclose((forward.x, forward.y), (sign * math.cos(heading), sign * math.sin(heading)), atol=1e-3)


def test_drawn_places_are_on_the_road(road_map: "carla.Map") -> None:
    rng = np.random.default_rng(0)
    for s_range in (EGO_RANGE, TRAFFIC_RANGE):
        for _ in range(50):
            lane, s = draw_place(rng, LANES, s_range)
            waypoint = road_map.get_waypoint(spawn_transform(road_map, 45, lane, s).location, project_to_road=False)
            assert waypoint is not None and (waypoint.road_id, waypoint.lane_id) == (45, lane)
            assert waypoint.s == pytest.approx(s, abs=0.5)  # the map cuts bends into straight pieces


@pytest.mark.parametrize(("road_id", "lane", "s"), [(45, -6, 100.0), (45, 2, 100.0), (45, -1, 501.0), (46, -1, 100.0)])
def test_missing_places_are_named(road_map: "carla.Map", road_id: int, lane: int, s: float) -> None:
    with pytest.raises(ValueError, match=rf"test has no lane {lane} on road {road_id} at s = {s:.1f} m"):
        spawn_transform(road_map, road_id, lane, s)


@pytest.mark.parametrize("lane", [-1, -4, 1])
@pytest.mark.parametrize("aside", [-0.8, 0.0, 0.8])
def test_lane_speed(road_map: "carla.Map", curvature: float, lane: int, aside: float) -> None:
    for s in (50.0, 200.0, 400.0):
        heading = centre(curvature, lane, s)[2] + (0.0 if lane < 0 else math.pi)
        for slip in (0.0, 0.3, math.pi / 2, math.pi):  # angle between the path of the car and the lane
            velocity = carla.Vector3D(20 * math.cos(heading + slip), 20 * math.sin(heading + slip), 0.5)
            state = lane_state(road_map, location(curvature, lane, s, aside), velocity)
            assert state.lane_speed == pytest.approx(20 * math.cos(slip), abs=0.06)
            assert state.speed == pytest.approx(math.hypot(20, 0.5)) and not state.offroad


@pytest.mark.parametrize(("lane", "side"), [(-LANES, 1), (1, -1)])
def test_offroad_begins_beyond_the_outer_lane(road_map: "carla.Map", curvature: float, lane: int, side: int) -> None:
    beyond = (-1.0, 0.0, MARGIN - 0.1, MARGIN + 0.1, 2.0, 30.0)
    spots = [location(curvature, lane, 250.0, side * (LANE_WIDTH / 2 + metres)) for metres in beyond]
    found = [lane_state(road_map, spot, carla.Vector3D()).offroad for spot in spots]
    assert found == [False, False, False, True, True, True]


def test_between_lanes_is_on_the_road_and_beyond_its_end_is_not(road_map: "carla.Map", curvature: float) -> None:
    for lane in (-1, -2, -3):
        spot = location(curvature, lane, 250.0, LANE_WIDTH / 2)
        assert not lane_state(road_map, spot, carla.Vector3D()).offroad
    x, y, heading = centre(curvature, -2, LENGTH)
    for metres, offroad in ((1.0, False), (4.0, True)):
        spot = carla.Location(x + metres * math.cos(heading), y + metres * math.sin(heading), HEIGHT)
        assert lane_state(road_map, spot, carla.Vector3D()).offroad == offroad
