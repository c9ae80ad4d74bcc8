"""The rules and options of CarlaVision-v0, without CARLA."""

import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from sb3_have.envs.carla_vision import PAPER, CarlaVisionEnv
from sb3_have.envs.carla_vision.rules import (
    DEFAULTS,
    EGO_RANGE,
    STANDSTILL_SPEED,
    TRAFFIC_RANGE,
    Reward,
    Trip,
    draw_place,
    pedals,
    steering_gain,
)
from sb3_have.envs.carla_vision.sensors import EVENT_DEFAULTS, dvs_attributes, event_options
from sb3_have.envs.highway_vision import HighwayVisionEnv
from sb3_have.envs.vision import EVENT_DEFAULTS as HIGHWAY_DEFAULTS

# ---- reward ----


def make_reward(form: Any, **options: float) -> Reward:
    weights = {name: DEFAULTS[form][name] for name in ("collision_cost", "crash_penalty")}
    return Reward(form, **{"steer_cost": 0.1, "brake_cost": 0.1, "max_speed": 30.0, **weights, **options})


def test_paper_reward() -> None:
    reward = make_reward("paper")
    assert reward([25.0], 0.05, 1.0, 0.0, 0.0, False) == pytest.approx(1.25)
    assert reward([25.0], 0.05, -0.5, -0.4, 300.0, False) == pytest.approx(1.25 - 0.05 - 0.04 - 0.3)
    assert reward([-2.0], 0.05, 0.0, 1.0, 0.0, True) == pytest.approx(-0.1 - 0.1)
    # The reward of a step is the sum over its ticks
    speeds = [20.0, 21.0, 19.5, 18.0]
    ticks = [reward([speed], 0.05, -0.3, 0.6, 0.0, False) for speed in speeds]
    assert reward(speeds, 0.05, -0.3, 0.6, 40.0, False) == pytest.approx(sum(ticks) - 0.04)


def test_highway_reward_equals_that_of_highway_vision() -> None:
    env = HighwayVisionEnv(image_size=16, vehicles_count=0, modalities=("depth",), initial_speed=20.0)
    env.reset(seed=0)
    reward = make_reward("highway")
    for throttle, steer in ((0.5, 0.0), (-0.4, 0.3), (1.0, -1.0)):
        before = env._distance
        _, theirs, terminated, _, info = env.step(np.array([throttle, steer]))
        mean = (info["distance"] - before) / 0.2
        assert reward([mean - 1, mean + 1], 0.1, throttle, steer, 500.0, terminated) == pytest.approx(theirs)
    assert reward([0.0], 0.05, 0.0, 0.0, 0.0, True) == -20.0
    assert make_reward("highway", max_speed=15.0)([15.0], 0.05, 0.0, 0.0, 0.0, False) == 1.0


@pytest.mark.parametrize(
    ("name", "amount"), [("steer_cost", 1.0), ("brake_cost", 1.0), ("collision_cost", 10.0), ("crash_penalty", 1.0)]
)
def test_reward_weights(name: str, amount: float) -> None:
    none = {"steer_cost": 0.0, "brake_cost": 0.0, "collision_cost": 0.0, "crash_penalty": 0.0}
    plain, weighted = (make_reward("highway", **options) for options in (none, {**none, name: 2.0}))
    situation = ([15.0], 0.05, -1.0, 1.0, 10.0, True)
    assert plain(*situation) == pytest.approx(0.5)
    assert weighted(*situation) == pytest.approx(0.5 - 2 * amount)
    with pytest.raises(ValueError, match=f"{name} must be at least 0"):
        make_reward("highway", **{name: -20.0})


# ---- ends of an episode ----


def test_distance_follows_the_lane() -> None:
    trip = Trip()
    for speed in (10.0, 20.0, -4.0):
        trip.tick(speed, abs(speed), 0.05, False)
    assert trip.distance == pytest.approx(1.3)


def test_standstill_is_counted_without_interruption() -> None:
    trip = Trip()
    for _ in range(99):
        trip.tick(0.0, 0.0, 0.05, False)
    assert not trip.stuck(5.0)
    trip.tick(0.0, 0.9 * STANDSTILL_SPEED, 0.05, False)
    assert trip.stuck(5.0) and not trip.stuck(math.inf)
    trip.tick(0.0, 1.1 * STANDSTILL_SPEED, 0.05, False)  # sideways
    trip.tick(0.0, 0.0, 0.05, False)
    assert not trip.stuck(5.0) and trip.stuck(0.05)


def test_a_trip_stays_offroad() -> None:
    trip = Trip()
    for offroad, expected in ((False, False), (True, True), (False, True)):
        trip.tick(9.0, 9.0, 0.05, offroad)
        assert trip.offroad == expected


# ---- actions and places ----


@pytest.mark.parametrize(
    ("action", "expected"),
    [((0.0, 0.0), (0.0, 0.0, 0.0)), ((0.7, 0.5), (0.7, 0.25, 0.0)), ((-0.7, -1.0), (0.0, -0.5, 0.7))],
)
def test_pedals(action: tuple[float, float], expected: tuple[float, float, float]) -> None:
    assert pedals(*action, 10.0, 30.0, 0.5) == pytest.approx(expected)


