"""CarlaVision-v0 under faults of the server, its sensors and its user: the right error, and nothing left behind."""

import gc
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla_fixtures  # noqa: E402
from fake_carla_fixtures import ALONE, FULL, SMALL, Start, fresh, install, release_to_readers, works  # noqa: E402
from fake_carla_server import DEPTH, DVS, RGB, Server  # noqa: E402

from sb3_have.configuration import evaluation_env_kwargs, load_config  # noqa: E402
from sb3_have.envs.carla_vision import CarlaConnectionError, CarlaVisionEnv, session  # noqa: E402

server, start = fake_carla_fixtures.server, fake_carla_fixtures.start

MOVING: dict[str, Any] = {**SMALL, "initial_speed": 10.0}
NAMES = {RGB: "rgb", DEPTH: "depth", DVS: "event"}


@pytest.fixture
def env(server: Server) -> Iterator[CarlaVisionEnv]:
    made = CarlaVisionEnv(**MOVING)
    yield made
    made.close()
    assert server.left_behind() == []


# ---- 1: no server ----


@pytest.mark.parametrize("options", [{}, {"port": 2345}, {"host": "example"}], ids=str)
def test_no_server(monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]) -> None:
    install(monkeypatch)
    env = CarlaVisionEnv(**SMALL, **options)
    where = f"{options.get('host', 'localhost')}:{options.get('port', 2000)}"
    with pytest.raises(CarlaConnectionError, match=rf"no CARLA server at {where}.*-carla-rpc-port"):
        env.reset()
    env.close()


def test_no_server_for_the_real_client() -> None:
    with pytest.raises(CarlaConnectionError, match="no CARLA server at localhost:2957"):
        CarlaVisionEnv(**SMALL, port=2957).reset()


# ---- 2: the server dies, or an exception interrupts, at any call ----

QUICK = {**MOVING, "vehicles_count": 1, "modalities": ("depth",)}
# An error of these calls between two episodes makes the client connect again, or does not matter
TOLERATED = ("Client.set_timeout", "Client.get_server_version", "World.get_settings", "Sensor.stop")


def drive(env: CarlaVisionEnv) -> None:
    env.reset(seed=0)
    env.step(FULL)
    env.reset()
    env.step(FULL)


def trials(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, Server, CarlaVisionEnv]]:
    """A fresh server for the first and the last call of each kind in each of the two episodes of :func:`drive`."""
    server = fresh(monkeypatch)
    env = CarlaVisionEnv(**QUICK)
    env.reset(seed=0)
    env.step(FULL)
    half = len(server.calls)
    env.reset()
    env.step(FULL)
    kinds = [(call, position < half) for position, call in enumerate(server.calls)]
    env.close()
    assert {call for call, _ in kinds} >= {
        "Client.get_world",
        "Client.get_trafficmanager",
        "Client.apply_batch_sync",
        "World.apply_settings",
        "World.tick",
        "World.try_spawn_actor",
        "Sensor.stop",
        "Vehicle.apply_control",
        "TrafficManager.set_synchronous_mode",
    }
    last = len(kinds) - 1
    for position in sorted({f(kind) for kind in kinds for f in (kinds.index, lambda k: last - kinds[::-1].index(k))}):
        server = fresh(monkeypatch)
        yield position, server, CarlaVisionEnv(**QUICK)


def test_death_at_any_call(monkeypatch: pytest.MonkeyPatch) -> None:
    for position, server, env in trials(monkeypatch):
        server.fail("*", None, after=position)
        with pytest.raises(CarlaConnectionError, match="localhost:2000") as caught:
            drive(env)
        message = str(caught.value)
        assert ("restart" in message) == bool(session._lost_with_traffic), server.calls[position]
        if not message.startswith("this process lost"):
            assert "CarlaUE4.sh" in message and "time-out" in str(caught.value.__cause__)
        env.close()
        assert server.missed <= 3, "each call to a server that is gone waits for the timeout"
        with pytest.raises(gym.error.ResetNeeded):
            env.step(FULL)
        server.restart()
        if session._lost_with_traffic:
            with pytest.raises(CarlaConnectionError, match="restart the process"):
                env.reset()
            install(monkeypatch, server)
        works(server, env)


