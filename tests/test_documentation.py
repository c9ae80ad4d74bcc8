"""README and docs: what they show runs, what they name exists, and the site builds.

The Python blocks of a page are executed in their order, in one namespace, with little training. A block that cannot run
here is preceded by ``<!-- not executed: REASON -->``, with one of the reasons below.
"""

import argparse
import configparser
import importlib.util
import inspect
import os
import random
import re
import runpy
import shlex
import subprocess
import sys
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from test_mujoco import missing as missing_for_mujoco

import sb3_have.plotting
import sb3_have.sensors
from sb3_have import HAVESAC, MultiModalPolicy
from sb3_have.configuration import env_wrapper
from sb3_have.sensors import EVENT_DTYPE

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "SECURITY")] + sorted((ROOT / "docs").rglob("*.md"))
REASONS = ("needs a CARLA server", "needs an account of W&B", "needs a PostgreSQL server")
STEPS, LEARNING_STARTS, BATCH_SIZE = 60, 50, 8
"""Most steps of a ``learn``, of these before the first update, and samples of an update's batch."""
FENCE = re.compile(r"^(?P<indent> *)(?P<fence>`{3,}|:{3,})(?P<info>[^`\n]*)\n(?P<body>.*?)^\1\2 *$", re.S | re.M)


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    text: str
    line: int
    reason: str | None
    """Why it is not executed, if the comment before it says so."""


class Parsed(Exception):
    """A program's arguments are understood; it is stopped here."""


def blocks(page: Path) -> list[Block]:
    text = page.read_text()
    found = []
    for match in FENCE.finditer(text):
        said = re.search(r"<!-- not executed: ([^>]*?) -->\s*\Z", text[: match.start()])
        line = text.count("\n", 0, match.start("body"))
        found.append(Block(match["info"].strip(), match["body"], line, said[1] if said else None))
    return found


def pages_with(language: str) -> list[Path]:
    return [page for page in PAGES if any(block.language == language for block in blocks(page))]


