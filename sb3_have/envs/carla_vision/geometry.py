"""Places and speeds on CARLA's road map, which works without a server."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import carla

from sb3_have.envs.carla_vision.rules import Place

#: Cars are put this far above the road and fall onto it: touching it, they would be refused as colliding [m].
LIFT: Final = 0.3
#: The centre of a car may be this far beyond the edge of the nearest lane: roads of a map meet with small gaps [m].
MARGIN: Final = 0.3


class LaneState(NamedTuple):
    """How a car moves on the nearest driving lane: speed along it [m/s], speed in all [m/s], and whether it left it."""

    lane_speed: float
    speed: float
    offroad: bool


def spawn_transform(road_map: carla.Map, road_id: int, place: Place) -> carla.Transform:
    """
    Where to put a car.

    :param road_map: The map.
    :param road_id: OpenDRIVE id of the road.
    :param place: Lane and arc length.
    :return: :data:`LIFT` above the centre of the lane, along it.
    :raises ValueError: if the map has no such place.
    """
    waypoint = road_map.get_waypoint_xodr(road_id, place.lane, place.s)
    if waypoint is None:
        raise ValueError(
            f"map {road_map.name} has no lane {place.lane} on road {road_id} at s = {place.s:.1f} m; "
            "choose another `road_id` or `town`, or fewer lanes (`lanes_count`)"
        )
    centre = waypoint.transform.location
    return carla.Transform(carla.Location(centre.x, centre.y, centre.z + LIFT), waypoint.transform.rotation)


def lane_state(road_map: carla.Map, location: carla.Location, velocity: carla.Vector3D) -> LaneState:
    """
    :param road_map: The map.
    :param location: Of the car's centre.
    :param velocity: Of the car [m/s].
    """
    waypoint = road_map.get_waypoint(location)
    centre, along = waypoint.transform.location, waypoint.transform.get_forward_vector()
    lane_speed = velocity.x * along.x + velocity.y * along.y + velocity.z * along.z
    speed = math.sqrt(velocity.x**2 + velocity.y**2 + velocity.z**2)
    beside = math.hypot(location.x - centre.x, location.y - centre.y)
    return LaneState(lane_speed, speed, beside > waypoint.lane_width / 2 + MARGIN)