@pytest.mark.parametrize("done", [False, True], ids=["before", "after"])
def test_ctrl_c_at_any_call(monkeypatch: pytest.MonkeyPatch, done: bool) -> None:
    for position, server, env in trials(monkeypatch):
        server.fail("*", KeyboardInterrupt(), after=position, done=done)
        with pytest.raises(KeyboardInterrupt):
            drive(env)
        assert server.left_behind() == [], server.calls[position]
        with pytest.raises(gym.error.ResetNeeded):
            env.step(FULL)
        works(server, env)


def test_an_error_at_any_call(monkeypatch: pytest.MonkeyPatch) -> None:
    for position, server, env in trials(monkeypatch):
        server.fail("*", RuntimeError("rpc::rpc_error during call"), after=position)
        try:
            drive(env)
            env.close()
            assert server.calls[position] in TOLERATED
        except (RuntimeError, CarlaConnectionError) as error:
            assert any("rpc::rpc_error" in str(cause) for cause in (error, error.__cause__)), server.calls[position]
        if server.calls[position] == "Sensor.stop":
            server.violations.clear()  # the sensor was destroyed all the same
        assert server.left_behind() == [], server.calls[position]
        works(server, env)


def test_restart_without_traffic(server: Server) -> None:
    env = CarlaVisionEnv(**{**MOVING, "vehicles_count": 0})
    env.reset()
    server.restart("Town01")
    works(server, env)
    assert server.map.name.endswith("Town04")
    env.reset()
    server.fail("World.get_settings", RuntimeError("trying to access an expired episode"))
    env.reset()
    server.restart()
    with pytest.raises(CarlaConnectionError, match="lost the CARLA server"):
        env.step(FULL)
    works(server, env)


def test_restart_with_traffic(server: Server, env: CarlaVisionEnv) -> None:
    env.reset()
    env.close()
    server.restart()
    works(server, env)  # the traffic manager was shut down before
    env.reset()
    server.restart()
    other = CarlaVisionEnv(**ALONE)
    for lost in (env, other, env):
        with pytest.raises(CarlaConnectionError, match=r"localhost:2000 .*restart the process.*checkpoint"):
            lost.reset()


def test_a_lost_server_does_not_abort_the_environment_of_another(
    monkeypatch: pytest.MonkeyPatch, server: Server, env: CarlaVisionEnv
) -> None:
    other = Server("Town01", port=2100)
    install(monkeypatch, server, other)
    second = CarlaVisionEnv(**SMALL, port=2100, tm_port=8100)
    for _ in range(2):
        env.reset()
        second.reset()
        assert env.step(FULL)[4].keys() == second.step(FULL)[4].keys()
    other.alive = False
    with pytest.raises(CarlaConnectionError, match="localhost:2100"):
        second.step(FULL)
    with (
        pytest.warns(UserWarning, match=r"localhost:2000 is left in synchronous mode.*take_over"),
        pytest.raises(CarlaConnectionError, match=r"lost .*localhost:2100 .*restart the process"),
    ):
        env.step(FULL)
    assert not server.actors and server.settings.synchronous_mode and not server.violations
    install(monkeypatch, server)
    third = CarlaVisionEnv(**SMALL, take_over=True)
    with pytest.warns(UserWarning, match="took over"):
        third.reset()
    third.close()


def test_a_slow_server_is_not_lost(server: Server, env: CarlaVisionEnv) -> None:
    env.reset()
    server.fail("World.tick", RuntimeError("time-out of 100ms while waiting for the simulator"), after=2)
    with pytest.raises(TimeoutError, match=r"alive.*0\.2 s.*timeout"):
        env.step(FULL)
    assert server.left_behind() == []
    works(server, env)


def test_an_error_that_is_no_timeout_does_not_mean_death(server: Server, env: CarlaVisionEnv) -> None:
    env.reset()
    server.fail("Client.get_server_version", RuntimeError("rpc::rpc_error during call"))
    env.close()
    assert server.left_behind() == []


# ---- 3: sensors ----


