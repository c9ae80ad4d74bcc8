"""The package as it is installed: version, typing marker, configurations, pinned versions."""

import configparser
import re
from importlib import metadata
from pathlib import Path

import pytest

import sb3_have

ROOT = Path(__file__).parent.parent


def test_version_is_the_installed_one() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", sb3_have.__version__)
    assert metadata.version("sb3_have") == sb3_have.__version__


def test_every_package_directory_is_listed() -> None:
    """A package missing from setup.cfg works in a checkout and is absent from the wheel."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    present = {".".join(p.parent.relative_to(ROOT).parts) for p in (ROOT / "sb3_have").rglob("__init__.py")}
    assert listed == present | {"sb3_have.zoo_configs"}
    assert (ROOT / "sb3_have" / "py.typed").is_file()


@pytest.mark.parametrize("section", ["options", "dev", "events", "carla", "mujoco"])
def test_every_direct_dependency_is_pinned(section: str) -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    text = config["options"]["install_requires"] if section == "options" else config["options.extras_require"][section]
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    needed = {re.split(r"[<>=;\[]", line)[0].lower().replace("_", "-") for line in lines}
    pins = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert needed <= {pin.split("==")[0].lower().replace("_", "-") for pin in pins}
    assert not [pin for pin in pins if "+" in pin or "@" in pin], "local versions and URLs install on one machine only"
