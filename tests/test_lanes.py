"""Roads of the scenarios "merge" and "curves": their shape, their lanes beside highway-env's, their drivers."""

import math

import numpy as np
import pytest
from highway_env.road.lane import SineLane
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle

from benchmarks.road_identity import BlindEnv
from sb3_have.envs.lanes import FORWARD, ONCOMING, RampLane, ShapedNetwork
from sb3_have.envs.road import ROAD_LENGTH
from sb3_have.envs.road_shape import (
    PERIOD,
    RAMP_ENDS,
    RAMP_JOINS,
    RAMP_OFFSET,
    RAMP_TAPERS,
    SCENARIOS,
    SWING,
    RoadShape,
    road_shape,
)

NEW = ("merge", "curves")
# Position at which a ramp begins [m]
RAMP_START = 4 * PERIOD


# ---- the shape of the road ----


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_slopes_are_derivatives_and_everything_is_periodic(scenario: str) -> None:
    shape = road_shape(scenario, 4)
    x = np.arange(3.5, 2 * PERIOD, 7.0)
    step = 1e-4
    np.testing.assert_allclose((shape.bend(x + step) - shape.bend(x - step)) / (2 * step), shape.slope(x), atol=1e-7)
    for k in range(2):
        change = (shape.ramp(x + step)[k] - shape.ramp(x - step)[k]) / (2 * step)
        np.testing.assert_allclose(change, shape.ramp_slope(x)[k], atol=1e-6)
        assert shape.ramps or (shape.ramp(x)[k] == shape.right_edge).all()
        assert (np.asarray(shape.ramp(0.0)[k]) == shape.right_edge) == (not shape.ramps)
    np.testing.assert_array_equal(shape.has_ramp(x), shape.ramps & (x % PERIOD < RAMP_ENDS))
    for f in (shape.bend, shape.slope, lambda u: shape.ramp(u)[0], lambda u: shape.ramp(u)[1]):
        np.testing.assert_allclose(f(x + PERIOD), f(x), atol=1e-9)
        np.testing.assert_allclose([f(float(u)) for u in x], f(x), atol=1e-9)
        assert np.asarray(f(x.astype(np.float32))).dtype == np.float32
    ahead, aside = shape.direction(100.0)
    assert math.hypot(ahead, aside) == pytest.approx(1) and aside / ahead == pytest.approx(float(shape.slope(100.0)))


