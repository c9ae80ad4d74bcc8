"""The rules of CarlaVision-v0 that need no simulator: reward, ends of an episode, pedals, starting places."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

RewardForm = Literal["paper", "highway"]

# Arc lengths along the road where the ego vehicle and the traffic start [m]
EGO_RANGE: Final = (100.0, 110.0)
TRAFFIC_RANGE: Final = (114.0, 300.0)
# A slower car counts as standing still [m/s]
STANDSTILL_SPEED: Final = 0.1
# Defaults of the options that depend on the form of the reward
DEFAULTS: Final[Mapping[RewardForm, Mapping[str, Any]]] = {
    "paper": {"collision_cost": 0.001, "crash_penalty": 0.0, "collision_ticks": 20, "standstill_time": 5.0},
    "highway": {"collision_cost": 0.0, "crash_penalty": 20.0, "collision_ticks": 1, "standstill_time": math.inf},
}


class CarlaConnectionError(ConnectionError):
    """There is no CARLA server, or the connection to it was lost."""


@dataclass(frozen=True)
class Plan:
    """The options of :class:`CarlaVisionEnv` that an episode needs, under the same names."""

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
    The reward of a control step, which consists of n simulation ticks of dt seconds.

    - ``"paper"``: the sum over the ticks of ``v_s dt - brake_cost brake - steer_cost |steer|``
    - ``"highway"``: ``mean v_s / max_speed - brake_cost brake - steer_cost |steer|``, as in HighwayVision-v0

    Both subtract ``collision_cost`` times the impulses of the step's collisions [N s], and ``crash_penalty`` if the
    step ends in a crash or off the road. v_s is the speed along the lane [m/s]; brake is in 0..1 and steer, the
    action, in -1..1.

    :param form: "paper" or "highway"
    :param steer_cost: Weight of steering
    :param brake_cost: Weight of braking
    :param collision_cost: Weight of the impulses
    :param crash_penalty: Penalty for a crash or for leaving the road
    :param max_speed: Top speed [m/s]
    """

    form: RewardForm
    steer_cost: float
    brake_cost: float
    collision_cost: float
    crash_penalty: float
    max_speed: float

    def __post_init__(self) -> None:
        for name in ("steer_cost", "brake_cost", "collision_cost", "crash_penalty"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be at least 0, because it is subtracted from the reward")

    def __call__(
        self, speeds: Sequence[float], dt: float, throttle: float, steer: float, impulse: float, failed: bool
    ) -> float:
        """Compute the reward from v_s after each tick, the action, the impulses, and whether the episode failed."""
        effort = self.brake_cost * max(0.0, -throttle) + self.steer_cost * abs(steer)
        if self.form == "paper":
            reward = sum(speeds) * dt - len(speeds) * effort
        else:
            reward = sum(speeds) / len(speeds) / self.max_speed - effort
        return reward - self.collision_cost * impulse - self.crash_penalty * failed


@dataclass
class Trip:
    """Running totals of an episode: distance along the lane [m], colliding ticks, time at a standstill [s]."""

    distance: float = 0.0
    collisions: int = 0
    still: float = 0.0
    offroad: bool = False

    def tick(self, lane_speed: float, speed: float, dt: float, offroad: bool) -> None:
        """Add one simulation tick. A trip that left the road stays offroad until the end of the episode."""
        self.distance += lane_speed * dt
        self.still = self.still + dt if speed < STANDSTILL_SPEED else 0.0
        self.offroad = self.offroad or offroad

    def stuck(self, standstill_time: float) -> bool:
        """Whether the car has stood still for this long [s], up to the rounding of the sum of ticks."""
        return self.still > standstill_time - 1e-6


def pedals(
    throttle: float, steer: float, speed: float, max_speed: float, steering_gain: float
) -> tuple[float, float, float]:
    """Convert an action to CARLA's throttle (0..1), steer (-1..1) and brake (0..1). Negative throttle brakes."""
    return max(0.0, throttle) if speed < max_speed else 0.0, steer * steering_gain, max(0.0, -throttle)


def steering_gain(steering_range: float | None, lock: float) -> float:
    """Compute the fraction of the steering lock [degrees] that ``steering_range`` [rad] uses; None is the full lock."""
    if steering_range is None:
        return 1.0
    if steering_range > math.radians(lock):
        raise ValueError(
            f"steering_range {steering_range} rad exceeds the vehicle's lock of {math.radians(lock):.3f} rad; "
            "reduce it, or pass None for the full lock"
        )
    return steering_range / math.radians(lock)


def draw_place(rng: np.random.Generator, lanes_count: int, s_range: tuple[float, float]) -> tuple[int, float]:
    """Draw a starting place: OpenDRIVE lane id in -1..-lanes_count (right of the centre line) and arc length [m]."""
    return -1 - int(rng.integers(lanes_count)), float(rng.uniform(*s_range))
