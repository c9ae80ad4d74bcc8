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
from sb3_have.envs.road import ROAD_LENGTH
from sb3_have.envs.road_shape import PERIOD, SCENARIOS, SWING
from sb3_have.envs.weather import WEATHERS

Array = NDArray[Any]
NEW = ("merge", "curves")
STRAIGHT = np.zeros(2)
# Position at which a ramp begins [m]
RAMP_START = 4 * PERIOD


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
    # It waits for the car that blocks its lane
    assert car.speed < 0.1 and 5 < car.position[0] - ego.position[0] < 20
    ego.speed = 10.0
    for _ in range(15):
        *_, terminated, _, info = env.step(STRAIGHT)
        assert car.speed >= 0
        if terminated:
            break
    assert info["end_reason"] == "crash" and info["crashed"] and not info["offroad"]


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
        ({"scenario": "curves", "lanes_count": 3}, "even.*got 3"),
        ({"scenario": "curves", "lanes_count": 1}, "even.*got 1"),
        ({"scenario": "curves", "simulation_frequency": 2, "policy_frequency": 1}, "simulation_frequency.*>= 3.*got 2"),
        ({"scenario": "merge", "lanes_count": 0}, "lanes_count"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HighwayVisionEnv(**options)
