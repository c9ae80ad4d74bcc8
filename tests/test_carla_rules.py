"""What CarlaVision-v0 computes by itself: rewards, ends, pedals, places, options. No CARLA here."""

import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from sb3_have.envs.carla_vision import PAPER, CarlaVisionEnv
from sb3_have.envs.carla_vision.rules import (
    EGO_RANGE,
    STANDSTILL_SPEED,
    TRAFFIC_RANGE,
    Reward,
    Trip,
    draw_place,
    pedals,
    steering_gain,
)
from sb3_have.envs.carla_vision.sensors import (
    dvs_attributes,
    event_options,
)
from sb3_have.envs.highway_vision import HighwayVisionEnv

# ---- rewards ----


def test_the_papers_reward_by_hand() -> None:
    reward = Reward("paper")
    assert reward([25.0], 0.05, 1.0, 0.0, 0.0, False) == pytest.approx(1.25)
    assert reward([25.0], 0.05, -0.5, -0.4, 300.0, False) == pytest.approx(1.25 - 0.05 - 0.04 - 0.3)
    assert reward([-2.0], 0.05, 0.0, 1.0, 0.0, True) == pytest.approx(-0.1 - 0.1)


def test_the_papers_reward_of_a_step_is_the_sum_of_its_ticks() -> None:
    reward, speeds = Reward("paper"), [20.0, 21.0, 19.5, 18.0]
    ticks = [reward([speed], 0.05, -0.3, 0.6, 0.0, False) for speed in speeds]
    assert reward(speeds, 0.05, -0.3, 0.6, 40.0, False) == pytest.approx(sum(ticks) - 0.04)


def test_the_reward_of_the_highway_is_that_of_highway_vision() -> None:
    env = HighwayVisionEnv(image_size=16, vehicles_count=0, modalities=("depth",), initial_speed=20.0)
    env.reset(seed=0)
    reward = Reward("highway")
    for throttle, steer in ((0.5, 0.0), (-0.4, 0.3), (1.0, -1.0)):
        before = env._distance
        _, theirs, terminated, _, info = env.step(np.array([throttle, steer]))
        mean = (info["distance"] - before) / 0.2
        assert reward([mean - 1, mean + 1], 0.1, throttle, steer, 500.0, terminated) == pytest.approx(theirs)
    assert reward([0.0], 0.05, 0.0, 0.0, 0.0, True) == -20.0


