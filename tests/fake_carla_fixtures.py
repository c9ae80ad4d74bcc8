"""Fixtures of the tests that drive CarlaVision-v0 on the fake server."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fake_carla import Server, install

from sb3_have.envs.carla_vision import CarlaVisionEnv, session

SMALL: dict[str, Any] = {"image_size": 16, "vehicles_count": 3, "timeout": 0.5}
#: No traffic, and the cheapest sensor.
ALONE: dict[str, Any] = {**SMALL, "vehicles_count": 0, "modalities": ("depth",)}
Start = Callable[..., CarlaVisionEnv]


def fresh(monkeypatch: pytest.MonkeyPatch) -> Server:
    """A new server of CARLA at localhost:2000."""
    # ports of traffic managers whose server was lost are remembered by the process
    monkeypatch.setattr(session, "_dead_ports", set())
    found = Server()
    install(monkeypatch, found)
    return found


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Server:
    return fresh(monkeypatch)


@pytest.fixture
def start(server: Server) -> Iterator[Start]:
    """Closes the last environment, then makes and resets a new one. After each test the server must be as it was."""
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
