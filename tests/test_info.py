"""What a bug report gets from ``python -m sb3_have.info``."""

from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.utils import get_device

import sb3_have
from sb3_have.common.encoders import MultiModalEncoder
from sb3_have.info import has_extra, main


def test_report(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    lines = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
    assert lines["sb3_have"].startswith(sb3_have.__version__)
    assert lines["torch"] == version("torch")
    count, folder = lines["configurations"].split(" in ")
    assert len(list(Path(folder).glob("*.yml"))) == int(count) + 1  # shared.yml is the Zoo's


@pytest.mark.parametrize("native", [True, False])
def test_precision_is_that_of_an_encoder(
    native: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sb3_have.common.encoders.has_native_bfloat16", lambda device_type: native)
    monkeypatch.setattr("sb3_have.info.has_native_bfloat16", lambda device_type: native)
    encoder = MultiModalEncoder(spaces.Dict({"rgb": spaces.Box(0, 255, (3, 16, 16), np.uint8)}))
    dtype = encoder.image_dtype(get_device("auto"))
    main([])
    assert f"precision: {str(dtype).removeprefix('torch.')} (auto)" in capsys.readouterr().out.splitlines()


def install(folder: Path, name: str, version: str, *requirements: str) -> None:
    """Write the metadata of a made-up package."""
    (folder / f"{name}-{version}.dist-info").mkdir()
    lines = ["Metadata-Version: 2.1", f"Name: {name}", f"Version: {version}"]
    lines += [f"Requires-Dist: {requirement}" for requirement in requirements]
    (folder / f"{name}-{version}.dist-info" / "METADATA").write_text("\n".join(lines) + "\n")


def test_extra_is_installed_if_all_of_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    install(
        tmp_path, "robot", "1.0",
        'arm>=2; extra == "complete"',
        'leg; python_version < "3" and extra == "complete"',
        'arm>=3; extra == "too-old"',
        'arm; extra == "missing"',
        'leg; extra == "missing"',
        'arm[hand]; extra == "nested"',
    )  # fmt: skip
    install(tmp_path, "arm", "2.5", 'hand; extra == "hand"')
    states = {extra: has_extra("robot", extra) for extra in ("complete", "too-old", "missing", "nested")}
    assert states == {"complete": True, "too-old": False, "missing": False, "nested": False}
    install(tmp_path, "hand", "1.0")
    assert has_extra("robot", "nested")
