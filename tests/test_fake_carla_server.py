"""What the fake CARLA server does: strict blueprints, ticks, motion, measurements, failures."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

from fake_carla import Server, install  # noqa: E402
from fake_carla_data import DVS_DTYPE  # noqa: E402


def start(monkeypatch: pytest.MonkeyPatch, server: Server) -> Any:
    """A world in synchronous mode."""
    install(monkeypatch, server)
    world = carla.Client("localhost", 2000).get_world()
    settings = world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, 0.05
    world.apply_settings(settings)
    return world


def put(world: Any, s: float = 105.0, lift: float = 0.5, role: str = "hero") -> Any:
    blueprint = world.get_blueprint_library().find("vehicle.tesla.model3")
    blueprint.set_attribute("role_name", role)
    transform = world.get_map().get_waypoint_xodr(45, -2, s).transform
    transform.location.z += lift
    return world.try_spawn_actor(blueprint, transform)


def mount(world: Any, ego: Any, kind: str, callback: Callable[[Any], Any]) -> Any:
    blueprint = world.get_blueprint_library().find(kind)
    if blueprint.has_attribute("image_size_x"):
        blueprint.set_attribute("image_size_x", "8")
        blueprint.set_attribute("image_size_y", "6")
    sensor = world.spawn_actor(blueprint, carla.Transform(carla.Location(x=1.0, z=1.5)), ego)
    sensor.listen(callback)
    return sensor


def test_blueprints_are_strict(monkeypatch: pytest.MonkeyPatch) -> None:
    library = start(monkeypatch, Server()).get_blueprint_library()
    cases: list[tuple[type[Exception], Callable[[], Any]]] = [
        (IndexError, lambda: library.find("sensor.camera.rbg")),
        (IndexError, lambda: library.find("sensor.camera.rgb").set_attribute("width", "8")),
        (TypeError, lambda: library.find("sensor.camera.rgb").set_attribute("image_size_x", 8)),
        (ValueError, lambda: library.find("sensor.camera.rgb").set_attribute("image_size_x", "8.5")),
        (ValueError, lambda: library.find("sensor.camera.dvs").set_attribute("use_log", "yes")),
        (ValueError, lambda: library.find("vehicle.tesla.model3").set_attribute("number_of_wheels", "3")),
    ]
    for refused, call in cases:
        with pytest.raises(refused):
            call()
    assert library.find("vehicle.tesla.model3").get_attribute("base_type").as_str() == "car"
    assert 0 < len(library.filter("vehicle.*")) < len(library)


def test_ticks_need_synchronous_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server()
    world = start(monkeypatch, server)
    frame, elapsed = server.frame, server.elapsed
    assert world.tick() == frame + 1 and server.elapsed == pytest.approx(elapsed + 0.05)
    world.apply_settings(carla.WorldSettings())
    with pytest.raises(AssertionError, match="synchronous"):
        world.tick()


def test_actors_tell_what_the_last_tick_told(monkeypatch: pytest.MonkeyPatch) -> None:
    world = start(monkeypatch, Server())
    assert put(world, lift=0.0) is None  # on the ground is in the ground
    ego = put(world)
    assert put(world) is None  # the place is taken
    assert ego.get_location() == carla.Location()
    world.tick()
    assert world.get_map().get_waypoint(ego.get_location()).s == pytest.approx(105)
    assert ego.destroy() and not ego.destroy()
    with pytest.raises(RuntimeError, match="destroyed actor"):
        ego.get_location()


def test_vehicles_move_along_the_road(monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server()
    world = start(monkeypatch, server)
    ego, other = put(world), put(world, 140.0, role="autopilot")
    manager = carla.Client("localhost", 2000).get_trafficmanager(8000)
    with pytest.raises(AssertionError, match="8001"):
        other.set_autopilot(True, 8001)
    other.set_autopilot(True, 8000)
    manager.set_desired_speed(other, 72.0)
    ego.apply_control(carla.VehicleControl(throttle=1.0))
    hits: list[Any] = []
    collision = mount(world, ego, "sensor.other.collision", lambda event: hits.append(event.normal_impulse.x))
    for _ in range(40):
        world.tick()
    s = [world.get_map().get_waypoint(vehicle.get_location()).s for vehicle in (ego, other)]
    assert s[0] == pytest.approx(105 + 6 * 2.0**2 / 2, abs=0.5)
    assert 140 + 0.95 * 40 <= s[1] <= 140 + 1.05 * 40
    assert ego.get_velocity().length() == pytest.approx(12)
    ego.apply_control(carla.VehicleControl(steer=1.0, brake=1.0))
    for _ in range(40):
        world.tick()
    assert ego.get_velocity().length() == 0 and ego.get_transform().rotation.yaw != pytest.approx(0, abs=0.1)
    assert not hits
    server.collide((3.0, 4.0, 0.0))
    world.tick()
    assert hits == [3.0]
    other.set_autopilot(False, 8000)
    other.set_transform(ego.get_transform())
    world.tick()
    assert len(hits) == 2
    for actor in (collision, ego, other):
        actor.destroy()
    assert any("listening" in line for line in server.left_behind())


@pytest.mark.parametrize("threaded", [False, True])
def test_measurements_die_with_their_callback(monkeypatch: pytest.MonkeyPatch, threaded: bool) -> None:
    server = Server()
    server.threaded = threaded
    world = start(monkeypatch, server)
    ego, kept = put(world), []
    mount(world, ego, "sensor.camera.rgb", lambda data: kept.append((data, data.raw_data, bytes(data.raw_data))))
    frame = world.tick()
    server.join()
    data, view, copy = kept[0]
    assert copy == server.sent["sensor.camera.rgb"][frame].tobytes() and len(copy) == 8 * 6 * 4
    assert set(bytes(view)) == {0x5A}
    with pytest.raises(RuntimeError, match="after the callback"):
        _ = data.raw_data


def test_the_event_camera_is_silent_at_first_and_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server()
    world = start(monkeypatch, server)
    ego, got = put(world), []
    ego.set_target_velocity(carla.Vector3D(*(10 * x for x in _forward(world))))

    def keep(data: Any) -> None:
        got.append((data.frame, np.frombuffer(bytes(data.raw_data), DVS_DTYPE)))

    mount(world, ego, "sensor.camera.dvs", keep)
    first = world.tick()
    world.tick()
    (frame, events), end = got[0], round(server.elapsed * 1e9)
    assert len(got) == 1 and frame == first + 1
    assert events["t"][0] == pytest.approx(end - 50e6, abs=1) and events["t"][-1] == end
    assert (np.diff(events["t"]) >= 0).all() and events["x"].max() < 8 and events["y"].max() < 6
    ego.apply_control(carla.VehicleControl(brake=1.0, hand_brake=True))
    for _ in range(20):
        world.tick()
    assert got[-1][0] < server.frame


def _forward(world: Any) -> tuple[float, float, float]:
    vector = world.get_map().get_waypoint_xodr(45, -2, 105.0).transform.get_forward_vector()
    return vector.x, vector.y, vector.z


def test_delivery_goes_wrong_as_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    server, kind = Server(), "sensor.camera.depth"
    world = start(monkeypatch, server)
    frames: list[int] = []

    def keep(data: Any) -> None:
        frames.append(data.frame)
        assert len(np.frombuffer(data.raw_data, "<u4")) == 48

    mount(world, put(world), kind, keep)
    base = server.frame
    server.drop(kind, 1)
    world.tick()
    world.tick()
    server.late(kind, 2)
    world.tick()
    server.late(kind, 0)
    world.tick()
    world.tick()
    server.misnumber(kind, 1)
    world.tick()
    assert [frame - base for frame in frames] == [2, 4, 3, 5, 7]
    assert not capsys.readouterr().err
    server.corrupt(kind)
    world.tick()  # the client swallows what goes wrong in a callback
    assert "Error" in capsys.readouterr().err


def test_a_server_dies_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server()
    world = start(monkeypatch, server)
    ego = put(world)
    carla.Client("localhost", 2000).get_trafficmanager(8000)
    server.die("World.tick", after=1)
    world.tick()
    for _ in range(2):
        with pytest.raises(RuntimeError, match=r"time-out of \d+ms while waiting for the simulator"):
            world.tick()
    ego.apply_control(carla.VehicleControl())  # does not wait for an answer
    manager = server.traffic_managers[8000]
    with pytest.raises(RuntimeError, match="time-out"):
        manager.set_synchronous_mode(False)
    assert "the process would abort" in server.violations[0]
    server.restart()
    for call in (world.tick, ego.destroy):
        with pytest.raises(RuntimeError, match="time-out"):
            call()
    assert not start(monkeypatch, server).get_actors()
    server.fail("Client.get_world", KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        carla.Client("localhost", 2000).get_world()
    world = start(monkeypatch, server)
    server.fail("World.try_spawn_actor", KeyboardInterrupt(), done=True)
    with pytest.raises(KeyboardInterrupt):
        put(world)
    assert not world.get_actors() and len(server.vehicles()) == 1
    world.tick()
    assert [actor.type_id for actor in world.get_actors()] == ["vehicle.tesla.model3"]


def test_loading_a_world_ends_the_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server("Town01")
    world = start(monkeypatch, server)
    assert world.get_map().name == "Carla/Maps/Town01" and world.get_map().get_waypoint_xodr(45, -1, 100.0) is None
    new = carla.Client("localhost", 2000).load_world("Town04")
    assert new.get_map().get_waypoint_xodr(45, -1, 100.0) is not None
    with pytest.raises(RuntimeError, match="expired episode"):
        world.tick()


def test_what_is_left_behind_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server()
    assert server.left_behind() == []
    world = start(monkeypatch, server)
    ego = put(world)
    sensor = mount(world, ego, "sensor.camera.rgb", print)
    carla.Client("localhost", 2000).get_trafficmanager(8000).set_synchronous_mode(True)
    told = " ".join(server.left_behind())
    for word in ("model3", "camera.rgb", "synchronous_mode", "fixed_delta_seconds", "traffic manager"):
        assert word in told
    sensor.stop()
    batch = [carla.command.DestroyActor(actor.id) for actor in (ego, sensor)]
    assert not any(reply.has_error() for reply in carla.Client("localhost", 2000).apply_batch_sync(batch, False))
    assert any("before its sensor" in line for line in server.left_behind())
