"""
The other vehicles: IDM/MOBIL drivers in a window that moves with the ego vehicle.

The window reaches from :data:`BEHIND` to :data:`AHEAD`. A vehicle that leaves it at one end returns at the other, in a
random lane with a random speed, so that the density of the traffic does not change. Both ends are out of sight: the
camera looks forward and draws cars up to 205 m away. Oncoming vehicles leave at the rear and return at the front. Where
a ramp begins out of sight, half of the vehicles return on the ramp, slowly enough for the ego vehicle to catch up with
them where they join the road.
"""

from __future__ import annotations

import numpy as np
from highway_env.road.road import LaneIndex, Road
from highway_env.vehicle.kinematics import Vehicle

from sb3_have.envs.driver import Driver, ScenarioDriver
from sb3_have.envs.lanes import FORWARD, ONCOMING, ShapedNetwork
from sb3_have.envs.merging import MergingDriver
from sb3_have.envs.road import ROAD_LENGTH
from sb3_have.envs.road_shape import RAMP_JOINS

# Vehicles appear at least this far ahead of the ego vehicle [m]
SIGHT = 300.0
# Front end of the window, ahead of the ego vehicle [m]; vehicles appear in its last 20 m
AHEAD = SIGHT + 20.0
# Rear end of the window, behind the ego vehicle [m]; vehicles appear in its last 20 m
BEHIND = 120.0
# Range of speeds on ramps [m/s]
RAMP_SPEED = (10.0, 13.0)
# While a ramp begins out of sight ahead, vehicles farther behind than this [m] and no faster than the ego vehicle are
# moved there
BEHIND_RAMP = 40.0
# Vehicles appear on a ramp within this distance from its beginning [m]
RAMP_ENTRY = 100.0


def populate(
    road: Road, ego: Vehicle, count: int, speeds: tuple[float, float], rng: np.random.Generator, tries: int = 100
) -> None:
    """
    Add vehicles to the road, uniformly over the window and with room around each.

    Each vehicle starts at least as far from the one in front as the gap that IDM wants at the speeds of both. Followers
    in the lane of an ego vehicle at rest thus have about 120 m to stop. If the road is too full, the remaining vehicles
    queue ahead of the window and enter through its rear end when there is room.

    :param road: Road that already holds the ego vehicle.
    :param ego: Ego vehicle.
    :param count: Number of vehicles to add.
    :param speeds: Range of the desired speeds in m/s.
    :param rng: Random generator.
    :param tries: Number of places to try for each vehicle.
    """
    for i in range(count):
        for _ in range(tries):
            x = ego.position[0] + rng.uniform(-BEHIND, AHEAD)
            lanes = _open_lanes(road, x, RAMP_JOINS) + _lanes(road, ONCOMING)
            vehicle = _random_vehicle(road, lanes, x, speeds, rng)
            if _has_room(vehicle):
                break
        else:
            x = ego.position[0] + AHEAD + 50.0 * (i + 1)
            vehicle = _random_vehicle(road, _lanes(road, FORWARD), x, speeds, rng)
        road.vehicles.append(vehicle)


def recycle(road: Road, ego: Vehicle, speeds: tuple[float, float], rng: np.random.Generator) -> list[int]:
    """
    Return vehicles that left the window to its other end where there is room; the others wait.

    :param road: Road, whose ``vehicles`` keep their order: vehicles are replaced in place.
    :param ego: Ego vehicle.
    :param speeds: Range of the desired speeds in m/s.
    :param rng: Random generator.
    :return: Indices into ``road.vehicles`` of the replaced vehicles.
    """
    replaced = []
    called = _on_ramp(road, ego.position[0] + SIGHT, RAMP_ENTRY)
    for i, vehicle in enumerate(road.vehicles):
        offset = vehicle.position[0] - ego.position[0]
        needed = called and offset < -BEHIND_RAMP and vehicle.speed <= ego.speed
        if vehicle is ego or (-BEHIND <= offset <= AHEAD and not needed):
            continue
        oncoming = vehicle.lane_index[:2] == ONCOMING
        at_front = offset < 0 or oncoming
        x = ego.position[0] + (rng.uniform(SIGHT, AHEAD) if at_front else rng.uniform(-BEHIND, -BEHIND + AHEAD - SIGHT))
        lanes = _lanes(road, ONCOMING) if oncoming else _open_lanes(road, x, RAMP_ENTRY if at_front else 0.0)
        newcomer = _random_vehicle(road, lanes, x, speeds, rng)
        if _has_room(newcomer):
            road.vehicles[i] = newcomer
            replaced.append(i)
            # Move one vehicle at a time to a ramp
            called = called and not needed
    return replaced


def _lanes(road: Road, direction: tuple[str, str]) -> list[LaneIndex]:
    """Lanes of a direction, without ramps."""
    lanes = road.network.graph.get(direction[0], {}).get(direction[1], [])
    return [(*direction, i) for i, lane in enumerate(lanes) if not lane.forbidden]


def _open_lanes(road: Road, x: float, ramp_until: float) -> list[LaneIndex]:
    """Lanes towards +x to draw from. If x lies in the first metres of a ramp, half of them are the ramp."""
    lanes = _lanes(road, FORWARD)
    return lanes + [(*FORWARD, len(lanes))] * len(lanes) if _on_ramp(road, x, ramp_until) else lanes


def _on_ramp(road: Road, x: float, until: float) -> bool:
    """Whether x lies in the first metres of a ramp."""
    return isinstance(road.network, ShapedNetwork) and bool(road.network.shape.has_ramp(x, until))


def _random_vehicle(
    road: Road, lanes: list[LaneIndex], x: float, speeds: tuple[float, float], rng: np.random.Generator
) -> Driver:
    index = lanes[rng.integers(len(lanes))]
    speed, along = rng.uniform(*speeds), x if index[:2] == FORWARD else ROAD_LENGTH - x
    vehicle: Driver
    if not isinstance(road.network, ShapedNetwork):
        vehicle = Driver.make_on_lane(road, index, along, speed)
    elif road.network.ramp is None:
        vehicle = ScenarioDriver.make_on_lane(road, index, along, speed)
    else:
        on_ramp = road.network.get_lane(index).forbidden
        vehicle = MergingDriver.make_on_lane(road, index, along, rng.uniform(*RAMP_SPEED) if on_ramp else speed)
        vehicle.cruise_speed = speed
    vehicle.DELTA = rng.uniform(*Driver.DELTA_RANGE)
    return vehicle


def _has_room(vehicle: Driver) -> bool:
    """
    Check whether all gaps in the vehicle's lane are at least those that IDM wants, and at least two car lengths.

    Vehicles that are changing into the lane count as being there, because MOBIL does not reconsider its decisions.
    """
    for other in vehicle.road.vehicles:
        changing_in = getattr(other, "target_lane_index", None) == vehicle.lane_index
        if changing_in or vehicle.lane.on_lane(other.position, margin=1):
            behind = (vehicle.position[0] < other.position[0]) == (vehicle.lane_index[:2] == FORWARD)
            pair = (vehicle, other) if behind else (other, vehicle)
            if pair[0].lane_distance_to(pair[1], vehicle.lane) < max(vehicle.desired_gap(*pair), 2 * vehicle.LENGTH):
                return False
    return True
