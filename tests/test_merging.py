"""Scenario "merge": how cars join from a ramp, and how the traffic supplies the ramps."""

from typing import Any

import numpy as np
import pytest

from benchmarks.road_identity import BlindEnv
from sb3_have.envs import traffic
from sb3_have.envs.lanes import FORWARD
from sb3_have.envs.merging import MergingDriver
from sb3_have.envs.road_shape import PERIOD, RAMP_JOINS, RAMP_TAPERS

STRAIGHT = np.zeros(2)
# Position at which a ramp begins [m]
RAMP_START = 4 * PERIOD


def place(env: Any, x: float, y: float, heading: float = 0.0) -> None:
    env.vehicle.position, env.vehicle.heading = np.array([x, y]), heading
    env.vehicle.on_state_update()


def merging(env: BlindEnv, u: float, speed: float) -> MergingDriver:
    """A car on the ramp, alone with an ego vehicle that stands on the left-most lane."""
    env.reset(seed=0)
    place(env, RAMP_START + 150.0, 0.0)
    car: MergingDriver = MergingDriver.make_on_lane(env.road, (*FORWARD, 4), RAMP_START + u, speed)
    car.cruise_speed = 22.0
    env.road.vehicles.append(car)
    return car


def test_ramp_traffic_joins_an_empty_road_on_the_acceleration_lane() -> None:
    env = BlindEnv(scenario="merge", vehicles_count=0)
    car = merging(env, 100.0, 11.0)
    while car.target_lane_index == (*FORWARD, 4):
        assert car.position[0] < RAMP_START + RAMP_JOINS + 2.0
        assert car.speed <= 11.5
        env.step(STRAIGHT)
    assert car.position[0] >= RAMP_START + RAMP_JOINS
    for _ in range(40):
        env.step(STRAIGHT)
    assert car.lane_index == (*FORWARD, 3) and car.speed > 20
    assert abs(car.position[1] - 12.0) < 0.2 and not car.crashed


def test_without_a_gap_it_stops_before_the_lane_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MergingDriver, "_can_join", lambda self, limit: False)
    env = BlindEnv(scenario="merge", vehicles_count=0)
    for u, speed in [(100.0, 12.0), (250.0, 22.0)]:
        car = merging(env, u, speed)
        for _ in range(200):
            env.step(STRAIGHT)
        assert car.speed < 0.2 and RAMP_TAPERS - 20 < car.position[0] - RAMP_START < RAMP_TAPERS
        assert car.lane_index == (*FORWARD, 4)


@pytest.mark.parametrize(
    ("offset", "speed", "early", "late"),
    [
        (0.0, 20.0, False, False),  # alongside
        (-12.0, 20.0, False, False),
        (-45.0, 20.0, False, True),  # it would have to brake, as it may be made to at the end
        (-80.0, 20.0, True, True),
        (12.0, 5.0, False, False),
        (60.0, 20.0, True, True),
    ],
)
def test_gaps_that_it_takes(offset: float, speed: float, early: bool, late: bool) -> None:
    env = BlindEnv(scenario="merge", vehicles_count=0)
    for u, expected in [(RAMP_JOINS + 1, early), (RAMP_TAPERS - 1, late)]:
        car = merging(env, u, 20.0)
        other = MergingDriver.make_on_lane(env.road, (*FORWARD, 3), RAMP_START + u + offset, speed)
        env.road.vehicles.append(other)
        car.change_lane_policy()
        assert (car.target_lane_index == (*FORWARD, 3)) == expected
        # Who is still changing to the same lane from its other side counts as well.
        car = merging(env, u, 20.0)
        other = MergingDriver.make_on_lane(env.road, (*FORWARD, 2), RAMP_START + u + offset, speed)
        other.target_lane_index = (*FORWARD, 3)
        env.road.vehicles.append(other)
        car.change_lane_policy()
        assert (car.target_lane_index == (*FORWARD, 3)) == expected


