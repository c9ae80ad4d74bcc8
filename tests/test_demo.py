"""The demo from end to end, in a small stand-in for the highway."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from fake_drive import CONFIG, ENV_ID, FakeDrive
from PIL import Image

from sb3_have import HAVESAC, demo


def test_the_demo_writes_all_of_its_results_and_can_be_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo, "ENV_ID", ENV_ID)
    config = {**CONFIG, "policy_kwargs": {"features_dim": 4, "net_arch": [8]}}
    monkeypatch.setattr(demo, "load_config", lambda *_: config)
    monkeypatch.setattr(demo, "WEATHERS", ("slow", "fast"))
    monkeypatch.setattr(demo, "SHOWN", "fast")
    for steps in (20, 30):  # the second run finds the results of the first in its folder
        demo.main(["--steps", str(steps), "--episodes", "1", "--out", str(tmp_path)])
        assert HAVESAC.load(tmp_path / "havesac_demo.zip").num_timesteps == steps
    table = pd.read_csv(tmp_path / "evaluation.csv")
    assert list(table["driver"].unique()) == ["HAVESAC", "random", "straight at 25 m/s", "straight at 20 m/s"]
    assert list(table["weather"]) == ["slow", "fast"] * 4
    assert "ER" in capsys.readouterr().out
    for name in ("learning_curve.png", "modality_weights.png", "drive.gif"):
        with Image.open(tmp_path / name) as picture:
            assert picture.width > 100


def test_the_demo_ends_when_interrupted_before_the_first_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(self: FakeDrive, action: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "ENV_ID", ENV_ID)
    config = {**CONFIG, "policy_kwargs": {"features_dim": 4, "net_arch": [8]}}
    monkeypatch.setattr(demo, "load_config", lambda *_: config)
    monkeypatch.setattr(FakeDrive, "step", interrupted)
    with pytest.raises(SystemExit) as stop:
        demo.main(["--steps", "20", "--out", str(tmp_path)])
    assert stop.value.code == 130 and "Interrupted" in capsys.readouterr().err
