"""The study of failing sensors: every case once, comparable with the healthy car, and resumed where it stopped."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from envs import TINY
from fake_drive import ENV_ID, FakeDrive

from benchmarks import failures
from sb3_have import HAVESAC
from sb3_have.sensors import failures_for


def test_every_failure_has_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = HAVESAC("MultiInputPolicy", FakeDrive(), buffer_size=10, policy_kwargs=TINY, device="cpu", seed=0)
    model.save(tmp_path / "model.zip")
    config = {
        "env_kwargs": {"weather": "slow"},
        "env_wrapper": {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 3}},
    }
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({ENV_ID: config}))
    monkeypatch.setattr(failures, "WEATHERS", ("slow", "fast"))
    command = [str(tmp_path / "model.zip"), "--config", str(tmp_path / "mine.yml"), "--env", ENV_ID]
    command += ["--episodes", "1", "--envs", "1", "--out", str(tmp_path / "failures.csv")]
    drive = failures.drive
    calls: list[failures.Case] = []

    def stop_after_three(*args, **kwargs):  # type: ignore[no-untyped-def]
        calls.append(args[2])
        if len(calls) == 4:
            raise KeyboardInterrupt
        return drive(*args, **kwargs)

    monkeypatch.setattr(failures, "drive", stop_after_three)
    with pytest.raises(KeyboardInterrupt):
        failures.main(command)
    assert len(pd.read_csv(tmp_path / "failures.csv", keep_default_na=False)) == 3
    failures.main(command)

    table = pd.read_csv(tmp_path / "failures.csv", keep_default_na=False)
    expected = [failures.NONE, *((key, kind, 3) for key in ("depth", "rgb") for kind in failures_for(key))]
    assert list(zip(table["modality"], table["kind"], table["severity"], strict=True)) == expected
    assert len(calls) == len(expected) + 1, "what was finished is not driven again"
    # Failures do not change what this environment does, only what is seen of it.
    assert (table["episodes"] == 2).all() and (table["distance_mean"] == table["distance_mean"][0]).all()
    assert (table["distance_mean"] == (3 + 6) / 2).all(), "three steps of 1 and 2 m, by the configuration's env_wrapper"
    assert (table["kept"] == 1).all() and (table["training_steps"] == 0).all() and (table["training_seed"] == 0).all()
    with pytest.raises(SystemExit, match="another run"):
        failures.main([*command, "--seed", "1"])


def test_the_sensor_does_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    class Watcher:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):  # type: ignore[no-untyped-def]
            seen.append(int(observation["rgb"].max()))
            return np.zeros((len(episode_start), 2)), None

    monkeypatch.setattr(failures, "WEATHERS", ("slow",))
    for case in (failures.NONE, ("rgb", "black", 3)):
        failures.drive(Watcher(), ENV_ID, case, n_episodes=1, seed=0)
    healthy, black = seen[: len(seen) // 2], seen[len(seen) // 2 :]
    assert min(healthy) > 0 and max(black) == 0
