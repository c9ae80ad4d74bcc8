"""Scenarios "merge" and "curves": traffic, reward, the ends of episodes, the gymnasium contract."""

import hashlib
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from benchmarks.road_identity import BlindEnv
from sb3_have.envs import HighwayVisionEnv, traffic
from sb3_have.envs.driver import ScenarioDriver
from sb3_have.envs.highway_vision import HEAD_ON_FREQUENCY, START_X
from sb3_have.envs.lanes import FORWARD, ONCOMING
from sb3_have.envs.merging import MergingDriver
from sb3_have.envs.road import ROAD_LENGTH
from sb3_have.envs.road_shape import (
    PERIOD,
    RAMP_JOINS,
    RAMP_TAPERS,
    SCENARIOS,
    SWING,
)
from sb3_have.envs.weather import WEATHERS

Array = NDArray[Any]
NEW = ("merge", "curves")
STRAIGHT = np.zeros(2)
RAMP_START = 4 * PERIOD
"""Where a ramp begins [m]."""


class RuleDrivenEnv(BlindEnv):
    """highway-env's own IDM/MOBIL driver at the wheel, whatever the action."""

    def _reset(self) -> None:
        super()._reset()
        ego = self.vehicle
        self.vehicle = IDMVehicle(self.road, ego.position, ego.heading, ego.speed, target_speed=25.0)
        self.road.vehicles[0] = self.vehicle


class HeedlessDriver(ScenarioDriver):
    """Neither brakes nor steers."""

    def act(self, action: Any = None) -> None:
        self.action = {"steering": 0.0, "acceleration": 0.0}


def place(env: Any, x: float, y: float, heading: float = 0.0) -> None:
    env.vehicle.position, env.vehicle.heading = np.array([x, y]), heading
    env.vehicle.on_state_update()


# ---- traffic ----


@pytest.mark.parametrize("scenario", NEW)
def test_traffic_keeps_its_side_and_its_number_and_appears_out_of_sight(scenario: str) -> None:
    env = RuleDrivenEnv(scenario=scenario, initial_speed=20.0, max_episode_steps=None)
    recycled = merged = oncoming = 0
    for seed in range(2):
        env.reset(seed=seed)
        env.vehicle.collidable = False
        for _ in range(150):
            before = list(env.road.vehicles)
            lanes = [v.lane_index for v in before]
            env.step(STRAIGHT)
            start = env._poses[0]
            x = start[:, 0] - start[0, 0]
            assert len(start) == 21 and before[0] is env.vehicle
            for i, (old, new) in enumerate(zip(before, env.road.vehicles, strict=True)):
                if old is not new:
                    recycled += 1
                    assert traffic.SIGHT <= x[i] <= traffic.AHEAD or -traffic.BEHIND <= x[i] <= -100
                    assert x[i] > 0 or new.lane_index[:2] == FORWARD
                elif old is not env.vehicle:
                    assert old.lane_index[:2] == lanes[i][:2]
                    merged += lanes[i] == (*FORWARD, 4) != old.lane_index
                oncoming += new.lane_index[:2] == ONCOMING
                assert not new.crashed and new.speed >= 0
    assert recycled > 8
    assert (oncoming > 2000) == (scenario == "curves") and (merged > 3) == (scenario == "merge")


def test_oncoming_traffic_comes_from_the_front() -> None:
    env = BlindEnv(scenario="curves", vehicles_count=0)
    for ahead in (traffic.AHEAD + 30.0, -traffic.BEHIND - 10.0):
        env.reset(seed=0)
        x = float(env.vehicle.position[0])
        car = ScenarioDriver.make_on_lane(env.road, (*ONCOMING, 0), ROAD_LENGTH - x - ahead, 20.0)
        env.road.vehicles.append(car)
        assert traffic.recycle(env.road, env.vehicle, (21.0, 24.0), env.np_random) == [1]
        newcomer = env.road.vehicles[1]
        assert newcomer.lane_index[:2] == ONCOMING and traffic.SIGHT <= newcomer.position[0] - x <= traffic.AHEAD


