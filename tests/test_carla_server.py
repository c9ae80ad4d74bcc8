"""CarlaVision-v0 and its servers: none, lost, restarted, taken, several, slow, of another version or town."""

import warnings

import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla_fixtures  # noqa: E402
from fake_carla import Server, install  # noqa: E402
from fake_carla_fixtures import BRIEF, FULL, restart_process, works  # noqa: E402

from sb3_have.configuration import evaluation_env_kwargs, load_config  # noqa: E402
from sb3_have.envs.carla_vision import CarlaConnectionError, CarlaVisionEnv  # noqa: E402

server, env = fake_carla_fixtures.server, fake_carla_fixtures.env


def test_no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    for options in ({}, {"port": 2345}, {"host": "example"}):
        env = CarlaVisionEnv(**BRIEF, **options)
        where = f"{options.get('host', 'localhost')}:{options.get('port', 2000)}"
        with pytest.raises(CarlaConnectionError, match=rf"no CARLA server at {where}.*-carla-rpc-port"):
            env.reset()
        env.close()


def test_no_server_for_the_real_client_either() -> None:
    env = CarlaVisionEnv(**BRIEF, port=2957)
    with pytest.raises(CarlaConnectionError, match="no CARLA server at localhost:2957"):
        env.reset()


def test_a_server_without_traffic_that_was_restarted(server: Server) -> None:
    env = CarlaVisionEnv(**{**BRIEF, "vehicles_count": 0})
    env.reset(seed=0)
    server.restart()
    works(server, env)
    env.reset()
    server.restart("Town01")
    works(server, env)
    assert server.map.name.endswith("Town04")
    env.reset(seed=0)
    env.step(FULL)
    server.restart()
    with pytest.raises(CarlaConnectionError, match="lost the CARLA server"):
        env.step(FULL)
    works(server, env)


def test_a_server_with_traffic_that_was_restarted(server: Server, env: CarlaVisionEnv) -> None:
    env.reset(seed=0)
    env.close()
    server.restart()
    works(server, env)  # the traffic manager was shut down while its server lived
    env.reset()
    server.restart()
    other = CarlaVisionEnv(**{**BRIEF, "vehicles_count": 0})
    for _ in range(2):
        with pytest.raises(CarlaConnectionError, match=r"lost .*localhost:2000 .*restart the process.*checkpoint"):
            env.reset()
        with pytest.raises(CarlaConnectionError, match="restart the process"):
            other.reset()
    assert server.left_behind() == []


def test_another_world_was_loaded_between_episodes(server: Server) -> None:
    env = CarlaVisionEnv(**{**BRIEF, "vehicles_count": 0})
    env.reset()
    carla.Client("localhost", 2000).load_world("Town01")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        works(server, env)


def test_another_town_is_loaded_and_an_unknown_one_refused(server: Server) -> None:
    env = CarlaVisionEnv(**BRIEF, town="Town01")
    with pytest.raises(ValueError, match=r"no lane .* on road 45"):
        env.reset()
    assert server.left_behind() == []
    env = CarlaVisionEnv(**BRIEF, town="Town01", road_id=7)
    with pytest.raises(ValueError, match="s = "):  # that road is too short for the traffic
        while True:
            env.reset()
    assert server.left_behind() == []
    env = CarlaVisionEnv(**BRIEF)
    env.reset()
    assert server.map.name == "Carla/Maps/Town04"
    assert server.calls.count("Client.load_world") == 2
    env.reset()
    env.close()
    assert server.calls.count("Client.load_world") == 2
    env = CarlaVisionEnv(**BRIEF, town="Town99")
    with pytest.raises(ValueError, match=r"Town99.*Town01, Town04"):
        env.reset()
    assert server.left_behind() == []


def test_a_world_that_a_crashed_client_left_synchronous(
    monkeypatch: pytest.MonkeyPatch, server: Server, env: CarlaVisionEnv
) -> None:
    crashed = CarlaVisionEnv(**BRIEF)
    crashed.reset()
    crashed._finalizer.detach()
    crashed._session = None
    restart_process(monkeypatch, server)
    actors = set(server.actors)
    with pytest.raises(RuntimeError, match=r"localhost:2000 is in synchronous mode already.*port=.*take_over=True"):
        env.reset()
    assert set(server.actors) == actors and server.settings.synchronous_mode
    env = CarlaVisionEnv(**BRIEF, take_over=True)
    with pytest.warns(UserWarning, match="took over"):
        env.reset()
    assert len(server.vehicles()) == 3 and not actors & set(server.actors)
    env.close()
    assert server.left_behind() == []


def test_a_training_and_its_evaluation_as_configured(
    monkeypatch: pytest.MonkeyPatch, server: Server, env: CarlaVisionEnv
) -> None:
    config = load_config("have", "CarlaVision-v0")
    kwargs = evaluation_env_kwargs(config) | {"port": 2010, "tm_port": 8010}  # --eval-env-kwargs
    other = Server(port=2010)
    install(monkeypatch, server, other)
    training = CarlaVisionEnv(**{**BRIEF, **config["env_kwargs"]})
    evaluation = CarlaVisionEnv(**{**BRIEF, **kwargs})
    for _ in range(2):
        training.reset()
        evaluation.reset()
        training.step(FULL)
        evaluation.step(FULL)
    assert set(other.traffic_managers).isdisjoint(server.traffic_managers)
    training.close()
    evaluation.close()
    assert server.left_behind() == other.left_behind() == []


