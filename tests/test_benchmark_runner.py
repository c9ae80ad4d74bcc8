"""Runs of a benchmark side by side: in order, none twice, none lost, and all stopped on request."""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tiny_grid import FAILURES, LocalPool, contents, make_grid, read

from sb3_have import HAVESAC, train
from sb3_have.benchmark import runner as runner_module
from sb3_have.benchmark.__main__ import main
from sb3_have.benchmark.grid import Job
from sb3_have.benchmark.reading import read_results
from sb3_have.benchmark.results import merge
from sb3_have.benchmark.runner import FAILED, FINISHED, STOPPED, Runner
from sb3_have.benchmark.stages import collect, run_job
from sb3_have.checkpoint import StopTrainingOnSignal


@pytest.fixture
def unexamined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ignore the results of runs that do nothing."""
    numbers = {"return_mean": [1.0], "distance_mean": [1.0]}
    tables = {"final": pd.DataFrame(numbers), "runs": pd.DataFrame({"minutes": [1.0]})}
    monkeypatch.setattr(runner_module, "collect", lambda job, folder: tables)
    monkeypatch.setattr(runner_module, "merge", lambda *args: None)


def test_results_of_a_grid(tmp_path: Path) -> None:
    grid, runs, results = make_grid(tmp_path, failures=FAILURES), tmp_path / "runs", tmp_path / "results"
    runner = Runner(grid.jobs(), runs, results)
    assert runner.run(LocalPool(lambda job: run_job(job, runs))) == FINISHED

    read_results([results])  # columns, types and keys
    final, episodes = read(results, "final"), read(results, "episodes")
    of_runs = [("gve", 0), ("have", 0), ("gve", 1), ("have", 1)]
    assert list(zip(final["method"], final["seed"], strict=True)) == [run for run in of_runs for _ in range(2)]
    assert list(final["weather"]) == ["slow", "fast"] * 4
    assert (final["step"] == 30).all() and (final["episodes"] == 3).all()
    # Every run has the same episodes, and the statistics are theirs
    seeds = episodes.groupby(["method", "seed"])["episode_seed"].agg(tuple)
    assert len(set(seeds)) == 1 and len(set(seeds.iloc[0])) == 6
    grouped = episodes.groupby(["method", "seed", "weather"], sort=False)
    np.testing.assert_allclose(final["return_mean"], grouped["return"].mean(), atol=1e-3)
    np.testing.assert_allclose(final["distance_std"], grouped["distance"].std(ddof=0), atol=1e-3)
    assert (episodes["distance"] == episodes["steps"] * episodes["weather"].map({"slow": 1, "fast": 2})).all()
    assert (episodes["crashed"] == (episodes["steps"] == 8)).all()

    curve = read(results, "evaluations")
    assert list(curve["step"].unique()) == [10, 20, 30]
    assert list(curve["episodes"].unique()) == [1, 3], "the last point is the final evaluation"
    assert len(curve) == 4 * 2 * 3

    weights = read(results, "weights")
    assert set(weights["method"]) == {"have"}
    np.testing.assert_allclose(weights.groupby(["seed", "weather", "t"])["weight"].sum(), 1, atol=2e-4)
    for key, rows in weights.groupby(["seed", "weather"]):
        first = episodes.set_index(["method", "seed", "weather"]).loc[[("have", *key)]].iloc[0]
        assert (rows["episode_seed"] == first["episode_seed"]).all()
        assert list(rows["t"]) == [t for t in range(0, first["steps"], 5) for _ in range(2)]
        assert rows["return_so_far"].iloc[0] == 0 and rows["return_so_far"].is_monotonic_increasing
        # The untrained policy gains about the same in every step
        so_far = rows["return_so_far"].to_numpy()[::2]
        np.testing.assert_allclose(so_far, first["return"] * rows["t"][::2] / first["steps"], rtol=0.1)

    failures = read(results, "failures")
    of_run = failures.query("method == 'gve' and seed == 0")
    cases = [
        ("none", "none", 0),
        *((modality, "black", 2) for modality in ("depth", "rgb")),
        ("rgb", "overexposure", 2),
    ]
    expected = [(weather, *case) for weather in ("slow", "fast") for case in cases]
    assert list(of_run[["weather", "modality", "kind", "severity"]].itertuples(index=False, name=None)) == expected
    assert (failures["episodes"] == 2).all() and len(failures) == 4 * len(expected)
    healthy = failures.query("kind == 'none'")
    np.testing.assert_allclose(healthy["return_mean"], grouped["return"].agg(lambda r: r.head(2).mean()), atol=1e-3)
    broken = of_run.query("kind == 'black'")["return_mean"].to_numpy()
    assert (broken != healthy.query("method == 'gve' and seed == 0")["return_mean"].repeat(2).to_numpy()).any()

    table = read(results, "runs")
    assert (table["steps"] == 30).all() and (table["minutes"] > 0).all()
    model = HAVESAC.load(runs / "gve-0" / "model.zip")
    assert isinstance(model, HAVESAC)
    of_target, everything = (
        sum(p.numel() for p in part.parameters()) for part in (model.policy.critic_target, model.policy)
    )
    assert table["parameters"][0] == everything - of_target > 0
    assert not [*runs.glob("*/checkpoint*")] and len([*runs.glob("*/model.zip")]) == 4

    # Nothing is left to do for a second runner
    before = contents(results)
    again = Runner(grid.jobs(), runs, results)
    assert again.is_done and again.run(LocalPool(lambda job: pytest.fail("it was finished"))) == FINISHED
    for job in grid.jobs():
        merge(results, job, collect(job, runs / job.name))
    assert contents(results).keys() == before.keys()
    for name in before:
        lines, lines_before = (sorted(text.splitlines()) for text in (contents(results)[name], before[name]))
        assert lines == lines_before, "a run's rows replace its old ones"


def test_work_goes_seed_by_seed_on_all_workers(tmp_path: Path, unexamined: None) -> None:
    pool = LocalPool(lambda job: True, workers=3)
    jobs = make_grid(tmp_path, seeds=[0, 1, 2]).jobs()
    assert Runner(jobs, tmp_path, tmp_path).run(pool) == FINISHED
    assert pool.started == [job.name for job in jobs] and pool.most == 3


def test_run_that_dies_resumes_from_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid, runs, results = make_grid(tmp_path, seeds=[0]), tmp_path / "runs", tmp_path / "results"
    deaths: list[int] = []

    class Dies(StopTrainingOnSignal):
        def _on_step(self) -> bool:
            if self.num_timesteps == 25 and not deaths:
                deaths.append(25)
                raise MemoryError("killed")
            return super()._on_step()

    monkeypatch.setattr(train, "StopTrainingOnSignal", Dies)
    assert Runner(grid.jobs(), runs, results).run(LocalPool(lambda job: run_job(job, runs))) == FINISHED
    assert deaths and {path.name for path in (runs / "gve-0").glob("log-*")} == {"log-0", "log-20"}
    curve = read(results, "evaluations").query("method == 'gve'")
    assert list(curve["step"]) == [10, 10, 20, 20, 30, 30], "no evaluation is repeated"
    assert not (runs / "gve-0" / "traceback.txt").exists()


def test_run_that_keeps_failing_is_given_up(
    tmp_path: Path, unexamined: None, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(job: Job) -> bool:
        if job.method == "gve" and job.seed == 0:
            raise RuntimeError("out of luck")
        return True

    pool = LocalPool(work)
    assert Runner(make_grid(tmp_path).jobs(), tmp_path / "runs", tmp_path, retries=2).run(pool) == FAILED
    assert pool.started == ["gve-0", "gve-0", "gve-0", "have-0", "gve-1", "have-1"]
    printed = capsys.readouterr().out
    path = tmp_path / "runs" / "gve-0" / "traceback.txt"
    assert f"failed: gve-0, {path}" in printed and "3 of 4 runs finished" in printed
    assert "out of luck" in path.read_text()


def test_run_that_is_stopped_from_outside(tmp_path: Path, unexamined: None) -> None:
    runner = Runner(make_grid(tmp_path).jobs()[:1], tmp_path / "runs", tmp_path, retries=1)
    assert runner.run(LocalPool(lambda job: False)) == FAILED
    assert "stopped from outside" in (tmp_path / "runs" / "gve-0" / "traceback.txt").read_text()


@pytest.mark.parametrize("cause", ["SIGINT", "SIGTERM", "time limit"])
def test_stop_asks_all_runs_to_save(
    tmp_path: Path, unexamined: None, cause: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(job: Job) -> bool:
        if cause != "time limit":
            os.kill(os.getpid(), signal.Signals[cause])
        return True

    before = signal.getsignal(signal.SIGTERM)
    pool = LocalPool(work, workers=2)
    runner = Runner(make_grid(tmp_path).jobs(), tmp_path, tmp_path, time_limit=0.0 if cause == "time limit" else None)
    assert runner.run(pool) == STOPPED
    assert pool.stopped and pool.started == ([] if cause == "time limit" else ["gve-0", "have-0"])
    assert not pool.running and not runner.failed
    assert "the same command resumes" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("missing", ["ray", "pydantic"])
def test_missing_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    make_grid(tmp_path)
    monkeypatch.setitem(sys.modules, missing, None)
    if missing == "pydantic":
        for name in ("runner", "pool", "results", "stages", "grid"):
            monkeypatch.delitem(sys.modules, f"sb3_have.benchmark.{name}")
    where = ["--runs", str(tmp_path / "runs"), "--results", str(tmp_path / "results")]
    with pytest.raises(SystemExit, match=r'pip install "sb3_have\[benchmark\]"'):
        main(["run", str(tmp_path / "mine.yml"), *where])


def test_wrong_command_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2 and "run,report" in capsys.readouterr().err
    assert main(["run", str(tmp_path / "gone.yml")]) == FAILED and "gone.yml" in capsys.readouterr().err
    make_grid(tmp_path)
    arguments = ["run", str(tmp_path / "mine.yml"), "--results", str(tmp_path / "results")]
    assert main([*arguments, "--only", "lve"]) == FAILED and "--only: unknown name 'lve'" in capsys.readouterr().err