def test_weights_of_the_reward() -> None:
    plain = Reward("highway", 0.0, 0.0, 0.0, 0.0)([15.0], 0.05, -1.0, 1.0, 10.0, True)
    assert plain == pytest.approx(0.5)
    weights = [("steer_cost", 1.0), ("brake_cost", 1.0), ("collision_cost", 10.0), ("crash_penalty", 1.0)]
    for name, amount in weights:
        options = {**{key: 0.0 for key, _ in weights}, name: 2.0}
        assert Reward("highway", **options)([15.0], 0.05, -1.0, 1.0, 10.0, True) == pytest.approx(plain - 2 * amount)
    assert Reward("highway", max_speed=15.0)([15.0], 0.05, 0.0, 0.0, 0.0, False) == 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"form": "sparse"}, "reward must be one of"),
        ({"steer_cost": -0.1}, "steer_cost must be a number >= 0"),
        ({"steer_cost": "x"}, "steer_cost must be a number >= 0 .*'x'"),
        ({"brake_cost": math.nan}, "brake_cost must be a number >= 0"),
        ({"collision_cost": -1.0}, "collision_cost must be a number >= 0"),
        ({"crash_penalty": math.inf}, "crash_penalty must be a number >= 0"),
        ({"max_speed": 0.0}, "max_speed must be a positive number"),
        ({"max_speed": "x"}, "max_speed must be a positive number, got 'x'"),
    ],
)
def test_rewards_that_make_no_sense(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Reward(**options)


# ---- ends ----


def test_distance_is_the_sum_of_the_speed_along_the_lane() -> None:
    trip = Trip()
    for speed in (10.0, 20.0, -4.0):
        trip = trip.tick(speed, abs(speed), 0.05, False)
    assert trip.distance == pytest.approx(1.3)


def test_collisions_add_up_to_a_crash() -> None:
    trip = Trip().collide(3).collide(0).tick(5.0, 5.0, 0.05, False).collide(16)
    assert trip.collisions == 19 and not trip.crashed(20)
    assert trip.collide(1).crashed(20) and trip.crashed(19)


def test_a_standstill_counts_only_in_a_row() -> None:
    trip = Trip()
    for _ in range(99):
        trip = trip.tick(0.0, 0.0, 0.05, False)
    assert not trip.stuck(5.0)
    assert trip.tick(0.0, 0.9 * STANDSTILL_SPEED, 0.05, False).stuck(5.0)
    moved = trip.tick(0.0, 1.1 * STANDSTILL_SPEED, 0.05, False)  # sideways, too
    assert moved.still == 0 and not moved.tick(0.0, 0.0, 0.05, False).stuck(5.0)
    assert not trip.tick(0.0, 0.0, 0.05, False).stuck(math.inf)


def test_off_the_road_is_not_forgotten() -> None:
    trip = Trip().tick(9.0, 9.0, 0.05, False)
    assert not trip.offroad
    assert trip.tick(9.0, 9.0, 0.05, True).tick(9.0, 9.0, 0.05, False).offroad


# ---- actions and places ----


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ((0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.7, 0.5), (0.7, 0.25, 0.0)),
        ((-0.7, -1.0), (0.0, -0.5, 0.7)),
        ((1.0, 1.0), (1.0, 0.5, 0.0)),
    ],
)
def test_throttle_brakes_below_zero_and_steers_to_the_same_side(
    action: tuple[float, float], expected: tuple[float, ...]
) -> None:
    control = pedals(*action, speed=10.0, max_speed=30.0, gain=0.5)
    assert control == pytest.approx(expected)
    assert all(type(value) is float for value in control)  # CARLA takes no numpy numbers


def test_the_throttle_closes_at_top_speed_and_the_brake_does_not() -> None:
    assert pedals(1.0, 0.0, 29.9, 30.0, 1.0).throttle == 1.0
    assert pedals(1.0, 0.0, 30.0, 30.0, 1.0).throttle == 0.0
    assert pedals(-1.0, 0.0, 31.0, 30.0, 1.0).brake == 1.0


def test_steering_by_an_angle_of_the_wheels() -> None:
    assert steering_gain(None, 70.0) == 1.0
    assert steering_gain(math.radians(7.0), 70.0) == pytest.approx(0.1)
    assert steering_gain(math.radians(70.0), 70.0) == pytest.approx(1.0)
    with pytest.raises(ValueError, match=r"steering_range 1.5 rad is beyond the vehicle's lock of 1.222 rad"):
        steering_gain(1.5, 70.0)


