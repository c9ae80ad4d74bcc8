"""The actors of the fake CARLA server: points that drive on a plane, and sensors whose data follow from the scene."""

from __future__ import annotations

import copy
import functools
import math
import zlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import carla
import numpy as np
from fake_carla_data import (
    DVS_DTYPE,
    ActorBlueprint,
    CollisionEvent,
    DVSEventArray,
    Image,
    SensorData,
    depth_image,
    expect,
)
from numpy.typing import NDArray

if TYPE_CHECKING:
    from fake_carla import Server

P = ParamSpec("P")
R = TypeVar("R")

DESTROYED = (
    "trying to operate on a destroyed actor; an actor's function was called, but the actor is already destroyed."
)
CAR = (2.4, 1.0)  # half length and half width of every vehicle [m]
MAX_STEER = 70.0  # [degrees]


def remote(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """A call that waits for the server's answer."""

    @functools.wraps(method)
    def call(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> R:
        self._server.reach(method.__qualname__, self)
        result = method(self, *args, **kwargs)
        self._server.answered(method.__qualname__)
        return result

    return call


def posted(method: Callable[Concatenate[Any, P], None]) -> Callable[Concatenate[Any, P], None]:
    """A call that does not wait: it is lost without a word where there is no server."""

    @functools.wraps(method)
    def call(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> None:
        if self._server.note(method.__qualname__, self):
            method(self, *args, **kwargs)
        self._server.answered(method.__qualname__)

    return call


class Actor:
    def __init__(
        self, server: Server, number: int, blueprint: ActorBlueprint, transform: carla.Transform, parent: Actor | None
    ) -> None:
        self._server, self._life, self._episode = server, server.life, server.episode
        self._number, self._blueprint, self._parent = number, blueprint, parent
        self._destroyed = False
        where, turned = transform.location, transform.rotation
        self._x, self._y, self._z, self._yaw = where.x, where.y, where.z, math.radians(turned.yaw)
        self._pitch, self._speed = turned.pitch, 0.0
        #: What the client was told in the last tick; nothing yet of an actor spawned since.
        self._seen = (carla.Transform(), carla.Vector3D())

    @property
    def id(self) -> int:
        return self._number

    @property
    def type_id(self) -> str:
        return self._blueprint.id

    @property
    def parent(self) -> Actor | None:
        return self._parent

    @property
    def attributes(self) -> dict[str, str]:
        return {attribute.id: attribute.as_str() for attribute in self._blueprint}

    @property
    def is_alive(self) -> bool:
        return not self._destroyed

    def get_transform(self) -> carla.Transform:
        return carla.Transform(self.get_location(), self._last()[0].rotation)

    def get_location(self) -> carla.Location:
        where = self._last()[0].location
        return carla.Location(where.x, where.y, where.z)

    def get_velocity(self) -> carla.Vector3D:
        velocity = self._last()[1]
        return carla.Vector3D(velocity.x, velocity.y, velocity.z)

    def _handle(self) -> Actor:
        """Another handle of the same actor, as lists of actors have them."""
        return copy.copy(self)

    @remote
    def destroy(self) -> bool:
        return self._server.remove(self._number)

    @posted
    def set_transform(self, transform: carla.Transform) -> None:
        expect(transform, carla.Transform)
        where = transform.location
        self._x, self._y, self._z, self._yaw = where.x, where.y, where.z, math.radians(transform.rotation.yaw)

    def _last(self) -> tuple[carla.Transform, carla.Vector3D]:
        if self._destroyed:
            raise RuntimeError(DESTROYED)
        return self._seen

    def _pose(self) -> carla.Transform:
        rotation = carla.Rotation(pitch=self._pitch, yaw=math.degrees(self._yaw))
        return carla.Transform(carla.Location(self._x, self._y, self._z), rotation)

    def _move(self, dt: float) -> None:
        """One step of physics; what is not a vehicle stays where it is."""

    def _report(self) -> None:
        forward = carla.Vector3D(self._speed * math.cos(self._yaw), self._speed * math.sin(self._yaw), 0.0)
        self._seen = (self._pose(), forward)


class Vehicle(Actor):
    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._control = carla.VehicleControl()
        self._autopilot: int | None = None
        self._deviation = 1.0

    @property
    def bounding_box(self) -> carla.BoundingBox:
        return carla.BoundingBox(carla.Location(0, 0, 0.75), carla.Vector3D(*CAR, 0.75))

    @posted
    def apply_control(self, control: carla.VehicleControl) -> None:
        expect(control, carla.VehicleControl)
        if not (0 <= control.throttle <= 1 and 0 <= control.brake <= 1 and -1 <= control.steer <= 1):
            raise AssertionError(f"control out of range: {control}")
        if self._autopilot is not None:
            raise AssertionError("a vehicle of the traffic manager is driven by hand")
        self._control = control

    def get_control(self) -> carla.VehicleControl:
        return self._control

    @remote
    def get_physics_control(self) -> Any:
        physics: Any = carla.VehiclePhysicsControl()
        physics.wheels = [carla.WheelPhysicsControl(max_steer_angle=MAX_STEER) for _ in range(4)]
        return physics

    @posted
    def set_target_velocity(self, velocity: carla.Vector3D) -> None:
        expect(velocity, carla.Vector3D)
        self._speed = velocity.x * math.cos(self._yaw) + velocity.y * math.sin(self._yaw)

    @posted
    def set_autopilot(self, enabled: bool = True, tm_port: int = 8000, /) -> None:
        expect(enabled, bool)
        expect(tm_port, int)
        manager = self._server.traffic_managers.get(tm_port)
        if manager is None:
            raise AssertionError(f"no traffic manager was opened at port {tm_port}: the client would make a second one")
        self._autopilot = tm_port if enabled else None
        self._deviation = manager._draw()

    def _move(self, dt: float) -> None:
        if self._autopilot is not None:
            manager = self._server.traffic_managers[self._autopilot]
            self._speed = manager._speeds.get(self._number, 60.0) / 3.6 * self._deviation
            ahead = self._server.map.get_waypoint(carla.Location(self._x, self._y, self._z)).next(self._speed * dt)
            if ahead:
                pose = ahead[0].transform
                self._x, self._y, self._yaw = pose.location.x, pose.location.y, math.radians(pose.rotation.yaw)
            else:
                self._speed = 0.0
        else:
            control = self._control
            push = 6.0 * control.throttle * (-1 if control.reverse else 1)
            drag = min(abs(self._speed) / dt, 10.0 * control.brake + 20.0 * control.hand_brake)
            self._speed += (push - math.copysign(drag, self._speed)) * dt
            self._yaw += self._speed / 2.9 * math.tan(math.radians(MAX_STEER) * control.steer) * dt
            self._x += self._speed * math.cos(self._yaw) * dt
            self._y += self._speed * math.sin(self._yaw) * dt
        self._z = self._server.map.get_waypoint(carla.Location(self._x, self._y, self._z)).transform.location.z

    def _touches(self, other: Vehicle) -> bool:
        dx, dy = other._x - self._x, other._y - self._y
        along = dx * math.cos(self._yaw) + dy * math.sin(self._yaw)
        across = dy * math.cos(self._yaw) - dx * math.sin(self._yaw)
        return abs(along) < 2 * CAR[0] and abs(across) < 2 * CAR[1]


class Sensor(Actor):
    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._callback: Callable[[Any], Any] | None = None
        self._ticks = 0

    @posted
    def listen(self, callback: Callable[[Any], Any]) -> None:
        if self._destroyed:
            raise RuntimeError(DESTROYED)
        self._callback = callback

    def _handle(self) -> Actor:
        handle = copy.copy(self)
        handle._callback = None  # only the handle that was told to listen listens
        return handle

    def is_listening(self) -> bool:
        return self._callback is not None

    @posted
    def stop(self) -> None:
        if self._destroyed:
            raise RuntimeError(DESTROYED)
        self._callback = None

    def _where(self) -> carla.Transform:
        assert self._parent is not None
        host, mount = self._parent._pose(), carla.Location(self._x, self._y, self._z)
        rotation = carla.Rotation(pitch=self._pitch, yaw=host.rotation.yaw + math.degrees(self._yaw))
        place = host.transform(mount)
        return carla.Transform(carla.Location(place.x, place.y, place.z), rotation)

    def _measure(self) -> list[SensorData]:
        """What the sensor sends in this tick."""
        server, parent = self._server, self._parent
        assert isinstance(parent, Vehicle)
        self._ticks += 1
        place = (server.frame, server.elapsed, self._where())
        if self.type_id == "sensor.other.collision":
            hits: list[tuple[Any, Vehicle | None]] = [
                (carla.Vector3D(*impulse), None) for impulse in server.due_impulses()
            ]
            hits += [(carla.Vector3D(500.0 * (parent._speed + 1), 0.0, 0.0), v) for v in server.touched_by(parent)]
            self._remember([(hit.x, hit.y, hit.z) for hit, _ in hits])
            return [CollisionEvent(*place, actor=parent, other_actor=v, normal_impulse=hit) for hit, v in hits]
        width, height = (int(self.attributes[f"image_size_{axis}"]) for axis in "xy")
        fov = float(self.attributes["fov"])
        rng = np.random.default_rng(zlib.crc32(self.type_id.encode() + server.scene()))
        if self.type_id == "sensor.camera.dvs":
            events = self._events(rng, width, height, abs(parent._speed))
            self._remember(events)
            sent = DVSEventArray(*place, (height, width), fov, events.tobytes())
            return [sent] if len(events) else []
        if self.type_id == "sensor.camera.depth":
            metres = np.exp(rng.uniform(0, math.log(1000), (height, width)))
            metres[: height // 3] = 1000.0  # the sky
            pixels = depth_image(metres)
        else:
            pixels = rng.integers(0, 256, (height, width, 4), dtype=np.uint8)
            pixels[..., 3] = 255
        self._remember(pixels)
        return [Image(*place, (height, width), fov, pixels.tobytes())]

    def _events(self, rng: np.random.Generator, width: int, height: int, speed: float) -> NDArray[Any]:
        """Sorted by time; the first and the last lie on the very ends of the tick. None without motion."""
        count = 0 if self._ticks == 1 or speed < 1e-3 else 2 + rng.poisson(20 * speed)
        ends = [round(1e9 * t) for t in (self._server.elapsed - self._server.step_length, self._server.elapsed)]
        events = np.empty(count, DVS_DTYPE)
        events["x"], events["y"] = rng.integers(width, size=count), rng.integers(height, size=count)
        events["t"] = np.sort(rng.integers(ends[0], ends[1] + 1, size=count))
        events["t"][:1], events["t"][-1:] = ends
        events["pol"] = rng.integers(2, size=count)
        return events

    def _remember(self, data: Any) -> None:
        self._server.sent.setdefault(self.type_id, {})[self._server.frame] = data