def test_ticks_without_events(server: Server, env: CarlaVisionEnv) -> None:
    env.reset(seed=0)
    server.disturb(DVS, drop=4)
    assert (env.step(FULL)[0]["event"] == 128).all()
    server.disturb(DVS, drop=2)
    event = env.step(FULL)[0]["event"]
    assert (event[..., :2] == 128).all() and (event[..., 3:] != 128).any()


def test_late_events_are_dropped_with_a_warning(server: Server, env: CarlaVisionEnv) -> None:
    env.reset(seed=0)
    server.disturb(DVS, late=4)
    assert (env.step(FULL)[0]["event"] == 128).all()
    server.disturb(DVS, drop=4)
    with pytest.warns(UserWarning, match=r"more than event_grace = 0\.02 s .* dropped"):
        assert (env.step(FULL)[0]["event"] == 128).all()
    # Events before the episode are dropped without a warning
    server.disturb(DVS, late=2)
    env.reset()
    server.disturb(DVS)
    env.step(FULL)


@pytest.mark.parametrize("grace", [0.0, 60.0])
def test_event_grace(server: Server, start: Start, monkeypatch: pytest.MonkeyPatch, grace: float) -> None:
    env = start(modalities=("event",), initial_speed=10.0, event_grace=grace)
    server.disturb(DVS, hold=True)
    if grace:
        release_to_readers(server, monkeypatch)
    assert (env.step(FULL)[0]["event"] != 128).any() == bool(grace)
    server.release()
    server.join()


@pytest.mark.parametrize("kind", [RGB, DEPTH])
def test_a_missing_image(server: Server, env: CarlaVisionEnv, kind: str) -> None:
    server.disturb(kind, drop=10**6)
    with pytest.raises(TimeoutError, match=NAMES[kind]):
        env.reset()
    assert server.left_behind() == []
    works(server, env)
    # Only the last image of a step is needed, and a late one is not taken for another
    env.reset()
    server.disturb(kind, drop=3)
    env.step(FULL)
    server.disturb(kind, late=1)
    with pytest.raises(TimeoutError, match=rf"frame {server.frame + 4} from the {NAMES[kind]} sensor within 0.2 s"):
        env.step(FULL)
    works(server, env)


def test_a_server_that_dies_before_it_sends_the_image(server: Server) -> None:
    env = CarlaVisionEnv(**{**SMALL, "vehicles_count": 0})
    env.reset()
    server.disturb(RGB, drop=10**6)
    server.fail("Client.get_server_version", None)  # the first call after the wait
    with pytest.raises(CarlaConnectionError, match="lost the CARLA server at localhost:2000") as caught:
        env.step(FULL)
    assert isinstance(caught.value.__cause__, TimeoutError) and "rgb" in str(caught.value.__cause__)
    server.restart()
    works(server, env)


@pytest.mark.parametrize(("shift", "error"), [(1, RuntimeError), (-1, TimeoutError)])
def test_wrong_frame_numbers(server: Server, env: CarlaVisionEnv, shift: int, error: type[Exception]) -> None:
    env.reset()
    server.disturb(RGB, shift=shift, drop=3)
    with pytest.raises(error, match=str(server.frame + 4)):
        env.step(FULL)
    assert server.left_behind() == []
    works(server, env)


@pytest.mark.parametrize("kind", [RGB, DEPTH, DVS])
def test_an_exception_in_a_callback(server: Server, env: CarlaVisionEnv, kind: str) -> None:
    env.reset()
    server.disturb(kind, corrupt=True)
    with pytest.raises(RuntimeError, match=f"callback of the {NAMES[kind]} sensor failed") as caught:
        env.step(FULL)
    assert isinstance(caught.value.__cause__, ValueError) and server.left_behind() == []
    works(server, env)


# ---- 4: the wrong map, version or client ----


def test_maps(server: Server) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"town": "Town01"}, "no lane .* on road 45"),
        ({"town": "Town01", "road_id": 7, "vehicles_count": 20}, "s = "),  # too short for the traffic
        ({"town": "Town99"}, r"Town99.*Town01, Town04"),
    ]
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            CarlaVisionEnv(**{**SMALL, **options}).reset()
        assert server.left_behind() == []
    assert server.calls.count("Client.load_world") == 1  # the others found Town01
    env = CarlaVisionEnv(**SMALL)
    env.reset()
    assert server.map.name == "Carla/Maps/Town04" and server.calls.count("Client.load_world") == 2
    assert server.timeouts == {"calls": 0.2, "ticks": 0.2}
    env.reset()
    env.close()
    assert server.calls.count("Client.load_world") == 2


