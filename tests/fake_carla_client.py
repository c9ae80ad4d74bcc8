"""The client side of the fake CARLA server: what ``carla.Client`` leads to, apart from actors and their data."""

from __future__ import annotations

import fnmatch
import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar, Concatenate

import carla
import numpy as np
from fake_carla_actors import Actor, P, posted, remote
from fake_carla_data import ActorBlueprint, BlueprintLibrary, expect

if TYPE_CHECKING:
    from fake_carla import Server

SETTINGS = (
    "synchronous_mode",
    "no_rendering_mode",
    "fixed_delta_seconds",
    "substepping",
    "max_substep_delta_time",
    "max_substeps",
    "max_culling_distance",
    "deterministic_ragdolls",
    "tile_stream_distance",
    "actor_active_distance",
    "spectator_as_ego",
)


def copy_settings(settings: carla.WorldSettings) -> carla.WorldSettings:
    copy = carla.WorldSettings()
    for name in SETTINGS:
        setattr(copy, name, getattr(settings, name))
    return copy


class Client:
    _find: ClassVar[Callable[[str, int], Server]]  # set by fake_carla.install

    def __init__(self, host: str = "127.0.0.1", port: int = 2000, worker_threads: int = 0) -> None:
        expect(host, str)
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
    def load_world(self, map_name: str, reset_settings: bool = True) -> World:
        expect(map_name, str)
        if any(manager._runs() and manager._synchronous for manager in self._server.traffic_managers.values()):
            self._server.violations.append("a map was loaded under a synchronous traffic manager")
        self._server.load(map_name.rsplit("/")[-1])
        if reset_settings:
            self._server.settings = carla.WorldSettings()
        return World(self._server)

    @remote
    def get_trafficmanager(self, port: int = 8000, /) -> TrafficManager:
        expect(port, int)
        managers = self._server.traffic_managers
        if port not in managers or not managers[port]._usable:
            managers[port] = TrafficManager(self._server, port)
        if managers[port]._life != self._server.life:
            raise RuntimeError("trying to create rpc server for traffic manager; bind error.")
        return managers[port]

    @remote
    def apply_batch_sync(self, commands: list[Any], do_tick: bool = False) -> list[Any]:
        expect(do_tick, bool)
        responses = []
        for command in commands:
            if not isinstance(command, carla.command.DestroyActor):
                raise NotImplementedError(f"command {command!r}")
            done = self._server.remove(command.actor_id)
            responses.append(Response(command.actor_id, "" if done else "unable to destroy actor: not found"))
        if do_tick:
            self._server.tick()
        return responses


class Response:
    """Of a command in a batch."""

    def __init__(self, actor_id: int, error: str) -> None:
        self._actor_id, self._error = actor_id, error

    @property
    def actor_id(self) -> int:
        return self._actor_id

    @property
    def error(self) -> str:
        return self._error

    def has_error(self) -> bool:
        return bool(self._error)


class World:
    def __init__(self, server: Server) -> None:
        self._server, self._life, self._episode = server, server.life, server.episode

    @property
    def id(self) -> int:
        return self._episode

    @remote
    def get_map(self) -> carla.Map:
        return self._server.map

    @remote
    def get_settings(self) -> carla.WorldSettings:
        return copy_settings(self._server.settings)

    @remote
    def apply_settings(self, settings: carla.WorldSettings, seconds: float = 0.0, /) -> int:
        expect(settings, carla.WorldSettings)
        expect(seconds, float)
        run_traffic_managers(self._server)
        self._server.settings = copy_settings(settings)
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
    def get_actors(self) -> ActorList:
        actors = self._server.actors
        return ActorList([actors[number]._handle() for number in self._server.listed if number in actors])

    def get_snapshot(self) -> WorldSnapshot:
        server = self._server
        return WorldSnapshot(carla.Timestamp(server.frame, server.elapsed, server.step_length, 0.0), server.listed)

    @remote
    def spawn_actor(
        self, blueprint: ActorBlueprint, transform: carla.Transform, attach_to: Actor | None = None
    ) -> Actor:
        actor = self._spawn(blueprint, transform, attach_to)
        if actor is None:
            raise RuntimeError("Spawn failed because of collision at spawn position")
        return actor

    @remote
    def try_spawn_actor(
        self, blueprint: ActorBlueprint, transform: carla.Transform, attach_to: Actor | None = None
    ) -> Actor | None:
        return self._spawn(blueprint, transform, attach_to)

    def _spawn(self, blueprint: ActorBlueprint, transform: carla.Transform, attach_to: Actor | None) -> Actor | None:
        expect(blueprint, ActorBlueprint)
        expect(transform, carla.Transform)
        expect(attach_to, Actor, type(None))
        if blueprint.id.startswith("sensor.") and attach_to is None:
            raise AssertionError(f"{blueprint.id} hangs in the air: attach it to a vehicle")
        return self._server.spawn(blueprint, transform, attach_to)

    @remote
    def tick(self, seconds: float = 10.0) -> int:
        expect(seconds, float)
        if not self._server.settings.synchronous_mode or not self._server.step_length:
            raise AssertionError("tick() without synchronous mode and fixed_delta_seconds")
        self._server.timeouts["ticks"] = seconds
        run_traffic_managers(self._server)
        return self._server.tick()


