"""One episode on a CARLA server: spawning, ticking, and the observations of the ego vehicle's sensors."""

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
    Plan,
    draw_place,
    pedals,
    steering_gain,
)
from sb3_have.envs.carla_vision.sensors import (
    Inbox,
    copy_events,
    copy_pixels,
    decode_depth,
    decode_rgb,
    dvs_attributes,
    event_image,
    impulse,
)
from sb3_have.envs.carla_vision.session import Session
from sb3_have.envs.vision import Observation
from sb3_have.sensors.depth import encode_depth

# Position of the roof camera relative to the centre of the car [m], and its horizontal field of view [degrees]
CAMERA: Final = {"x": 1.0, "z": 1.5}
FIELD_OF_VIEW: Final = 60.0
# Places to try for a car before giving up
ATTEMPTS: Final = 20
# Ticks before the episode starts, while cars drop onto the road and sensors begin to send
SETTLING: Final = 10
# Height above the road where cars spawn [m]; CARLA refuses to spawn a car that touches the road
LIFT: Final = 0.3
# Distance of the car's centre from the edge of the nearest lane that still counts as on the road [m], because there
# are small gaps between the roads of a map
MARGIN: Final = 0.3

BLUEPRINTS: Final = {"rgb": "sensor.camera.rgb", "depth": "sensor.camera.depth", "event": "sensor.camera.dvs"}


class LaneState(NamedTuple):
    """Speed along the nearest lane [m/s], speed in any direction [m/s], and whether the car is off the road."""

    lane_speed: float
    speed: float
    offroad: bool


