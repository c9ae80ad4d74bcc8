"""Fixtures of the tests that drive CarlaVision-v0 on the fake server."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from fake_carla import Server, install, new_process

from sb3_have.envs.carla_vision import CarlaVisionEnv, session

SMALL: dict[str, Any] = {"image_size": 16, "vehicles_count": 3, "timeout": 0.5}
#: No traffic, and the cheapest sensor.
ALONE: dict[str, Any] = {**SMALL, "vehicles_count": 0, "modalities": ("depth",)}
#: Time-outs that a test can wait for.
BRIEF: dict[str, Any] = {**SMALL, "vehicles_count": 2, "timeout": 0.1, "initial_speed": 10.0}
FULL = np.array([1.0, 0.0], dtype=np.float32)
Start = Callable[..., CarlaVisionEnv]


def fresh(monkeypatch: pytest.MonkeyPatch) -> Server:
    """A new server of CARLA at localhost:2000."""
    found = Server()
    install(monkeypatch, found)
    restart_process(monkeypatch, found)
    return found


def restart_process(monkeypatch: pytest.MonkeyPatch, server: Server) -> None:
    """Forget what a process remembers of servers that it drives, and of those that it lost."""
    monkeypatch.setattr(session, "_drivers", {})
    monkeypatch.setattr(session, "_lost_with_traffic", [])
    new_process(monkeypatch, server)


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


@pytest.fixture
def env(server: Server) -> Iterator[CarlaVisionEnv]:
    made = CarlaVisionEnv(**BRIEF)
    yield made
    made.close()
    assert server.left_behind() == []


def works(server: Server, env: CarlaVisionEnv) -> None:
    """A new episode runs to its end, and nothing is left after it."""
    server.heal()
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation) and info["distance"] == 0
    assert env.step(FULL)[4]["distance"] > 0
    env.close()
    assert server.left_behind() == []
