"""What CarlaVision-v0 computes by itself: rewards, ends, pedals, places, decoding, queues, options. No CARLA here."""

import math
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

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
    DVS_DTYPE,
    Inbox,
    copy_events,
    copy_image,
    decode_depth_image,
    decode_dvs,
    decode_rgb,
    dvs_attributes,
    event_options,
    impulse,
)
from sb3_have.envs.highway_vision import HighwayVisionEnv
from sb3_have.sensors import EVENT_DTYPE, stack_by_time

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
        ({"steer_cost": -0.1}, "steer_cost must be >= 0"),
        ({"brake_cost": math.nan}, "brake_cost must be >= 0"),
        ({"collision_cost": -1.0}, "collision_cost must be >= 0"),
        ({"crash_penalty": math.inf}, "crash_penalty must be >= 0"),
        ({"max_speed": 0.0}, "max_speed must be positive"),
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
    assert not trip.tick(0.0, 0.0, 0.05, False).stuck(None)


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


# ---- decoding ----


def test_colours_come_in_the_order_red_green_blue() -> None:
    pixels = np.zeros((2, 3, 4), dtype=np.uint8)
    pixels[0, 1] = (10, 20, 30, 255)  # blue, green, red, alpha
    decoded = decode_rgb(pixels)
    assert decoded.shape == (2, 3, 3) and decoded.flags.c_contiguous
    assert decoded[0, 1].tolist() == [30, 20, 10] and decoded.sum() == 60


@pytest.mark.parametrize(
    ("red", "green", "blue", "metres"),
    [
        (0, 0, 0, 0.0),
        (1, 0, 0, 1000 / 16777215),
        (0, 1, 0, 256000 / 16777215),
        (0, 0, 1, 65536000 / 16777215),
        (0, 0, 128, 500.00003),
        (254, 255, 255, 1000 * 16777214 / 16777215),
        (255, 255, 255, math.inf),
    ],
)
def test_depth_by_hand(red: int, green: int, blue: int, metres: float) -> None:
    pixels = np.array([[[blue, green, red, 255]]], dtype=np.uint8)
    decoded = decode_depth_image(pixels)
    assert decoded.shape == (1, 1) and decoded.dtype == np.float32
    assert decoded[0, 0] == pytest.approx(metres, rel=1e-6)


def dvs(*events: tuple[int, int, int, bool]) -> NDArray[np.void]:
    return np.array(list(events), dtype=DVS_DTYPE)


def test_events_keep_their_places_and_get_times_of_the_step() -> None:
    start = 37_250_000_000
    first = dvs((3, 1, start + 10_000_000, True), (0, 2, start + 50_000_000, False))
    second = dvs((3, 1, start + 60_000_000, False))
    events = decode_dvs([first, second], start, 0.2)
    assert events.dtype == EVENT_DTYPE
    assert events["x"].tolist() == [3, 0, 3] and events["y"].tolist() == [1, 2, 1]
    np.testing.assert_allclose(events["t"], [0.01, 0.05, 0.06], atol=1e-12)
    assert events["p"].tolist() == [1, -1, -1]
    image = stack_by_time(events, 4, 0.0, 0.2, 4, 5)
    assert image[1, 3].tolist() == [1, -1, 0, 0] and image[2, 0].tolist() == [0, -1, 0, 0]


def test_rounding_to_nanoseconds_loses_no_event() -> None:
    start = int(1e9 * 0.1 * 3)  # 300000000.00000006 rounded down
    events = decode_dvs([dvs((0, 0, start - 1, True), (0, 0, start + 200_000_001, True))], start, 0.2)
    assert stack_by_time(events, 5, 0.0, 0.2, 1, 1)[0, 0].tolist() == [1, 0, 0, 0, 1]
    assert len(decode_dvs([], start, 0.2)) == 0


def test_what_the_callbacks_copy() -> None:
    buffer = bytearray(range(24))
    image = SimpleNamespace(raw_data=memoryview(buffer), width=3, height=2)
    pixels = copy_image(image)
    stream = bytearray(dvs((7, 8, 9, True)).tobytes())
    events = copy_events(SimpleNamespace(raw_data=memoryview(stream)))
    for index in range(len(buffer)):
        buffer[index] = 0  # CARLA reuses its buffers
    stream[:] = bytes(len(stream))
    assert pixels.shape == (2, 3, 4) and pixels[1, 2].tolist() == [20, 21, 22, 23]
    assert events.tolist() == [(7, 8, 9, True)]
    assert impulse(SimpleNamespace(normal_impulse=SimpleNamespace(x=2.0, y=-3.0, z=6.0))) == 7.0


# ---- queues ----


def data(frame: int, value: Any = None) -> Any:
    return SimpleNamespace(frame=frame, value=value)


def inbox() -> Inbox[Any]:
    return Inbox("rgb", lambda data: data.value)


def test_an_image_of_the_frame_is_found_behind_older_ones() -> None:
    box = inbox()
    for frame in (3, 4, 5):
        box(data(frame, 10 * frame))
    assert box.at(5, 1.0) == 50


def test_an_image_may_come_later() -> None:
    box = inbox()
    sender = threading.Timer(0.05, box, [data(5, "late")])
    sender.start()
    assert box.at(5, 5.0) == "late"
    sender.join()