class Episode:
    """
    An episode on a CARLA server. The constructor replaces the actors of the last one and lets the new ones settle.

    :param session: The connection to the server
    :param plan: Options of the episode
    :param weather: Name of a preset of ``carla.WeatherParameters``
    :param rng: Random number generator
    :raises RuntimeError: If there is no room for a car, or the server is lost
    """

    def __init__(self, session: Session, plan: Plan, weather: str, rng: np.random.Generator) -> None:
        self.session, self.plan = session, plan
        session.destroy_actors()
        session.world.set_weather(getattr(carla.WeatherParameters, weather))
        if session.traffic_manager is not None:
            session.traffic_manager.set_random_device_seed(int(rng.integers(2**31)))

        # Spawn the vehicles
        blueprint = session.blueprints.find(plan.ego_vehicle)
        self.ego = self._spawn_car(blueprint, EGO_RANGE, rng, "the ego vehicle")
        lock = self.ego.get_physics_control().wheels[0].max_steer_angle
        self._steering_gain = steering_gain(plan.steering_range, lock)
        if session.traffic_manager is not None:
            self._add_traffic(session.traffic_manager, rng)

        # Mount the sensors
        self._images = {name: self._camera(name, copy_pixels) for name in plan.modalities if name != "event"}
        self._events = self._camera("event", copy_events) if "event" in plan.modalities else None
        self._collisions: Inbox[float] = Inbox("collision", impulse)
        self._mount(session.blueprints.find("sensor.other.collision"), carla.Transform(), self._collisions)

        self._settle()
        self._first_frame = self._observed_frame = self.frame
        self._observed_time = 0
        self.lane = self._lane_state()

    # ---- actors ----

    def _spawn_car(
        self, blueprint: carla.ActorBlueprint, s_range: tuple[float, float], rng: np.random.Generator, who: str
    ) -> carla.Vehicle:
        plan, road_map = self.plan, self.session.road_map
        for _ in range(ATTEMPTS):
            lane, s = draw_place(rng, plan.lanes_count, s_range)
            actor = self.session.spawn(blueprint, spawn_transform(road_map, plan.road_id, lane, s))
            if actor is not None:
                return cast(carla.Vehicle, actor)
        raise RuntimeError(
            f"found no room for {who} in {ATTEMPTS} attempts, on lanes -1..-{plan.lanes_count} of road {plan.road_id} "
            f"at s in {list(s_range)} m; remove the cars of other clients, or reduce `vehicles_count`"
        )

    def _add_traffic(self, traffic_manager: carla.TrafficManager, rng: np.random.Generator) -> None:
        plan = self.plan
        models = [model for model in self.session.blueprints.filter("vehicle.*") if _is_car(model)]
        models.sort(key=lambda model: model.id)
        for number in range(1, plan.vehicles_count + 1):
            model = models[rng.integers(len(models))]
            if model.has_attribute("color"):
                colours = model.get_attribute("color").recommended_values
                model.set_attribute("color", colours[rng.integers(len(colours))])
            vehicle = self._spawn_car(model, TRAFFIC_RANGE, rng, f"vehicle {number} of {plan.vehicles_count}")
            vehicle.set_autopilot(True, self.session.tm_port)
            if plan.traffic_speed is not None:
                traffic_manager.set_desired_speed(vehicle, 3.6 * float(rng.uniform(*plan.traffic_speed)))

    def _camera(self, name: str, read: Callable[[Any], Any]) -> Inbox[Any]:
        size = str(self.plan.image_size)
        attributes = {"image_size_x": size, "image_size_y": size, "fov": str(FIELD_OF_VIEW)}
        if name == "event":
            attributes |= dvs_attributes(self.plan.event)
        blueprint = self.session.blueprints.find(BLUEPRINTS[name])
        for attribute, value in attributes.items():
            blueprint.set_attribute(attribute, value)
        inbox: Inbox[Any] = Inbox(name, read)
        self._mount(blueprint, carla.Transform(carla.Location(**CAMERA)), inbox)
        return inbox

    def _mount(self, blueprint: carla.ActorBlueprint, transform: carla.Transform, inbox: Inbox[Any]) -> None:
        sensor = self.session.spawn(blueprint, transform, self.ego)
        if sensor is None:
            raise RuntimeError(f"the server could not spawn the {inbox.name} sensor ({blueprint.id}); see its log")
        self.session.listen(cast(carla.Sensor, sensor), inbox)

    # ---- time ----

    def _settle(self) -> None:
        self.ego.apply_control(carla.VehicleControl(throttle=0.0, steer=0.0, brake=1.0, hand_brake=True))
        for _ in range(SETTLING - 1):
            self.session.tick()
        # Release the brakes for the last tick
        self.ego.apply_control(carla.VehicleControl())
        if self.plan.initial_speed > 0:
            forward = self.ego.get_transform().get_forward_vector()
            self.ego.set_target_velocity(forward * self.plan.initial_speed)
        self.frame = self.session.tick()

    def tick(self, throttle: float, steer: float) -> LaneState:
        """Apply an action for one tick and return the motion of the ego vehicle."""
        control = pedals(throttle, steer, self.lane.speed, self.plan.max_speed, self._steering_gain)
        self.ego.apply_control(carla.VehicleControl(*control))
        self.frame = self.session.tick()
        self.lane = self._lane_state()
        return self.lane

    def _lane_state(self) -> LaneState:
        return lane_state(self.session.road_map, self.ego.get_location(), self.ego.get_velocity())

    # ---- sensors ----

    def collisions(self) -> tuple[int, float]:
        """Count the ticks with a collision, and sum the impulses [N s], reported since the last call."""
        # Ignore collisions before the start of the episode
        reports = [report for report in self._collisions.drain() if report[0] > self._first_frame]
        return len({frame for frame, _ in reports}), sum(size for _, size in reports)

    def observe(self, ticks: int) -> Observation:
        """
        Read the sensors.

        :param ticks: Number of ticks since the last observation; 0 at the start of the episode
        :return: Image of the last frame per modality; events of all frames since the last observation
        :raises TimeoutError: If an image does not arrive
        :raises RuntimeError: If a callback failed or an image is of a later frame
        """
        plan, session = self.plan, self.session
        pixels = {name: inbox.at(self.frame, session.timeout) for name, inbox in self._images.items()}
        images: Observation = {}
        if "rgb" in pixels:
            images["rgb"] = decode_rgb(pixels["rgb"])
        if "depth" in pixels:
            images["depth"] = encode_depth(decode_depth(pixels["depth"]), *plan.depth.values())[..., None]
        if self._events is not None:
            arrays = self._new_events(self._events)
            duration = max(1, ticks) * session.dt
            images["event"] = event_image(arrays, self._observed_time, duration, plan.image_size, plan.event)

        # The next step starts here
        self._observed_frame = self.frame
        self._observed_time = int(1e9 * session.world.get_snapshot().timestamp.elapsed_seconds)
        return {name: images[name] for name in plan.modalities}

    def _new_events(self, inbox: Inbox[Any]) -> list[Any]:
        received = inbox.drain(self.frame, self.plan.event_grace)
        if any(self._first_frame < frame <= self._observed_frame for frame, _ in received):
            gym.logger.warn(
                f"events arrived more than event_grace = {self.plan.event_grace} s after the end of their control step "
                "and were dropped; increase `event_grace`"
            )
        return [events for frame, events in received if frame > self._observed_frame]


def _is_car(model: carla.ActorBlueprint) -> bool:
    return model.has_attribute("base_type") and model.get_attribute("base_type").as_str() == "car"


def spawn_transform(road_map: carla.Map, road_id: int, lane: int, s: float) -> carla.Transform:
    """Compute the pose for spawning a car on the centre of a lane, at arc length ``s`` [m]."""
    waypoint = road_map.get_waypoint_xodr(road_id, lane, s)
    if waypoint is None:
        raise ValueError(
            f"map {road_map.name} has no lane {lane} on road {road_id} at s = {s:.1f} m; choose another `road_id` or "
            "`town`, or reduce `lanes_count`"
        )
    centre = waypoint.transform.location
    return carla.Transform(carla.Location(centre.x, centre.y, centre.z + LIFT), waypoint.transform.rotation)


def lane_state(road_map: carla.Map, location: carla.Location, velocity: carla.Vector3D) -> LaneState:
    """Compute the motion of a car relative to the nearest driving lane."""
    waypoint = road_map.get_waypoint(location)
    centre, forward = waypoint.transform.location, waypoint.transform.get_forward_vector()
    lane_speed = velocity.x * forward.x + velocity.y * forward.y + velocity.z * forward.z
    speed = math.sqrt(velocity.x**2 + velocity.y**2 + velocity.z**2)
    lateral = math.hypot(location.x - centre.x, location.y - centre.y)
    return LaneState(lane_speed, speed, lateral > waypoint.lane_width / 2 + MARGIN)