def test_the_throttle_closes_at_top_speed() -> None:
    assert [pedals(1.0, 0.0, speed, 30.0, 1.0)[0] for speed in (29.9, 30.0)] == [1.0, 0.0]
    assert pedals(-1.0, 0.0, 31.0, 30.0, 1.0)[2] == 1.0


def test_steering_gain() -> None:
    assert steering_gain(None, 70.0) == 1.0
    assert steering_gain(math.radians(7.0), 70.0) == pytest.approx(0.1)
    with pytest.raises(ValueError, match=r"steering_range 1.5 rad exceeds the vehicle's lock of 1.222 rad"):
        steering_gain(1.5, 70.0)


@pytest.mark.parametrize("s_range", [EGO_RANGE, TRAFFIC_RANGE])
def test_places_cover_their_range_and_all_lanes(s_range: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    places = [draw_place(rng, 4, s_range) for _ in range(400)]
    counts = {lane: sum(found == lane for found, _ in places) for lane in (-1, -2, -3, -4)}
    assert sum(counts.values()) == 400 and min(counts.values()) > 60
    along = np.array([s for _, s in places])
    assert s_range[0] <= along.min() and along.max() <= s_range[1] and np.ptp(along) > 0.98 * np.ptp(s_range)


# ---- options ----


def test_dvs_attributes() -> None:
    given = {"threshold": (0.2, 0.4), "threshold_sigma": 0.1, "refractory": 1e-4, "mapping": "identity", "log_eps": 0}
    assert dvs_attributes(event_options(given)) == {
        "positive_threshold": "0.2",
        "negative_threshold": "0.4",
        "sigma_positive_threshold": "0.1",
        "sigma_negative_threshold": "0.1",
        "refractory_period_ns": "100000",
        "use_log": "false",
        "log_eps": "0.0",
    }
    default = dvs_attributes(event_options(None))
    assert default["positive_threshold"] == default["negative_threshold"] == "0.3" and default["use_log"] == "true"


def test_options_of_highway_vision_without_effect_are_accepted() -> None:
    given = {"bins": 3, "leak_rate": 0.0, "shot_rate": 0, "cutoff_hz": None, "seed": 0, "subframes": 5}
    assert event_options(given) == {**event_options(None), "bins": 3}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"event": {"leak_rate": 0.1}}, "does not support leak_rate=0.1"),
        ({"event": {"subframes": 4}}, "does not support subframes=4"),
        ({"event": {"thresold": 0.3}}, r"unknown event option \['thresold'\]"),
        ({"event": {"threshold": (0.3, -0.3)}}, "event threshold must be positive"),
        ({"event": {"refractory": -1.0}}, "event refractory must be at least 0"),
        ({"event": {"log_eps": 0}}, "event log_eps must be positive with mapping 'log'"),
        ({"event": {"mapping": "lin_log"}}, "'log' or 'identity' in CARLA, got 'lin_log'"),
        ({"event": {"representation": "histogram"}}, "representation"),
        ({"depth": {"encodings": "log"}}, "unknown depth option"),
        ({"weather": "Snow"}, "weather"),
        ({"modalities": ("rgb", "lidar")}, "modalities must be a non-empty subset"),
        ({"simulation_frequency": 5}, "simulation_frequency >= 10 Hz"),
        ({"policy_frequency": 3}, "must be a multiple of policy_frequency"),
        ({"reward": "dense"}, "reward must be one of"),
        ({"crash_penalty": -20.0}, "crash_penalty must be at least 0"),
        ({"render_mode": "human"}, "render_mode must be None or 'rgb_array'"),
        ({"scenario": "merge"}, "no scenario 'merge'; choose another road with `town` and `road_id`"),
    ],
)
def test_wrong_options_are_refused_before_connecting(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CarlaVisionEnv(**options)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"modalities": ("depth", "rgb"), "image_size": 32},
        {"event": {"bins": 3, "representation": "voxel"}},
        {"event": {"bins": 3, "representation": "polarity"}},
        {"event": EVENT_DEFAULTS},
        {"event": HIGHWAY_DEFAULTS},
    ],
    ids=str,
)
def test_spaces_equal_those_of_highway_vision(options: dict[str, Any]) -> None:
    ours, theirs = CarlaVisionEnv(**options), HighwayVisionEnv(**options)
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space


def test_paper_options() -> None:
    env = CarlaVisionEnv(**PAPER)
    assert env.observation_space["event"].shape == (128, 128, 5)  # type: ignore[index]
    # The reward does not depend on the top speed, which is beyond 250 km/h
    slow, fast = (make_reward("paper", max_speed=speed) for speed in (30.0, PAPER["max_speed"]))
    assert slow([40.0], 0.05, -0.5, 0.4, 9.0, True) == fast([40.0], 0.05, -0.5, 0.4, 9.0, True)
    assert PAPER["max_speed"] > 70


def test_importing_does_not_require_carla() -> None:
    code = (
        "import sys; sys.modules['carla'] = None\n"
        "import gymnasium, sb3_have, sb3_have.envs.carla_vision\n"
        "env = gymnasium.make('CarlaVision-v0')\n"
        "try: env.reset()\n"
        "except ImportError as error: assert \"pip install 'sb3_have[carla]'\" in str(error), error\n"
        "else: raise AssertionError('no error')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