def test_past_the_end_of_the_ramp_it_is_on_the_road() -> None:
    env = BlindEnv(scenario="merge", vehicles_count=0)
    car = merging(env, 450.0, 15.0)
    car.target_speed = 11.0
    car.position[0] = RAMP_START + 461.0
    car.on_state_update()
    assert car.target_lane_index == (*FORWARD, 4)
    car.act()
    assert car.lane_index == car.target_lane_index == (*FORWARD, 3) and car.target_speed == 22.0


@pytest.mark.parametrize("u, called", [(20.0, True), (95.0, True), (150.0, False), (470.0, False)])
def test_a_ramp_that_begins_ahead_calls_for_cars_from_behind(u: float, called: bool) -> None:
    env = BlindEnv(scenario="merge", vehicles_count=0, initial_speed=21.0)
    env.reset(seed=0)
    place(env, RAMP_START + u - traffic.SIGHT, 0.0)
    # The first comes nearer, the second is needed yet, and one of the others at a time.
    for lane, offset, speed in [(3, -60.0, 21.5), (2, -35.0, 20.0), (3, -90.0, 20.0), (2, -90.0, 20.0)]:
        car = MergingDriver.make_on_lane(env.road, (*FORWARD, lane), env.vehicle.position[0] + offset, speed)
        env.road.vehicles.append(car)
    for replaced in ([3], [4], []):
        expected = replaced if called else []
        assert traffic.recycle(env.road, env.vehicle, (21.0, 24.0), env.np_random) == expected
        if called:
            lanes = [env.road.vehicles[i].lane_index for i in expected]
            assert all(env.road.vehicles[i].position[0] > env.vehicle.position[0] + traffic.SIGHT for i in expected)
            assert all(lane[:2] == FORWARD for lane in lanes)


def overtakings(scenario: str, u: float) -> tuple[int, float]:
    """Vehicles that overtake a car standing on the leftmost lane within a minute, and the number of cars in sight."""
    env = BlindEnv(scenario=scenario, vehicles_count=0, max_episode_steps=None)
    env.reset(seed=0)
    place(env, RAMP_START + u, 0.0)
    traffic.populate(env.road, env.vehicle, 20, env.traffic_speed, env.np_random)
    passed, seen = 0, []
    for step in range(300):
        assert env.step(STRAIGHT)[4]["end_reason"] is None
        before, after = (pose[1:, 0] - RAMP_START - u for pose in (env._poses[0], env._snapshot()))
        passed += int(((before < 0) & (after >= 0)).sum())
        if step >= 100:
            seen.append(((after > 0) & (after < 205)).sum())
    return passed, float(np.mean(seen))


@pytest.mark.parametrize("u", [100.0, 230.0])
def test_traffic_goes_on_past_a_car_that_stands_where_a_ramp_begins_ahead(u: float) -> None:
    passed, seen = overtakings("merge", u)
    as_many, as_seen = overtakings("highway", 0.0)
    assert as_many > 30 and 0.75 < passed / as_many < 1.25
    assert as_seen > 5 and 0.7 < seen / as_seen < 1.3


def test_who_arrives_on_a_ramp_is_slow() -> None:
    env = BlindEnv(scenario="merge", vehicles_count=0)
    arrivals = 0
    for seed in range(20):
        env.reset(seed=seed)
        x = RAMP_START - traffic.SIGHT + 5.0
        place(env, x, 0.0)
        env.road.vehicles.append(MergingDriver.make_on_lane(env.road, (*FORWARD, 0), x - 150.0, 20.0))
        assert traffic.recycle(env.road, env.vehicle, (21.0, 24.0), env.np_random) == [1]
        newcomer = env.road.vehicles[1]
        slow, fast = traffic.RAMP_SPEED if newcomer.lane_index == (*FORWARD, 4) else (21.0, 24.0)
        assert slow <= newcomer.speed == newcomer.target_speed <= fast and 21 <= newcomer.cruise_speed <= 24
        arrivals += newcomer.lane_index == (*FORWARD, 4)
    assert 5 <= arrivals <= 15