class WorldSnapshot:
    def __init__(self, timestamp: carla.Timestamp, actors: list[int]) -> None:
        self._timestamp, self._actors = timestamp, actors

    @property
    def frame(self) -> int:
        return int(self._timestamp.frame)

    @property
    def timestamp(self) -> carla.Timestamp:
        return self._timestamp

    def has_actor(self, actor_id: int) -> bool:
        return actor_id in self._actors


class ActorList:
    def __init__(self, actors: list[Actor]) -> None:
        self._actors = actors

    def filter(self, wildcard_pattern: str) -> ActorList:
        expect(wildcard_pattern, str)
        return ActorList([actor for actor in self._actors if fnmatch.fnmatch(actor.type_id, wildcard_pattern)])

    def find(self, actor_id: int, /) -> Actor | None:
        return next((actor for actor in self._actors if actor.id == actor_id), None)

    def __iter__(self) -> Iterator[Actor]:
        return iter(self._actors)

    def __len__(self) -> int:
        return len(self._actors)

    def __getitem__(self, pos: int) -> Actor:
        return self._actors[pos]


def managed(method: Callable[Concatenate[TrafficManager, P], None]) -> Callable[Concatenate[TrafficManager, P], None]:
    """A call to a traffic manager: ends the process if its server is gone, which its user may have noticed before."""

    @functools.wraps(method)
    def call(self: TrafficManager, /, *args: P.args, **kwargs: P.kwargs) -> None:
        server = self._server
        if not self._usable:
            raise RuntimeError("the traffic manager was shut down")
        known = server.missed > 0 or self._life != server.life
        if not server.note(method.__qualname__, self):
            server.violations += [f"{method.__qualname__} without a server: the process would abort"] * known
            raise RuntimeError("time-out of 200ms while waiting for the simulator")
        method(self, *args, **kwargs)
        server.answered(method.__qualname__)

    return call


def run_traffic_managers(server: Server) -> None:
    """What each tick of any world, and each change of settings, does in the client: the process has all of them."""
    for manager in TrafficManager._of_this_process:
        if manager._usable and manager._synchronous and not manager._runs():
            server.violations.append(f"traffic manager {manager._port} ran without its server: the process would abort")


class TrafficManager:
    """Lives in the client's process; its threads end the process when they find that their server is gone."""

    _of_this_process: ClassVar[list[TrafficManager]]  # set by fake_carla.install

    def __init__(self, server: Server, port: int) -> None:
        self._server, self._life, self._port = server, server.life, port
        self._synchronous, self._usable = False, True
        self._seed: int | None = None
        self._rng = np.random.default_rng()  # without a seed no two runs are the same
        self._speeds: dict[int, float] = {}
        self._of_this_process.append(self)

    def _runs(self) -> bool:
        """It was not shut down, and has a server."""
        return self._usable and self._server.alive and self._life == self._server.life

    def _draw(self) -> float:
        """How a vehicle deviates from the speed that it is told, as traffic managers' vehicles do."""
        return float(self._rng.uniform(0.95, 1.05))

    def get_port(self) -> int:
        return self._port

    @managed
    def set_synchronous_mode(self, mode_switch: bool) -> None:
        expect(mode_switch, bool)
        self._synchronous = mode_switch

    @managed
    def set_random_device_seed(self, value: int) -> None:
        expect(value, int)
        if not 0 <= value < 2**64:
            raise OverflowError(f"seed {value}")
        self._seed, self._rng = value, np.random.default_rng(value)

    @managed
    def set_desired_speed(self, actor: Actor, speed: float) -> None:
        expect(actor, Actor)
        expect(speed, float)
        self._speeds[actor.id] = speed

    @managed
    def auto_lane_change(self, actor: Actor, enable: bool) -> None:
        expect(actor, Actor)
        expect(enable, bool)

    @managed
    def shut_down(self) -> None:
        self._usable = False
