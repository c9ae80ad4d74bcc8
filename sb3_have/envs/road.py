"""
A straight highway that behaves like that of :mod:`highway_env`, bit for bit, but is faster.

Every vehicle looks up its neighbours several times per simulation step, and every pair of vehicles is checked for
collisions. On a road along x, plain floats suffice for both. Only public methods are overridden;
``benchmarks/road_identity.py`` compares this road with that of highway-env. :mod:`sb3_have.envs.lanes` has the lanes
that are not straight.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import numpy as np
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import LaneIndex, Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

# Width of a lane [m]. The centre of lane k is at y = k * LANE_WIDTH; y points to the right.
LANE_WIDTH: float = StraightLane.DEFAULT_WIDTH

# Length of the road [m], longer than any episode
ROAD_LENGTH = 1e6

# Highest desired speed of the traffic [m/s], the default of highway-env
SPEED_LIMIT = 30.0

# x [m], y [m], offset of the road to the right of the x axis at x [m], and the vehicle
Placed = tuple[float, float, float, Vehicle]


class AxisLane(StraightLane):
    """A straight lane along +x, whose coordinates are differences instead of dot products."""

    # +1 for a lane driven towards +x, -1 towards -x
    sign = 1.0

    def __init__(self, start: Sequence[float], end: Sequence[float], **kwargs: Any) -> None:
        super().__init__(start, end, **kwargs)
        self.beginning, self.centre = float(start[0]), float(start[1])

    def local_coordinates(self, position: np.ndarray) -> tuple[float, float]:
        x, y = position.tolist()
        return x - self.beginning, y - self.centre

    def heading_at(self, longitudinal: float) -> float:
        return 0.0

    def occupants(self, placed: list[Placed]) -> list[tuple[float, Vehicle]]:
        """Vehicles on the lane or across its border, with their positions along the lane [m]."""
        centre = self.centre
        return [(x, vehicle) for x, y, _, vehicle in placed if abs(y - centre) <= LANE_WIDTH / 2 + 1]


class HighwayNetwork(RoadNetwork):
    """
    Parallel lanes along +x.

    :param lanes_count: Number of lanes; lane 0 is the leftmost.
    """

    def __init__(self, lanes_count: int) -> None:
        super().__init__()
        for k in range(lanes_count):
            y = k * LANE_WIDTH
            left = LineType.CONTINUOUS_LINE if k == 0 else LineType.STRIPED
            right = LineType.CONTINUOUS_LINE if k == lanes_count - 1 else LineType.NONE
            lane = AxisLane([0.0, y], [ROAD_LENGTH, y], line_types=(left, right), speed_limit=SPEED_LIMIT)
            self.add_lane("0", "1", lane)

    def bend(self, x: float) -> float:
        """Offset of the road to the right of the x axis [m] at x [m]."""
        return 0.0

    def get_closest_lane_index(self, position: np.ndarray, heading: float | None = None) -> LaneIndex:
        x, y = position.tolist()
        beyond = max(x - ROAD_LENGTH, 0) + max(0 - x, 0)
        angle = 0.0 if heading is None else abs((heading + math.pi) % (2 * math.pi) - math.pi)
        distances = [abs(y - k * LANE_WIDTH) + beyond + angle for k in range(len(self.graph["0"]["1"]))]
        return "0", "1", distances.index(min(distances))


class HighwayRoad(Road):
    """A :class:`~highway_env.road.road.Road` along x with fast look-ups of neighbours and collisions."""

    _placed: list[Placed] | None = None
    _on_lane: dict[LaneIndex, tuple[list[float], list[Vehicle]]]
    _motions: dict[Vehicle, tuple[np.ndarray, np.ndarray]]

    def act(self) -> None:
        # No vehicle moves while all decide, so assign vehicles to lanes only once
        self._placed = self._places()
        self._on_lane, self._motions = {}, {}
        try:
            super().act()
        finally:
            self._placed = None
            self._on_lane, self._motions = {}, {}

    def _places(self) -> list[Placed]:
        # Of two vehicles at the same x, highway-env finds the later one in front and the earlier one behind
        bend, vehicles = self.network.bend, self.vehicles[::-1]
        return [(x, y, bend(x), v) for (x, y), v in zip([v.position.tolist() for v in vehicles], vehicles, strict=True)]

    def neighbour_vehicles(
        self, vehicle: Vehicle, lane_index: LaneIndex | None = None
    ) -> tuple[Vehicle | None, Vehicle | None]:
        if self._placed is None:
            return super().neighbour_vehicles(vehicle, lane_index)  # type: ignore[no-any-return]
        lane_index = lane_index or vehicle.lane_index
        lane = self.network.get_lane(lane_index)
        if lane_index not in self._on_lane:
            occupants = sorted(lane.occupants(self._placed), key=itemgetter(0))
            self._on_lane[lane_index] = [x for x, _ in occupants], [other for _, other in occupants]
        positions, others = self._on_lane[lane_index]
        i = bisect.bisect_left(positions, lane.sign * float(vehicle.position[0]))
        rear = others[i - 1] if i > 0 else None
        if i < len(others) and others[i] is vehicle:
            i += 1
        return others[i] if i < len(others) else None, rear

    def motion(self, vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
        """Direction (a unit vector) and velocity [m/s] of a vehicle."""
        motion = None if self._placed is None else self._motions.get(vehicle)
        if motion is None:
            direction = vehicle.direction
            motion = direction, vehicle.speed * direction
            if self._placed is not None:
                self._motions[vehicle] = motion
        return motion

    def step(self, dt: float) -> None:
        for vehicle in self.vehicles:
            vehicle.step(dt)
        for vehicle, other in self._close_pairs(dt):
            vehicle.handle_collisions(other, dt)

    def _close_pairs(self, dt: float) -> list[tuple[Vehicle, Vehicle]]:
        """All pairs that ``handle_collisions`` might find to collide, and few others, in the order of the vehicles."""
        reach = max(v.diagonal for v in self.vehicles) + max(abs(v.speed) for v in self.vehicles) * dt + 1.0
        along = sorted((float(v.position[0]), number) for number, v in enumerate(self.vehicles))
        pairs = []
        for rank, (x, number) in enumerate(along):
            for x_other, other in itertools.islice(along, rank + 1, None):
                if x_other - x > reach:
                    break
                pairs.append((min(number, other), max(number, other)))
        close = [(self.vehicles[i], self.vehicles[j]) for i, j in sorted(pairs)]
        return [pair for pair in close if not _pass_by(*pair, dt)]


def _pass_by(one: Vehicle, other: Vehicle, dt: float) -> bool:
    """
    Check whether two vehicles are certain to stay clear of each other, side by side, for another step.

    They are if they and their motion leave a gap across the heading of the first, one of the four directions that
    ``handle_collisions`` examines.
    """
    heading, turn = float(one.heading), float(other.heading - one.heading)
    dx, dy = (other.position - one.position).tolist()
    gap = abs(dy * math.cos(heading) - dx * math.sin(heading))
    slant = abs(math.sin(turn))
    half_widths = 0.5 * (one.WIDTH + slant * other.LENGTH + abs(math.cos(turn)) * other.WIDTH)
    # The first vehicle moves along its heading, not across it. The centimetre is far more than any rounding error.
    return bool(gap > half_widths + abs(other.speed) * dt * slant + 0.01)
