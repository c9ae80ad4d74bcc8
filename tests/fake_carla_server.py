"""The fake CARLA server: its simulation, and the faults that tests can inject."""

from __future__ import annotations

import threading
import zlib
from collections import Counter
from collections.abc import Callable
from typing import Any

import carla
import numpy as np
from fake_carla import (
    SETTINGS,
    Actor,
    ActorAttribute,
    ActorBlueprint,
    BlueprintLibrary,
    CollisionEvent,
    DVSEventArray,
    Image,
    Sensor,
    SensorData,
    TrafficManager,
    Vehicle,
)
from fake_carla_road import town01, town04

from sb3_have.envs.carla_vision.sensors import DVS_DTYPE

RGB, DEPTH, DVS = "sensor.camera.rgb", "sensor.camera.depth", "sensor.camera.dvs"
COLLISION = "sensor.other.collision"

# Attributes of the blueprints of the sensors, and their types
_CAMERA: dict[str, type] = {"image_size_x": int, "image_size_y": int, "fov": float}
_EVENTS: dict[str, type] = {
    "positive_threshold": float,
    "negative_threshold": float,
    "sigma_positive_threshold": float,
    "sigma_negative_threshold": float,
    "log_eps": float,
    "refractory_period_ns": int,
    "use_log": bool,
}
_KINDS: dict[str, dict[str, type]] = {RGB: _CAMERA, DEPTH: _CAMERA, DVS: _CAMERA | _EVENTS, COLLISION: {}}
_VEHICLES = {"tesla.model3": "car", "audi.tt": "car", "nissan.patrol": "car", "yamaha.yzf": "motorcycle"}


