"""A drive in CARLA without CARLA: what it consists of and is worth, when it ends, pedals, places. Needs no client."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np

from sb3_have.sensors.checks import is_finite

RewardForm = Literal["paper", "highway"]

#: Arc lengths of the road within which the ego and the traffic are put [m].
EGO_RANGE: Final = (100.0, 110.0)
TRAFFIC_RANGE: Final = (114.0, 300.0)
#: A car slower than this stands still [m/s].
STANDSTILL_SPEED: Final = 0.1

# Defaults of the weights: the paper's reward knows impulses and no penalty, HighwayVision's the reverse.
_COLLISION_COST: Final = {"paper": 0.001, "highway": 0.0}
_CRASH_PENALTY: Final = {"paper": 0.0, "highway": 20.0}
#: Defaults of the ends: ticks with a collision and seconds without moving; HighwayVision's first collision is its last.
COLLISION_TICKS: Final = {"paper": 20, "highway": 1}
STANDSTILL_TIME: Final = {"paper": 5.0, "highway": math.inf}


class CarlaConnectionError(ConnectionError):
    """There is no CARLA server, or it has gone."""


@dataclass(frozen=True)
class Server:
    """
    Which server to connect to, and how it is to run.

    :param host: Its name or address.
    :param port: Its RPC port.
    :param tm_port: Port for the traffic manager.
    :param town: The map.
    :param tick: Length of a simulation tick [s].
    :param timeout: For every call [s].
    :param traffic: Whether there will be traffic, and so a traffic manager.
    :param take_over: Whether to take it from a client that left it in synchronous mode.
    """

    host: str
    port: int
    tm_port: int
    town: str
    tick: float
    timeout: float
    traffic: bool
    take_over: bool = False


@dataclass(frozen=True)
class Plan:
    """What an episode consists of; the options of :class:`CarlaVisionEnv` by the same names."""

    modalities: tuple[str, ...]
    image_size: int
    event: Mapping[str, Any]
    event_grace: float
    depth: Mapping[str, Any]
    vehicles_count: int
    traffic_speed: tuple[float, float] | None
    lanes_count: int
    road_id: int
    ego_vehicle: str
    initial_speed: float
    max_speed: float
    steering_range: float | None


@dataclass(frozen=True)
class Reward:
    """
    The reward of a control step of n simulation ticks of dt seconds each.

    - ``"paper"``, per tick and summed: ``v_s dt - brake_cost brake - steer_cost |steer|``
    - ``"highway"``, as HighwayVision-v0: ``mean v_s / max_speed - brake_cost brake - steer_cost |steer|``

    and in both forms less collision_cost times the sum of the impulses of the step's collisions [N s], and less
    crash_penalty in the step that ends in a crash or off the road. v_s is the speed along the lane [m/s], brake lies
    in 0..1 and steer, the action's, in -1..1.

    :param form: One of the two.
    :param steer_cost: Weight of steering.
    :param brake_cost: Weight of braking.
    :param collision_cost: Per newton second; None: 0.001 in the paper's form, 0 in the other.
    :param crash_penalty: None: 0 in the paper's form, 20 in the other.
    :param max_speed: In m/s.
    :raises ValueError: on an unknown form, a weight below 0 or a top speed that is not positive.
    """

    form: RewardForm = "paper"
    steer_cost: float = 0.1
    brake_cost: float = 0.1
    collision_cost: float | None = None
    crash_penalty: float | None = None
    max_speed: float = 30.0

    def __post_init__(self) -> None:
        if self.form not in get_args(RewardForm):
            raise ValueError(f"reward must be one of {get_args(RewardForm)}, got {self.form!r}")
        if not (is_finite(self.max_speed) and self.max_speed > 0):
            raise ValueError(f"max_speed must be a positive number, got {self.max_speed!r}")
        for name in ("steer_cost", "brake_cost", "collision_cost", "crash_penalty"):
            weight = getattr(self, name)
            if weight is not None and not (is_finite(weight) and weight >= 0):
                raise ValueError(f"{name} must be a number >= 0 (it is subtracted from the reward), got {weight!r}")

    def __call__(
        self, speeds: Sequence[float], dt: float, throttle: float, steer: float, impulse: float, failed: bool
    ) -> float:
        """
        :param speeds: v_s after each tick [m/s].
        :param dt: Length of a tick [s].
        :param throttle: The first action, -1..1; below 0 it brakes.
        :param steer: The second action, -1..1.
        :param impulse: Sum over the step's collisions of the size of the impulse [N s].
        :param failed: The step ended in a crash or off the road.
        """
        effort = self.brake_cost * max(0.0, -throttle) + self.steer_cost * abs(steer)
        if self.form == "paper":
            reward = sum(speeds) * dt - len(speeds) * effort
        else:
            reward = sum(speeds) / len(speeds) / self.max_speed - effort
        collision_cost = _COLLISION_COST[self.form] if self.collision_cost is None else self.collision_cost
        crash_penalty = _CRASH_PENALTY[self.form] if self.crash_penalty is None else self.crash_penalty
        return reward - collision_cost * impulse - crash_penalty * failed


class Trip(NamedTuple):
    """An episode so far: metres along the lane, ticks with a collision, seconds without moving, the road left."""

    distance: float = 0.0
    collisions: int = 0
    still: float = 0.0
    offroad: bool = False

    def tick(self, lane_speed: float, speed: float, dt: float, offroad: bool) -> Trip:
        """
        One simulation tick on.

        :param lane_speed: Speed along the lane [m/s].
        :param speed: Speed in any direction [m/s].
        :param dt: Length of the tick [s].
        :param offroad: The car has left the road; it stays so to the end of the episode.
        """
        still = self.still + dt if speed < STANDSTILL_SPEED else 0.0
        return Trip(self.distance + lane_speed * dt, self.collisions, still, self.offroad or offroad)

    def collide(self, ticks: int) -> Trip:
        """So many more ticks with a collision."""
        return self._replace(collisions=self.collisions + ticks)

    def crashed(self, collision_ticks: int) -> bool:
        """As many ticks with a collision as end an episode."""
        return self.collisions >= collision_ticks

    def stuck(self, standstill_time: float) -> bool:
        """Has not moved for so long [s]. Sums of ticks are compared with a margin for rounding."""
        return self.still > standstill_time - 1e-6


class Pedals(NamedTuple):
    """CARLA's vehicle control: throttle and brake in 0..1, steer in -1..1, positive to the right."""

    throttle: float
    steer: float
    brake: float