def test_a_ramp_comes_from_afar_joins_runs_along_and_tapers_off() -> None:
    shape = road_shape("merge", 3)
    edge = 2.5 * 4.0
    assert shape.right_edge == edge
    left, right = shape.ramp(
        np.array([0.0, RAMP_JOINS, RAMP_TAPERS, 0.5 * (RAMP_TAPERS + RAMP_ENDS), RAMP_ENDS, 479.0])
    )
    np.testing.assert_allclose(left, edge + np.array([RAMP_OFFSET, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(right, edge + np.array([RAMP_OFFSET + 4, 4, 4, 2, 0, 0]))


def test_the_car_can_follow_the_curves_comfortably() -> None:
    shape = road_shape("curves", 4)
    x = np.linspace(0, PERIOD, 4801)
    curvature = np.abs(np.gradient(shape.slope(x), x)) / (1 + shape.slope(x) ** 2) ** 1.5
    assert 1 / curvature.max() == pytest.approx(486, abs=2)
    # highway-env's bicycle: turning radius LENGTH / 2 / sin(slip angle) at full lock
    lock = 2.5 / math.sin(math.atan(0.5 * math.tan(0.02)))
    assert lock == pytest.approx(250, abs=1)
    assert lock * 1.5 < 1 / curvature.max()


# ---- lanes ----


def stock_lane(number: int) -> SineLane:
    """highway-env's lane in the same place."""
    y, pulsation = 4.0 * number, 2 * np.pi / PERIOD
    if number >= 2:
        return SineLane([0, y], [ROAD_LENGTH, y], SWING, pulsation, 0.0)
    return SineLane([ROAD_LENGTH, y], [0, y], SWING, pulsation, -pulsation * ROAD_LENGTH)


@pytest.mark.parametrize("number", range(4))
def test_lanes_are_highway_envs_sine_lanes(number: int) -> None:
    network = ShapedNetwork(road_shape("curves", 4))
    index = (*FORWARD, number - 2) if number >= 2 else (*ONCOMING, 1 - number)
    lane, stock = network.get_lane(index), stock_lane(number)
    for x in np.linspace(1000, 2000, 37):
        for across in (-1.5, 0.0, 1.0):
            point = np.array([x, 4.0 * number + SWING * np.sin(2 * np.pi * x / PERIOD) + across])
            s, r = lane.local_coordinates(point)
            np.testing.assert_allclose((s, r), stock.local_coordinates(point), atol=1e-6)
            np.testing.assert_allclose(lane.position(s, r), point, atol=1e-9)
            np.testing.assert_allclose(stock.position(s, r), point, atol=1e-6)
            turn = lane.heading_at(s) - stock.heading_at(s)
            assert abs(math.remainder(turn, 2 * math.pi)) < 1e-6
            assert network.get_closest_lane_index(point, heading=2.0) == index


def test_ramp_lane() -> None:
    network = ShapedNetwork(road_shape("merge", 2))
    ramp = network.get_lane((*FORWARD, 2))
    assert isinstance(ramp, RampLane)
    for u in np.linspace(0.5, RAMP_TAPERS - 0.5, 30):
        x = RAMP_START + u
        for lateral in (-1.9, 0.0, 1.9):
            point = ramp.position(x, lateral)
            np.testing.assert_allclose(ramp.local_coordinates(point), (x, lateral), atol=1e-9)
            assert network.get_closest_lane_index(point) == (*FORWARD, 2) and ramp.on_lane(point)
        assert not ramp.on_lane(ramp.position(x, 2.1)) and not ramp.on_lane(ramp.position(x, -2.1))
        assert ramp.on_lane(ramp.position(x, 2.9), margin=1)
    # grass between the road and the ramp; a narrowing lane; no lane
    for u, y, index, on in [
        (50.0, 10.0, 1, False),
        (300.0, 6.1, 2, True),
        (440.0, 7.9, 2, True),
        (440.0, 8.1, 2, False),
        (465.0, 6.1, 1, False),
        (465.0, 5.9, 1, True),
    ]:
        point = np.array([RAMP_START + u, y])
        closest = network.get_closest_lane_index(point)
        assert closest == (*FORWARD, index) and network.get_lane(closest).on_lane(point) == on, (u, y)
    assert not ramp.is_reachable_from(np.array([RAMP_START + 300.0, 4.0]))


def test_occupants_of_lanes_of_another_width() -> None:
    shape = RoadShape(lanes_count=2, lane_width=6.0, swing=SWING)
    network = ShapedNetwork(shape)
    env = BlindEnv(vehicles_count=0)
    env.reset(seed=0)
    x, car = 1000.0, env.vehicle
    y = 6.0 + float(shape.bend(x))
    for across, inside in [(0.0, True), (-3.9, True), (3.9, True), (4.1, False), (-4.1, False)]:
        occupants = network.get_lane((*FORWARD, 1)).occupants([(x, y + across, float(shape.bend(x)), car)])
        assert occupants == [(x, car)] * inside
        assert network.get_lane((*FORWARD, 1)).on_lane(np.array([x, y + across]), margin=1) == inside


@pytest.mark.parametrize("scenario", NEW)
def test_neighbours_are_those_of_the_stock_road(scenario: str) -> None:
    env = BlindEnv(scenario=scenario, vehicles_count=30)
    found = 0
    for seed in range(3):
        env.reset(seed=seed)
        road = env.road
        # Three vehicles at the same place
        for k in (3, 7):
            road.vehicles[k].position[:] = road.vehicles[5].position
        road._placed = road._places()
        road._on_lane = {}
        for vehicle in road.vehicles:
            for direction, ends in road.network.graph.items():
                for end, lanes in ends.items():
                    for i in range(len(lanes)):
                        index = (direction, end, i)
                        fast = road.neighbour_vehicles(vehicle, index)
                        slow = Road.neighbour_vehicles(road, vehicle, index)
                        assert fast == slow
                        found += fast[0] is not None
        road._placed = None
    assert found > 300


@pytest.mark.parametrize("scenario", NEW)
def test_drivers_are_highway_envs(scenario: str) -> None:
    """Beside the stock driver on the same road: the same decisions, but for what a driver here does of its own."""
    env = BlindEnv(scenario=scenario, max_episode_steps=None)
    compared = 0
    for seed in range(4):
        env.reset(seed=seed)
        for _ in range(15):
            env.step(np.array([0.5, 0.0]))
        for vehicle in env.road.vehicles[1:]:
            if isinstance(vehicle.lane, RampLane):
                continue
            twin = IDMVehicle.create_from(vehicle)
            twin.DELTA, twin.timer = vehicle.DELTA, vehicle.timer
            place = env.road.vehicles.index(vehicle)
            env.road.vehicles[place] = twin
            twin.act()
            env.road.vehicles[place] = vehicle
            vehicle.act()
            assert vehicle.target_lane_index == twin.target_lane_index
            for key in ("steering", "acceleration"):
                assert vehicle.action[key] == pytest.approx(twin.action[key], abs=1e-6)
            compared += 1
    assert compared > 40
