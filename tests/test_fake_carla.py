"""The fake CARLA module against the real one: the same names, the same arguments, the same strictness."""

import ast
import inspect
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla  # noqa: E402
import fake_carla_fixtures  # noqa: E402
from fake_carla_fixtures import Start, install  # noqa: E402
from fake_carla_server import Server  # noqa: E402

from sb3_have.envs.weather import WEATHERS  # noqa: E402

server, start = fake_carla_fixtures.server, fake_carla_fixtures.start

FAKES = [cls for name, cls in vars(fake_carla).items() if getattr(cls, "__module__", "") == "fake_carla"]
FAKES = [cls for cls in FAKES if inspect.isclass(cls) and not cls.__name__.startswith("_")]
# Attributes of instances that the package reads
FIELDS: dict[str, tuple[str, ...]] = {
    "Image": ("frame", "raw_data", "width", "height"),
    "DVSEventArray": ("frame", "raw_data"),
    "CollisionEvent": ("frame", "normal_impulse"),
    "Response": ("error", "has_error"),
    "WorldSnapshot": ("timestamp",),
    "Timestamp": ("elapsed_seconds",),
    "WorldSettings": fake_carla.SETTINGS,
    "VehicleControl": ("throttle", "steer", "brake", "hand_brake"),
    "VehiclePhysicsControl": ("wheels",),
    "WheelPhysicsControl": ("max_steer_angle",),
    "Waypoint": ("transform", "road_id", "lane_id", "s", "lane_width"),
    "Transform": ("location", "rotation", "get_forward_vector"),
    "Map": ("name", "get_waypoint", "get_waypoint_xodr"),
    "WeatherParameters": WEATHERS,
}


def real(name: str) -> Any:
    return carla.command.Response if name == "Response" else getattr(carla, name)


def members(fake: type) -> dict[str, Any]:
    return {name: value for name, value in vars(fake).items() if not name.startswith("_")}


METHODS = [
    pytest.param(fake, name, id=f"{fake.__name__}.{name}")
    for fake in FAKES
    for name, value in members(fake).items()
    if inspect.isfunction(value)
]


def test_classes_and_members_exist() -> None:
    assert {"Client", "World", "Vehicle", "Sensor", "Image", "DVSEventArray", "TrafficManager"} <= {
        fake.__name__ for fake in FAKES
    }
    for fake in FAKES:
        bases = {base.__name__ for base in fake.__mro__[1:-1] if not base.__name__.startswith("_")}
        assert bases <= {base.__name__ for base in real(fake.__name__).__mro__}
        for name, value in members(fake).items():
            assert isinstance(value, property) != callable(getattr(real(fake.__name__), name)), (fake, name)
    for cls, names in FIELDS.items():
        assert [name for name in names if not hasattr(real(cls), name)] == [], cls


@lru_cache
def stub() -> dict[str, dict[str, list[list[str]]]]:
    """Names of the arguments in the module's stub: class -> method -> a list for each overload."""
    classes: dict[str, dict[str, list[list[str]]]] = {}
    for node in ast.parse((Path(carla.__path__[0]) / "libcarla.pyi").read_text()).body:
        if isinstance(node, ast.ClassDef):
            methods = classes.setdefault(node.name, {})
            for item in node.body:
                if isinstance(item, ast.FunctionDef):
                    names = [argument.arg for argument in (*item.args.posonlyargs, *item.args.args)]
                    methods.setdefault(item.name, []).append(names[1:])
    return classes


def signature(method: Callable[..., Any]) -> list[tuple[str, bool]]:
    """Names of the arguments in the compiled module, and whether they have a default."""
    text = (method.__doc__ or "").strip().splitlines()[0]
    return [(name, bool(default)) for name, default in re.findall(r"\(\w+\)(\w+)(=?)", text)][1:]


@pytest.mark.parametrize(("fake", "name"), METHODS)
def test_arguments_are_those_of_the_real_method(fake: type, name: str) -> None:
    parameters = list(inspect.signature(getattr(fake, name)).parameters.values())[1:]
    cls = real(fake.__name__)
    compiled = signature(getattr(cls, name))
    assert all(optional for _, optional in compiled[len(parameters) :]), f"{compiled} need more arguments"
    for k, parameter in enumerate(parameters):
        assert (parameter.default is not inspect.Parameter.empty) <= compiled[k][1]
        # Arguments are positional-only where the stub and the module disagree about the name
        if parameter.kind is not inspect.Parameter.POSITIONAL_ONLY:
            assert re.fullmatch(rf"{parameter.name}|arg\d+", compiled[k][0]), compiled
            base = next(base for base in cls.__mro__ if name in vars(base))
            overloads = stub()[base.__name__][name] if base.__name__ in stub() else [[p.name for p in parameters]]
            assert any(names[k : k + 1] == [parameter.name] for names in overloads), overloads


def test_the_package_only_uses_names_that_exist() -> None:
    folder = Path(__file__).parent.parent / "sb3_have" / "envs" / "carla_vision"
    names = {
        ast.unparse(node)
        for path in folder.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute)
    }
    dotted = {name for name in names if re.fullmatch(r"carla(\.\w+)+", name)}
    assert "carla.Client" in dotted
    for name in dotted:
        found = carla
        for part in name.split(".")[1:]:
            assert hasattr(found, part), name
            found = getattr(found, part)


@pytest.mark.parametrize("value", [1, 1.5, "1", None, np.float32(1), np.int64(1)], ids=lambda value: repr(value))
def test_numbers_are_accepted_as_by_the_real_module(value: Any) -> None:
    def accepted(call: Callable[[], Any]) -> bool:
        try:
            call()
        except TypeError:
            return False
        return True

    for kind, take in ((float, lambda: carla.Location(x=value)), (int, lambda: carla.Timestamp(value, 0.0, 0.0, 0.0))):
        assert accepted(lambda kind=kind: fake_carla.expect(value, kind)) == accepted(take)  # type: ignore[misc]


def test_timeouts_read_like_the_real_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    def text(client: Any) -> str:
        client.set_timeout(0.2)
        with pytest.raises(RuntimeError) as caught:
            client.get_world()
        return str(caught.value)

    before = text(carla.Client("localhost", 2957))
    install(monkeypatch)
    assert text(carla.Client("localhost", 2957)) == before


def test_left_behind_sees_everything(server: Server, start: Start) -> None:
    start()
    found = " ".join(server.left_behind())
    for word in ("model3", "camera.rgb", "synchronous_mode", "fixed_delta_seconds", "traffic manager"):
        assert word in found
    ego, *_ = server.vehicles
    world = carla.Client("localhost", 2000).get_world()
    world.get_actors()
    server.remove(ego.id)
    server.remove(server.sensors[0].id)
    assert [line for line in server.violations if "before its sensors" in line or "listening" in line]
    server.violations.clear()
