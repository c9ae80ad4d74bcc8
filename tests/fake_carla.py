"""A CARLA server in memory, for driving the real client code without one.

``install(monkeypatch, server)`` puts it in the place of ``carla.Client``; everything else is reached through the
client. Transforms, controls, settings, weathers, waypoints and the map are the real objects of the ``carla`` module,
which work without a server. The fake is stricter than the real client where that lets mistakes pass.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections import Counter
from typing import Any

import carla
import numpy as np
import pytest
from fake_carla_actors import Actor, Sensor, Vehicle
from fake_carla_client import SETTINGS, Client, TrafficManager
from fake_carla_data import ActorBlueprint, SensorData, blueprints
from fake_carla_road import other_town, town04


class Server:
    """What a CARLA server holds, and the switches that make it fail.

    :param town: the map that it has loaded
    :param port: where clients find it
    """

    def __init__(self, town: str = "Town04", port: int = 2000) -> None:
        self.port, self.version = port, "0.9.16"
        self.alive, self.life, self.episode = True, 0, 0
        self.calls: list[str] = []  # every call, "World.tick"
        self.missed = 0  # calls that waited in vain
        self.violations: list[str] = []  # what the real client allows, though it does harm
        self.timeouts: dict[str, float] = {}  # the last of "calls" and of "ticks" [s]
        self.sent: dict[str, dict[int, Any]] = {}  # type of sensor -> frame -> data
        self.settings = carla.WorldSettings()
        self.frame, self.elapsed, self._last_id = 1000, 37.25, 23
        self.traffic_managers: dict[int, TrafficManager] = {}
        self.library = blueprints()
        self.threaded = False  # callbacks run in threads of their own
        self._failures: dict[tuple[str, int, bool], BaseException | None] = {}
        self._count: Counter[str] = Counter()
        self._drop: Counter[str] = Counter()
        self._late: dict[str, int] = {}
        self._slow: dict[str, float] = {}
        self._shift: dict[str, int] = {}
        self._corrupt: set[str] = set()
        self._blocked = 0
        self._impulses: list[tuple[float, float, float]] = []
        self._waiting: list[tuple[int, Sensor, SensorData]] = []
        self._threads: dict[int, threading.Thread] = {}  # the last of each sensor
        self.load(town)

    # ---- switches ----

    def fail(self, call: str, error: BaseException, after: int = 0, done: bool = False) -> None:
        """The call after the next ``after`` ones raises ``error``; "World.tick", "Sensor.stop" and so on, "*" for any.

        :param done: the server has done its work when the error strikes
        """
        self._failures[call, self._count[call] + after + 1, done] = error

    def die(self, call: str | None = None, after: int = 0) -> None:
        """Stop answering, at once or from the call after the next ``after`` ones on."""
        if call is None:
            self.alive = False
        else:
            self._failures[call, self._count[call] + after + 1, False] = None

    def restart(self, town: str = "Town04") -> None:
        """A fresh server at the same port; no handle of before is good for anything."""
        self.alive, self.life, self.missed = True, self.life + 1, 0
        self.settings, self.frame, self.elapsed = carla.WorldSettings(), 3, 0.5
        self.load(town)

    def drop(self, sensor: str, ticks: int) -> None:
        """The sensor misses its next ticks."""
        self._drop[sensor] += ticks

    def late(self, sensor: str, ticks: int) -> None:
        """All that the sensor sends comes so many ticks later."""
        self._late[sensor] = ticks

    def slow(self, sensor: str, seconds: float) -> None:
        """All that the sensor sends comes so much after the tick has returned, from another thread."""
        self._slow[sensor] = seconds

    def misnumber(self, sensor: str, by: int) -> None:
        """Measurements carry a wrong frame."""
        self._shift[sensor] = by

    def corrupt(self, sensor: str) -> None:
        """Half of each buffer is missing, so that whoever decodes it in the callback fails there."""
        self._corrupt.add(sensor)

    def block(self, spawns: int) -> None:
        """So many attempts to spawn a vehicle end in a collision."""
        self._blocked = spawns

    def collide(self, *impulses: tuple[float, float, float]) -> None:
        """Impulses [N s] that the next ticks' collision sensor reports, one a tick."""
        self._impulses.extend(impulses)

    def heal(self) -> None:
        """No more failures."""
        self._failures.clear()
        for switch in (self._drop, self._late, self._slow, self._shift):
            switch.clear()
        self._corrupt.clear()
        self._impulses.clear()
        self._blocked, self.threaded = 0, False

    # ---- what tests look at ----

    @property
    def ego(self) -> Vehicle:
        """The only vehicle that no traffic manager drives."""
        (ego,) = (vehicle for vehicle in self.vehicles() if vehicle._autopilot is None)
        return ego

    def vehicles(self) -> list[Vehicle]:
        return [actor for actor in self.actors.values() if isinstance(actor, Vehicle)]

    def sensors(self) -> list[Sensor]:
        return [actor for actor in self.actors.values() if isinstance(actor, Sensor)]

    def left_behind(self) -> list[str]:
        """What a client should have cleared away before it left."""
        found = [f"{actor.type_id} {number} lives" for number, actor in self.actors.items()]
        found += [f"{name} is {value}" for name in SETTINGS[:3] if (value := getattr(self.settings, name))]
        managers = self.traffic_managers.items()
        found += [f"traffic manager at {port} runs" for port, tm in managers if tm._runs()]
        return found + self.violations

    def join(self) -> None:
        """Wait for the callbacks that are still on their way."""
        for thread in self._threads.values():
            thread.join()
        self._threads.clear()

    # ---- the simulation ----

    def load(self, town: str) -> None:
        texts = {"Town04": town04, "Town01": other_town}
        if town not in texts:
            raise RuntimeError(f"map '{town}' not found")
        self.episode += 1
        self.map = carla.Map(f"Carla/Maps/{town}", texts[town]())
        self.actors: dict[int, Actor] = {}
        self.listed: list[int] = []  # of the last tick
        self.weather = carla.WeatherParameters()
        self._waiting.clear()

    def note(self, call: str, handle: Any) -> bool:
        """Record a call; raise what was arranged for it; tell whether the handle belongs to this server's world."""
        self.calls.append(call)
        self._count.update((call, "*"))
        self._strike(call, done=False)
        return self.alive and handle._life == self.life

    def answered(self, call: str) -> None:
        """The end of a call that waits for its answer."""
        self._strike(call, done=True)

    def _strike(self, call: str, done: bool) -> None:
        for name in (call, "*"):
            if (key := (name, self._count[name], done)) in self._failures:
                error = self._failures.pop(key)
                if error is not None:
                    raise error
                self.alive = False

    def reach(self, call: str, handle: Any) -> None:
        if not self.note(call, handle):
            self.missed += 1
            raise RuntimeError(
                "time-out of 200ms while waiting for the simulator, make sure the simulator is ready and connected to "
                f"localhost:{self.port}"
            )
        if getattr(handle, "_episode", self.episode) != self.episode:
            raise RuntimeError(
                "trying to access an expired episode; a new episode was started in the simulation but an object tried "
                "accessing the old one."
            )

    @property
    def step_length(self) -> float:
        return float(self.settings.fixed_delta_seconds or 0.0)

    def tick(self) -> int:
        self._deliver_late()
        self.frame += 1
        self.elapsed += self.step_length
        for actor in self.actors.values():
            actor._move(self.step_length)
        for actor in self.actors.values():
            actor._report()
        self.listed = list(self.actors)
        for sensor in self.sensors():
            for data in sensor._measure():
                self._send(sensor, data)
        return self.frame

    def scene(self) -> bytes:
        """Everything that the cameras see, where the vehicles are and what the weather is."""
        poses = np.array([(v._x, v._y, v._yaw) for v in self.vehicles()]).round(6)
        return poses.tobytes() + str(self.weather).encode()

    def due_impulses(self) -> list[tuple[float, float, float]]:
        return [self._impulses.pop(0)] if self._impulses else []

    def touched_by(self, vehicle: Vehicle) -> list[Vehicle]:
        return [other for other in self.vehicles() if other is not vehicle and vehicle._touches(other)]

    def spawn(self, blueprint: ActorBlueprint, transform: carla.Transform, parent: Actor | None) -> Actor | None:
        kind = Sensor if blueprint.id.startswith("sensor.") else Vehicle
        self._last_id += 1
        actor = kind(self, self._last_id, blueprint, transform, parent)
        if isinstance(actor, Vehicle):
            ground = self.map.get_waypoint(transform.location).transform.location.z
            self._blocked -= (blocked := self._blocked > 0)
            if blocked or actor._z < ground + 0.05 or self.touched_by(actor):
                return None
        self.actors[actor.id] = actor
        return actor

    def remove(self, number: int) -> bool:
        actor = self.actors.pop(number, None)
        if actor is None:
            return False
        if isinstance(actor, Sensor) and actor.is_listening():
            self.violations.append(f"{actor.type_id} was destroyed while it was listening")
        self.violations += [
            f"{actor.type_id} was destroyed before its {child.type_id}"
            for child in self.actors.values()
            if child.parent is actor
        ]
        actor._destroyed = True
        return True

    # ---- delivery ----

    def _send(self, sensor: Sensor, data: SensorData) -> None:
        name = sensor.type_id
        if self._drop[name] > 0:
            self._drop[name] -= 1
            return
        data._fields["frame"] += self._shift.get(name, 0)
        if name in self._corrupt:
            data._fields["raw_data"] = data._fields["raw_data"][: len(data._buffer) // 2 - 1]
        if self._late.get(name):
            self._waiting.append((self.frame + self._late[name], sensor, data))
        else:
            self._hand_over(sensor, data, self._slow.get(name, 0.0))

    def _deliver_late(self) -> None:
        due = [entry for entry in self._waiting if entry[0] <= self.frame + 1]
        self._waiting = [entry for entry in self._waiting if entry not in due]
        for _, sensor, data in due:
            self._hand_over(sensor, data, 0.0)

    def _hand_over(self, sensor: Sensor, data: SensorData, delay: float) -> None:
        callback = sensor._callback
        if callback is None:
            return

        before, due = self._threads.get(sensor.id), time.monotonic() + delay

        def run() -> None:
            if before is not None:
                before.join()  # a sensor's data come in order
            time.sleep(max(0.0, due - time.monotonic()))
            try:
                callback(data)
            except Exception:  # the client prints it and goes on
                traceback.print_exc()
            data._die()

        if self.threaded or delay:
            self._threads[sensor.id] = threading.Thread(target=run, daemon=True)
            self._threads[sensor.id].start()
        else:
            run()


def install(monkeypatch: pytest.MonkeyPatch, *servers: Server) -> None:
    """Let ``carla.Client`` find these servers, and nothing else."""

    def find(host: str, port: int) -> Server:
        for server in servers:
            if server.port == port and host in ("localhost", "127.0.0.1"):
                return server
        nobody = Server(port=port)
        nobody.die()
        return nobody

    monkeypatch.setattr(Client, "_find", staticmethod(find), raising=False)
    monkeypatch.setattr(carla, "Client", Client)
    new_process(monkeypatch, *servers)


def new_process(monkeypatch: pytest.MonkeyPatch, *servers: Server) -> None:
    """Traffic managers and callbacks have died with the clients' process."""
    for server in servers:
        server.traffic_managers.clear()
        server.listed.clear()  # a client knows of no actor before the first tick that it sees
        for sensor in server.sensors():
            sensor._callback = None
    monkeypatch.setattr(TrafficManager, "_of_this_process", [], raising=False)
