"""The notebooks run from top to bottom on a small budget, find the package, and hold no outputs."""

import ast
import importlib.util
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import nbformat
import pytest
from IPython.core.inputtransformer2 import TransformerManager
from jupyter_client.manager import KernelManager, start_new_kernel
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
STEPS = "40"
RESET = "%reset -f\n"
"""Before each notebook: a fresh namespace."""
STRICT = """import warnings
warnings.simplefilter("error")
warnings.filterwarnings("ignore", "rich is experimental/alpha")"""
"""Warnings are errors as in the other tests, unless pytest has filters on its command line."""

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_of(path: Path) -> list[dict[str, Any]]:
    """The code cells of a notebook."""
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]


def setup_of(path: Path) -> str:
    """The first code cell of a notebook."""
    return "".join(code_of(path)[0]["source"])


@pytest.fixture(scope="module")
def kernel() -> Iterator[KernelManager]:
    """One for all notebooks, because importing torch takes longer than most of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_HAVE_NOTEBOOK_STEPS", STEPS)
        manager, client = start_new_kernel(kernel_name="python3", cwd=str(FOLDER))
    client.stop_channels()
    yield manager
    manager.shutdown_kernel(now=True)


def test_there_are_six() -> None:
    assert [path.name[0] for path in NOTEBOOKS] == list("123456")


@each
def test_runs(path: Path, kernel: KernelManager, pytestconfig: pytest.Config) -> None:
    notebook = nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]
    setup = RESET if pytestconfig.getoption("pythonwarnings") else RESET + STRICT
    notebook.cells.insert(0, nbformat.v4.new_code_cell(setup))  # type: ignore[no-untyped-call]
    client = NotebookClient(notebook, km=kernel, timeout=None, startup_timeout=1800)
    try:
        client.execute()
    finally:
        assert client.kc is not None
        client.kc.stop_channels()  # its sockets; nbclient leaves them open where the kernel is not its own
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = [output["data"] for output in outputs if "data" in output]
    figures = [data for data in shown if data.get("text/plain", "").startswith("<Figure")]
    assert figures and all("image/png" in data for data in figures)


@each
def test_is_stripped_and_tidy(path: Path) -> None:
    """As git should see it: no outputs, no counts, nothing of whoever ran it last, and ids that stay."""
    notebook = json.loads(path.read_text())
    nbformat.validate(notebook)
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    assert notebook["metadata"]["language_info"] == {"name": "python"}
    assert not any(cell["metadata"] for cell in notebook["cells"])
    for cell in code_of(path):
        assert cell["outputs"] == [] and cell["execution_count"] is None, cell["id"]
    assert path.read_text() == json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
    assert "".join(notebook["cells"][0]["source"]).startswith("# ")


@each
@pytest.mark.parametrize("where", ["installed", "checkout", "Colab", "elsewhere"])
def test_first_cell_finds_the_package(path: Path, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It installs in Colab alone, if there is nothing to import, and needs no network in a checkout."""
    installed = []

    class Shell:
        def run_line_magic(self, name: str, line: str, **kwargs: Any) -> None:
            installed.append((name, line))

    code = TransformerManager().transform_cell(setup_of(path))  # type: ignore[no-untyped-call]
    before = list(sys.path)
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path if where in ("Colab", "elsewhere") else FOLDER)
        patch.setattr(sys, "path", list(before))
        if where != "installed":
            patch.setattr(importlib.util, "find_spec", lambda name: None)
        if where == "Colab":
            patch.setitem(sys.modules, "google.colab", ModuleType("google.colab"))
        exec(code, {"get_ipython": Shell})
        after = list(sys.path)
    assert installed == ([("pip", "install --quiet sb3_have")] if where == "Colab" else [])
    assert after == ([str(FOLDER.parent.resolve())] if where == "checkout" else []) + before


@each
def test_takes_its_budget_from_the_environment(path: Path) -> None:
    """All but the one that trains nothing, and each says so in words."""
    trains = path.stem != "3_event_camera"
    code = "".join("".join(cell["source"]) for cell in code_of(path))
    introduction = "".join(json.loads(path.read_text())["cells"][0]["source"])
    assert (".learn(" in code) == trains
    assert ('os.environ.get("SB3_HAVE_NOTEBOOK_STEPS", ' in code) == trains
    assert ("`SB3_HAVE_NOTEBOOK_STEPS`" in introduction) == trains


@each
def test_uses_what_is_public(path: Path) -> None:
    code = "\n".join("".join(cell["source"]) for cell in code_of(path))
    tree = ast.parse(TransformerManager().transform_cell(code))  # type: ignore[no-untyped-call]
    used = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    private = [node for node in used if node.attr.startswith("_") and not node.attr.startswith("__")]
    assert {ast.unparse(node.value) for node in private} <= {"self"}, [ast.unparse(node) for node in private]


@pytest.mark.parametrize("command", [["check"], ["format", "--check"]], ids=lambda command: command[0])
def test_lint(command: list[str]) -> None:
    ruff = [sys.executable, "-m", "ruff", *command, "--no-cache", str(FOLDER)]
    result = subprocess.run(ruff, cwd=FOLDER.parent, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