@pytest.mark.parametrize(
    ("host", "message"), [("localhost", "this process already drives .*localhost:2000"), ("127.0.0.1", "synchronous")]
)
def test_two_environments_on_one_server(server: Server, env: CarlaVisionEnv, host: str, message: str) -> None:
    env.reset()
    actors = set(server.actors)
    second = CarlaVisionEnv(**BRIEF, host=host, tm_port=8001)
    for _ in range(2):
        with pytest.raises(RuntimeError, match=rf"{message}.*port=\.\.\., tm_port=\.\.\."):
            second.reset()
        second.close()
        assert set(server.actors) == actors
        assert env.step(FULL)[4]["distance"] > 0
    env.close()
    works(server, second)
    works(server, env)


def test_time_outs_and_the_order_of_calls(server: Server) -> None:
    server.load("Town01")
    env = CarlaVisionEnv(**BRIEF)
    env.reset()
    assert server.timeouts == {"calls": BRIEF["timeout"], "ticks": BRIEF["timeout"]}
    assert server.calls.index("World.set_weather") < server.calls.index("World.tick")
    env.step(FULL)
    frame = server.frame
    env.close()
    assert server.frame == frame and server.left_behind() == []  # nobody waits for a tick that shows nothing


def test_settings_and_weather_are_as_before(server: Server) -> None:
    server.settings.max_culling_distance = 123.0
    server.settings.no_rendering_mode = True
    server.settings.fixed_delta_seconds = 0.1
    server.weather = weather = carla.WeatherParameters.MidRainyNoon
    env = CarlaVisionEnv(**BRIEF, weather="ClearNight")
    env.reset()
    assert not server.settings.no_rendering_mode and server.settings.max_culling_distance == 123
    env.close()
    assert not server.settings.synchronous_mode and server.settings.fixed_delta_seconds == pytest.approx(0.1)
    assert server.settings.no_rendering_mode and server.weather == weather


def test_other_versions_are_told(server: Server, env: CarlaVisionEnv) -> None:
    server.version = "0.9.13"
    with pytest.warns(UserWarning, match=r"0\.9\.16.*0\.9\.13.*frame numbers"):
        env.reset()


def test_a_slow_server_is_not_a_lost_one(server: Server, env: CarlaVisionEnv) -> None:
    env.reset()
    server.fail("World.tick", RuntimeError("time-out of 100ms while waiting for the simulator"), after=2)
    with pytest.raises(TimeoutError, match=r"alive.*0\.1 s.*timeout"):
        env.step(FULL)
    assert server.left_behind() == []
    works(server, env)


def test_a_server_that_ticks_too_late_is_cleared_all_the_same(server: Server, env: CarlaVisionEnv) -> None:
    for tick in range(3):  # the first of the episode, and two to list its actors
        server.fail("World.tick", RuntimeError("time-out of 100ms while waiting"), after=tick, done=True)
    with pytest.warns(UserWarning, match="cleaning up .* time-out"), pytest.raises(TimeoutError, match="alive"):
        env.reset()
    assert server.left_behind() == []
    works(server, env)


def test_one_port_for_two_traffic_managers(
    monkeypatch: pytest.MonkeyPatch, server: Server, env: CarlaVisionEnv
) -> None:
    other = Server(port=2100)
    install(monkeypatch, server, other)
    env.reset()
    second = CarlaVisionEnv(**BRIEF, port=2100)
    with pytest.raises(RuntimeError, match=r"traffic manager on port 8000 .*localhost:2000.*tm_port="):
        second.reset()
    assert not other.calls
    env.step(FULL)
    alone = CarlaVisionEnv(**{**BRIEF, "vehicles_count": 0}, port=2100)
    alone.reset()
    alone.close()
    env.close()
    works(other, second)


def test_two_servers_at_a_time(monkeypatch: pytest.MonkeyPatch, server: Server, env: CarlaVisionEnv) -> None:
    other = Server("Town01", port=2100)
    install(monkeypatch, server, other)
    second = CarlaVisionEnv(**BRIEF, port=2100, tm_port=8100)
    for _ in range(2):
        env.reset()
        second.reset()
        assert env.step(FULL)[4].keys() == second.step(FULL)[4].keys()
    assert list(server.traffic_managers) == [8000] and list(other.traffic_managers) == [8100]
    other.die()
    with pytest.raises(CarlaConnectionError, match="localhost:2100"):
        second.step(FULL)
    with (
        pytest.warns(UserWarning, match=r"localhost:2000 is left in synchronous mode.*take_over"),
        pytest.raises(CarlaConnectionError, match=r"lost .*localhost:2100 .*restart the process"),
    ):
        env.step(FULL)
    assert not server.actors and server.settings.synchronous_mode and not server.violations
    restart_process(monkeypatch, server)
    third = CarlaVisionEnv(**BRIEF, take_over=True)
    with pytest.warns(UserWarning, match="took over"):
        third.reset()
    third.close()


def test_an_unknown_ego_vehicle(server: Server) -> None:
    with pytest.raises((ValueError, IndexError), match=r"vehicle\.trabant\.p601"):
        CarlaVisionEnv(**BRIEF, ego_vehicle="vehicle.trabant.p601").reset()
    assert server.left_behind() == []


def test_a_taken_port_of_the_traffic_manager(server: Server, env: CarlaVisionEnv) -> None:
    server.fail("Client.get_trafficmanager", RuntimeError("bind error"))
    with pytest.raises(RuntimeError, match="tm_port"):
        env.reset()
    assert server.left_behind() == []
    works(server, env)