def pedals(throttle: float, steer: float, speed: float, max_speed: float, gain: float) -> Pedals:
    """
    The control for an action.

    :param throttle: First action, -1..1: throttle above 0, brake below.
    :param steer: Second action, -1..1, positive to the right.
    :param speed: Of the car [m/s]; the throttle closes at ``max_speed``.
    :param max_speed: In m/s.
    :param gain: Of the steering, see :func:`steering_gain`.
    """
    accelerate = throttle if speed < max_speed else 0.0
    return Pedals(max(0.0, float(accelerate)), float(steer * gain), max(0.0, float(-throttle)))


def steering_gain(steering_range: float | None, lock: float) -> float:
    """
    Share of the vehicle's lock that the action ``steer`` = 1 turns the wheels by.

    :param steering_range: Wanted angle of the front wheels [rad], or None for the full lock.
    :param lock: The vehicle's greatest angle [degrees], ``max_steer_angle`` of its front wheels.
    :raises ValueError: if the vehicle cannot turn its wheels as far.
    """
    if steering_range is None:
        return 1.0
    gain = steering_range / math.radians(lock)
    if gain > 1:
        raise ValueError(
            f"steering_range {steering_range} rad is beyond the vehicle's lock of {math.radians(lock):.3f} rad; "
            "choose at most that, or None for the full lock"
        )
    return gain


class Place(NamedTuple):
    """A place on a road of the map: OpenDRIVE lane id (negative: to the right, driving along s) and arc length [m]."""

    lane: int
    s: float


def draw_place(rng: np.random.Generator, lanes_count: int, s_range: tuple[float, float]) -> Place:
    """
    A random place in one of the lanes -1 to -``lanes_count``.

    :param rng: Source of the draw.
    :param lanes_count: Number of lanes.
    :param s_range: Least and greatest arc length [m].
    """
    lane = -1 - int(rng.integers(lanes_count))
    return Place(lane, float(rng.uniform(*s_range)))
