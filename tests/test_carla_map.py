"""Places and speeds on CARLA's own map, against hand-written OpenDRIVE roads whose lanes have closed forms."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest

from sb3_have.envs.carla_vision.rules import EGO_RANGE, TRAFFIC_RANGE, Place, draw_place

if TYPE_CHECKING:
    import carla
else:
    carla = pytest.importorskip("carla", reason="no package carla (wheels for Python 3.10-3.12 on 64-bit Linux)")

from sb3_have.envs.carla_vision.episode import LIFT, MARGIN, lane_state, spawn_transform

ROAD, LENGTH, WIDTH, LANES, HEIGHT = 45, 500.0, 3.5, 4, 6.0
X0, Y0, HEADING = 30.0, -12.0, 0.7  # where the road begins, in OpenDRIVE's axes (y to the left)
CURVATURE = {"straight": 0.0, "left": 0.004, "right": -0.006}


def opendrive(curvature: float) -> str:
    shape = f'<arc curvature="{curvature}"/>' if curvature else "<line/>"
    lane = '<lane id="{}" type="driving" level="false"><width sOffset="0" a="{}" b="0" c="0" d="0"/></lane>'
    right = "".join(lane.format(-number, WIDTH) for number in range(1, LANES + 1))
    return f"""<?xml version="1.0"?>
    <OpenDRIVE>
      <header revMajor="1" revMinor="4" name="" version="1" north="0" south="0" east="0" west="0"/>
      <road name="" length="{LENGTH}" id="{ROAD}" junction="-1">
        <planView>
          <geometry s="0" x="{X0}" y="{Y0}" hdg="{HEADING}" length="{LENGTH}">{shape}</geometry>
        </planView>
        <elevationProfile><elevation s="0" a="{HEIGHT}" b="0" c="0" d="0"/></elevationProfile>
        <lanes><laneSection s="0">
          <left>{lane.format(1, WIDTH)}</left>
          <center><lane id="0" type="none" level="false"/></center>
          <right>{right}</right>
        </laneSection></lanes>
      </road>
    </OpenDRIVE>"""


def centre(curvature: float, lane: int, s: float, aside: float = 0.0) -> tuple[float, float, float]:
    """x, y (to the right) and heading [rad] of the centre of a lane, in CARLA's axes; aside: to the right of it."""
    heading = HEADING + curvature * s
    if curvature:
        x = X0 + (math.sin(heading) - math.sin(HEADING)) / curvature
        y = Y0 - (math.cos(heading) - math.cos(HEADING)) / curvature
    else:
        x, y = X0 + s * math.cos(HEADING), Y0 + s * math.sin(HEADING)
    left = math.copysign(abs(lane) - 0.5, lane) * WIDTH - aside
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
    return carla.Map("hand-written", opendrive(curvature))


@pytest.mark.parametrize("lane", [-1, -2, -3, -4, 1])
@pytest.mark.parametrize("s", [100.0, 114.0, 237.5, 300.0])
def test_cars_are_put_on_the_centre_of_their_lane_and_along_it(
    road_map: "carla.Map", curvature: float, lane: int, s: float
) -> None:
    transform = spawn_transform(road_map, ROAD, Place(lane, s))
    x, y, heading = centre(curvature, lane, s)
    found = transform.location
    np.testing.assert_allclose((found.x, found.y, found.z), (x, y, HEIGHT + LIFT), atol=0.02)
    forward = transform.get_forward_vector()
    direction = 1.0 if lane < 0 else -1.0  # lanes to the left of the road's line run against it
    np.testing.assert_allclose(
        (forward.x, forward.y), (direction * math.cos(heading), direction * math.sin(heading)), atol=1e-3
    )


def test_places_drawn_are_on_the_road_and_in_their_ranges(road_map: "carla.Map") -> None:
    rng = np.random.default_rng(0)
    for s_range in (EGO_RANGE, TRAFFIC_RANGE):
        for _ in range(50):
            place = draw_place(rng, LANES, s_range)
            spot = spawn_transform(road_map, ROAD, place).location
            waypoint = road_map.get_waypoint(spot, project_to_road=False)
            assert waypoint is not None and waypoint.road_id == ROAD and waypoint.lane_id == place.lane
            assert waypoint.s == pytest.approx(place.s, abs=0.5)  # the map cuts bends into straight pieces


