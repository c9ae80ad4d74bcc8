"""The classes of the ``carla`` module that need a server, as a fake that runs in memory.

Every class and method has the name and the arguments of the real one (test_fake_carla.py). Value types such as
transforms, controls, settings, weathers and maps are the real ones, because they work without a server. What happens
on the server is in fake_carla_server.py.
"""

from __future__ import annotations

import copy
import fnmatch
import functools
import math
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, Concatenate, ParamSpec, TypeVar

import carla

if TYPE_CHECKING:
    from fake_carla_server import Server

P = ParamSpec("P")
R = TypeVar("R")

SETTINGS = ("synchronous_mode", "fixed_delta_seconds", "no_rendering_mode", "max_culling_distance")
MAX_STEER = 70.0  # [degrees]


def remote(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """A call that waits for the answer of the server, and fails without one."""

    @functools.wraps(method)
    def call(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> R:
        self._server.reach(method.__qualname__, self)
        result = method(self, *args, **kwargs)
        self._server.finish(method.__qualname__)
        return result

    return call


def posted(method: Callable[Concatenate[Any, P], None]) -> Callable[Concatenate[Any, P], None]:
    """A call that does not wait, and has no effect without a server."""

    @functools.wraps(method)
    def call(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> None:
        if self._server.begin(method.__qualname__, self):
            method(self, *args, **kwargs)
        self._server.finish(method.__qualname__)

    return call


def expect(value: Any, *kinds: type) -> None:
    """Raise what Boost.Python raises: NumPy's numbers are neither float nor int."""
    kinds = (*kinds, int) if float in kinds else kinds
    if not isinstance(value, kinds):
        raise TypeError(f"Python argument types did not match C++ signature: {type(value).__name__} for {kinds}")


# ---- data of the sensors ----


class SensorData:
    """Its buffer is overwritten when the callback has returned, as CARLA reuses it."""

    _buffer = bytearray()

    def __init__(self, frame: int) -> None:
        self.frame = frame


class Image(SensorData):
    def __init__(self, frame: int, size: int, data: bytes) -> None:
        super().__init__(frame)
        self._buffer = bytearray(data)
        self.raw_data, self.width, self.height = memoryview(self._buffer), size, size


class DVSEventArray(SensorData):
    def __init__(self, frame: int, data: bytes) -> None:
        super().__init__(frame)
        self._buffer = bytearray(data)
        self.raw_data = memoryview(self._buffer)


class CollisionEvent(SensorData):
    def __init__(self, frame: int, normal_impulse: carla.Vector3D) -> None:
        super().__init__(frame)
        self.normal_impulse = normal_impulse


# ---- blueprints ----


class ActorAttribute:
    def __init__(self, value: str, kind: type = str) -> None:
        self._value, self._kind = value, kind

    @property
    def recommended_values(self) -> list[str]:
        return [self._value]

    def as_str(self) -> str:
        return self._value


class ActorBlueprint:
    def __init__(self, name: str, attributes: dict[str, ActorAttribute]) -> None:
        self._name, self._attributes = name, dict(attributes)

    @property
    def id(self) -> str:
        return self._name

    def has_attribute(self, id: str) -> bool:
        return id in self._attributes

    def get_attribute(self, id: str) -> ActorAttribute:
        if id not in self._attributes:
            raise IndexError(f"attribute '{id}' not found")
        return self._attributes[id]

    def set_attribute(self, id: str, value: str) -> None:
        expect(value, str)
        attribute = self.get_attribute(id)
        if attribute._kind is bool and value not in ("true", "false"):
            raise ValueError("invalid attribute value")
        attribute._kind(value)
        self._attributes[id] = ActorAttribute(value, attribute._kind)


class BlueprintLibrary:
    def __init__(self, blueprints: list[ActorBlueprint]) -> None:
        self._blueprints = blueprints

    def find(self, id: str) -> ActorBlueprint:
        for blueprint in self:
            if blueprint.id == id:
                return blueprint
        raise IndexError(f"blueprint '{id}' not found")

    def filter(self, wildcard_pattern: str) -> BlueprintLibrary:
        return BlueprintLibrary([b for b in self._blueprints if fnmatch.fnmatch(b.id, wildcard_pattern)])

    def __iter__(self) -> Iterator[ActorBlueprint]:
        return (ActorBlueprint(blueprint.id, blueprint._attributes) for blueprint in self._blueprints)


# ---- actors ----


class Actor:
    def __init__(self, server: Server, number: int, blueprint: ActorBlueprint, pose: carla.Transform) -> None:
        self._server, self._life = server, server.life
        self._number, self._blueprint = number, blueprint
        self._x, self._y, self._z = pose.location.x, pose.location.y, pose.location.z
        self._yaw, self._speed = math.radians(pose.rotation.yaw), 0.0
        # State at the last tick, which is all that a client sees
        self._seen = (carla.Transform(), carla.Vector3D())

    @property
    def id(self) -> int:
        return self._number

    @property
    def type_id(self) -> str:
        return self._blueprint.id

    @property
    def attributes(self) -> dict[str, str]:
        return {name: attribute.as_str() for name, attribute in self._blueprint._attributes.items()}

    def get_transform(self) -> carla.Transform:
        return self._seen[0]

    def get_location(self) -> carla.Location:
        return self._seen[0].location

    def get_velocity(self) -> carla.Vector3D:
        return self._seen[1]

    def _pose(self) -> carla.Transform:
        location = carla.Location(self._x, self._y, self._z)
        return carla.Transform(location, carla.Rotation(yaw=math.degrees(self._yaw)))


class Vehicle(Actor):
    """Drives on a plane: gains 6 m/s^2 at full throttle, and loses 10 with the brake and 20 with the hand brake."""

    def __init__(self, server: Server, number: int, blueprint: ActorBlueprint, pose: carla.Transform) -> None:
        super().__init__(server, number, blueprint, pose)
        self._control = carla.VehicleControl()
        self._autopilot: int | None = None

    @posted
    def apply_control(self, control: carla.VehicleControl) -> None:
        expect(control, carla.VehicleControl)
        assert 0 <= control.throttle <= 1 and 0 <= control.brake <= 1 and -1 <= control.steer <= 1, control
        self._control = control

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
        expect(tm_port, int)
        assert tm_port in self._server.traffic_managers, "the client would start a second traffic manager"
        self._autopilot = tm_port if enabled else None

    def _move(self, dt: float) -> None:
        control = self._control
        if self._autopilot is not None:
            self._speed = self._server.traffic_managers[self._autopilot]._speeds.get(self.id, 60.0) / 3.6
        else:
            drag = min(abs(self._speed) / dt, 10.0 * control.brake + 20.0 * control.hand_brake)
            self._speed += (6.0 * control.throttle - math.copysign(drag, self._speed)) * dt
            self._yaw += self._speed / 2.9 * math.tan(math.radians(MAX_STEER) * control.steer) * dt
        self._x += self._speed * math.cos(self._yaw) * dt
        self._y += self._speed * math.sin(self._yaw) * dt
        road = self._server.map.get_waypoint(carla.Location(self._x, self._y, self._z)).transform
        self._z = road.location.z
        forward = carla.Vector3D(self._speed * math.cos(self._yaw), self._speed * math.sin(self._yaw), 0.0)
        self._seen = (self._pose(), forward)


class Sensor(Actor):
    _parent: Vehicle
    _callback: Callable[[Any], Any] | None = None
    _ticks = 0

    @posted
    def listen(self, callback: Callable[[Any], Any]) -> None:
        self._callback = callback

    @posted
    def stop(self) -> None:
        self._callback = None


# ---- the client ----


class Client:
    _find: ClassVar[Callable[[str, int], Server]]  # set by fake_carla_server.install

    def __init__(self, host: str = "127.0.0.1", port: int = 2000) -> None:
        expect(port, int)
        self._server = type(self)._find(host, port)
        self._life = self._server.life

    def set_timeout(self, seconds: float, /) -> None:
        expect(seconds, float)
        self._server.timeouts["calls"] = seconds

    @remote
    def get_client_version(self) -> str:
        return "0.9.16"

    @remote
    def get_server_version(self) -> str:
        return self._server.version

    @remote
    def get_available_maps(self) -> list[str]:
        return ["/Game/Carla/Maps/Town01", "/Game/Carla/Maps/Town04"]

    @remote
    def get_world(self) -> World:
        return World(self._server)

    @remote
    def load_world(self, map_name: str) -> World:
        self._server.load(map_name)
        self._server.settings = carla.WorldSettings()
        return World(self._server)

    @remote
    def get_trafficmanager(self, port: int = 8000, /) -> TrafficManager:
        expect(port, int)
        managers = self._server.traffic_managers
        if port not in managers or not managers[port]._usable:
            managers[port] = TrafficManager(self._server)
        return managers[port]

    @remote
    def apply_batch_sync(self, commands: list[Any], do_tick: bool = False) -> list[Any]:
        assert all(isinstance(command, carla.command.DestroyActor) for command in commands) and not do_tick
        errors = [self._server.remove(command.actor_id) for command in commands]
        return [SimpleNamespace(error=error, has_error=lambda error=error: bool(error)) for error in errors]


class World:
    def __init__(self, server: Server) -> None:
        self._server, self._life = server, server.life

    @remote
    def get_map(self) -> carla.Map:
        return self._server.map

    @remote
    def get_settings(self) -> carla.WorldSettings:
        settings = carla.WorldSettings()
        for name in SETTINGS:
            setattr(settings, name, getattr(self._server.settings, name))
        return settings

    @remote
    def apply_settings(self, settings: carla.WorldSettings, /) -> int:
        expect(settings, carla.WorldSettings)
        run_traffic_managers()
        self._server.settings = settings
        return self._server.frame

    @remote
    def get_weather(self) -> Any:
        return self._server.weather

    @posted
    def set_weather(self, weather: carla.WeatherParameters) -> None:
        expect(weather, carla.WeatherParameters)
        self._server.weather = weather

    @remote
    def get_blueprint_library(self) -> BlueprintLibrary:
        return self._server.library

    @remote
    def get_actors(self) -> list[Actor]:
        actors = self._server.actors
        return [copy.copy(actors[number]) for number in self._server.listed if number in actors]

    def get_snapshot(self) -> Any:
        server = self._server
        return SimpleNamespace(timestamp=carla.Timestamp(server.frame, server.elapsed, server.dt, 0.0))

    def try_spawn_actor(
        self, blueprint: ActorBlueprint, transform: carla.Transform, attach_to: Actor | None = None
    ) -> Actor | None:
        expect(transform, carla.Transform)
        try:
            self._server.reach("World.try_spawn_actor", self)
        except RuntimeError as error:
            if "time-out" in str(error):
                return None  # the real client also hides a lost connection
            raise
        actor = self._server.spawn(blueprint, transform, attach_to)
        self._server.finish("World.try_spawn_actor")
        return actor

    @remote
    def tick(self, seconds: float = 10.0) -> int:
        expect(seconds, float)
        self._server.timeouts["ticks"] = seconds
        run_traffic_managers()
        return self._server.tick()


def run_traffic_managers() -> None:
    """What every tick of any world, and every change of settings, does with all traffic managers of the process."""
    for manager in TrafficManager._of_this_process:
        if manager._usable and manager._synchronous and not manager._runs():
            manager._server.violations.append("a traffic manager ran without its server: the process would abort")


class TrafficManager:
    """Lives in the client's process, and aborts it when its server is gone."""

    _of_this_process: ClassVar[list[TrafficManager]] = []

    def __init__(self, server: Server) -> None:
        self._server, self._life = server, server.life
        self._synchronous, self._usable = False, True
        self._seed: int | None = None
        self._speeds: dict[int, float] = {}
        self._of_this_process.append(self)

    def _runs(self) -> bool:
        return self._usable and self._server.alive and self._life == self._server.life

    @remote
    def set_synchronous_mode(self, mode_switch: bool) -> None:
        self._synchronous = mode_switch

    @remote
    def set_random_device_seed(self, value: int) -> None:
        expect(value, int)
        self._seed = value

    @remote
    def set_desired_speed(self, actor: Actor, speed: float) -> None:
        expect(actor, Actor)
        expect(speed, float)
        self._speeds[actor.id] = speed

    @remote
    def shut_down(self) -> None:
        if self._synchronous:
            self._server.violations.append("a traffic manager was shut down in synchronous mode")
        self._usable = False
