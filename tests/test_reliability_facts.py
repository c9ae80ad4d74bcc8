"""What the reliability benchmark's figures stand between: drivers by hand, and differences of runs that are there."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks import reliability_facts
from benchmarks.reliability import COLUMNS
from benchmarks.reliability_facts import constant, differences, drive, floors, liveliness, rule
from benchmarks.reliability_runs import EVALUATION_SEED, Drive
from sb3_have.envs.reliability_drive import CONDITIONS, DriveBatch, ReliabilityDriveEnv


def test_drives_are_the_episodes_of_the_evaluation() -> None:
    """Each to its end, with the truth of the moment in which the action was chosen."""
    driven = drive(constant(0.3, 0.1), n_episodes=3)
    for i in range(3):
        env = ReliabilityDriveEnv()
        _, info = env.reset(seed=EVALUATION_SEED + i)
        total, over, steps = 0.0, False, 0
        while not over:
            assert driven.reliable[steps, i].tolist() == info["reliable"].tolist() and driven.alive[steps, i]
            _, reward, terminated, truncated, info = env.step(np.array([0.3, 0.1]))
            total, over, steps = total + reward, terminated or truncated, steps + 1
        assert driven.returns[i] == pytest.approx(total, rel=1e-4) and driven.alive[:, i].sum() == steps
    assert len(set(driven.alive.sum(axis=0))) > 1


def batch(**state: float) -> DriveBatch:
    """One drive on a straight road, an obstacle far away, at the speed to hold, and what ``state`` says."""
    drives = DriveBatch(1)
    drives.reset(np.array([0]))
    drives.phases[:], drives.s[:], drives.y[:], drives.drift[:], drives.speed[:] = 0, 0, 0, 0, 10
    drives.obstacle[:] = state.pop("ahead", 50), state.pop("aside", 0), 0
    for name, value in state.items():
        getattr(drives, name)[:] = value
    return drives


def test_rule_holds_speed_and_lane_and_goes_round_the_obstacle() -> None:
    assert rule(batch(speed=5))[0, 0] == 1 and rule(batch(speed=15))[0, 0] == -1
    assert 0 < rule(batch())[0, 0] < 0.5, "the speed to hold rises here"
    assert rule(batch())[0, 1] == 0
    assert rule(batch(y=2))[0, 1] < -0.5 < 0.5 < rule(batch(y=-2))[0, 1]
    assert rule(batch(drift=1))[0, 1] < -0.3 < 0.3 < rule(batch(drift=-1))[0, 1]
    assert rule(batch(ahead=8, aside=1))[0, 1] == -1 and rule(batch(ahead=8, aside=-1))[0, 1] == 1
    for unseen in (batch(ahead=-6, aside=1), batch(ahead=20, aside=1), batch(ahead=8, aside=4)):
        assert rule(unseen)[0, 1] == 0
    with_bends = batch()
    with_bends.phases[:] = np.pi / 2  # the road bends to the left, which carries the car to the right
    assert rule(with_bends)[0, 1] > 0.3


def test_rule_is_far_above_doing_nothing_and_looks_at_no_sensor() -> None:
    ruled, clean, idle = drive(rule, 4), drive(rule, 4, corruption=0.0), drive(constant(0, 0), 4)
    assert np.array_equal(ruled.returns, clean.returns)
    assert ruled.alive.all() and ruled.returns.min() > 150 > 100 > idle.returns.mean()


def test_liveliness_is_that_of_sound_modalities() -> None:
    """Highest for sound ones, lower for still ones and for noise."""
    drives = DriveBatch(200, corruption=0.7)
    drives.reset(np.arange(200))
    for _ in range(30):
        drives.step(rule(drives))
    scores = liveliness(drives)
    assert scores.shape == (200, 3)
    means = [scores[drives.condition == code].mean() for code in range(len(CONDITIONS))]
    assert means[0] > max(means[1:]) + 0.3, dict(zip(CONDITIONS, means, strict=True))


def rows() -> pd.DataFrame:
    measures = {"kept_black": 0.5, "kept_frozen": 0.8, "kept_noise": 1.0, "weight_auc": 0.9}
    table: list[tuple[Any, ...]] = [
        (method, seed, 10, measure, value * (0.5 if measure == "kept_black" and method == "gve" else 1))
        for method, clean in (("gve", 60.0), ("have", 100.0), ("lve", 100.0))
        for measure, value in {**measures, "clean_return": clean}.items()
        for seed in range(3)
    ]
    table = [(*row[:4], np.nan) if row[0] == "gve" and row[3] == "weight_auc" else row for row in table]
    table += [("lve", 3, 10, "weight_auc", 0.5)]
    return pd.DataFrame(table, columns=COLUMNS)


def test_differences_of_known_runs() -> None:
    leads = {
        (row["than"], row["fact"].removesuffix(": have less")): (row["value"], row["lower"], row["upper"])
        for row in differences(rows())
    }
    assert leads["gve", "kept_black"] == pytest.approx([0.25] * 3)
    assert leads["gve", "return under black"] == pytest.approx([50 - 15] * 3)
    assert leads["gve", "return under noise"] == pytest.approx([100 - 60] * 3)
    assert leads["lve", "kept_noise"] == pytest.approx([0] * 3)
    value, lower, upper = leads["lve", "weight_auc"]
    assert value == pytest.approx(0.1) and lower == pytest.approx(0) and 0.1 < upper <= 0.4
    assert ("gve", "weight_auc") not in leads, "it has no weights"
    assert {method for method, _ in leads} == {"gve", "lve"}


def test_floors_of_known_runs() -> None:
    shares = {row["than"]: row["value"] for row in floors(rows(), 30.0)}
    assert shares == {"gve": 0.5, "have": 0.3, "lve": 0.3}


def test_facts_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def short(policy: reliability_facts.Policy, **task: Any) -> Drive:
        assert task == {"n_blind": 2, "corruption": 0.6}, "the standard task"
        return drive(policy, n_episodes=2, max_episode_steps=40, **task)

    monkeypatch.setattr(reliability_facts, "drive", short)
    monkeypatch.setattr(reliability_facts, "N_CONSTANTS", 3)
    reliability_facts.main(tmp_path / "facts.csv")
    facts = pd.read_csv(tmp_path / "facts.csv")
    assert list(facts.columns) == ["fact", "than", "value", "lower", "upper"]
    nothing, best, ruled = facts["value"].to_numpy()[:3]

    def earned(throttle: float, steering: float) -> float:
        return float(short(constant(throttle, steering), n_blind=2, corruption=0.6).returns.mean())

    actions = itertools.product((-1, 0, 1), repeat=2)
    assert nothing == pytest.approx(earned(0, 0), abs=1e-4)
    assert best == pytest.approx(max(earned(*action) for action in actions), abs=1e-4) and ruled > best
    lead = facts[facts["fact"].eq("return under noise: have less") & facts["than"].eq("gve-wide")]
    lower, value, upper = lead[["lower", "value", "upper"]].to_numpy()[0]
    assert 0 < lower < value < upper, "of the runs that are committed"