def test_oncoming_traffic_is_met_head_on_and_brakes_but_does_not_reverse() -> None:
    env = BlindEnv(scenario="curves", vehicles_count=0)
    env.reset(seed=0)
    ego: Any = env.vehicle
    lane = env.road.network.get_lane((*ONCOMING, 0))
    ego.position = lane.position(lane.local_coordinates(ego.position)[0], 0.0)
    ego.on_state_update()
    along = lane.local_coordinates(ego.position)[0]
    car: Any = ScenarioDriver.make_on_lane(env.road, (*ONCOMING, 0), along - 150.0, 20.0)
    assert car.position[0] == pytest.approx(ego.position[0] + 150) and math.cos(car.heading) < -0.98
    assert env.road.neighbour_vehicles(car)[0] == ego
    car.enable_lane_change = False
    env.road.vehicles.append(car)
    for _ in range(100):
        info = env.step(STRAIGHT)[4]
        assert info["end_reason"] is None and car.speed >= 0
    # It waits for who blocks its lane.
    assert car.speed < 0.1 and 5 < car.position[0] - ego.position[0] < 20
    ego.speed = 10.0
    for _ in range(15):
        *_, terminated, _, info = env.step(STRAIGHT)
        assert car.speed >= 0
        if terminated:
            break
    assert info["end_reason"] == "crash" and info["crashed"] and not info["offroad"]


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
    """By whom a car that stands on the left-most lane is overtaken in a minute, and how many cars are in sight."""
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


# ---- reward, ends ----


@pytest.mark.parametrize("angle", [0.0, 0.3, -0.3])
def test_reward_is_progress_along_the_road(angle: float) -> None:
    env = BlindEnv(scenario="curves", vehicles_count=0, initial_speed=20.0)
    env.reset(seed=0)
    x = 2 * PERIOD + 1.0  # the road's heading is 9 degrees and hardly changes
    heading = math.atan(SWING * 2 * math.pi / PERIOD)
    place(env, x, 8.0 + float(env.shape.bend(x)), heading + angle)
    _, reward, *_, info = env.step(STRAIGHT)
    assert info["distance"] == pytest.approx(4 * math.cos(angle), abs=2e-3)
    assert reward == pytest.approx(info["distance"] * 5 / 30)


def test_distance_is_the_length_of_the_road() -> None:
    env = RuleDrivenEnv(scenario="curves", vehicles_count=0, initial_speed=25.0)
    env.reset(seed=0)
    x = env.vehicle.position[0]
    for _ in range(96):
        info = env.step(STRAIGHT)[4]
    # 4.0 % of a period's length are the sine's: 1 + (2 pi 12 / 480)^2 / 4
    assert info["distance"] / (env.vehicle.position[0] - x) == pytest.approx(1.00617, abs=5e-4)
    assert info["distance"] == pytest.approx(96 * 5.0, rel=2e-3)


def test_a_rule_keeps_the_curves_with_the_wheel_and_a_blind_driver_does_not() -> None:
    for seed in range(4):
        env = BlindEnv(scenario="curves", vehicles_count=0, initial_speed=20.0)
        env.reset(seed=seed)
        largest = 0.0
        for _ in range(130):
            ego = env.vehicle
            along, lateral = ego.lane.local_coordinates(ego.position)
            error = ego.lane.local_angle(ego.heading, along + 8.0)
            steer = -(0.01 * lateral + 0.4 * error) / 0.02
            largest = max(largest, abs(steer))
            info = env.step(np.array([0.0, np.clip(steer, -1, 1)]))[4]
            assert info["end_reason"] is None and abs(lateral) < 1
        assert 0.3 < largest < 0.9 and info["distance"] > PERIOD
        env.reset(seed=seed)
        while info["end_reason"] is None or info["distance"] > PERIOD:
            info = env.step(STRAIGHT)[4]
        assert info["end_reason"] == "offroad" and info["distance"] < PERIOD


def test_the_wrong_side_is_road_and_the_verge_is_not() -> None:
    env = BlindEnv(scenario="curves", vehicles_count=0)
    env.reset(seed=0)
    for across, off in [(-2.1, True), (-1.9, False), (2.0, False), (4.0, False), (13.9, False), (14.1, True)]:
        env.reset(seed=0)
        place(env, 1100.0, across + float(env.shape.bend(1100.0)))
        assert env.step(STRAIGHT)[4]["offroad"] == off, across


