"""What contributors rely on: CI tests the versions that setup.cfg names, and CONTRIBUTING.md names what exists."""

import configparser
import re
from pathlib import Path
from typing import Any

import yaml
from test_documentation import check_make

import sb3_have
from sb3_have import info

ROOT = Path(__file__).parent.parent
GITHUB = ROOT / ".github"


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def steps(workflow: Path) -> list[dict[str, Any]]:
    return [step for job in read(workflow)["jobs"].values() for step in job["steps"]]


def test_ci_tests_every_version_of_python() -> None:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    versions = re.findall(r"Python :: (3\.\d+)", setup["metadata"]["classifiers"])
    jobs = read(GITHUB / "workflows" / "ci.yml")["jobs"]
    assert jobs["test"]["strategy"]["matrix"]["python"] == versions
    lowest = [step["with"]["python-version"] for step in jobs["lowest"]["steps"] if "with" in step]
    assert lowest == [setup["options"]["python_requires"].removeprefix(">=")] == versions[:1]


def test_workflows_run_what_exists() -> None:
    commands = [step["run"] for file in (GITHUB / "workflows").glob("*.yml") for step in steps(file) if "run" in step]
    targets = [command.removeprefix("make ") for command in commands if command.startswith("make ")]
    assert {"lint", "type", "test", "docs"} <= set(targets)
    check_make(targets)
    assert any(f"python -m {info.__name__}\n" in command for command in commands)


def test_bug_form_asks_for_the_versions() -> None:
    labels = [field["attributes"].get("label", "") for field in read(GITHUB / "ISSUE_TEMPLATE" / "bug.yml")["body"]]
    assert f"Output of `python -m {info.__name__}`" in labels


def test_citation_has_the_version() -> None:
    assert read(ROOT / "CITATION.cff")["version"] == sb3_have.__version__


def test_contributing_names_what_exists() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    named = re.findall(r"((?:`\w+`(?:,| and| or)? )+)in\s+\[[^\]]*\]\(([^)#]+)\)", text)
    names = [(name, file) for group, file in named for name in re.findall(r"`(\w+)`", group)]
    missing = [(name, file) for name, file in names if not re.search(rf"^\s*{name}\b", (ROOT / file).read_text(), re.M)]
    assert len(names) >= 12 and not missing, missing
