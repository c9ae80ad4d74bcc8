"""One episode on a CARLA server: who is put where, ticks, and what the sensors of the ego saw."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple, cast

import carla
import gymnasium as gym
import numpy as np

from sb3_have.envs.carla_vision.rules import (
    EGO_RANGE,
    TRAFFIC_RANGE,
    Pedals,
    Place,
    Plan,
    draw_place,
    pedals,
    steering_gain,
)
from sb3_have.envs.carla_vision.sensors import (
    Inbox,
    copy_events,
    copy_image,
    decode_depth_image,
    decode_rgb,
    dvs_attributes,
    event_image,
    impulse,
)
from sb3_have.envs.carla_vision.session import Session
from sb3_have.envs.vision import Observation
from sb3_have.sensors.depth import encode_depth

#: The roof camera: metres ahead of and above the car's centre on the ground, horizontal field of view [degrees].
CAMERA: Final = {"x": 1.0, "z": 1.5}
FIELD_OF_VIEW: Final = 60.0
#: Places tried for a car before giving up.
ATTEMPTS: Final = 20
#: Ticks before the episode starts: cars fall onto the road, sensors begin to deliver.
SETTLING: Final = 10
#: Cars are put this far above the road and fall onto it: touching it, they would be refused as colliding [m].
LIFT: Final = 0.3
#: The centre of a car may be this far beyond the edge of the nearest lane: roads of a map meet with small gaps [m].
MARGIN: Final = 0.3

_BLUEPRINTS: Final = {"rgb": "sensor.camera.rgb", "depth": "sensor.camera.depth", "event": "sensor.camera.dvs"}


class LaneState(NamedTuple):
    """How a car moves on the nearest driving lane: speed along it [m/s], speed in all [m/s], and whether it left it."""

    lane_speed: float
    speed: float
    offroad: bool


class Collisions(NamedTuple):
    """In how many ticks the ego collided, and the sum of the sizes of the impulses [N s]."""

    ticks: int
    impulse: float


class Episode:
    """
    An episode that has started: the cars stand on the road, the sensors deliver.

    :param session: The server.
    :param plan: What it consists of.
    :param weather: A preset of ``carla.WeatherParameters``.
    :param rng: Source of everything random.
    :raises RuntimeError: if there is no room for a car, or the server is lost.
    """

    def __init__(self, session: Session, plan: Plan, weather: str, rng: np.random.Generator) -> None:
        self.session, self.plan = session, plan
        self._dt = session.server.tick
        session.destroy_actors()
        session.world.set_weather(getattr(carla.WeatherParameters, weather))
        if session.traffic_manager is not None:
            session.traffic_manager.set_random_device_seed(int(rng.integers(2**31)))
        blueprint = session.blueprints.find(plan.ego_vehicle)
        self.ego = self._place(blueprint, EGO_RANGE, rng, "the ego vehicle")
        lock = self.ego.get_physics_control().wheels[0].max_steer_angle
        self._gain = steering_gain(plan.steering_range, lock)
        self._add_traffic(rng)
        self._images = {name: self._camera(name, copy_image) for name in plan.modalities if name != "event"}
        self._events = self._camera("event", copy_events) if "event" in plan.modalities else None
        self._collisions: Inbox[float] = Inbox("collision", impulse)
        self._listen(session.blueprints.find("sensor.other.collision"), carla.Transform(), self._collisions)
        self._settle()

    # ---- actors ----

    def _place(
        self, blueprint: carla.ActorBlueprint, s_range: tuple[float, float], rng: np.random.Generator, who: str
    ) -> carla.Vehicle:
        plan, road_map = self.plan, self.session.road_map
        for _ in range(ATTEMPTS):
            place = draw_place(rng, plan.lanes_count, s_range)
            actor = self.session.spawn(blueprint, spawn_transform(road_map, plan.road_id, place))
            if actor is not None:
                return cast(carla.Vehicle, actor)
        raise RuntimeError(
            f"found no room for {who} in {ATTEMPTS} attempts, on lanes -1..-{plan.lanes_count} of road {plan.road_id} "
            f"at s in {list(s_range)} m; are cars of other clients there? Otherwise lower `vehicles_count`"
        )

    def _add_traffic(self, rng: np.random.Generator) -> None:
        session, plan = self.session, self.plan
        if session.traffic_manager is None:
            return
        models = [model for model in session.blueprints.filter("vehicle.*") if _is_car(model)]
        models.sort(key=lambda model: model.id)
        if not models:
            raise RuntimeError("the server has no blueprint of a car (vehicle.* with base_type 'car')")
        for number in range(1, plan.vehicles_count + 1):
            model = models[rng.integers(len(models))]
            if model.has_attribute("color"):
                colours = model.get_attribute("color").recommended_values
                model.set_attribute("color", colours[rng.integers(len(colours))])
            vehicle = self._place(model, TRAFFIC_RANGE, rng, f"vehicle {number} of {plan.vehicles_count}")
            vehicle.set_autopilot(True, session.server.tm_port)
            if plan.traffic_speed is not None:
                kmh = 3.6 * float(rng.uniform(*plan.traffic_speed))
                session.traffic_manager.set_desired_speed(vehicle, kmh)

    def _camera(self, name: str, read: Callable[[Any], Any]) -> Inbox[Any]:
        plan = self.plan
        blueprint = self.session.blueprints.find(_BLUEPRINTS[name])
        attributes = {
            "image_size_x": str(plan.image_size),
            "image_size_y": str(plan.image_size),
            "fov": str(FIELD_OF_VIEW),
            **(dvs_attributes(plan.event) if name == "event" else {}),
        }
        for attribute, value in attributes.items():
            blueprint.set_attribute(attribute, value)
        inbox: Inbox[Any] = Inbox(name, read)
        self._listen(blueprint, carla.Transform(carla.Location(**CAMERA)), inbox)
        return inbox

    def _listen(self, blueprint: carla.ActorBlueprint, transform: carla.Transform, inbox: Inbox[Any]) -> None:
        sensor = self.session.spawn(blueprint, transform, self.ego)
        if sensor is None:
            raise RuntimeError(f"the server refused the {inbox.name} sensor ({blueprint.id}); its log says why")
        self.session.listen(cast(carla.Sensor, sensor), inbox)

    # ---- time ----

    def _settle(self) -> None:
        self.ego.apply_control(carla.VehicleControl(0.0, 0.0, 1.0, True))
        for remaining in reversed(range(SETTLING)):
            if remaining == 0:
                self.ego.apply_control(carla.VehicleControl())
                if self.plan.initial_speed > 0:
                    along = self.ego.get_transform().get_forward_vector()
                    self.ego.set_target_velocity(along * self.plan.initial_speed)
            self.frame = self.session.tick()
        self._first_frame = self.frame
        self.lane = self._lane()

    def tick(self, throttle: float, steer: float) -> LaneState:
        """
        One simulation tick.

        :param throttle: Of the action, -1..1.
        :param steer: Of the action, -1..1.
        :return: How the ego moves after it.
        """
        control: Pedals = pedals(throttle, steer, self.lane.speed, self.plan.max_speed, self._gain)
        self.ego.apply_control(carla.VehicleControl(*control))
        self.frame = self.session.tick()
        self.lane = self._lane()
        return self.lane

    def _lane(self) -> LaneState:
        return lane_state(self.session.road_map, self.ego.get_location(), self.ego.get_velocity())

    # ---- sensors ----

    def collisions(self) -> Collisions:
        """
        Those of this episode reported since the last call.

        One that is reported late counts when it is, so that none is lost; those of the cars' fall onto the road never.
        """
        reports = [report for report in self._collisions.drain() if report[0] > self._first_frame]
        return Collisions(len({frame for frame, _ in reports}), sum(size for _, size in reports))

    def first_observation(self) -> Observation:
        """What is seen at the start; no events yet."""
        observation = self._see()
        if self._events is not None:
            self._events.drain(self.frame, self.plan.event_grace)
            observation["event"] = event_image([], 0, self._dt, self.plan.image_size, self.plan.event)
        self._begin_step()
        return self._in_order(observation)

    def observation(self, ticks: int) -> Observation:
        """
        What was seen in a control step.

        The image of events holds those of the frames after the last observation. Events that arrive after the images
        of the last tick and ``event_grace`` are dropped, with a warning the first time: their step is over.

        :param ticks: Number of simulation ticks since the last observation.
        :raises TimeoutError: if an image does not come.
        :raises RuntimeError: if a callback failed or an image is of another frame.
        """
        observation = self._see()
        if self._events is not None:
            came = self._events.drain(self.frame, self.plan.event_grace)
            self._tell_of_late(sum(self._first_frame < frame <= self._step_frame for frame, _ in came))
            arrays = [data for frame, data in came if frame > self._step_frame]
            observation["event"] = event_image(
                arrays, self._step_time, ticks * self._dt, self.plan.image_size, self.plan.event
            )
        self._begin_step()
        return self._in_order(observation)

    def _tell_of_late(self, frames: int) -> None:
        session = self.session
        if frames and not session.told_of_late_events:
            session.told_of_late_events = True
            gym.logger.warn(
                f"the events of {frames} ticks came more than event_grace = {self.plan.event_grace} s after their "
                "control step and were dropped; more may follow, untold. Raise `event_grace`, or add a camera, whose "
                "images are waited for"
            )

    def _begin_step(self) -> None:
        self._step_frame = self.frame
        self._step_time = int(1e9 * self.session.world.get_snapshot().timestamp.elapsed_seconds)

    def _see(self) -> Observation:
        timeout = self.session.server.timeout
        pixels = {name: inbox.at(self.frame, timeout) for name, inbox in self._images.items()}
        observation: Observation = {}
        if "rgb" in pixels:
            observation["rgb"] = decode_rgb(pixels["rgb"])
        if "depth" in pixels:
            metres = decode_depth_image(pixels["depth"])
            observation["depth"] = encode_depth(metres, *self.plan.depth.values())[..., None]
        return observation

    def _in_order(self, observation: Observation) -> Observation:
        return {name: observation[name] for name in self.plan.modalities}


def _is_car(model: carla.ActorBlueprint) -> bool:
    return model.has_attribute("base_type") and model.get_attribute("base_type").as_str() == "car"


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
