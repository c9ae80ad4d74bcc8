"""CarlaVision-v0 when the server or the user interrupts: the right error, and nothing left behind."""

import gc
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla_fixtures  # noqa: E402
from fake_carla import Server  # noqa: E402
from fake_carla_fixtures import BRIEF, FULL, fresh, restart_process, works  # noqa: E402

from sb3_have.envs.carla_vision import CarlaConnectionError, CarlaVisionEnv, session  # noqa: E402

server, env = fake_carla_fixtures.server, fake_carla_fixtures.env


# ---- at every call that the client makes ----


def drive(env: CarlaVisionEnv) -> None:
    env.reset(seed=0)
    env.step(FULL)
    env.reset()
    env.step(FULL)


def calls_of_a_drive(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Positions of the calls of :func:`drive`: the first and the last of each kind before and after the first step."""
    server = fresh(monkeypatch)
    env = CarlaVisionEnv(**{**BRIEF, "vehicles_count": 1, "modalities": ("depth",)})
    env.reset(seed=0)
    env.step(FULL)
    half = len(server.calls)
    env.reset()
    env.step(FULL)
    calls = list(server.calls)
    env.close()
    assert server.left_behind() == []
    kinds = [(call, position < half) for position, call in enumerate(calls)]
    first_and_last = {kinds.index(kind) for kind in kinds} | {
        len(kinds) - 1 - kinds[::-1].index(kind) for kind in kinds
    }
    assert {call for call, _ in kinds} >= {
        "Client.get_world",
        "Client.get_trafficmanager",
        "Client.apply_batch_sync",
        "World.apply_settings",
        "World.get_map",
        "World.tick",
        "World.try_spawn_actor",
        "Sensor.stop",
        "Vehicle.apply_control",
        "Vehicle.set_autopilot",
        "TrafficManager.set_synchronous_mode",
    }
    return sorted(first_and_last)


#: Whose failure between two episodes makes the client connect anew, or does not matter.
TOLERATED = ("Client.set_timeout", "Client.get_server_version", "World.get_settings", "Sensor.stop")


def trials(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, Server, CarlaVisionEnv]]:
    for position in calls_of_a_drive(monkeypatch):
        server = fresh(monkeypatch)
        yield position, server, CarlaVisionEnv(**{**BRIEF, "vehicles_count": 1, "modalities": ("depth",)})


@pytest.mark.parametrize("done", [False, True], ids=["before", "after"])
def test_ctrl_c_at_any_call_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch, done: bool) -> None:
    for position, server, env in trials(monkeypatch):
        server.fail("*", KeyboardInterrupt(), after=position, done=done)
        with pytest.raises(KeyboardInterrupt):
            drive(env)
        assert server.left_behind() == [], server.calls[position]
        with pytest.raises(gym.error.ResetNeeded):
            env.step(FULL)
        works(server, env)


def test_an_error_at_any_call_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    for position, server, env in trials(monkeypatch):
        server.fail("*", RuntimeError("rpc::rpc_error during call"), after=position)
        try:
            drive(env)
            env.close()
            assert server.calls[position] in TOLERATED
        except (RuntimeError, CarlaConnectionError) as error:
            assert any("rpc::rpc_error" in str(cause) for cause in (error, error.__cause__)), server.calls[position]
        assert server.left_behind() == [], server.calls[position]
        works(server, env)


def test_a_server_may_die_at_any_call(monkeypatch: pytest.MonkeyPatch) -> None:
    for position, server, env in trials(monkeypatch):
        server.die("*", after=position)
        with pytest.raises(CarlaConnectionError, match="localhost:2000") as caught:
            drive(env)
        message = str(caught.value)
        assert ("restart" in message) == bool(session._lost_with_traffic), server.calls[position]
        if not message.startswith("this process lost"):  # between the episodes
            assert "CarlaUE4.sh" in message and "time-out" in str(caught.value.__cause__)
        assert server.missed <= 3, "each call to a server that is gone waits for the time-out"
        env.close()
        assert server.missed <= 3
        with pytest.raises(gym.error.ResetNeeded):
            env.step(FULL)
        server.restart()
        if session._lost_with_traffic:
            with pytest.raises(CarlaConnectionError, match="restart the process"):
                env.reset()
            restart_process(monkeypatch, server)
        works(server, env)


CLEAN_UP = {
    "Sensor.stop": "",
    "Client.apply_batch_sync": "lives",
    "TrafficManager.set_synchronous_mode": "traffic manager",
    "TrafficManager.shut_down": "traffic manager",
    "World.set_weather": "",
    "World.apply_settings": "_mode is True fixed_delta_seconds is",
}


@pytest.mark.parametrize("call", CLEAN_UP)
def test_an_error_while_cleaning_up_is_made_good(server: Server, env: CarlaVisionEnv, call: str) -> None:
    env.reset()
    server.fail(call, RuntimeError("out of order"))
    env.close()
    assert server.left_behind() == []


@pytest.mark.parametrize("call", CLEAN_UP)
def test_what_cannot_be_cleaned_up_does_not_stop_the_rest(monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    server = fresh(monkeypatch)
    env = CarlaVisionEnv(**BRIEF)
    env.reset()
    for attempt in range(8):
        server.fail(call, RuntimeError("out of order"), after=attempt)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        env.close()
    expected = CLEAN_UP[call].split()
    for line in server.left_behind():
        assert any(word in line for word in expected) or (call == "Sensor.stop" and "while it was listening" in line)
    assert call == "Sensor.stop" or "out of order" in str(told[-1].message)
    assert not server.actors or call == "Client.apply_batch_sync"


@pytest.mark.parametrize("call", ["Sensor.stop", "Client.apply_batch_sync", "World.apply_settings"])
@pytest.mark.parametrize("done", [False, True], ids=["before", "after"])
def test_ctrl_c_while_closing_does_not_stop_the_rest(
    server: Server, env: CarlaVisionEnv, call: str, done: bool
) -> None:
    env.reset()
    server.fail(call, KeyboardInterrupt(), done=done)
    with pytest.raises(KeyboardInterrupt):
        env.close()
    env.close()
    assert server.left_behind() == []


@pytest.mark.parametrize("call", ["Sensor.stop", "Client.apply_batch_sync", "World.apply_settings"])
def test_an_impatient_ctrl_c_is_made_good_by_the_next_reset(server: Server, env: CarlaVisionEnv, call: str) -> None:
    env.reset()
    server.fail("World.tick", KeyboardInterrupt(), after=1)
    server.fail(call, KeyboardInterrupt())  # while the first is being cleaned up
    with pytest.raises(KeyboardInterrupt):
        env.step(FULL)
    works(server, env)


def test_an_error_of_another_kind_is_no_sign_of_death(server: Server, env: CarlaVisionEnv) -> None:
    env.reset()
    server.fail("World.tick", KeyboardInterrupt(), after=2)
    server.fail("Client.get_server_version", RuntimeError("rpc::rpc_error during call"))  # while cleaning up
    with pytest.raises(KeyboardInterrupt):
        env.step(FULL)
    works(server, env)


def test_an_error_right_after_an_interrupted_spawn(server: Server, env: CarlaVisionEnv) -> None:
    server.fail("World.try_spawn_actor", KeyboardInterrupt(), after=1, done=True)
    server.fail("World.tick", RuntimeError("rpc::rpc_error during call"))  # whose success would list the actor
    with pytest.raises(KeyboardInterrupt):
        env.reset()
    works(server, env)


def test_two_ctrl_c_one_of_them_right_after_a_spawn(monkeypatch: pytest.MonkeyPatch) -> None:
    for second, before in (("World.tick", 0), ("World.get_actors", 1), ("Client.apply_batch_sync", 0)):
        server = fresh(monkeypatch)
        env = CarlaVisionEnv(**BRIEF)
        server.fail("World.try_spawn_actor", KeyboardInterrupt(), after=1, done=True)
        server.fail(second, KeyboardInterrupt(), after=before)
        with pytest.raises(KeyboardInterrupt):
            env.reset()
        assert server.actors
        env.close()
        assert server.left_behind() == []


# ---- spawning ----


def test_spawn_collisions_are_tried_again(server: Server, env: CarlaVisionEnv) -> None:
    server.block(10)
    env.reset()
    assert len(server.vehicles()) == 3


@pytest.mark.parametrize("vehicles", [0, 1])
def test_no_room(server: Server, env: CarlaVisionEnv, vehicles: int) -> None:
    env.reset()
    env.close()
    if vehicles:
        spawn, free = server.spawn, iter([True])
        server.spawn = lambda *args: spawn(*args) if next(free, False) else None  # type: ignore[method-assign]
    else:
        server.block(10**6)
    with pytest.raises(RuntimeError, match=r"no room for (the ego|vehicle 1 of 2)"):
        env.reset()
    assert server.left_behind() == []
    if vehicles:
        server.spawn = spawn  # type: ignore[method-assign]
    works(server, env)


# ---- the end ----


def test_closing_at_any_time(server: Server, env: CarlaVisionEnv) -> None:
    env.close()
    assert server.calls == []
    for close in (1, 2):
        env.reset()
        for _ in range(close):
            env.close()
        assert server.left_behind() == []
        count = len(server.calls)
        env.close()
        assert len(server.calls) == count


def test_sensors_are_stopped_before_they_are_destroyed(server: Server, env: CarlaVisionEnv) -> None:
    env.reset()
    env.reset()
    assert len(server.sensors()) == 4 and len(server.vehicles()) == 3  # those of one episode
    env.close()
    assert server.calls.count("Sensor.stop") == 8 and server.violations == []


def test_an_environment_that_is_forgotten(server: Server) -> None:
    env = CarlaVisionEnv(**BRIEF)
    env.reset()
    del env
    gc.collect()
    assert server.left_behind() == []


PROGRAM = """
import atexit, sys
atexit.register(lambda: print(server.left_behind(), server.calls.count("World.tick") > 10))
sys.modules["carla"] = None
from sb3_have.envs.carla_vision import CarlaVisionEnv
env = CarlaVisionEnv(image_size=16, vehicles_count=1, timeout=0.5)
try:
    env.reset()
except ImportError as error:
    print(error)
del sys.modules["carla"]
import pytest
from fake_carla import Server, install
server = Server()
install(pytest.MonkeyPatch(), server)
env.reset()
env.step([1.0, 0.0])
raise ValueError("a mistake")
"""


def test_a_program_without_a_client_and_without_an_end() -> None:
    """Without the client there is advice; a mistake in the program leaves nothing on the server."""
    folder = Path(__file__).parent
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=folder, capture_output=True, text=True, timeout=120)
    advice, left = done.stdout.strip().splitlines()
    assert "pip install 'sb3_have[carla]'" in advice and left == "[] True", done.stderr
    assert done.stderr.strip().endswith("ValueError: a mistake")