def prose(page: Path) -> str:
    """Without fenced blocks."""
    return FENCE.sub("", page.read_text())


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.fixture
def small_budget(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    learn: Callable[..., Any] = OffPolicyAlgorithm.learn

    def learn_little(model: OffPolicyAlgorithm, total_timesteps: int, *args: Any, **kwargs: Any) -> OffPolicyAlgorithm:
        model.batch_size = min(model.batch_size, BATCH_SIZE)
        model.learning_starts = min(model.learning_starts, LEARNING_STARTS)
        return learn(model, min(total_timesteps, STEPS), *args, **kwargs)  # type: ignore[no-any-return]

    monkeypatch.setattr(OffPolicyAlgorithm, "learn", learn_little)
    monkeypatch.setenv("MUJOCO_GL", "egl")  # also takes back what a page sets
    monkeypatch.chdir(tmp_path)
    random.seed(0)
    np.random.seed(0)
    th.manual_seed(0)
    yield


def write_recording(folder: Path) -> None:
    """The recording that docs/sensors.md reads: 3 seconds of 640 x 480 pixels."""
    from event_recordings import put  # needs h5py

    rng = np.random.default_rng(0)
    events = np.zeros(1000, EVENT_DTYPE)
    events["x"], events["y"] = rng.integers(640, size=1000), rng.integers(480, size=1000)
    events["t"], events["p"] = np.sort(rng.uniform(0, 3, 1000)), rng.choice([-1, 1], 1000)
    put(folder / "events.h5", events)


PREPARATIONS = {"docs/sensors.md": write_recording}


@pytest.mark.filterwarnings("ignore:The replay buffer's frames will take")  # the machine's memory is not the page's
@pytest.mark.parametrize("page", pages_with("python"), ids=name_of)
def test_python_blocks_run(page: Path, small_budget: None, tmp_path: Path) -> None:
    python = [block for block in blocks(page) if block.language == "python" and block.reason is None]
    if any("MUJOCO_GL" in block.text for block in python) and (reason := missing_for_mujoco()):
        pytest.skip(reason)
    if prepare := PREPARATIONS.get(name_of(page)):
        prepare(tmp_path)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for block in python:
        exec(compile("\n" * block.line + block.text, str(page), "exec"), namespace)


def test_only_what_cannot_run_here_is_left_out() -> None:
    reasons = {name_of(page): block.reason for page in PAGES for block in blocks(page) if block.reason is not None}
    assert set(reasons.values()) <= set(REASONS), reasons
    comments = [text for page in PAGES for text in re.findall("<!--.*?-->", page.read_text(), re.S)]
    assert len(comments) == sum(block.reason is not None for page in PAGES for block in blocks(page)), comments
    languages = {block.language.split()[0] for page in PAGES for block in blocks(page)}
    assert languages <= {"python", "bash", "yaml", "bibtex", "html", "{raw}", "{toctree}", "{eval-rst}", "{include}"}, (
        languages
    )


@pytest.mark.parametrize("page", pages_with("yaml"), ids=name_of)
def test_yaml_blocks_are_configurations(page: Path) -> None:
    for_others = {"n_timesteps", "n_envs", "frame_stack", "env_kwargs", "env_wrapper"}
    known = for_others | inspect.signature(HAVESAC).parameters.keys()
    of_policy = set(inspect.signature(MultiModalPolicy).parameters)
    for block in blocks(page):
        if block.language == "yaml":
            read = yaml.safe_load(block.text)
            config = read if "env_wrapper" in read else next(iter(read.values()))
            assert config.keys() <= known and config.get("policy_kwargs", {}).keys() <= of_policy, block.text
            assert "env_wrapper" not in config or env_wrapper(config) is not None


def test_citation_has_the_version() -> None:
    assert f"version = {{{sb3_have.__version__}}}" in (ROOT / "docs" / "citation.md").read_text()


def commands(page: Path) -> list[str]:
    """Shell commands of a page: in bash blocks, in indented blocks, and whole in the running text."""
    text = prose(page)
    lines = [line for block in blocks(page) if block.language == "bash" for line in joined(block.text)]
    lines += [line for block in re.findall(r"(?<=\n\n)(?:    \S.*\n)+", text) for line in joined(block)]
    lines += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]
    return [line for line in lines if re.match(r"(?:[A-Z_]+=\S+ )*(?:python|pip|make) ", line)]


def joined(text: str) -> list[str]:
    """Its lines; those that a backslash or a quotation connects, as one."""
    lines = [""]
    for line in text.replace("\\\n", " ").splitlines():
        if lines[-1].count('"') % 2:
            lines[-1] += "\n" + line
        else:
            lines.append(line.strip())
    return lines


