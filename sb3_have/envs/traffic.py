"""The other vehicles of a highway: IDM/MOBIL drivers in a window that moves with the ego vehicle.

The window reaches from :data:`BEHIND` to :data:`AHEAD`. Who leaves it at one end comes back at the other, in a random
lane with a random speed, so the ego vehicle never runs out of traffic and the density stays what it was. Both ends
are out of sight: the camera looks forward and draws cars up to 205 m.
"""

from __future__ import annotations

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle

from sb3_have.envs.driver import Driver

SIGHT = 300.0
"""No vehicle appears nearer than this ahead of the ego vehicle [m]."""
AHEAD = SIGHT + 20.0
"""Front end of the window, ahead of the ego vehicle [m]; arrivals are spread over the last 20 m."""
BEHIND = 120.0
"""Rear end of the window, behind the ego vehicle [m]; arrivals are spread over the last 20 m."""


def populate(
    road: Road, ego: Vehicle, count: int, speeds: tuple[float, float], rng: np.random.Generator, tries: int = 100
) -> None:
    """Add ``count`` vehicles to the road, uniformly over the window, with room to everyone around.

    Room means that nobody starts nearer to the one in front than the gap IDM itself wants, at the speeds of both; for
    an ego vehicle at rest that leaves followers in its lane about 120 m to stop. On a road too full for that the
    rest queues ahead of the window and comes in through its rear end when there is room.

    :param road: holds the ego vehicle already
    :param ego: the ego vehicle
    :param count: number of vehicles to add
    :param speeds: range of the speeds they want to drive at [m/s]
    :param rng: source of all randomness
    :param tries: how often a place is drawn for each vehicle
    """
    for i in range(count):
        for _ in range(tries):
            vehicle = _random_vehicle(road, ego.position[0] + rng.uniform(-BEHIND, AHEAD), speeds, rng)
            if _has_room(vehicle):
                break
        else:
            vehicle = _random_vehicle(road, ego.position[0] + AHEAD + 50.0 * (i + 1), speeds, rng)
        road.vehicles.append(vehicle)


def recycle(road: Road, ego: Vehicle, speeds: tuple[float, float], rng: np.random.Generator) -> list[int]:
    """Bring vehicles that left the window at one end back at the other, where there is room; the rest waits.

    :param road: its ``vehicles`` keep their order, a recycled one is replaced in place
    :param ego: the ego vehicle, never recycled
    :param speeds: range of the speeds they want to drive at [m/s]
    :param rng: source of all randomness
    :return: indices into ``road.vehicles`` of the vehicles that were replaced
    """
    replaced = []
    for i, vehicle in enumerate(road.vehicles):
        offset = vehicle.position[0] - ego.position[0]
        if vehicle is ego or -BEHIND <= offset <= AHEAD:
            continue
        arrival = rng.uniform(SIGHT, AHEAD) if offset < 0 else rng.uniform(-BEHIND, -BEHIND + AHEAD - SIGHT)
        newcomer = _random_vehicle(road, ego.position[0] + arrival, speeds, rng)
        if _has_room(newcomer):
            road.vehicles[i] = newcomer
            replaced.append(i)
    return replaced


def _random_vehicle(road: Road, x: float, speeds: tuple[float, float], rng: np.random.Generator) -> Driver:
    lanes = road.network.all_side_lanes(("0", "1", 0))
    vehicle: Driver = Driver.make_on_lane(road, lanes[rng.integers(len(lanes))], x, rng.uniform(*speeds))
    vehicle.DELTA = rng.uniform(*Driver.DELTA_RANGE)
    return vehicle


def _has_room(vehicle: Driver) -> bool:
    """Whether all gaps in the vehicle's lane are what IDM wants (and never under two car lengths).

    Who is changing into the lane counts as being there: MOBIL does not look again after it has decided.
    """
    for other in vehicle.road.vehicles:
        changing_in = getattr(other, "target_lane_index", None) == vehicle.lane_index
        if changing_in or vehicle.lane.on_lane(other.position, margin=1):
            pair = (vehicle, other) if vehicle.position[0] < other.position[0] else (other, vehicle)
            if pair[0].lane_distance_to(pair[1]) < max(vehicle.desired_gap(*pair), 2 * vehicle.LENGTH):
                return False
    return True