@pytest.mark.parametrize("s_range", [EGO_RANGE, TRAFFIC_RANGE])
def test_places_cover_their_range_and_their_lanes(s_range: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    places = [draw_place(rng, 4, s_range) for _ in range(400)]
    counts = {lane: sum(place.lane == lane for place in places) for lane in (-1, -2, -3, -4)}
    assert sum(counts.values()) == 400 and min(counts.values()) > 60
    along = np.array([place.s for place in places])
    assert s_range[0] <= along.min() and along.max() <= s_range[1]
    assert np.ptp(along) > 0.98 * (s_range[1] - s_range[0])
    again = np.random.default_rng(0)
    assert places == [draw_place(again, 4, s_range) for _ in range(400)]
    assert {draw_place(rng, 1, s_range).lane for _ in range(20)} == {-1}


# ---- options ----


def test_options_of_the_event_camera_become_attributes_of_the_sensor() -> None:
    options = event_options(
        {"threshold": (0.2, 0.4), "threshold_sigma": 0.1, "refractory": 1e-4, "mapping": "identity", "log_eps": 0.01}
    )
    assert dvs_attributes(options) == {
        "positive_threshold": "0.2",
        "negative_threshold": "0.4",
        "sigma_positive_threshold": "0.1",
        "sigma_negative_threshold": "0.1",
        "refractory_period_ns": "100000",
        "use_log": "false",
        "log_eps": "0.01",
    }
    usual = dvs_attributes(event_options(None))
    assert usual["positive_threshold"] == usual["negative_threshold"] == "0.3" and usual["use_log"] == "true"


def test_options_that_say_nothing_are_taken_from_highway_vision() -> None:
    given = {"bins": 3, "leak_rate": 0.0, "shot_rate": 0, "cutoff_hz": None, "seed": 0, "subframes": 5}
    assert event_options(given) == {**event_options(None), "bins": 3}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"event": {"leak_rate": 0.1}}, "leak_rate=0.1 means nothing .* leave it out"),
        ({"event": {"shot_rate": 1.0}}, "shot_rate=1.0 means nothing"),
        ({"event": {"subframes": 4}}, "subframes=4 means nothing .* raise simulation_frequency"),
        ({"event": {"seed": 1}}, "seed=1 means nothing"),
        ({"event": {"cutoff_hz": 100.0}}, "cutoff_hz=100.0 means nothing"),
        ({"event": {"thresold": 0.3}}, r"unknown event option \['thresold'\]"),
        ({"event": {"threshold": 0.0}}, "event threshold must be one positive number"),
        ({"event": {"threshold": (0.3, -0.3)}}, "event threshold must be one positive number"),
        ({"event": {"threshold": (0.1, 0.2, 0.3)}}, r"event threshold must be .* a pair .*got \(0.1, 0.2, 0.3\)"),
        ({"event": {"threshold": "x"}}, "event threshold must be .*got 'x'"),
        ({"event": {"refractory": -1.0}}, "event refractory must be a number >= 0"),
        ({"event": {"refractory": "x"}}, "event refractory must be a number >= 0, got 'x'"),
        ({"event": {"log_eps": 0}}, "event log_eps must be > 0 with mapping 'log'"),
        ({"event": {"representation": "time_surface", "tau": "x"}}, "tau must be a finite number .*'x'"),
        ({"event": {"mapping": "lin_log"}}, "'log' or 'identity', got 'lin_log'"),
        ({"event": {"representation": "histogram"}}, "representation must be one of"),
        ({"event": {"bins": 0}}, "event bins must be a whole number >= 1, got 0"),
        ({"event": {"bins": 2.5}}, "event bins must be a whole number >= 1, got 2.5"),
        ({"depth": {"encodings": "log"}}, r"unknown depth option \['encodings'\]"),
        ({"depth": {"encoding": "linear"}}, "depth encoding must be one of"),
        ({"depth": {"max": 50.0}}, "no effect with encoding 'log'"),
        ({"depth": {"encoding": "clipped", "max": "x"}}, "maximum depth must be finite .*'x'"),
        ({"weather": "Snow"}, "weather must be 'random' or among"),
        ({"modalities": ("rgb", "lidar")}, "modalities must be a non-empty subset"),
        ({"image_size": 8}, "image_size must be a whole number >= 16"),
        ({"vehicles_count": -1}, "vehicles_count must be a whole number >= 0"),
        ({"lanes_count": 0}, "lanes_count must be a whole number >= 1"),
        ({"max_episode_steps": 0}, "max_episode_steps must be a whole number >= 1"),
        ({"simulation_frequency": 5}, "simulation_frequency must be a whole number >= 10"),
        ({"policy_frequency": 3}, "must be a multiple of policy_frequency"),
        ({"collision_ticks": 0}, "collision_ticks must be a whole number >= 1"),
        ({"tm_port": 80}, r"tm_port must be a whole number in 1024\.\.65535"),
        ({"port": 70000}, r"port must be a whole number in 1\.\.65535, got 70000"),
        ({"road_id": "x"}, "road_id must be a whole number >= 0, got 'x'"),
        ({"traffic_speed": (24.0, 21.0)}, "traffic_speed must be None or .*least, greatest"),
        ({"traffic_speed": (1.0, math.inf)}, "traffic_speed must be None or .*finite"),
        ({"traffic_speed": ("1", "2")}, "traffic_speed must be None or .*'1', '2'"),
        ({"initial_speed": 31.0}, r"initial_speed must be a number in 0..max_speed"),
        ({"initial_speed": "1"}, r"initial_speed must be a number in 0..max_speed .*'1'"),
        ({"steering_range": 0.0}, "steering_range must be a positive number"),
        ({"standstill_time": -1.0}, "standstill_time must be a positive number"),
        ({"standstill_time": "x"}, "standstill_time must be a positive number, got 'x'"),
        ({"timeout": 0.0}, "timeout must be a positive number"),
        ({"timeout": None}, "timeout must be a positive number, got None"),
        ({"event_grace": "x"}, "event_grace must be a number >= 0, got 'x'"),
        ({"reward": "dense"}, "reward must be one of"),
        ({"crash_penalty": -1.0}, "crash_penalty must be a number >= 0"),
        ({"render_mode": "human"}, "render_mode must be None or 'rgb_array'"),
        ({"scenario": "merge"}, "no scenario 'merge'; choose another road by `town` and `road_id`"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_there_is_a_server(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CarlaVisionEnv(**options)


def test_spaces_are_those_of_highway_vision() -> None:
    choices: list[dict[str, Any]] = [
        {},
        {"modalities": ("depth", "rgb"), "image_size": 32},
        {"event": {"bins": 3, "representation": "voxel"}},
    ]
    for options in choices:
        ours, theirs = CarlaVisionEnv(**options), HighwayVisionEnv(**options)
        assert ours.observation_space == theirs.observation_space
        assert ours.action_space == theirs.action_space
    env = CarlaVisionEnv(event={"bins": 3, "representation": "polarity"})
    assert env.observation_space["event"].shape == (84, 84, 6)  # type: ignore[index]


def test_numbers_of_numpy_and_the_ends_of_the_ranges_are_options() -> None:
    options: dict[str, Any] = {
        "port": 65535,
        "road_id": np.int64(0),
        "initial_speed": np.float32(30),
        "traffic_speed": np.array([1, 2]),
        "standstill_time": math.inf,
        "event": {"bins": np.int64(2), "threshold": np.array([0.1, 0.2])},
    }
    CarlaVisionEnv(**options)
    assert dvs_attributes(event_options({"mapping": "identity", "log_eps": 0}))["log_eps"] == "0.0"


def test_the_papers_options_are_options() -> None:
    env = CarlaVisionEnv(**PAPER)
    assert env.observation_space["event"].shape == (128, 128, 5)  # type: ignore[index]


def test_the_papers_car_has_no_top_speed() -> None:
    top = PAPER["max_speed"]
    assert top > 70  # beyond 250 km/h
    assert CarlaVisionEnv(**PAPER)._plan.max_speed == top
    slow, fast = (Reward(PAPER["reward"], max_speed=speed) for speed in (30.0, top))
    assert slow([40.0], 0.05, -0.5, 0.4, 9.0, True) == fast([40.0], 0.05, -0.5, 0.4, 9.0, True)


def test_importing_the_package_needs_no_carla() -> None:
    code = (
        "import sys; sys.modules['carla'] = None\n"
        "import gymnasium, sb3_have, sb3_have.envs.carla_vision\n"
        "env = gymnasium.make('CarlaVision-v0')\n"
        "try: env.reset()\n"
        "except ImportError as error: assert \"pip install 'sb3_have[carla]'\" in str(error), error\n"
        "else: raise AssertionError('no error')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