def test_an_image_that_does_not_come() -> None:
    box = inbox()
    box(data(4))
    with pytest.raises(TimeoutError, match=r"no data of frame 5 from the rgb sensor within 0.02 s .* raise `timeout`"):
        box.at(5, 0.02)


def test_an_image_of_a_later_frame_means_somebody_else_ticks() -> None:
    box = inbox()
    box(data(6))
    with pytest.raises(RuntimeError, match="rgb sensor sent frame 6 when frame 5 was due"):
        box.at(5, 1.0)


def test_an_exception_in_a_callback_is_raised_where_the_data_is_read() -> None:
    reads: tuple[Callable[[Inbox[Any]], Any], ...] = (lambda box: box.at(5, 1.0), lambda box: box.drain())
    for read in reads:
        box: Inbox[Any] = Inbox("depth", lambda data: 1 / 0)
        box(data(5))  # CARLA would swallow it here
        with pytest.raises(RuntimeError, match="callback of the depth sensor failed: ZeroDivisionError") as caught:
            read(box)
        assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_all_that_has_come_is_drained_with_its_frames() -> None:
    box = inbox()
    assert box.drain() == []
    for frame in (3, 3, 5):
        box(data(frame, frame))
    assert box.drain() == [(3, 3), (3, 3), (5, 5)]
    assert box.drain() == []


def test_draining_waits_for_the_frame_and_no_longer() -> None:
    class Items(queue.SimpleQueue[Any]):
        waits: list[float] = []  # noqa: RUF012

        def get(self, block: bool = True, timeout: float | None = None) -> Any:
            assert timeout is not None
            self.waits.append(timeout)
            if len(self.waits) == 2:
                box(data(5, "new"))
            return super().get(block, min(timeout, 1.0))

    box = inbox()
    box._items = Items()
    box(data(4, "old"))
    assert box.drain(5, 60.0) == [(4, "old"), (5, "new")]
    assert len(Items.waits) == 3 and Items.waits[1] > 0 and Items.waits[2] == 0
    assert box.drain(6, 0.01) == []


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
    given = {"bins": 3, "leak_rate": 0.0, "shot_rate": 0, "cutoff_hz": None, "seed": None, "subframes": None}
    assert event_options(given) == {**event_options(None), "bins": 3}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"event": {"leak_rate": 0.1}}, "leak_rate=0.1 means nothing .* leave it out"),
        ({"event": {"shot_rate": 1.0}}, "shot_rate=1.0 means nothing"),
        ({"event": {"subframes": 5}}, "subframes=5 means nothing .* raise simulation_frequency"),
        ({"event": {"seed": 0}}, "seed=0 means nothing"),
        ({"event": {"cutoff_hz": 100.0}}, "cutoff_hz=100.0 means nothing"),
        ({"event": {"thresold": 0.3}}, r"unknown event option \['thresold'\]"),
        ({"event": {"threshold": 0.0}}, "event threshold must be positive"),
        ({"event": {"threshold": (0.3, -0.3)}}, "event threshold must be positive"),
        ({"event": {"refractory": -1.0}}, "event refractory must be >= 0"),
        ({"event": {"mapping": "lin_log"}}, "'log' or 'identity', got 'lin_log'"),
        ({"event": {"representation": "histogram"}}, "representation must be one of"),
        ({"event": {"bins": 0}}, "bins"),
        ({"depth": {"encodings": "log"}}, r"unknown depth option \['encodings'\]"),
        ({"depth": {"encoding": "linear"}}, "depth encoding must be one of"),
        ({"depth": {"max": 50.0}}, "no effect with encoding 'log'"),
        ({"weather": "Snow"}, "weather must be 'random' or among"),
        ({"modalities": ("rgb", "lidar")}, "modalities must be a non-empty subset"),
        ({"image_size": 8}, "image_size must be a whole number >= 16"),
        ({"vehicles_count": -1}, "vehicles_count must be a whole number >= 0"),
        ({"lanes_count": 0}, "lanes_count must be a whole number >= 1"),
        ({"max_episode_steps": 0}, "max_episode_steps must be a whole number >= 1"),
        ({"simulation_frequency": 5}, "simulation_frequency must be a whole number >= 10"),
        ({"policy_frequency": 3}, "must be a multiple of policy_frequency"),
        ({"collision_ticks": 0}, "collision_ticks must be a whole number >= 1"),
        ({"tm_port": 80}, "tm_port must be a whole number >= 1024"),
        ({"traffic_speed": (24.0, 21.0)}, "traffic_speed must be None or a range"),
        ({"initial_speed": 31.0}, r"initial_speed must lie in 0..max_speed"),
        ({"steering_range": 0.0}, "steering_range must be positive"),
        ({"standstill_time": -1.0}, "standstill_time must be positive"),
        ({"timeout": 0.0}, "timeout must be positive"),
        ({"reward": "dense"}, "reward must be one of"),
        ({"crash_penalty": -1.0}, "crash_penalty must be >= 0"),
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


def test_the_papers_options_are_options() -> None:
    env = CarlaVisionEnv(**PAPER)
    assert env.observation_space["event"].shape == (128, 128, 5)  # type: ignore[index]


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
