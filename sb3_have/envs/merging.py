"""Drivers on a highway with on-ramps, who join the traffic before the ramp ends."""

from __future__ import annotations

import math
from typing import Any

from highway_env.road.road import LaneIndex
from highway_env.utils import not_zero
from highway_env.vehicle.kinematics import Vehicle

from sb3_have.envs.driver import ScenarioDriver
from sb3_have.envs.lanes import FORWARD, RampLane
from sb3_have.envs.road_shape import PERIOD, RAMP_JOINS, RAMP_TAPERS


class MergingDriver(ScenarioDriver):
    """
    An IDM/MOBIL driver that changes from a ramp to the road as soon as MOBIL considers it safe.

    The criterion loosens along the acceleration lane: nobody may have to brake harder than :attr:`GENTLE` at its
    beginning and :attr:`HARD` at its end. Until the lane change, the end of the lane counts as a standing car.
    """

    # Hardest braking accepted at the beginning of the acceleration lane [m/s^2]
    GENTLE = 2.0
    # Hardest braking accepted at its end [m/s^2], the hardest of any driver
    HARD = 6.0

    target_lane_index: LaneIndex
    # Desired speed after the curve of the ramp [m/s]
    cruise_speed: float

    def act(self, action: Any = None) -> None:
        on_ramp = isinstance(self.lane, RampLane)
        u = float(self.position[0]) % PERIOD
        if on_ramp and u >= RAMP_JOINS:
            self.target_speed = self.cruise_speed
        elif not on_ramp and isinstance(self.road.network.get_lane(self.target_lane_index), RampLane):
            # The ramp has ended
            self.target_lane_index = self.lane_index
            self.target_speed = self.cruise_speed
        super().act(action)
        if on_ramp and self.target_lane_index == self.lane_index and not self.crashed:
            speed = float(self.speed)
            braking = 2 * math.sqrt(-self.COMFORT_ACC_MAX * self.COMFORT_ACC_MIN)
            gap = self.DISTANCE_WANTED + speed * self.TIME_WANTED + speed**2 / braking
            slower = self.COMFORT_ACC_MAX * (gap / not_zero(RAMP_TAPERS - u)) ** 2
            self.action["acceleration"] = max(self.action["acceleration"] - slower, -self.ACC_MAX)

    def change_lane_policy(self) -> None:
        if not isinstance(self.lane, RampLane):
            super().change_lane_policy()
        elif self.lane_index == self.target_lane_index:
            progress = (float(self.position[0]) % PERIOD - RAMP_JOINS) / (RAMP_TAPERS - RAMP_JOINS)
            if progress >= 0 and self._can_join(self.GENTLE + min(progress, 1) * (self.HARD - self.GENTLE)):
                self.target_lane_index = (*FORWARD, self.lane_index[2] - 1)

    def _can_join(self, limit: float) -> bool:
        """Whether neither this driver nor the one behind would have to brake harder than the limit [m/s^2]."""
        beside = (*FORWARD, self.lane_index[2] - 1)
        front, rear = self.road.neighbour_vehicles(self, beside)
        pairs = [(self, front), (rear, self)]
        # Vehicles that are changing to the same lane count as being there
        for other in self.road.vehicles:
            if other is not self and getattr(other, "target_lane_index", None) == beside != other.lane_index:
                pairs.append((other, self) if other.position[0] < self.position[0] else (self, other))
        return all(self._braking(behind, ahead) <= limit for behind, ahead in pairs if behind and ahead)

    def _braking(self, behind: Vehicle, ahead: Vehicle) -> float:
        """Braking of IDM for the car ahead at its desired speed [m/s^2]."""
        distance = max(float(ahead.position[0] - behind.position[0]), 1e-2)
        return float(self.COMFORT_ACC_MAX) * max(self.desired_gap(behind, ahead) / distance, 0.0) ** 2
