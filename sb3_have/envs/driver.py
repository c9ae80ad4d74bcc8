"""
highway-env's IDM/MOBIL driver on a :class:`~sb3_have.envs.road.HighwayRoad`, bit for bit, in half the time.

A driver decides with a few dozen operations on single numbers, which are slow in NumPy. This module uses Python's
arithmetic, which rounds in the same way. Other functions remain NumPy's, because those of the C library may differ in
the last bit. The models are those of Treiber et al., "Congested traffic states in empirical observations and
microscopic simulations", Physical Review E 62, 2000 (IDM); Kesting et al., "General lane-changing model MOBIL for
car-following models", TRR 1999, 2007. The steering is highway-env's, a cascade of proportional controllers for lateral
position and heading.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.utils import not_zero, wrap_to_pi
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle


class Driver(IDMVehicle):
    """An ``IDMVehicle`` for a road along x that is longer than any episode."""

    speed: float
    heading: float
    crashed: bool
    impact: np.ndarray | None

    def act(self, action: Any = None) -> None:
        if self.crashed:
            return
        if self.enable_lane_change:
            self.change_lane_policy()
        acceleration = self.acceleration(self, *self.road.neighbour_vehicles(self, self.lane_index))
        if self.target_lane_index != self.lane_index:
            changing = self.acceleration(self, *self.road.neighbour_vehicles(self, self.target_lane_index))
            acceleration = min(acceleration, changing)
        self.action = {
            "steering": self.steering_control(self.target_lane_index),
            "acceleration": _clip(acceleration, -self.ACC_MAX, self.ACC_MAX),
        }

    def step(self, dt: float) -> None:
        self.timer += dt
        self.clip_actions()
        steering, speed, heading = self.action["steering"], float(self.speed), float(self.heading)
        slip_angle = float(np.arctan(0.5 * np.tan(steering)))
        course = heading + slip_angle
        x, y = self.position.tolist()
        x += speed * float(np.cos(course)) * dt
        y += speed * float(np.sin(course)) * dt
        self.position[:] = x, y
        if self.impact is not None:
            self.position += self.impact
            self.crashed = True
            self.impact = None
        self.heading = heading + speed * float(np.sin(slip_angle)) / (self.LENGTH / 2) * dt
        self.speed = speed + self.action["acceleration"] * dt
        self.on_state_update()

    def steering_control(self, target_lane_index: LaneIndex) -> float:
        lane = self.road.network.get_lane(target_lane_index)
        along, lateral = lane.local_coordinates(self.position)
        road_heading = lane.heading_at(along + float(self.speed) * self.TAU_PURSUIT)
        speed, heading = not_zero(float(self.speed)), float(self.heading)
        wanted_heading = float(np.arcsin(_clip(-self.KP_LATERAL * lateral / speed, -1, 1)))
        wanted_heading = road_heading + _clip(wanted_heading, -math.pi / 4, math.pi / 4)
        turn = self.KP_HEADING * wrap_to_pi(wanted_heading - heading)
        slip_angle = np.arcsin(_clip(self.LENGTH / 2 / speed * turn, -1, 1))
        steering = float(np.arctan(2 * np.tan(slip_angle)))
        return _clip(steering, -self.MAX_STEERING_ANGLE, self.MAX_STEERING_ANGLE)

    def acceleration(
        self, ego_vehicle: Vehicle | None, front_vehicle: Vehicle | None = None, rear_vehicle: Vehicle | None = None
    ) -> float:
        if ego_vehicle is None:
            return 0
        target_speed = _clip(getattr(ego_vehicle, "target_speed", 0), 0, ego_vehicle.lane.speed_limit)
        speed_ratio = max(ego_vehicle.speed, 0) / abs(not_zero(target_speed))
        acceleration = self.COMFORT_ACC_MAX * (1 - float(np.power(speed_ratio, self.DELTA)))
        if front_vehicle is not None:
            # Its sign does not matter, because it is squared
            distance = float(front_vehicle.position[0] - ego_vehicle.position[0])
            gap_ratio = self.desired_gap(ego_vehicle, front_vehicle) / not_zero(distance)
            acceleration -= self.COMFORT_ACC_MAX * float(np.power(gap_ratio, 2.0))
        return float(acceleration)

    def desired_gap(self, ego_vehicle: Vehicle, front_vehicle: Vehicle | None = None, projected: bool = True) -> float:
        if front_vehicle is None or not projected:
            return super().desired_gap(ego_vehicle, front_vehicle, projected)  # type: ignore[no-any-return]
        direction, velocity = self.road.motion(ego_vehicle)
        _, front_velocity = self.road.motion(front_vehicle)
        speed, approach = float(ego_vehicle.speed), float(np.dot(velocity - front_velocity, direction))
        braking = 2 * math.sqrt(-self.COMFORT_ACC_MAX * self.COMFORT_ACC_MIN)
        return float(self.DISTANCE_WANTED + speed * self.TIME_WANTED + speed * approach / braking)


class NeverReverses(Vehicle):
    """A vehicle that does not go backwards when it keeps braking, as highway-env's does."""

    MIN_SPEED = 0.0
    speed: float

    def step(self, dt: float) -> None:
        super().step(dt)
        self.speed = _clip(float(self.speed), self.MIN_SPEED, self.MAX_SPEED)


class ScenarioDriver(NeverReverses, Driver):
    """Driver on winding roads and roads with ramps, who may have to stop for oncoming cars or the end of a lane."""


def _clip(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value