def test_the_acceleration_lane_is_road_while_it_lasts() -> None:
    env = BlindEnv(scenario="merge", vehicles_count=0, initial_speed=20.0)
    env.reset(seed=0)
    place(env, RAMP_START + 300.0, 16.0)
    for _ in range(60):
        info = env.step(STRAIGHT)[4]
        if info["offroad"]:
            break
    # Its middle is on the lane until half of its width has tapered off.
    assert env.vehicle.position[0] - RAMP_START == pytest.approx(440, abs=4.1)
    assert info["end_reason"] == "offroad"
    env.reset(seed=0)
    place(env, RAMP_START + 50.0, 16.0)
    assert env.step(STRAIGHT)[4]["offroad"]


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_episodes_begin_anywhere_but_on_the_plain_highway(scenario: str) -> None:
    env = BlindEnv(scenario=scenario, vehicles_count=0)
    starts = []
    for seed in range(10):
        env.reset(seed=seed)
        starts.append(float(env.vehicle.position[0]))
    if scenario == "highway":
        assert set(starts) == {START_X}
    else:
        assert START_X <= min(starts) < max(starts) - 300 and max(starts) <= START_X + PERIOD


@pytest.mark.parametrize("speed", [0.0, 15.0, 30.0])
def test_no_cars_miss_each_other_head_on(speed: float) -> None:
    frequency = HEAD_ON_FREQUENCY
    env = BlindEnv(
        scenario="curves",
        vehicles_count=0,
        initial_speed=speed,
        simulation_frequency=frequency,
        policy_frequency=frequency,
    )
    nearer = (30 + speed) / frequency  # per step
    for phase in np.arange(0, 1, 0.05):
        env.reset(seed=0)
        lane, x = env.road.network.get_lane((*ONCOMING, 0)), 2.25 * PERIOD  # where the road leads along x
        place(env, x, lane.position(ROAD_LENGTH - x, 0.0)[1])
        ahead = 12 + (1 + phase) * nearer
        other = HeedlessDriver.make_on_lane(env.road, (*ONCOMING, 0), ROAD_LENGTH - x - ahead, 30.0)
        env.road.vehicles.append(other)
        end = None
        while end is None and other.position[0] > x - nearer:
            end = env.step(STRAIGHT)[4]["end_reason"]
        assert end == "crash", phase


# ---- the gymnasium contract ----


def digest(seed: int, **kwargs: Any) -> str:
    env = gym.make("HighwayVision-v0", image_size=36, max_episode_steps=9, **kwargs)
    env.action_space.seed(seed)
    total = hashlib.sha256()
    env.reset(seed=seed)
    for _ in range(20):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        for key in sorted(observation):
            total.update(observation[key].tobytes())
        total.update(repr((reward, sorted(info.items()))).encode())
        if terminated or truncated:
            env.reset()
    return total.hexdigest()


def test_same_seed_same_bits() -> None:
    digests = {scenario: digest(3, scenario=scenario) for scenario in SCENARIOS}
    assert len(set(digests.values())) == 3
    assert digests == {scenario: digest(3, scenario=scenario) for scenario in SCENARIOS}
    assert digest(3) == digests["highway"]
    assert digest(4, scenario="curves") != digests["curves"]


@pytest.mark.parametrize("weather", WEATHERS)
@pytest.mark.parametrize("scenario", NEW)
def test_checkers_accept_every_scenario_in_every_weather(scenario: str, weather: str) -> None:
    env = gym.make("HighwayVision-v0", scenario=scenario, weather=weather, image_size=36, render_mode="rgb_array")
    check_gymnasium_env(env.unwrapped)
    check_sb3_env(env)


@pytest.mark.parametrize("scenario, lanes", [("merge", 1), ("merge", 2), ("curves", 2), ("curves", 6)])
def test_other_numbers_of_lanes(scenario: str, lanes: int) -> None:
    env = HighwayVisionEnv(scenario=scenario, lanes_count=lanes, image_size=36, vehicles_count=8)
    starts = set()
    for seed in range(10):
        env.reset(seed=seed)
        starts.add(env.vehicle.lane_index)
        for _ in range(3):
            info = env.step(np.array([0.3, 0.0]))[4]
            assert info["end_reason"] is None
    assert starts <= {(*FORWARD, i) for i in range(lanes if scenario == "merge" else lanes // 2)}
    assert len(starts) > 1 or lanes <= 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": "city"}, "highway, merge, curves; got 'city'"),
        ({"scenario": None}, "highway, merge, curves"),
        ({"scenario": "curves", "lanes_count": 3}, "even.*got 3, choose 2 or 4"),
        ({"scenario": "curves", "lanes_count": 1}, "even.*got 1, choose 2$"),
        ({"scenario": "curves", "simulation_frequency": 2, "policy_frequency": 1}, "simulation_frequency.*>= 3.*got 2"),
        ({"scenario": "merge", "lanes_count": 0}, "lanes_count"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HighwayVisionEnv(**options)
