"""The demo: as a user runs it, with short episodes, and its interruptions in a small stand-in for the highway."""

import multiprocessing
import pickle
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest
import torch as th
from fake_drive import CONFIG, ENV_ID, FakeDrive
from gymnasium import spaces
from PIL import Image
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_have import HAVESAC, demo, evaluate
from sb3_have.common.encoders import MultiModalEncoder
from sb3_have.envs.drivers import RandomDriver
from sb3_have.trained import features


class Coaster(RandomDriver):
    """Stands for the trained driver of the package."""

    env_kwargs: ClassVar[dict[str, Any]] = {}

    def __init__(self) -> None:
        super().__init__()
        images: dict[str, Any] = {
            key: spaces.Box(0, 255, (2 * n, 36, 36), np.uint8) for key, n in {"rgb": 3, "depth": 1}.items()
        }
        with th.random.fork_rng():
            self.encoder = MultiModalEncoder(spaces.Dict(images), 4)


COASTER = Coaster()


def interrupt(*args: Any) -> Any:
    raise KeyboardInterrupt


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The demo with a small environment and a small model."""
    # A shell may have started the tests with SIGINT ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    config = {**CONFIG, "learning_rate": 1e-3, "policy_kwargs": {"features_dim": 4, "net_arch": [8]}}
    constants = {
        "ENV_ID": ENV_ID,
        "RULES_ID": ENV_ID,
        "WEATHERS": ("slow", "fast"),
        "SHOWN": "fast",
        "SubprocVecEnv": DummyVecEnv,
        "OVERRIDES": {"auxiliary": None},
        "TRAFFIC": {},
    }
    functions = {"load_config": lambda *_: dict(config), "pretrained": lambda *_: COASTER}
    for name, value in {**constants, **functions}.items():
        monkeypatch.setattr(demo, name, value)
    monkeypatch.setattr(features, "pretrained", lambda *_: COASTER)
    yield
    signal.signal(signal.SIGINT, before)


def test_the_whole_demo_with_environments_in_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    multiprocessing.get_context("forkserver").set_forkserver_preload(["sb3_have.demo"])
    weathers = ["ClearNoon", "HardRainNight"]
    monkeypatch.setattr(demo, "WEATHERS", weathers)
    monkeypatch.setattr(demo, "SHOWN_STEPS", 5)
    monkeypatch.setattr(demo, "OVERRIDES", {**demo.OVERRIDES, "n_envs": 2, "learning_starts": 20})
    monkeypatch.setattr(demo, "TRAFFIC", {**demo.TRAFFIC, "duration": 3.0})
    before = multiprocessing.active_children()
    demo.main(["--steps", "40", "--episodes", "1", "--out", str(tmp_path)])
    assert set(multiprocessing.active_children()) <= set(before)

    # Files
    written = {path.name for path in tmp_path.iterdir()}
    assert written >= {*demo.RESULTS, "trained.gif", "trained.html", "0.monitor.csv", "1.monitor.csv"} - {"model.zip"}
    assert "model.zip" not in written
    for name in ("trained.gif", "learning_curve.png", "modality_weights.png", "drive.gif"):
        with Image.open(tmp_path / name) as picture:
            assert picture.width > 100
    model = HAVESAC.load(tmp_path / "havesac_demo.zip")
    assert model.num_timesteps == 40
    assert model.observation_space["rgb"].shape == (9, 64, 64), "it reads images"  # type: ignore[index]

    # Rows of the table, in the file and as printed
    rows = pd.read_csv(tmp_path / "evaluation.csv")
    drivers = ["this HAVESAC", "trained HAVESAC", "random", "straight at 20 m/s", "IDM/MOBIL"]
    assert list(zip(rows["driver"], rows["weather"], strict=True)) == [(d, w) for d in drivers for w in weathers]
    assert (rows["episodes"] == 1).all() and rows["steps_mean"].between(1, 15).all()
    means = rows.groupby("driver")["distance_mean"].mean()
    assert (means[["trained HAVESAC", "straight at 20 m/s", "IDM/MOBIL"]] > 1.5 * means["random"]).all()
    printed = capsys.readouterr().out
    lines = [line.split("|")[1:-1] for line in printed.splitlines() if line.startswith("|")]
    head, _, *table = [[cell.strip() for cell in line] for line in lines]
    assert head == ["weather", "", *drivers]
    names = [name for weather in [*weathers, "all"] for name in (weather, "")]
    assert [line[:2] for line in table] == [[name, "ER" if name else "D [m]"] for name in names]
    assert printed.count("\nstep ") == 10


def test_the_learning_rate_decays_over_steps_or_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    rate = demo.Decay(1e-3, seconds=10.0)
    assert rate(1.0) == 1e-3
    now = 102.0
    assert rate(0.5) == pytest.approx(0.5e-3) and rate(0.9) == pytest.approx(0.8e-3)
    now = 111.0
    assert rate(0.5) == 0.0
    assert pickle.loads(pickle.dumps(rate))(1.0) == 1e-3, "a loaded model can be trained on"


def test_the_line_of_distances() -> None:
    line = demo.DistanceLine(steps=80)
    assert line.line() == f"step      0 |{' ' * 30}| "
    line.episodes, line.num_timesteps = [(3, 8.0), (4, 16.0), (40, 80.0), (80, 40.0)], 80
    assert line.line() == f"step     80 | ▂{' ' * 13}█{' ' * 13}▄|    36 m (mean of last 4)"
    line.episodes = [(2, 0.0)] + [(4, 10.0)] * 10
    assert line.line().endswith("   10 m (mean of last 10)") and len(line.line()) < 80


@pytest.mark.usefixtures("small")
def test_an_interruption_keeps_what_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluated = []

    def interrupted(driver: Any, *args: Any, **kwargs: Any) -> pd.DataFrame:
        evaluated.append(driver)
        if len(evaluated) == 3:
            raise KeyboardInterrupt
        return evaluate(driver, *args, **kwargs)

    monkeypatch.setattr(demo, "evaluate", interrupted)
    with pytest.raises(SystemExit) as stop:
        demo.main(["--steps", "20", "--out", str(tmp_path)])
    assert stop.value.code == 130 and f"the results so far are in {tmp_path}" in capsys.readouterr().err
    assert list(pd.read_csv(tmp_path / "evaluation.csv")["driver"].unique()) == ["this HAVESAC", "trained HAVESAC"]
    assert HAVESAC.load(tmp_path / "havesac_demo.zip").num_timesteps == 20


@pytest.mark.usefixtures("small")
def test_an_interruption_after_the_training_does_not_stop_the_next_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["--steps", "20", "--episodes", "1", "--out", str(tmp_path)]
    for name in demo.RESULTS:
        (tmp_path / name).write_text("of an earlier demo")
    with monkeypatch.context() as context, pytest.raises(SystemExit):
        context.setattr(demo, "with_encoders", interrupt)
        demo.main(arguments)
    assert HAVESAC.load(tmp_path / "model.zip").num_timesteps == 20, "what was learned is still there"
    assert [name for name in demo.RESULTS if (tmp_path / name).exists()] == ["model.zip"]
    demo.main(arguments)
    assert [name for name in demo.RESULTS if not (tmp_path / name).exists()] == ["model.zip"]


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("second", ["training", "saving"])
def test_a_second_interruption_keeps_what_was_learned(
    second: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_step, save = demo.DistanceLine._on_step, HAVESAC.save

    def interrupted_step(line: demo.DistanceLine) -> bool:
        if line.num_timesteps == 10:
            for _ in range(2 if second == "training" else 1):
                signal.raise_signal(signal.SIGINT)
        return on_step(line)

    def interrupted_save(model: HAVESAC, *args: Any, **kwargs: Any) -> None:
        monkeypatch.setattr(HAVESAC, "save", save)
        signal.raise_signal(signal.SIGINT)
        save(model, *args, **kwargs)

    monkeypatch.setattr(demo.DistanceLine, "_on_step", interrupted_step)
    monkeypatch.setattr(HAVESAC, "save", interrupted_save)
    with pytest.raises(SystemExit) as stop:
        demo.main(["--steps", "20", "--out", str(tmp_path)])
    assert stop.value.code == 130
    assert HAVESAC.load(tmp_path / "havesac_demo.zip").num_timesteps == 10
    left = [name for name in demo.RESULTS if (tmp_path / name).exists()]
    assert left == ["havesac_demo.zip"], "the second interruption takes effect"


def test_the_line_is_printed_after_each_tenth(capsys: pytest.CaptureFixture[str]) -> None:
    line = demo.DistanceLine(steps=100)
    line.locals = {"infos": []}
    for line.num_timesteps in range(4, 101, 4):
        line._on_step()
    assert capsys.readouterr().out.count("step") == 10


@pytest.mark.usefixtures("small")
def test_the_demo_ends_when_interrupted_before_the_first_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(FakeDrive, "step", interrupt)
    with pytest.raises(SystemExit) as stop:
        demo.main(["--steps", "20", "--out", str(tmp_path)])
    assert stop.value.code == 130 and "Interrupted" in capsys.readouterr().err