def test_another_version(server: Server, env: CarlaVisionEnv) -> None:
    server.version = "0.9.13"
    with pytest.warns(UserWarning, match=r"0\.9\.16.*0\.9\.13.*frame numbers"):
        env.reset()


def test_a_server_that_a_dead_client_left_synchronous(
    monkeypatch: pytest.MonkeyPatch, server: Server, env: CarlaVisionEnv
) -> None:
    dead = CarlaVisionEnv(**SMALL)
    dead.reset()
    dead._finalizer.detach()
    install(monkeypatch, server)
    actors = set(server.actors)
    with pytest.raises(RuntimeError, match=r"localhost:2000 is already in synchronous mode.*port=.*take_over=True"):
        env.reset()
    assert set(server.actors) == actors and server.settings.synchronous_mode
    env = CarlaVisionEnv(**SMALL, take_over=True)
    with pytest.warns(UserWarning, match="took over"):
        env.reset()
    assert len(server.vehicles) == 3 and not actors & set(server.actors)
    env.close()
    assert server.left_behind() == []


def test_two_environments_on_one_server(server: Server, env: CarlaVisionEnv) -> None:
    env.reset()
    actors = set(server.actors)
    second = CarlaVisionEnv(**SMALL, tm_port=8001, take_over=True)
    with pytest.raises(RuntimeError, match=r"already drives.*port=\.\.\., tm_port=\.\.\."):
        second.reset()
    second.close()
    assert set(server.actors) == actors and env.step(FULL)[4]["distance"] > 0
    env.close()
    works(server, second)


def test_a_training_run_and_its_evaluation(monkeypatch: pytest.MonkeyPatch, server: Server) -> None:
    config = load_config("have", "CarlaVision-v0")
    other = Server(port=2010)
    install(monkeypatch, server, other)
    training = CarlaVisionEnv(**{**config["env_kwargs"], **SMALL})
    training.reset()
    kwargs = {**evaluation_env_kwargs(config), **SMALL, "port": 2010}
    # CARLA would drive the second server's traffic with the first one's traffic manager
    with pytest.raises(RuntimeError, match=r"already has a traffic manager on port 8000.*tm_port="):
        CarlaVisionEnv(**kwargs).reset()
    assert other.left_behind() == []
    evaluation = CarlaVisionEnv(**kwargs, tm_port=8010)
    evaluation.reset()
    for env in (training, evaluation):
        env.step(FULL)
    assert (list(server.traffic_managers), list(other.traffic_managers)) == ([8000], [8010])
    for env in (training, evaluation):
        env.close()
    assert other.left_behind() == []
    works(server, training)


def test_a_taken_port_of_the_traffic_manager(server: Server, env: CarlaVisionEnv) -> None:
    for attempt in range(2):
        server.fail("Client.get_trafficmanager", RuntimeError("bind error"), after=attempt)
    with pytest.warns(UserWarning, match="cleaning up"), pytest.raises(RuntimeError, match="bind error"):
        env.reset()
    assert server.left_behind() == []
    works(server, env)


# ---- 5: actors that cannot be spawned ----


def test_occupied_places_are_tried_again(server: Server, env: CarlaVisionEnv) -> None:
    server.blocked = 10
    env.reset()
    assert len(server.vehicles) == 3


@pytest.mark.parametrize("vehicles", [0, 1])
def test_no_room(monkeypatch: pytest.MonkeyPatch, server: Server, env: CarlaVisionEnv, vehicles: int) -> None:
    spawn, free = server.spawn, iter([True] * vehicles)
    monkeypatch.setattr(server, "spawn", lambda *args: spawn(*args) if next(free, False) else None)
    with pytest.raises(RuntimeError, match=r"no room for (the ego|vehicle 1 of 2)"):
        env.reset()
    assert server.left_behind() == []
    monkeypatch.setattr(server, "spawn", spawn)
    works(server, env)


# ---- 6: exceptions while cleaning up, and the end of the program ----

