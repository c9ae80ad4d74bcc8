"""
Lanes of winding roads with traffic in both directions, and of on-ramps.

The longitudinal coordinate is x, counted from the other end on lanes driven towards -x. The lateral coordinate is
measured along y, to the right of the driver. Both are in metres and follow highway-env's ``SineLane``.
"""

from __future__ import annotations

import math

import numpy as np
from highway_env.road.road import LaneIndex, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

from sb3_have.envs.road import ROAD_LENGTH, SPEED_LIMIT, AxisLane, Placed
from sb3_have.envs.road_shape import RoadShape

# The two directions in a lane index; lane 0 is the leftmost of its direction
FORWARD, ONCOMING = ("0", "1"), ("1", "0")


class BentLane(AxisLane):
    """
    A lane that bends with its road.

    :param shape: Shape of the road.
    :param number: Number of the lane from the left; the first ``shape.oncoming`` lanes are driven towards -x.
    """

    def __init__(self, shape: RoadShape, number: int) -> None:
        y = number * shape.lane_width
        super().__init__([0.0, y], [ROAD_LENGTH, y], width=shape.lane_width, speed_limit=SPEED_LIMIT)
        self.shape = shape
        self.sign = -1.0 if number < shape.oncoming else 1.0

    def position(self, longitudinal: float, lateral: float) -> np.ndarray:
        x = self._mirrored(longitudinal)
        return np.array([x, self._y(x) + self.sign * lateral])

    def local_coordinates(self, position: np.ndarray) -> tuple[float, float]:
        x, y = position.tolist()
        return self._mirrored(x), self.sign * (y - self._y(x))

    def heading_at(self, longitudinal: float) -> float:
        along = math.atan(self._slope(self._mirrored(longitudinal)))
        return along if self.sign > 0 else along + math.pi

    def occupants(self, placed: list[Placed]) -> list[tuple[float, Vehicle]]:
        sign, centre, reach = self.sign, self.centre, self.shape.lane_width / 2 + 1
        return [(sign * x, vehicle) for x, y, bend, vehicle in placed if abs(y - (centre + bend)) <= reach]

    def _mirrored(self, x: float) -> float:
        return x if self.sign > 0 else ROAD_LENGTH - x

    def _y(self, x: float) -> float:
        bend: float = self.shape.bend(x)
        return self.centre + bend

    def _slope(self, x: float) -> float:
        slope: float = self.shape.slope(x)
        return slope


class RampLane(BentLane):
    """
    All on-ramps of a straight road, one per period. Vehicles never change to it, and it narrows at its end.

    :param shape: Shape of the road.
    """

    def __init__(self, shape: RoadShape) -> None:
        super().__init__(shape, shape.lanes_count)
        self.forbidden = True

    def on_lane(
        self, position: np.ndarray, longitudinal: float | None = None, lateral: float | None = None, margin: float = 0
    ) -> bool:
        x, y = float(position[0]), float(position[1])
        left, right = self.shape.ramp(x)
        return bool(self.shape.has_ramp(x)) and left - margin <= y <= right + margin

    def occupants(self, placed: list[Placed]) -> list[tuple[float, Vehicle]]:
        edge = self.shape.right_edge - 1
        return [(x, v) for x, y, _, v in placed if y >= edge and self.on_lane(v.position, margin=1)]

    def _y(self, x: float) -> float:
        return float(self.shape.ramp(x)[0]) + 0.5 * self.shape.lane_width

    def _slope(self, x: float) -> float:
        return float(self.shape.ramp_slope(x)[0])


class ShapedNetwork(RoadNetwork):
    """
    The lanes of a road.

    :param shape: Shape of the road.
    """

    def __init__(self, shape: RoadShape) -> None:
        super().__init__()
        self.shape = shape
        for number in range(shape.oncoming, shape.lanes_count):
            self.add_lane(*FORWARD, BentLane(shape, number))
        for number in reversed(range(shape.oncoming)):
            self.add_lane(*ONCOMING, BentLane(shape, number))
        self.ramp: RampLane | None = None
        if shape.ramps:
            self.ramp = RampLane(shape)
            self.add_lane(*FORWARD, self.ramp)

    def bend(self, x: float) -> float:
        """Offset of the road to the right of the x axis [m] at x [m]."""
        return float(self.shape.bend(x))

    def get_closest_lane_index(self, position: np.ndarray, heading: float | None = None) -> LaneIndex:
        # Ignore the heading: a vehicle on the wrong side of the road is in an oncoming lane
        shape, (x, y) = self.shape, position.tolist()
        across = y - shape.bend(x)
        number = min(max(round(across / shape.lane_width), 0), shape.lanes_count - 1)
        if self.ramp is not None and across > shape.right_edge and shape.has_ramp(x):
            past_road, past_ramp = across - shape.right_edge, abs(self.ramp.local_coordinates(position)[1])
            if past_ramp < past_road + 0.5 * shape.lane_width:
                return *FORWARD, shape.lanes_count
        if number < shape.oncoming:
            return *ONCOMING, shape.oncoming - 1 - number
        return *FORWARD, number - shape.oncoming
