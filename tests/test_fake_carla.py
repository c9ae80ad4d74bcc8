"""The fake CARLA server against the real client module: the same names, the same arguments, the same strictness."""

import ast
import inspect
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install carla")

import fake_carla_actors  # noqa: E402
import fake_carla_client  # noqa: E402
import fake_carla_data  # noqa: E402
from fake_carla import install  # noqa: E402

from sb3_have.envs.weather import WEATHERS  # noqa: E402

MODULES = (fake_carla_actors, fake_carla_client, fake_carla_data)
FAKES = [
    cls
    for module in MODULES
    for name, cls in vars(module).items()
    if inspect.isclass(cls) and cls.__module__ == module.__name__ and not name.startswith("_")
]
DUNDERS = ("__iter__", "__len__", "__getitem__", "__int__")


def real(fake: type) -> Any:
    return carla.command.Response if fake.__name__ == "Response" else getattr(carla, fake.__name__)


def members(fake: type) -> dict[str, Any]:
    """What the fake class and its private bases offer to client code."""
    own = [base for base in fake.__mro__ if base is fake or base.__name__.startswith("_")]
    found = {name: value for base in own for name, value in vars(base).items()}
    return {name: value for name, value in found.items() if not name.startswith("_") or name in DUNDERS}


MEMBERS = [pytest.param(fake, name, id=f"{fake.__name__}.{name}") for fake in FAKES for name in members(fake)]
METHODS = [
    pytest.param(fake, name, id=f"{fake.__name__}.{name}")
    for fake in FAKES
    for name, value in members(fake).items()
    if inspect.isfunction(value) and name not in DUNDERS
]


# ---- names ----


def test_the_fake_is_made_of_classes_of_the_client() -> None:
    assert {"Client", "World", "Vehicle", "Sensor", "Image", "DVSEventArray", "TrafficManager"} <= {
        fake.__name__ for fake in FAKES
    }
    for fake in FAKES:
        bases = {base.__name__ for base in fake.__mro__[1:-1] if not base.__name__.startswith("_")}
        assert bases <= {base.__name__ for base in real(fake).__mro__[1:]}


@pytest.mark.parametrize(("fake", "name"), MEMBERS)
def test_every_member_exists_on_the_real_class(fake: type, name: str) -> None:
    assert hasattr(real(fake), name), f"carla.{fake.__name__} has no {name}"
    if name not in DUNDERS:
        assert isinstance(members(fake)[name], property) != callable(getattr(real(fake), name))


@lru_cache
def stub() -> dict[str, dict[str, list[list[str]]]]:
    """Class -> method -> names of the arguments after self, of each overload."""
    folder = Path(carla.__path__[0])
    classes: dict[str, dict[str, list[list[str]]]] = {}
    for file in ("libcarla.pyi", "command.pyi"):
        for node in ast.parse((folder / file).read_text()).body:
            if isinstance(node, ast.ClassDef):
                methods = classes.setdefault(node.name, {})
                for item in node.body:
                    if isinstance(item, ast.FunctionDef):
                        names = [argument.arg for argument in (*item.args.posonlyargs, *item.args.args)]
                        methods.setdefault(item.name, []).append(names[1:])
    return classes


def signature(method: Callable[..., Any]) -> list[tuple[str, bool]]:
    """Names of the arguments after self as the compiled module itself tells them, and whether they have a default."""
    text = (method.__doc__ or "").strip().splitlines()[0]
    return [(name, bool(default)) for name, default in re.findall(r"\(\w+\)(\w+)(=?)", text)][1:]


@pytest.mark.parametrize(("fake", "name"), METHODS)
def test_arguments_have_the_names_of_the_real_ones(fake: type, name: str) -> None:
    parameters = list(inspect.signature(getattr(fake, name)).parameters.values())[1:]
    compiled = signature(getattr(real(fake), name))
    assert len(parameters) <= len(compiled)
    assert all(optional for _, optional in compiled[len(parameters) :]), f"{compiled} need more arguments"
    for k, parameter in enumerate(parameters):
        assert (parameter.default is not inspect.Parameter.empty) <= compiled[k][1]
        if parameter.kind is inspect.Parameter.POSITIONAL_ONLY:
            continue
        assert re.fullmatch(rf"{parameter.name}|arg\d+", compiled[k][0]), f"the module says {compiled}"
        base = next(base for base in real(fake).__mro__ if name in vars(base))
        overloads = stub()[base.__name__][name]
        assert any(names[k : k + 1] == [parameter.name] for names in overloads), f"the stub says {overloads}"