# Calls of the cleanup, and what may be left behind if they fail
CLEANUP = {
    "Sensor.stop": "listening",
    "Client.apply_batch_sync": "alive",
    "TrafficManager.shut_down": "traffic manager",
    "World.set_weather": "",
    "World.apply_settings": "_mode is True|fixed_delta_seconds is",
}


@pytest.mark.parametrize("call", CLEANUP)
def test_an_error_while_cleaning_up_does_not_stop_the_rest(monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    server = fresh(monkeypatch)
    env = CarlaVisionEnv(**SMALL)
    env.reset()
    server.fail(call, RuntimeError("out of order"))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        env.close()
    words = CLEANUP[call].split("|")
    assert all(any(word and word in line for word in words) for line in server.left_behind())
    assert call == "Sensor.stop" or "out of order" in str(found[-1].message)
    assert not server.actors or call == "Client.apply_batch_sync"


@pytest.mark.parametrize("call", CLEANUP)
@pytest.mark.parametrize("done", [False, True], ids=["before", "after"])
def test_a_second_close_completes_an_interrupted_one(
    server: Server, env: CarlaVisionEnv, call: str, done: bool
) -> None:
    env.reset()
    server.fail(call, KeyboardInterrupt(), done=done)
    with pytest.raises(KeyboardInterrupt):
        env.close()
    env.close()
    assert server.left_behind() == []
    # A reset completes it, too
    env.reset()
    server.fail("World.tick", KeyboardInterrupt(), after=1)
    server.fail(call, KeyboardInterrupt(), done=done)
    with pytest.raises(KeyboardInterrupt):
        env.step(FULL)
    works(server, env)


def test_a_slow_tick_while_cleaning_up(server: Server, env: CarlaVisionEnv) -> None:
    for tick in range(2):  # the first of the episode, and the one that lists its actors
        server.fail("World.tick", RuntimeError("time-out of 100ms while waiting"), after=tick, done=True)
    with pytest.warns(UserWarning, match="cleaning up .* time-out"), pytest.raises(TimeoutError, match="alive"):
        env.reset()
    assert server.left_behind() == []
    works(server, env)


def test_settings_and_weather_are_restored(server: Server) -> None:
    server.settings.max_culling_distance = 123.0
    server.settings.no_rendering_mode = True
    server.settings.fixed_delta_seconds = 0.1
    server.weather = weather = carla.WeatherParameters.MidRainyNoon
    env = CarlaVisionEnv(**SMALL, weather="ClearNight")
    env.reset()
    assert not server.settings.no_rendering_mode and server.settings.max_culling_distance == 123
    env.close()
    assert not server.settings.synchronous_mode and server.settings.fixed_delta_seconds == pytest.approx(0.1)
    assert server.settings.no_rendering_mode and server.weather == weather
    server.settings = carla.WorldSettings()


def test_closing(server: Server, env: CarlaVisionEnv) -> None:
    env.close()
    assert server.calls == []
    env.reset()
    env.reset()
    assert len(server.sensors) == 4 and len(server.vehicles) == 3  # only those of the last episode
    env.close()
    assert server.left_behind() == [] and server.calls.count("Sensor.stop") == 8
    count, frame = len(server.calls), server.frame
    env.close()
    assert (len(server.calls), server.frame) == (count, frame)


def test_a_forgotten_environment_is_closed(server: Server) -> None:
    env = CarlaVisionEnv(**SMALL)
    env.reset()
    del env
    gc.collect()
    assert server.left_behind() == []


PROGRAM = """
import atexit
atexit.register(lambda: print(server.left_behind(), server.calls.count("World.tick") > 10))
import pytest
from fake_carla_fixtures import SMALL, CarlaVisionEnv, fresh
server = fresh(pytest.MonkeyPatch())
env = CarlaVisionEnv(**SMALL)
env.reset()
env.step([1.0, 0.0])
raise ValueError("a mistake")
"""


def test_a_program_that_ends_with_an_exception() -> None:
    folder = Path(__file__).parent
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=folder, capture_output=True, text=True)
    assert done.stdout.strip() == "[] True", done.stderr
    assert done.stderr.strip().endswith("ValueError: a mistake")