@pytest.mark.parametrize("place", [Place(-5, 100.0), Place(2, 100.0), Place(-1, LENGTH + 1)])
def test_a_place_that_is_not_there_is_named(place: Place) -> None:
    road_map = carla.Map("hand-written", opendrive(0.0))
    with pytest.raises(ValueError, match=rf"hand-written has no lane {place.lane} on road 45 at s = {place.s:.1f} m"):
        spawn_transform(road_map, ROAD, place)
    with pytest.raises(ValueError, match="no lane -1 on road 46"):
        spawn_transform(road_map, 46, Place(-1, 100.0))


@pytest.mark.parametrize("lane", [-1, -4, 1])
@pytest.mark.parametrize("aside", [-0.8, 0.0, 0.8])
def test_speed_along_the_lane_is_the_share_of_the_velocity_that_follows_it(
    road_map: "carla.Map", curvature: float, lane: int, aside: float
) -> None:
    for s in (50.0, 200.0, 400.0):
        heading = centre(curvature, lane, s)[2] + (0.0 if lane < 0 else math.pi)
        for slip in (0.0, 0.3, math.pi / 2, math.pi):  # angle between the car's path and the lane
            velocity = carla.Vector3D(20 * math.cos(heading + slip), 20 * math.sin(heading + slip), 0.5)
            state = lane_state(road_map, location(curvature, lane, s, aside), velocity)
            assert state.lane_speed == pytest.approx(20 * math.cos(slip), abs=0.06)
            assert state.speed == pytest.approx(math.hypot(20, 0.5))
            assert not state.offroad


def test_driving_along_a_lane_adds_up_to_its_length(road_map: "carla.Map", curvature: float) -> None:
    dt, speed, s, distance = 0.05, 25.0, 100.0, 0.0
    stretch = 1 - curvature * -2.5 * WIDTH  # lane -3 is longer than the road's line in a left bend
    while s < 400:
        heading = centre(curvature, -3, s)[2]
        velocity = carla.Vector3D(speed * math.cos(heading), speed * math.sin(heading), 0.0)
        distance += lane_state(road_map, location(curvature, -3, s), velocity).lane_speed * dt
        s += speed * dt / stretch
    assert distance == pytest.approx((s - 100) * stretch, rel=1e-3)


def edge(side: int) -> Callable[[float, float], "carla.Location"]:
    """Points so far beyond the outer edge of the outermost lane to the left (-1: lane 1) or to the right (lane -4)."""

    def point(curvature: float, beyond: float) -> "carla.Location":
        return location(curvature, -LANES if side > 0 else 1, 250.0, side * (WIDTH / 2 + beyond))

    return point


@pytest.mark.parametrize("side", [-1, 1])
def test_off_the_road_begins_a_margin_beyond_the_outer_lane(road_map: "carla.Map", curvature: float, side: int) -> None:
    standing = carla.Vector3D(0.0, 0.0, 0.0)
    beyond = {
        metres: lane_state(road_map, edge(side)(curvature, metres), standing).offroad
        for metres in (-1.0, 0.0, MARGIN - 0.1, MARGIN + 0.1, 3.0, 30.0)
    }
    assert list(beyond.values()) == [False, False, False, True, True, True]


def test_between_two_lanes_is_on_the_road(road_map: "carla.Map", curvature: float) -> None:
    for lane in (-1, -2, -3):
        spot = location(curvature, lane, 250.0, WIDTH / 2)
        assert not lane_state(road_map, spot, carla.Vector3D(1.0, 0.0, 0.0)).offroad


def test_beyond_the_end_of_the_road_is_off_it(road_map: "carla.Map", curvature: float) -> None:
    x, y, heading = centre(curvature, -2, LENGTH)
    for metres, offroad in ((1.0, False), (4.0, True)):
        spot = carla.Location(x + metres * math.cos(heading), y + metres * math.sin(heading), HEIGHT)
        assert lane_state(road_map, spot, carla.Vector3D()).offroad == offroad
