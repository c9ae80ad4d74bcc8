"""Importing the package is cheap, and nothing is missing from it."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest

import sb3_have
from sb3_have import envs

HEAVY = ("torch", "stable_baselines3", "highway_env", "matplotlib", "pandas", "cv2")


def loaded_by(statement: str) -> set[str]:
    """Top-level packages, and torch's compiler, that a statement imports in a fresh interpreter."""
    code = f"import sys; {statement}; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    return {name.partition(".")[0] for name in modules} | {name for name in modules if name == "torch._dynamo"}


def test_importing_the_package_only_registers_environments() -> None:
    loaded = loaded_by("import sb3_have; assert 'HighwayVision-v0' in __import__('gymnasium').registry")
    assert loaded.isdisjoint(HEAVY), loaded.intersection(HEAVY)


def test_importing_the_algorithm_imports_little_beside_sb3() -> None:
    """SB3 imports PyTorch and pandas anyway; matplotlib, highway-env and PyTorch's compiler would double the time."""
    beside_sb3 = loaded_by("from sb3_have import HAVESAC") - loaded_by("from stable_baselines3 import SAC")
    assert beside_sb3.isdisjoint({"matplotlib", "highway_env", "torch._dynamo"}), beside_sb3


@pytest.mark.parametrize("module", [sb3_have, envs])
def test_every_public_name_can_be_imported_and_is_listed(module: object) -> None:
    names: list[str] = module.__all__  # type: ignore[attr-defined]
    assert set(names) <= set(dir(module))
    for name in names:
        value = getattr(module, name)
        if hasattr(value, "__module__"):  # and it is what its own module holds
            assert getattr(import_module(value.__module__), value.__name__) is value


@pytest.mark.parametrize("module", ["sb3_have", "sb3_have.envs"])
def test_a_name_that_does_not_exist(module: str) -> None:
    with pytest.raises(AttributeError, match=f"'{module}' has no attribute 'Nothing'"):
        import_module(module).Nothing  # noqa: B018


def test_packages_inside_are_attributes() -> None:
    code = "import sb3_have; sb3_have.sensors.EventCamera; sb3_have.plotting; sb3_have.export; sb3_have.have.HAVESAC"
    subprocess.run([sys.executable, "-c", code], check=True)


ROOMS = ("benchmark", "trained", "export", "have", "plotting", "evaluation", "checkpoint", "common", "envs", "sensors")
"""From the top down: a package may only import from those below it. The programs import from all of them."""


def imports() -> dict[str, set[str]]:
    """All imports between the modules of the package, also in functions and for type checkers."""
    root = Path(sb3_have.__file__).parent
    files = {".".join(file.relative_to(root.parent).with_suffix("").parts): file for file in root.rglob("*.py")}
    files = {name.removesuffix(".__init__"): file for name, file in files.items()}
    graph: dict[str, set[str]] = {}
    for name, file in files.items():
        found = graph.setdefault(name, set())
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
        graph[name] = (found & files.keys()) - {name}
    return graph


def test_no_import_cycles() -> None:
    # A package imports its modules, which is no reason for them not to import one another
    graph = {name: {other for other in found if not name.startswith(f"{other}.")} for name, found in imports().items()}
    assert len(list(TopologicalSorter(graph).static_order())) > 90


def test_imports_point_down() -> None:
    for name, found in imports().items():
        room = name.split(".")[1] if "." in name else ""
        if room in ROOMS:
            programs = () if room == "benchmark" else ("train", "zoo", "demo", "watch")  # it is a program itself
            above = {*ROOMS[: ROOMS.index(room)], *programs}
            wrong = [other for other in found if other.split(".")[1:2] and other.split(".")[1] in above]
            assert not wrong, f"{name} imports {wrong}"