def check_module(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Stops the program as soon as its own parser has understood the arguments."""
    module = arguments[0]
    assert importlib.util.find_spec(module) is not None, f"no module {module}"
    if len(arguments) == 1 or module.split(".")[0] not in ("sb3_have", "benchmarks"):
        return
    parse: Callable[..., Any] = argparse.ArgumentParser.parse_args

    def parse_only(*args: Any, **kwargs: Any) -> None:
        parse(*args, **kwargs)
        raise Parsed

    with monkeypatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the module may have been imported before
        patch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
        patch.setattr(sys, "argv", arguments)
        if arguments[:2] == ["sb3_have.zoo", "enjoy"]:
            importlib.import_module("rl_zoo3.enjoy")  # first, or it would keep what stands in for its function
            patch.setattr("rl_zoo3.utils.get_model_path", lambda *_: None)  # as if one had been trained
        with pytest.raises(Parsed):
            runpy.run_module(module, run_name="__main__")


def extras_of_setup() -> set[str]:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    return set(setup["options.extras_require"])


def check_pip(arguments: list[str]) -> None:
    extras = {extra for argument in arguments for extra in re.findall(r"(?:sb3_have|\.)\[(.*)\]", argument)}
    assert {name for extra in extras for name in extra.split(",")} <= extras_of_setup(), extras
    assert all((ROOT / argument).exists() for argument in arguments if argument.endswith(".txt"))


def check_make(arguments: list[str]) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
    assert {argument for argument in arguments if "=" not in argument} <= set(targets)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_exist(page: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    for command in commands(page):
        words = [word for word in shlex.split(command, comments=True) if not re.match(r"[A-Z_]+=", word)]
        try:
            if words[:2] == ["python", "-m"]:
                check_module(words[2:], monkeypatch)
            elif words[:2] == ["python", "-c"]:
                compile(words[2], command, "exec")
            elif words[:2] == ["pip", "install"]:
                check_pip(words[2:])
            elif words[0] == "make":
                check_make(words[1:])
            else:
                raise AssertionError("unknown command")
        except (Exception, SystemExit) as error:
            said = capsys.readouterr().err
            if "--trial-id" in words and "`tune` writes it" in said:
                continue  # understood, but for the study that another command of the page makes
            pytest.fail(f"{name_of(page)}: {command}: {error}\n{said}")


def test_quickstart_lists_every_extra() -> None:
    table = (ROOT / "docs" / "quickstart.md").read_text().partition("| extra |")[2].partition("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.M)) == extras_of_setup()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_local_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub("`[^`]*`", "", prose(page))):
        if re.match(r"\w+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.is_file(), f"{name_of(page)}: there is no {path}"
        assert not anchor or anchor in anchors(file), f"{name_of(page)}: {path} has no heading #{anchor}"


def anchors(page: Path) -> set[str]:
    """Of its headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.M)
    return {
        re.sub(r"[^\w\- ]", "", re.sub(r"\[(.*?)\]\(.*?\)", r"\1", h)).strip().lower().replace(" ", "-")
        for h in headings
    }


def test_every_page_and_picture_is_used() -> None:
    pages = {page for page in PAGES if page.parent != ROOT}
    texts = {page: page.read_text() for page in PAGES}
    for picture in (ROOT / "docs").rglob("*.png"):
        assert any(f"{picture.name})" in text for text in texts.values()), f"no page shows {picture.name}"
        assert picture.stat().st_size < 500_000
    for page in pages - {ROOT / "docs" / "index.md"}:
        tables = [index for index in pages if "{toctree}" in texts[index]]
        entries = {
            (index.parent / line.strip()).with_suffix(".md") for index in tables for line in texts[index].splitlines()
        }
        assert page in entries, f"{name_of(page)} is in no toctree"


def test_site_builds_without_warnings(tmp_path: Path) -> None:
    for package in ("sphinx", "myst_parser", "furo", "sphinx-mathjax-offline"):
        pytest.importorskip(package, reason='pip install "sb3_have[docs]"')
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", str(tmp_path / "html")]
    build = subprocess.run(
        [*command, "-d", str(tmp_path / "doctrees")], cwd=ROOT, capture_output=True, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert build.returncode == 0, build.stderr
    named = documented_names(tmp_path / "html" / "objects.inv")
    assert "HAVESAC.modality_weights" in named
    for module in (sb3_have, sb3_have.have, sb3_have.envs, sb3_have.export, sb3_have.plotting, sb3_have.sensors):
        assert set(module.__all__) - {"__version__", "Representation"} <= named, module.__name__
    assert not re.search("[“”]", (tmp_path / "html" / "api" / "have.html").read_text())  # they could not be pasted
    for page in (tmp_path / "html").rglob("*.html"):  # formulas need no network either
        remote = re.findall(r'<(?:script|link|img)[^>]* (?:src|href)="https?:[^"]*"', page.read_text())
        assert not remote, f"{page.name} loads {remote}"


def documented_names(inventory: Path) -> set[str]:
    """Of the API reference, without modules before them: ``Class`` and ``Class.method``."""
    lines = zlib.decompress(inventory.read_bytes().split(b"\n", 4)[4]).decode().splitlines()
    names = [line.split()[0].split(".") for line in lines if " py:" in line]
    return {name[-1] for name in names} | {".".join(name[-2:]) for name in names}
