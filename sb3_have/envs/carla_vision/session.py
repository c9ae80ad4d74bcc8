"""The connection to a CARLA server: what was changed there is undone, what was put there is removed, come what may."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final, cast

import carla
import gymnasium as gym

from sb3_have.envs.carla_vision.errors import CarlaConnectionError

#: Loading a map takes longer than any other call [s].
LOAD_TIMEOUT: Final = 120.0
#: How long to wait for a sign of life before giving a server up [s].
PING_TIMEOUT: Final = 5.0
#: The roles of all actors begin so.
ROLE: Final = "sb3_have-"

# Traffic managers live in threads of this process, on ports. One whose server died stays there, unusable.
_dead_ports: set[int] = set()


@dataclass(frozen=True)
class Server:
    """
    Which server to connect to, and how it is to run.

    :param host: Its name or address.
    :param port: Its RPC port.
    :param tm_port: Port for the traffic manager; environments of different processes need different ones.
    :param town: The map.
    :param tick: Length of a simulation tick [s].
    :param timeout: For every call [s].
    :param traffic: Whether there will be traffic, and so a traffic manager.
    """

    host: str
    port: int
    tm_port: int
    town: str
    tick: float
    timeout: float
    traffic: bool


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
        self._actors: list[carla.Actor] = []
        self._spawning = self._connected = self._closing = False
        #: What puts things right, in the order of the things done; each step may be taken again.
        self._undo: list[Callable[[], object]] = []

    def connect(self) -> None:
        """
        Connect, and take the server over.

        :raises CarlaConnectionError: if there is none.
        :raises ValueError: if it does not have the town.
        """
        server = self.server
        try:
            self.client = carla.Client(server.host, server.port)
            self.client.set_timeout(server.timeout)
            theirs = self.client.get_server_version()
            self.world = self.client.get_world()
        except RuntimeError as error:
            self.lost = True
            raise self.connection_error("no CARLA server at") from error
        self._connected = True
        ours = self.client.get_client_version()
        if ours != theirs:
            gym.logger.warn(
                f"CARLA client {ours} talks to a server of version {theirs}: calls may fail or mean something else. "
                f"Install the client of that version: pip install carla=={theirs}"
            )
        original, weather = self.world.get_settings(), self.world.get_weather()
        abandoned = original.synchronous_mode
        if abandoned:
            gym.logger.warn(
                f"the CARLA server at {server.host}:{server.port} is in synchronous mode already: another client "
                "drives it, or died without cleaning up. It will be left in asynchronous mode."
            )
            original.synchronous_mode, original.fixed_delta_seconds = False, None
        self._load_town()
        settings = self.world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, server.tick
        settings.no_rendering_mode = False
        # Each step is noted before there is something to undo, so that an interrupt between cannot hide it.
        self._undo.append(lambda: self.world.apply_settings(original))
        self._undo.append(lambda: self.world.set_weather(weather))
        self.world.apply_settings(settings)
        self.tm_port = server.tm_port
        if server.traffic:
            self._start_traffic_manager()
        self._undo.append(self.destroy_actors)
        if abandoned:
            self._find_actors(ROLE)  # whoever died may have left some behind
        self.blueprints = self.world.get_blueprint_library()

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
        while self.tm_port in _dead_ports:
            self.tm_port += 1
        self._undo.append(self._stop_traffic_manager)
        try:
            self.traffic_manager = self.client.get_trafficmanager(self.tm_port)
        except RuntimeError as error:
            self._undo.pop()
            raise RuntimeError(
                f"no traffic manager on port {self.tm_port}: {error}. If the port is taken, choose another `tm_port`"
            ) from error
        self.traffic_manager.set_synchronous_mode(True)

    def _stop_traffic_manager(self) -> None:
        # If it ran on it would poll the server, and abort this process when that is shut down. An interrupt right after
        # it was started leaves us without a handle; asking for the port again gives one.
        manager = self.traffic_manager or self.client.get_trafficmanager(self.tm_port)
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
        with self._noticed():
            # an Actor or None, whatever the stub says
            actor: carla.Actor | None = self.world.try_spawn_actor(blueprint, transform, parent)
            if actor is None:
                self.client.get_server_version()  # None also stands for a lost connection; this would raise then
            else:
                self._actors.append(actor)
        return actor

    @contextmanager
    def _noticed(self) -> Iterator[None]:
        """An interrupt between the server's answer and our note of it leaves an actor that only the server knows."""
        self._spawning = True
        yield
        self._spawning = False  # not in a `finally`: an exception leaves it standing for `destroy_actors` to read

    def destroy_actors(self) -> None:
        """Stop and remove every sensor, then every vehicle, of this session."""
        if self._spawning:
            self._find_actors(self.role)
            self._spawning = False
        self._actors.sort(key=lambda actor: not actor.type_id.startswith("sensor."))  # these first
        for actor in 2 * self._actors:  # one error is no reason to leave a sensor streaming
            with suppress(RuntimeError):
                if actor.type_id.startswith("sensor.") and cast(carla.Sensor, actor).is_listening():
                    cast(carla.Sensor, actor).stop()
        if self._actors:
            destroy = [carla.command.DestroyActor(actor.id) for actor in self._actors]
            failures = [reply.error for reply in self.client.apply_batch_sync(destroy, False) if reply.has_error()]
            failures = [failure for failure in failures if "not found" not in failure]  # gone already
            if failures:
                gym.logger.warn(f"the CARLA server did not remove {len(failures)} actors: {failures[0]}")
        self._actors.clear()

    def _find_actors(self, role: str) -> None:
        """Note those of a role, or roles that begin so, that only the server knows."""
        self.tick()  # new actors are listed from the next tick on
        known = {actor.id for actor in self._actors}
        everybody = cast(Iterable[carla.Actor], self.world.get_actors())
        found = [actor for actor in everybody if actor.attributes.get("role_name", "").startswith(role)]
        self._actors += [actor for actor in found if actor.id not in known]

    def tick(self) -> int:
        """Let one tick of simulated time pass; its frame."""
        return self.world.tick(self.server.timeout)

    # ---- ends ----

    def connection_error(self, what: str) -> CarlaConnectionError:
        """An error that says where no server is, and how to start one."""
        server = self.server
        return CarlaConnectionError(
            f"{what} {server.host}:{server.port}; start it with "
            f"`./CarlaUE4.sh -RenderOffScreen -carla-rpc-port={server.port}`"
        )

    def close(self) -> None:
        """
        Remove the actors, restore the settings of the server. Calling it again finishes what was interrupted.

        A server that has gone is left alone: each call would wait for its time-out, and a traffic manager that cannot
        reach its server aborts the whole process.

        :raises BaseException: an interrupt, after the other steps.
        """
        self._closing = True
        if self._connected and not self._alive():
            self._give_up()
        interrupt: BaseException | None = None
        for step in reversed(self._undo.copy()):
            try:
                if not self.lost:
                    self._take(step)
            except BaseException as error:
                interrupt = interrupt or error
            else:
                self._undo = [other for other in self._undo if other is not step]
        if interrupt is not None:
            raise interrupt
        self._connected = False

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
            _dead_ports.add(self.tm_port)
        self._undo.clear()

    def usable(self) -> bool:
        """Whether the server is there, its world is the one connected to, and it still waits for our ticks."""
        try:
            return not self._closing and self._alive() and self.world.get_settings().synchronous_mode
        except RuntimeError:
            return False  # another world has been loaded

    def _alive(self) -> bool:
        try:
            self.client.set_timeout(min(self.server.timeout, PING_TIMEOUT))
            self.client.get_server_version()
            self.client.set_timeout(self.server.timeout)
        except RuntimeError:
            return False
        return True
