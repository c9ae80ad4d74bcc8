"""The connection to a CARLA server: what was changed there is undone, what was put there is removed, come what may."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, Final, cast

import carla
import gymnasium as gym

from sb3_have.envs.carla_vision.rules import CarlaConnectionError, Server

#: Loading a map takes longer than any other call [s].
LOAD_TIMEOUT: Final = 120.0
#: The roles of all actors begin so.
ROLE: Final = "sb3_have-"

# Who drives which server, by host and port: a second session of this process would destroy the first one's actors.
_drivers: dict[tuple[str, int], Session] = {}
# Servers that were lost while their traffic manager, threads of this process, ran. It cannot be stopped any more. Every
# tick of any world, and every change of settings, runs it, and as it does not find its server the process aborts.
_lost_with_traffic: list[str] = []
_RESTART: Final = (
    ", and restart the process, which CARLA's traffic manager would abort at the next tick; a training resumes from "
    "its checkpoint"
)


class Session:
    """
    A server in synchronous mode, with the actors of one episode, between :meth:`connect` and :meth:`close`.

    :param server: Which and how.
    """

    client: carla.Client
    world: carla.World
    road_map: carla.Map
    traffic_manager: carla.TrafficManager | None = None

    def __init__(self, server: Server) -> None:
        self.server = server
        self.lost = False
        #: All actors of this session bear it as their role, so that none is overlooked.
        self.role = ROLE + uuid.uuid4().hex
        self.told_of_late_events = False
        self._listening: list[carla.Sensor] = []
        self._connected = self._closing = self._unlisted = False
        #: What puts things right, in the order of the things done; each step may be taken again.
        self._undo: list[Callable[[], object]] = []

    def connect(self) -> None:
        """
        Connect, and begin to drive the server.

        :raises CarlaConnectionError: if there is none, or this process cannot drive one any more.
        :raises RuntimeError: if somebody else drives it.
        :raises ValueError: if it does not have the town.
        """
        server = self.server
        where = f"{server.host}:{server.port}"
        _refuse_after_a_loss()
        if _drivers.setdefault((server.host, server.port), self) is not self:
            raise RuntimeError(
                f"this process already drives the CARLA server at {where}; give every environment a server of its own: "
                "port=..., tm_port=..."
            )
        # CARLA keeps the traffic managers of a process by their port alone, whatever server they belong to.
        for other in (driver.server for driver in _drivers.values() if driver is not self):
            if server.traffic and other.traffic and other.tm_port == server.tm_port:
                raise RuntimeError(
                    f"this process has a traffic manager on port {server.tm_port} already, for the CARLA server at "
                    f"{other.host}:{other.port}; give every environment its own: tm_port=..."
                )
        try:
            self.client = carla.Client(server.host, server.port)
            self.client.set_timeout(server.timeout)
            version = self.client.get_server_version()
            self.world = self.client.get_world()
        except RuntimeError as error:
            self.lost = True
            raise self.connection_error("no CARLA server at") from error
        self._connected = True
        ours = self.client.get_client_version()
        if ours != version:
            gym.logger.warn(
                f"CARLA client {ours} talks to a server of version {version}: calls may fail or mean something else, "
                "and images may bear frame numbers that are off by some ticks. Install the client of that version: "
                f"pip install carla=={version}"
            )
        original, weather = self.world.get_settings(), self.world.get_weather()
        if taken_over := original.synchronous_mode:
            if not server.take_over:
                raise RuntimeError(
                    f"the CARLA server at {where} is in synchronous mode already: another client drives it, or one "
                    "died without cleaning up. Give every environment a server of its own (port=..., tm_port=...); if "
                    "nobody else is there, pass take_over=True"
                )
            gym.logger.warn(f"took over the CARLA server at {where}; it will be left in asynchronous mode")
            original.synchronous_mode, original.fixed_delta_seconds = False, None
        self._load_town()
        settings = self.world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, server.tick
        settings.no_rendering_mode = False
        # Each step is noted before there is something to undo, so that an interrupt between cannot hide it.
        self._undo.append(lambda: self._restore(original))
        self._undo.append(lambda: self.world.set_weather(weather))
        self.world.apply_settings(settings)
        if server.traffic:
            self._start_traffic_manager()
        self._undo.append(self._destroy)
        self._undo.append(self._stop_sensors)
        if taken_over:
            self._unlisted = True
            self._destroy(ROLE)  # whoever died may have left some behind
        self.blueprints = self.world.get_blueprint_library()

    def _restore(self, settings: carla.WorldSettings) -> None:
        if not _lost_with_traffic:
            self.world.apply_settings(settings)
            return
        gym.logger.warn(
            f"the CARLA server at {self.server.host}:{self.server.port} is left in synchronous mode: restoring it "
            f"would abort this process, which lost {_lost_with_traffic[0]}. Pass take_over=True to the next environment"
        )

    def _load_town(self) -> None:
        town = self.server.town
        self.road_map = self.world.get_map()
        if self.road_map.name.rsplit("/", 1)[-1] == town:
            return  # loading it again would leak memory on the server
        towns = sorted({name.rsplit("/", 1)[-1] for name in self.client.get_available_maps()})
        if town not in towns:
            raise ValueError(f"the server has no town {town!r}; it has {', '.join(towns)}")
        self.client.set_timeout(max(self.server.timeout, LOAD_TIMEOUT))
        self.world = self.client.load_world(town)
        self.client.set_timeout(self.server.timeout)
        self.road_map = self.world.get_map()

    def _start_traffic_manager(self) -> None:
        port = self.server.tm_port
        self._undo.append(self._stop_traffic_manager)
        try:
            self.traffic_manager = self.client.get_trafficmanager(port)
        except RuntimeError as error:
            self._undo.pop()
            raise RuntimeError(
                f"no traffic manager on port {port}: {error}. If the port is taken, choose another `tm_port`"
            ) from error
        self.traffic_manager.set_synchronous_mode(True)

    def _stop_traffic_manager(self) -> None:
        # If it ran on it would poll the server, and abort this process when that is shut down. An interrupt right after
        # it was started leaves us without a handle; asking for the port again gives one.
        manager = self.traffic_manager or self.client.get_trafficmanager(self.server.tm_port)
        try:
            manager.set_synchronous_mode(False)
        finally:
            self.traffic_manager = None
            manager.shut_down()

    # ---- actors ----

    def spawn(
        self, blueprint: carla.ActorBlueprint, transform: carla.Transform, parent: carla.Actor | None = None
    ) -> carla.Actor | None:
        """
        Put an actor into the world; :meth:`destroy_actors` and :meth:`close` remove it.

        :param blueprint: Of the actor; its role is set here.
        :param transform: Where, relative to the parent if there is one.
        :param parent: What to fix it to.
        :return: None if something is in the way.
        """
        blueprint.set_attribute("role_name", self.role)
        self._unlisted = True
        # an Actor or None, whatever the stub says
        actor: carla.Actor | None = self.world.try_spawn_actor(blueprint, transform, parent)
        if actor is None:
            self.client.get_server_version()  # None also stands for a lost connection; this would raise then
        return actor

    def listen(self, sensor: carla.Sensor, callback: Callable[[Any], None]) -> None:
        """
        Let a sensor send its data, until :meth:`destroy_actors` or :meth:`close`.

        :param sensor: As :meth:`spawn` returned it: only this handle can stop it.
        :param callback: Called with each datum, from another thread.
        """
        self._listening.append(sensor)
        sensor.listen(callback)

    def destroy_actors(self) -> None:
        """Stop and remove every sensor, then every vehicle, of this session."""
        self._stop_sensors()
        self._destroy()

    def _stop_sensors(self) -> None:
        while self._listening:
            for _ in range(2):  # one error may pass; a sensor that does not stop must not keep the others
                with suppress(RuntimeError):
                    if self._listening[-1].is_listening():
                        self._listening[-1].stop()
                    break
            self._listening.pop()

    def _destroy(self, role: str | None = None) -> None:
        """Remove all actors whose role begins so; the server knows them, even if an interrupt hid them from us."""
        try:
            if self._unlisted and not _lost_with_traffic:
                self.tick()  # new actors are listed from the next tick on
        finally:  # a server too slow for a tick may still remove what it lists
            self._remove_listed(self.role if role is None else role)

    def _remove_listed(self, role: str) -> None:
        everybody = cast(Iterable[carla.Actor], self.world.get_actors())
        ours = [actor for actor in everybody if actor.attributes.get("role_name", "").startswith(role)]
        ours.sort(key=lambda actor: not actor.type_id.startswith("sensor."))  # these first
        if ours:
            destroy = [carla.command.DestroyActor(actor.id) for actor in ours]
            failures = [reply.error for reply in self.client.apply_batch_sync(destroy, False) if reply.has_error()]
            failures = [failure for failure in failures if "not found" not in failure]  # gone already
            if failures:
                gym.logger.warn(f"the CARLA server did not remove {len(failures)} actors: {failures[0]}")

    def tick(self) -> int:
        """
        Let one tick of simulated time pass; its frame.

        :raises CarlaConnectionError: if this process has lost a server with traffic, which a tick would not survive.
        """
        _refuse_after_a_loss()
        frame = self.world.tick(self.server.timeout)
        self._unlisted = False
        return frame

    # ---- ends ----

    def connection_error(self, what: str) -> CarlaConnectionError:
        """An error that says where no server is, and how to start one."""
        server = self.server
        return CarlaConnectionError(
            f"{what} {server.host}:{server.port}; start it with "
            f"`./CarlaUE4.sh -RenderOffScreen -carla-rpc-port={server.port}`" + _RESTART * bool(_lost_with_traffic)
        )

    def close(self) -> None:
        """
        Remove the actors, restore the settings of the server. Calling it again finishes what was interrupted.

        A server that has gone is left alone: each call would wait for its time-out, and a traffic manager that cannot
        reach its server aborts the whole process.

        :raises BaseException: an interrupt; the steps that it left are for the next call.
        """
        self._closing = True
        if self._connected and not self._alive():
            self._give_up()
        while self._undo:
            self._take(self._undo[-1])
            if self._undo:
                self._undo.pop()
        self._connected = False
        if _drivers.get(key := (self.server.host, self.server.port)) is self:
            del _drivers[key]

    def _take(self, step: Callable[[], object]) -> None:
        try:
            step()
        except RuntimeError:
            if not self._alive():
                self._give_up()
                return
            try:
                step()
            except RuntimeError as error:
                gym.logger.warn(f"cleaning up the CARLA server {self.server.host}:{self.server.port} failed: {error}")

    def _give_up(self) -> None:
        self.lost = True
        if self._stop_traffic_manager in self._undo:
            _lost_with_traffic.append(f"{self.server.host}:{self.server.port}")
        self._undo.clear()

    def usable(self) -> bool:
        """Whether the server is there, its world is the one connected to, and it still waits for our ticks."""
        try:
            return not self._closing and self._alive() and self.world.get_settings().synchronous_mode
        except RuntimeError:
            return False  # another world has been loaded

    def _alive(self) -> bool:
        for _ in range(2):  # one error of another kind is no sign of death
            try:
                self.client.set_timeout(self.server.timeout)  # loading a town may have left another
                self.client.get_server_version()
                return True
            except RuntimeError as error:
                if "time-out" in str(error):
                    break
        return False


def _refuse_after_a_loss() -> None:
    if _lost_with_traffic:
        raise CarlaConnectionError(
            f"this process lost the CARLA server at {_lost_with_traffic[0]} while traffic was there{_RESTART}"
        )