class Server:
    """
    What a CARLA server holds, and switches that make it fail.

    :param town: The map that it has loaded
    :param port: The port where clients find it
    """

    def __init__(self, town: str = "Town04", port: int = 2000) -> None:
        self.port, self.version = port, "0.9.16"
        self.alive, self.life = True, 0
        self.calls: list[str] = []
        self.missed = 0  # calls that waited for the timeout
        self.violations: list[str] = []  # what the real client allows, although it does harm
        self.timeouts: dict[str, float] = {}
        self.sent: dict[str, dict[int, Any]] = {}  # data by type of sensor and frame
        self.settings = carla.WorldSettings()
        self.frame, self.elapsed, self._last_id = 1000, 37.25, 23
        self.traffic_managers: dict[int, TrafficManager] = {}
        cars = {f"vehicle.{name}": {"base_type": kind, "color": "255,0,0"} for name, kind in _VEHICLES.items()}
        self.library = BlueprintLibrary(
            [_blueprint(name, {key: ("0", kind) for key, kind in kinds.items()}) for name, kinds in _KINDS.items()]
            + [_blueprint(name, {key: (value, str) for key, value in car.items()}) for name, car in cars.items()]
        )
        self._count: Counter[str] = Counter()
        self._held: list[tuple[Callable[[SensorData], None], SensorData]] = []
        self._threads: list[threading.Thread] = []
        self.heal()
        self.load(town)

    # ---- faults ----

    def fail(self, call: str, error: BaseException | None, after: int = 0, done: bool = False) -> None:
        """
        Make a call fail.

        :param call: Name such as "World.tick", or "*" for any call
        :param error: Exception to raise; None makes the server die
        :param after: Number of calls that succeed before
        :param done: Whether the server has done its work before the failure
        """
        self._failures[call, self._count[call] + after + 1, done] = error

    def disturb(self, sensor: str, **fault: Any) -> None:
        """
        Disturb a sensor: ``drop`` n ticks, be n ticks ``late``, ``hold`` the data until :meth:`release`, ``shift`` the
        frame number, or ``corrupt`` the buffer.
        """
        self._faults[sensor] = fault

    def collide(self, *impulses: tuple[float, float, float], at_once: int = 1) -> None:
        """Report collisions with these impulses [N s] in the next ticks, ``at_once`` in each."""
        self._impulses.extend(impulses)
        self._at_once = at_once

    def heal(self) -> None:
        """Undo all faults."""
        self._failures: dict[tuple[str, int, bool], BaseException | None] = {}
        self._faults: dict[str, dict[str, Any]] = {}
        self._impulses: list[tuple[float, float, float]] = []
        self._at_once = 1
        self.blocked = 0  # number of attempts to spawn a vehicle that fail

    def restart(self, town: str = "Town04") -> None:
        """Start a new server at the same port. Handles of the old one do not work any more."""
        self.alive, self.life, self.missed = True, self.life + 1, 0
        self.settings, self.frame, self.elapsed = carla.WorldSettings(), 3, 0.5
        self.load(town)

    # ---- what tests look at ----

    @property
    def vehicles(self) -> list[Vehicle]:
        return [actor for actor in self.actors.values() if isinstance(actor, Vehicle)]

    @property
    def sensors(self) -> list[Sensor]:
        return [actor for actor in self.actors.values() if isinstance(actor, Sensor)]

    @property
    def ego(self) -> Vehicle:
        (ego,) = (vehicle for vehicle in self.vehicles if vehicle._autopilot is None)
        return ego

    def left_behind(self) -> list[str]:
        """What a client should have cleaned up."""
        found = [f"{actor.type_id} {number} is alive" for number, actor in self.actors.items()]
        found += [f"{name} is {value}" for name in SETTINGS[:3] if (value := getattr(self.settings, name))]
        found += [f"traffic manager at {port} runs" for port, tm in self.traffic_managers.items() if tm._runs()]
        return found + self.violations

    def release(self) -> None:
        """Send from a thread, in its order, what sensors hold."""
        held, self._held = self._held, []

        def send_all() -> None:
            for callback, data in held:
                send(callback, data)

        self._threads.append(threading.Thread(target=send_all, daemon=True))
        self._threads[-1].start()

    def join(self) -> None:
        """Wait for the threads."""
        while self._threads:
            self._threads.pop().join()

    # ---- calls of the client ----

    def begin(self, call: str, handle: Any) -> bool:
        """Record a call, raise its failure, and return whether the handle belongs to this server."""
        self.calls.append(call)
        self._count.update((call, "*"))
        self._strike(call, done=False)
        return bool(self.alive and handle._life == self.life)

    def finish(self, call: str) -> None:
        self._strike(call, done=True)

    def _strike(self, call: str, done: bool) -> None:
        for name in (call, "*"):
            if (key := (name, self._count[name], done)) in self._failures:
                error = self._failures.pop(key)
                if error is not None:
                    raise error
                self.alive = False

    def reach(self, call: str, handle: Any) -> None:
        if not self.begin(call, handle):
            if isinstance(handle, TrafficManager) and self.missed:
                self.violations.append(f"{call} without a server: the process would abort")
            self.missed += 1
            raise RuntimeError(
                "time-out of 200ms while waiting for the simulator, make sure the simulator is ready and connected to "
                f"localhost:{self.port}"
            )

    # ---- simulation ----

    @property
    def dt(self) -> float:
        return float(self.settings.fixed_delta_seconds or 0.0)

    def load(self, town: str) -> None:
        self.map = carla.Map(f"Carla/Maps/{town}", {"Town04": town04, "Town01": town01}[town]())
        self.actors: dict[int, Actor] = {}
        self.listed: list[int] = []
        self.weather = carla.WeatherParameters()
        self._waiting: list[tuple[int, Sensor, SensorData]] = []

    def spawn(self, blueprint: ActorBlueprint, pose: carla.Transform, parent: Actor | None) -> Actor | None:
        self._last_id += 1
        if not blueprint.id.startswith("sensor."):
            ground = self.map.get_waypoint(pose.location).transform.location.z
            near = [v for v in self.vehicles if v._pose().location.distance(pose.location) < 4.0]
            self.blocked -= (blocked := self.blocked > 0)
            if blocked or near or pose.location.z < ground + 0.05:
                return None
            self.actors[self._last_id] = Vehicle(self, self._last_id, blueprint, pose)
        else:
            assert isinstance(parent, Vehicle), "a sensor must be attached to a vehicle"
            self.actors[self._last_id] = sensor = Sensor(self, self._last_id, blueprint, pose)
            sensor._parent = parent
        return self.actors[self._last_id]

    def remove(self, number: int) -> str:
        actor = self.actors.pop(number, None)
        if isinstance(actor, Sensor) and actor._callback is not None:
            self.violations.append(f"{actor.type_id} was destroyed while it was listening")
        if any(sensor._parent is actor for sensor in self.sensors):
            self.violations.append("a vehicle was destroyed before its sensors")
        return "" if actor else "unable to destroy actor: not found"

    def tick(self) -> int:
        assert self.settings.synchronous_mode and self.dt, "tick() requires synchronous mode"
        self._deliver_late()
        self.frame += 1
        self.elapsed += self.dt
        for vehicle in self.vehicles:
            vehicle._move(self.dt)
        self.listed = list(self.actors)
        for sensor in self.sensors:
            sensor._ticks += 1
            for data in self._measure(sensor):
                self._send(sensor, data)
        return self.frame

    def _measure(self, sensor: Sensor) -> list[SensorData]:
        kind, sent = sensor.type_id, self.sent.setdefault(sensor.type_id, {})
        if kind == COLLISION:
            sent[self.frame] = hits = [self._impulses.pop(0) for _ in range(self._at_once) if self._impulses]
            return [CollisionEvent(self.frame, carla.Vector3D(*hit)) for hit in hits]
        size = int(sensor.attributes["image_size_x"])
        # What cameras see depends on the vehicles and the weather
        scene = np.array([(v._x, v._y, v._yaw) for v in self.vehicles]).round(6).tobytes()
        rng = np.random.default_rng(zlib.crc32(kind.encode() + scene + str(self.weather).encode()))
        if kind == DVS:
            moving = abs(sensor._parent._speed) > 1e-3 and sensor._ticks > 1
            sent[self.frame] = events = self._events(rng, size, 200 if moving else 0)
            return [DVSEventArray(self.frame, events.tobytes())] if moving else []
        pixels = rng.integers(0, 256, (size, size, 4), dtype=np.uint8)
        if kind == DEPTH:
            pixels[: size // 3] = 255  # the sky
        sent[self.frame] = pixels
        return [Image(self.frame, size, pixels.tobytes())]

    def _events(self, rng: np.random.Generator, size: int, count: int) -> Any:
        """Events sorted by time, the first and the last at the very ends of the tick."""
        ends = [round(1e9 * t) for t in (self.elapsed - self.dt, self.elapsed)]
        events = np.empty(count, DVS_DTYPE)
        events["x"], events["y"] = rng.integers(size, size=(2, count))
        events["t"] = np.sort(rng.integers(ends[0], ends[1] + 1, size=count))
        events["t"][:1], events["t"][-1:] = ends
        events["pol"] = rng.integers(2, size=count)
        return events

    # ---- delivery of the data ----

    def _send(self, sensor: Sensor, data: SensorData) -> None:
        fault = self._faults.get(sensor.type_id, {})
        if fault.get("drop", 0) > 0:
            fault["drop"] -= 1
            return
        data.frame += fault.get("shift", 0)
        if fault.get("corrupt"):
            data.raw_data = memoryview(data._buffer)[: len(data._buffer) // 2 - 1]  # type: ignore[attr-defined]
        if fault.get("late"):
            self._waiting.append((self.frame + fault["late"], sensor, data))
        else:
            self._deliver(sensor, data, bool(fault.get("hold")))

    def _deliver_late(self) -> None:
        due = [entry for entry in self._waiting if entry[0] <= self.frame + 1]
        self._waiting = [entry for entry in self._waiting if entry not in due]
        for _, sensor, data in due:
            self._deliver(sensor, data)

    def _deliver(self, sensor: Sensor, data: SensorData, hold: bool = False) -> None:
        if sensor._callback is None:
            return
        if hold:
            self._held.append((sensor._callback, data))
        else:
            send(sensor._callback, data)


def send(callback: Callable[[SensorData], None], data: SensorData) -> None:
    """Call a sensor's callback; its data does not outlive the call."""
    callback(data)
    data._buffer[:] = bytes(len(data._buffer))


def _blueprint(name: str, attributes: dict[str, tuple[str, type]]) -> ActorBlueprint:
    attributes = {"role_name": ("default", str), **attributes}
    return ActorBlueprint(name, {key: ActorAttribute(*value) for key, value in attributes.items()})