def test_arguments_whose_name_is_uncertain_are_positional() -> None:
    """Stub and module disagree here, so that a keyword would fail on one of the two."""
    uncertain = [(carla.World, "apply_settings"), (carla.Client, "set_timeout"), (carla.Vehicle, "set_autopilot")]
    for cls, name in uncertain:
        assert [[name for name, _ in signature(getattr(cls, name))]] != stub()[cls.__name__][name]
        fake = next(fake for fake in FAKES if fake.__name__ == cls.__name__)
        kinds = {parameter.kind for parameter in list(inspect.signature(getattr(fake, name)).parameters.values())[1:]}
        assert kinds == {inspect.Parameter.POSITIONAL_ONLY}


@pytest.mark.parametrize(
    ("made", "fields"),
    [
        (lambda: carla.WorldSettings(), fake_carla_client.SETTINGS),
        (lambda: carla.VehicleControl(), ("throttle", "steer", "brake", "hand_brake", "reverse")),
        (lambda: carla.Timestamp(), ("frame", "elapsed_seconds", "delta_seconds")),
        (lambda: carla.VehiclePhysicsControl(), ("wheels",)),
        (lambda: carla.WheelPhysicsControl(), ("max_steer_angle",)),
        (lambda: carla.Waypoint, ("transform", "road_id", "lane_id", "s", "lane_width", "lane_type", "next")),
        (lambda: carla.Transform(), ("location", "rotation", "transform", "get_forward_vector")),
        (lambda: carla.WeatherParameters, WEATHERS),
        (lambda: carla.ActorAttributeType, ("Bool", "Int", "Float", "String", "RGBColor")),
        (lambda: carla.command.DestroyActor(1), ("actor_id",)),
    ],
)
def test_real_objects_have_the_fields_that_the_fake_relies_on(made: Callable[[], Any], fields: tuple[str, ...]) -> None:
    assert [field for field in fields if not hasattr(made(), field)] == []


def test_the_package_names_only_what_the_client_has() -> None:
    """Real objects take a misspelt attribute without a word; names looked up on the module are checked here."""
    folder = Path(__file__).parent.parent / "sb3_have" / "envs" / "carla_vision"
    sources = [ast.parse(path.read_text()) for path in folder.glob("*.py")]
    names = {
        ast.unparse(node)
        for tree in sources
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and ast.unparse(node).startswith("carla.")
    }
    dotted = {name for name in names if re.fullmatch(r"carla(\.\w+)+", name)}
    assert "carla.Client" in dotted
    for name in dotted:
        found = carla
        for part in name.split(".")[1:]:
            assert hasattr(found, part), name
            found = getattr(found, part)


# ---- strictness ----

SAMPLES = [1, 1.5, True, "1", None, np.float32(1), np.float64(1), np.int64(1), np.bool_(True)]


@pytest.mark.parametrize("value", SAMPLES, ids=lambda value: f"{type(value).__name__}")
@pytest.mark.parametrize(
    ("kind", "take"),
    [
        (float, lambda value: carla.Location(x=value)),
        (int, lambda value: carla.Timestamp(value, 0.0, 0.0, 0.0)),
        (str, lambda value: carla.Client(value, 65000) if value != "1" else None),
    ],
)
def test_the_fake_takes_the_types_that_the_real_client_takes(
    kind: type, take: Callable[[Any], Any], value: Any
) -> None:
    def accepted(call: Callable[[], Any]) -> bool:
        try:
            call()
        except TypeError:
            return False
        return True

    assert accepted(lambda: fake_carla_data.expect(value, kind)) == accepted(lambda: take(value))


def test_a_time_out_reads_as_the_real_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def text(client: Any) -> str:
        client.set_timeout(0.2)
        with pytest.raises(RuntimeError) as caught:
            client.get_world()
        return str(caught.value)

    before = text(carla.Client("localhost", 2957))
    install(monkeypatch)
    assert text(carla.Client("localhost", 2957)) == before
