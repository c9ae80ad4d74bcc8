"""Options, helpers and fixtures of the tests that run CarlaVision-v0 on the fake server."""

from collections.abc import Callable, Iterator
from typing import Any

import carla
import numpy as np
import pytest
from fake_carla import Client, TrafficManager
from fake_carla_server import Server

from sb3_have.envs.carla_vision import CarlaVisionEnv, sensors, session

# Small and quick options for the environment: with traffic, and without traffic and with the cheapest sensor
SMALL: dict[str, Any] = {"image_size": 16, "vehicles_count": 2, "timeout": 0.2}
ALONE: dict[str, Any] = {**SMALL, "vehicles_count": 0, "modalities": ("depth",)}
FULL = np.array([1.0, 0.0], dtype=np.float32)
STRAIGHT = np.zeros(2, dtype=np.float32)
Start = Callable[..., CarlaVisionEnv]


def install(monkeypatch: pytest.MonkeyPatch, *servers: Server) -> None:
    """Start a process in which ``carla.Client`` finds these servers and nothing else."""

    def find(host: str, port: int) -> Server:
        for server in servers:
            if server.port == port and host in ("localhost", "127.0.0.1"):
                return server
        nobody = Server(port=port)
        nobody.alive = False
        return nobody

    monkeypatch.setattr(Client, "_find", staticmethod(find), raising=False)
    monkeypatch.setattr(carla, "Client", Client)
    # Callbacks, traffic managers and what the module remembers belong to the process
    monkeypatch.setattr(TrafficManager, "_of_this_process", [])
    monkeypatch.setattr(session, "_tm_ports", set())
    monkeypatch.setattr(session, "_servers", set())
    monkeypatch.setattr(session, "_lost_with_traffic", [])
    for server in servers:
        server.traffic_managers.clear()
        server.listed.clear()
        for sensor in server.sensors:
            sensor._callback = None


def fresh(monkeypatch: pytest.MonkeyPatch) -> Server:
    """Start a new process with a new server at localhost:2000."""
    server = Server()
    install(monkeypatch, server)
    return server


def works(server: Server, env: CarlaVisionEnv) -> None:
    """Check that an episode works, and that nothing is left behind after it."""
    server.heal()
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation) and info["distance"] == 0
    assert env.step(FULL)[4]["distance"] > 0
    env.close()
    assert server.left_behind() == []


def release_to_readers(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the server send what it holds when the environment begins to wait for data."""
    wait = sensors.Inbox._next

    def release_and_wait(box: sensors.Inbox[Any], deadline: float) -> Any:
        server.release()
        return wait(box, deadline)

    monkeypatch.setattr(sensors.Inbox, "_next", release_and_wait)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A server that is checked after the test."""
    server = fresh(monkeypatch)
    yield server
    assert server.left_behind() == []


@pytest.fixture
def start(server: Server) -> Iterator[Start]:
    """Make and reset an environment, after closing the last one."""
    opened: list[CarlaVisionEnv] = []

    def make(seed: int = 0, **options: Any) -> CarlaVisionEnv:
        close()
        opened.append(CarlaVisionEnv(**{**SMALL, **options}))
        opened[-1].reset(seed=seed)
        return opened[-1]

    def close() -> None:
        for env in opened:
            env.close()
        assert server.left_behind() == []

    yield make
    close()
