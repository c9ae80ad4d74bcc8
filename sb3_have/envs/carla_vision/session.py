"""The connection to a CARLA server. Closing it removes all actors and restores the settings of the server."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, cast

import carla
import gymnasium as gym

from sb3_have.envs.carla_vision.rules import CarlaConnectionError

# Loading a map takes longer than any other call [s]
LOAD_TIMEOUT: Final = 120.0
# Prefix of the role name of all actors
ROLE: Final = "sb3_have-"

# Ports of the traffic managers of this process. CARLA identifies them by port only, whatever their server is.
_tm_ports: set[int] = set()
# Servers that this process drives: a second session would destroy the actors of the first one
_servers: set[tuple[str, int]] = set()
# Servers that were lost while their traffic manager was running. It consists of threads of this process that cannot be
# stopped any more. Every tick of any world, and every change of settings, runs them and would abort the process.
_lost_with_traffic: list[str] = []
_RESTART: Final = (
    "restart the process, because CARLA's traffic manager would abort it at the next tick; a training run resumes from "
    "its checkpoint"
)


@dataclass(eq=False, repr=False)
class Session:
    """
    A CARLA server in synchronous mode, with the actors of one episode.

    :param host: Host of the server
    :param port: RPC port of the server
    :param tm_port: Port of the traffic manager
    :param town: Name of the map
    :param dt: Length of a simulation tick [s]
    :param timeout: Timeout of every call [s]
    :param traffic: Whether to start a traffic manager
    :param take_over: Whether to accept a server that another client left in synchronous mode
    """

    host: str
    port: int
    tm_port: int
    town: str
    dt: float
    timeout: float
    traffic: bool
    take_over: bool

    client: carla.Client = field(init=False)
    world: carla.World = field(init=False)
    road_map: carla.Map = field(init=False)
    blueprints: carla.BlueprintLibrary = field(init=False)
    traffic_manager: carla.TrafficManager | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.where = f"{self.host}:{self.port}"
        self.lost = False  # the server stopped answering
        # The role name of all actors, by which they are found on the server even if their handle was lost
        self._role = ROLE + uuid.uuid4().hex
        self._sensors: list[carla.Sensor] = []
        self._connected = self._closing = self._unlisted = False
        # Steps that undo what was done to the server, to be taken from the last to the first
        self._undo: list[Callable[[], object]] = []

    def connect(self) -> None:
        """
        Connect to the server, load the map, and switch to synchronous mode.

        :raises CarlaConnectionError: If there is no server, or this process lost one with traffic
        :raises RuntimeError: If another client drives the server
        :raises ValueError: If the server does not have the map
        """
        _check_traffic_managers()
        server = (self.host, self.port)
        if server in _servers:
            raise RuntimeError(
                f"this process already drives the CARLA server at {self.where}; give every environment a server of its "
                "own (port=..., tm_port=...)"
            )
        _servers.add(server)
        self._undo.append(lambda: _servers.discard(server))
        try:
            self.client = carla.Client(self.host, self.port)
            self.client.set_timeout(self.timeout)
            server_version = self.client.get_server_version()
            self.world = self.client.get_world()
        except RuntimeError as error:
            raise self.connection_error("no CARLA server at") from error
        self._connected = True

        client_version = self.client.get_client_version()
        if client_version != server_version:
            gym.logger.warn(
                f"version {client_version} of the CARLA client does not match version {server_version} of the server; "
                f"calls may fail and frame numbers may be off. Run: pip install carla=={server_version}"
            )

        # Remember what to restore
        original, weather = self.world.get_settings(), self.world.get_weather()
        if taken_over := original.synchronous_mode:
            if not self.take_over:
                raise RuntimeError(
                    f"the CARLA server at {self.where} is already in synchronous mode: another client drives it, or "
                    "died without cleaning up. Give every environment a server of its own (port=..., tm_port=...), or "
                    "pass take_over=True if no other client is running"
                )
            gym.logger.warn(f"took over the CARLA server at {self.where}; it will be left in asynchronous mode")
            original.synchronous_mode, original.fixed_delta_seconds = False, None

        self._load_town()
        settings = self.world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, self.dt
        settings.no_rendering_mode = False
        # Register each undo step before the change, so that an interrupt cannot come between the two
        self._undo.append(lambda: self._restore(original))
        self._undo.append(lambda: self.world.set_weather(weather))
        self.world.apply_settings(settings)
        if self.traffic:
            self._start_traffic_manager()
        self._undo.append(self.destroy_actors)
        if taken_over:
            self._unlisted = True
            self._destroy(ROLE)  # actors of the client that died
        self.blueprints = self.world.get_blueprint_library()

    def _load_town(self) -> None:
        self.road_map = self.world.get_map()
        if _base_name(self.road_map.name) == self.town:
            return  # reloading it would leak memory on the server
        towns = sorted({_base_name(name) for name in self.client.get_available_maps()})
        if self.town not in towns:
            raise ValueError(f"the CARLA server has no map {self.town!r}; it has {', '.join(towns)}")
        self.client.set_timeout(max(self.timeout, LOAD_TIMEOUT))
        self.world = self.client.load_world(self.town)
        self.client.set_timeout(self.timeout)
        self.road_map = self.world.get_map()

    def _restore(self, settings: carla.WorldSettings) -> None:
        if _lost_with_traffic:
            gym.logger.warn(
                f"the CARLA server at {self.where} is left in synchronous mode, because restoring its settings would "
                "abort this process; pass take_over=True to the next environment"
            )
        else:
            self.world.apply_settings(settings)

    def _start_traffic_manager(self) -> None:
        if self.tm_port in _tm_ports:
            raise RuntimeError(
                f"this process already has a traffic manager on port {self.tm_port}; give every environment its own: "
                "tm_port=..."
            )
        self._undo.append(self._stop_traffic_manager)
        self.traffic_manager = self.client.get_trafficmanager(self.tm_port)
        _tm_ports.add(self.tm_port)
        self.traffic_manager.set_synchronous_mode(True)

    def _stop_traffic_manager(self) -> None:
        # After an interrupt there may be no handle yet; asking for the port again returns the same traffic manager
        manager = self.traffic_manager or self.client.get_trafficmanager(self.tm_port)
        _tm_ports.discard(self.tm_port)
        try:
            manager.set_synchronous_mode(False)
        finally:
            self.traffic_manager = None
            manager.shut_down()

    # ---- actors ----

    def spawn(
        self, blueprint: carla.ActorBlueprint, transform: carla.Transform, parent: carla.Actor | None = None
    ) -> carla.Actor | None:
        """Spawn an actor, which :meth:`destroy_actors` removes. Returns None if another object is in the way."""
        blueprint.set_attribute("role_name", self._role)
        self._unlisted = True
        actor: carla.Actor | None = self.world.try_spawn_actor(blueprint, transform, parent)
        if actor is None:
            self.client.get_server_version()  # raises if None means that the connection was lost
        return actor

    def listen(self, sensor: carla.Sensor, callback: Callable[[Any], None]) -> None:
        """Subscribe to a sensor until the actors are destroyed. CARLA calls the callback from another thread."""
        self._sensors.append(sensor)  # only this handle can stop it
        sensor.listen(callback)

    def destroy_actors(self) -> None:
        """Stop all sensors and destroy all actors of this session."""
        for sensor in self._sensors:
            with suppress(RuntimeError):
                sensor.stop()
        self._sensors.clear()
        self._destroy(self._role)

    def _destroy(self, role: str) -> None:
        try:
            # A new actor is listed after the next tick only
            if self._unlisted and not _lost_with_traffic:
                self.tick()
        finally:
            actors = cast(Iterable[carla.Actor], self.world.get_actors())
            ours = [actor for actor in actors if actor.attributes.get("role_name", "").startswith(role)]
            # Destroy sensors before the vehicle that carries them
            ours.sort(key=lambda actor: not actor.type_id.startswith("sensor."))
            commands = [carla.command.DestroyActor(actor.id) for actor in ours]
            replies = self.client.apply_batch_sync(commands, False) if commands else []
            errors = [reply.error for reply in replies if reply.has_error() and "not found" not in reply.error]
            if errors:
                gym.logger.warn(f"the CARLA server did not destroy {len(errors)} actors: {errors[0]}")

    def tick(self) -> int:
        """Advance the simulation by one tick and return the number of the frame."""
        _check_traffic_managers()
        frame = self.world.tick(self.timeout)
        self._unlisted = False
        return frame

    # ---- end of the session ----

    def usable(self) -> bool:
        """Whether the session was not closed, and the server still has the same world in synchronous mode."""
        try:
            return not self._closing and self._alive() and self.world.get_settings().synchronous_mode
        except RuntimeError:
            return False  # the server has another world, so that the handle expired

    def connection_error(self, what: str) -> CarlaConnectionError:
        """Create an error that explains how to start a server."""
        advice = f"start it with `./CarlaUE4.sh -RenderOffScreen -carla-rpc-port={self.port}`"
        if _lost_with_traffic:
            advice += f" and {_RESTART}"
        return CarlaConnectionError(f"{what} {self.where}; {advice}")

    def close(self) -> None:
        """
        Destroy the actors and restore the settings of the server. A second call completes an interrupted one.

        A server that does not answer is left alone: every call would wait for the timeout, and a traffic manager
        without its server aborts the process.
        """
        self._closing = True
        if self._connected and not self._alive():
            self._give_up()
        while self._undo:
            try:
                self._undo[-1]()
            except RuntimeError as error:
                if not self._alive():
                    self._give_up()
                    break
                gym.logger.warn(f"cleaning up the CARLA server at {self.where} failed: {error}")
            self._undo.pop()
        self._connected = False

    def _give_up(self) -> None:
        self.lost = True
        if self._stop_traffic_manager in self._undo:
            _lost_with_traffic.append(self.where)
        _servers.discard((self.host, self.port))
        self._undo.clear()

    def _alive(self) -> bool:
        try:
            self.client.set_timeout(self.timeout)  # loading a map may have left a longer one
            self.client.get_server_version()
        except RuntimeError as error:
            return "time-out" not in str(error)
        return True


def _base_name(map_name: str) -> str:
    return map_name.rsplit("/", 1)[-1]


def _check_traffic_managers() -> None:
    if _lost_with_traffic:
        raise CarlaConnectionError(
            f"this process lost the CARLA server at {_lost_with_traffic[0]} while it had traffic; {_RESTART}"
        )
