"""Runs of a benchmark: every stage once, taken up where it was, and results that are whole at any moment."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from fake_drive import CONFIG, ENV_ID

from sb3_have import HAVESAC, train
from sb3_have.benchmark import results as results_module
from sb3_have.benchmark import runner as runner_module
from sb3_have.benchmark import stages
from sb3_have.benchmark.__main__ import main
from sb3_have.benchmark.grid import Grid, GridError, Job, read_grid
from sb3_have.benchmark.reading import read_results
from sb3_have.benchmark.results import difference, is_finished, merge
from sb3_have.benchmark.runner import FAILED, FINISHED, STOPPED, Runner
from sb3_have.benchmark.stages import FINAL_SEED, collect, run_job
from sb3_have.common import files
from sb3_have.common.evaluation import evaluate_episodes
from sb3_have.train import EVALUATION_SEED, Run, algorithms, checkpoint_step, newest_checkpoint

TINY = {**CONFIG, "policy_kwargs": {"net_arch": [8], "features_dim": 8}}
GRID = {
    "env": ENV_ID,
    "steps": 30,
    "methods": ["gve.yml", "have.yml"],
    "seeds": [0, 1],
    "weathers": ["slow", "fast"],
    "eval_freq": 10,
    "final_episodes": 3,
    "save_freq": 20,
}
FAILURES = {"kinds": ["black", "overexposure"], "severity": 2, "episodes": 2}


def make_grid(folder: Path, config: dict[str, Any] | None = None, **changes: Any) -> Grid:
    for value_estimation in ("gve", "have"):
        block = {**TINY, "value_estimation": value_estimation, **(config or {})}
        (folder / f"{value_estimation}.yml").write_text(yaml.safe_dump({ENV_ID: block}))
    (folder / "mine.yml").write_text(yaml.safe_dump({**GRID, **changes}))
    return read_grid(folder / "mine.yml")


class LocalPool:
    """Runs one thing after the other in this process.

    :param work: in place of a run; what it raises is what the run died of
    """

    def __init__(self, work: Callable[[Job], bool], workers: int = 1) -> None:
        self.work, self.workers = work, workers
        self.running: list[Job] = []
        self.started: list[str] = []
        self.most = 0
        self.stopped = False

    def start(self, job: Job) -> None:
        self.running.append(job)
        self.started.append(job.name)
        self.most = max(self.most, len(self.running))

    def wait(self, seconds: float) -> list[tuple[Job, bool | Exception]]:
        if not self.running:
            return []
        job = self.running.pop(0)
        try:
            return [(job, False if self.stopped else self.work(job))]
        except Exception as error:
            return [(job, error)]

    def stop(self) -> None:
        self.stopped = True


@pytest.fixture
def unexamined(monkeypatch: pytest.MonkeyPatch) -> None:
    """For runs that only pretend: their results are of no interest."""
    numbers = {"return_mean": [1.0], "distance_mean": [1.0]}
    tables = {"final": pd.DataFrame(numbers), "runs": pd.DataFrame({"minutes": [1.0]})}
    monkeypatch.setattr(runner_module, "collect", lambda job, folder: tables)
    monkeypatch.setattr(runner_module, "merge", lambda *args: None)


def read(folder: Path, name: str) -> pd.DataFrame:
    return pd.read_csv(folder / f"{name}.csv", keep_default_na=False)


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in sorted(folder.iterdir())}


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
    # each drives the same episodes, and the statistics are theirs
    seeds = episodes.groupby(["method", "seed"])["episode_seed"].agg(tuple)
    assert len(set(seeds)) == 1 and len(set(seeds.iloc[0])) == 6
    grouped = episodes.groupby(["method", "seed", "weather"], sort=False)
    np.testing.assert_allclose(final["return_mean"], grouped["return"].mean(), atol=1e-3)
    np.testing.assert_allclose(final["distance_std"], grouped["distance"].std(ddof=0), atol=1e-3)
    assert (episodes["distance"] == episodes["steps"] * episodes["weather"].map({"slow": 1, "fast": 2})).all()
    assert (episodes["crashed"] == (episodes["steps"] == 8)).all()

    curve = read(results, "evaluations")
    assert list(curve["step"].unique()) == [10, 20, 30]
    assert list(curve["episodes"].unique()) == [1, 3], "of the last step there is the final evaluation alone"
    assert len(curve) == 4 * 2 * 3

    weights = read(results, "weights")
    assert set(weights["method"]) == {"have"}
    np.testing.assert_allclose(weights.groupby(["seed", "weather", "t"])["weight"].sum(), 1, atol=2e-4)
    for key, rows in weights.groupby(["seed", "weather"]):
        first = episodes.set_index(["method", "seed", "weather"]).loc[[("have", *key)]].iloc[0]
        assert (rows["episode_seed"] == first["episode_seed"]).all()
        assert list(rows["t"]) == [t for t in range(first["steps"]) for _ in range(2)]
        assert rows["return_so_far"].iloc[0] == 0 and rows["return_so_far"].is_monotonic_increasing
        gained = np.diff(rows["return_so_far"].iloc[::2])
        # the policy is deterministic and sees this environment change little
        np.testing.assert_allclose(first["return"] - rows["return_so_far"].iloc[-1], gained.mean(), rtol=0.2)

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
    model = algorithms()["havesac"].load(runs / "gve-0" / "model.zip")
    assert isinstance(model, HAVESAC)
    of_target, everything = (
        sum(p.numel() for p in part.parameters()) for part in (model.policy.critic_target, model.policy)
    )
    assert table["parameters"][0] == everything - of_target > 0
    assert not [*runs.glob("*/checkpoint*")] and len([*runs.glob("*/model.zip")]) == 4

    # and again: nothing is left to do
    before = contents(results)
    again = Runner(grid.jobs(), runs, results)
    assert again.is_done and again.run(LocalPool(lambda job: pytest.fail("it was finished"))) == FINISHED
    for job in grid.jobs():
        merge(results, job, collect(job, runs / job.name))
    assert contents(results).keys() == before.keys()
    for name in before:
        lines, lines_before = (sorted(text.splitlines()) for text in (contents(results)[name], before[name]))
        assert lines == lines_before, "a run's rows take the place of those it had"


def test_evaluation_seeds_are_not_those_of_training() -> None:
    assert FINAL_SEED != EVALUATION_SEED and min(FINAL_SEED, EVALUATION_SEED) > 100_000


def test_work_goes_seed_by_seed_on_all_workers(tmp_path: Path, unexamined: None) -> None:
    pool = LocalPool(lambda job: True, workers=3)
    jobs = make_grid(tmp_path, seeds=[0, 1, 2]).jobs()
    assert Runner(jobs, tmp_path, tmp_path).run(pool) == FINISHED
    assert pool.started == [job.name for job in jobs] and pool.most == 3


def test_run_that_dies_goes_on_from_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid, runs, results = make_grid(tmp_path, seeds=[0]), tmp_path / "runs", tmp_path / "results"
    began: list[tuple[str, int]] = []
    learn = Run._learn

    def learn_and_die_once(run: Run, model: Any, steps: int, progress_bar: bool) -> None:
        began.append((run.out.name, model.num_timesteps))
        if len(began) == 1:
            learn(run, model, 25, progress_bar)  # a checkpoint at 20
            raise MemoryError("killed")
        learn(run, model, steps, progress_bar)

    monkeypatch.setattr(Run, "_learn", learn_and_die_once)
    assert Runner(grid.jobs(), runs, results).run(LocalPool(lambda job: run_job(job, runs))) == FINISHED
    assert began == [("gve-0", 0), ("gve-0", 20), ("have-0", 0)]
    curve = read(results, "evaluations").query("method == 'gve'")
    assert list(curve["step"]) == [10, 10, 20, 20, 30, 30], "no evaluation is there twice"
    assert not (runs / "gve-0" / "traceback.txt").exists()


def test_run_that_dies_again_is_left_and_told(
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


def test_run_that_others_stop_is_told(tmp_path: Path, unexamined: None) -> None:
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
    assert "the same command goes on" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGTERM) == before


def test_stages_go_on_weather_by_weather(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_grid(tmp_path, failures=FAILURES).jobs()[1]
    driven: list[tuple[str, Any]] = []
    drive, watch = stages._drive, stages.weights_of_episode

    def stop_at(number: int) -> None:
        driven.append(("stop", number))
        if len(driven) == number:
            raise KeyboardInterrupt

    def counted_drive(job: Job, model: Any, weather: str, n: int, failure: dict[str, Any] | None = None) -> Any:
        stop_at(stop)
        driven[-1] = (weather, None if failure is None else (failure["modality"], failure["kind"]))
        return drive(job, model, weather, n, failure)

    def counted_watch(job: Job, model: Any, task: Any) -> Any:
        stop_at(stop)
        driven[-1] = (task.weather, "weights")
        return watch(job, model, task)

    monkeypatch.setattr(stages, "_drive", counted_drive)
    monkeypatch.setattr(stages, "weights_of_episode", counted_watch)
    for stop in (2, 4, 8):  # noqa: B007 (the functions above read it)
        with pytest.raises(KeyboardInterrupt):
            run_job(job, tmp_path)
        driven.pop()
    stop = 99
    assert run_job(job, tmp_path)
    broken = [("depth", "black"), ("rgb", "black"), ("rgb", "overexposure")]
    expected: list[tuple[str, Any]] = [(w, what) for what in (None, "weights") for w in ("slow", "fast")]
    assert driven == expected + [(w, case) for w in ("slow", "fast") for case in broken]


def test_failures_may_be_asked_for_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs, results = tmp_path / "runs", tmp_path / "results"
    job = make_grid(tmp_path).jobs()[0]
    assert run_job(job, runs)
    merge(results, job, collect(job, runs / job.name))
    assert is_finished(results, job) and not (results / "failures.csv").exists()

    later = make_grid(tmp_path, failures=FAILURES).jobs()[0]
    assert not is_finished(results, later)
    monkeypatch.setattr(Run, "train", lambda *args: pytest.fail("it is trained"))
    assert run_job(later, runs)
    merge(results, later, collect(later, runs / job.name))
    assert is_finished(results, later) and is_finished(results, job)
    assert len(read(results, "failures")) == 8


def test_results_of_other_settings_are_refused(tmp_path: Path) -> None:
    runs, results = tmp_path / "runs", tmp_path / "results"
    job = make_grid(tmp_path).jobs()[0]
    assert run_job(job, runs)
    merge(results, job, collect(job, runs / job.name))
    for changes, told in [
        ({"config": {"gamma": 0.5}}, "gamma is new"),
        ({"config": {"batch_size": 5}}, "batch_size: 4, now 5"),
        ({"config": {"env_kwargs": {"weather": "slow"}}}, "env_kwargs.weather: 'fast', now 'slow'"),
        ({"steps": 40}, "steps: 30, now 40"),
        ({"final_episodes": 4}, "final_episodes: 3, now 4"),
        ({"weathers": ["slow"]}, "weathers: ['fast', 'slow'], now ['slow']"),
    ]:
        other = make_grid(tmp_path, **changes).jobs()[0]  # type: ignore[arg-type]
        with pytest.raises(GridError, match="holds gve-0 with other settings") as error:
            is_finished(results, other)
        assert f"({told})" in str(error.value)
    assert not is_finished(results, make_grid(tmp_path, config={"gamma": 0.5}).jobs()[1]), "another run, not yet there"
    changed = make_grid(tmp_path, config={"gamma": 0.5}).jobs()[0]
    with pytest.raises(ValueError, match="other settings"):
        run_job(changed, runs)


def test_difference_of_settings() -> None:
    assert difference({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}) == "a.c: 2, now 3"
    assert difference({"a": 1, "b": 2}, {"b": 2, "c": 3}) == "a: 1, not given now; c is new"
    assert difference({"a": [1]}, {"a": [1]}) == ""


def test_run_begun_by_train_is_taken_up(tmp_path: Path) -> None:
    job = make_grid(tmp_path, save_freq=0).jobs()[0]
    config = {**TINY, "value_estimation": "gve", "n_timesteps": 7}
    options: dict[str, Any] = {"eval_freq": 10, "eval_episodes": 1, "weathers": ("slow", "fast"), "save_freq": 0}
    plain = Run(config, ENV_ID, tmp_path / job.name, seed=0, **options)
    plain.train(12)
    assert run_job(job, tmp_path)
    minutes = float(collect(job, tmp_path / job.name)["runs"]["minutes"].iloc[0])
    assert [path.name for path in (tmp_path / job.name).glob("log-*")] != []
    assert sorted(path.name for path in (tmp_path / job.name).glob("log-*")) == ["log-0", "log-12"]
    assert minutes >= round(plain.seconds / 60, 2)


def test_checkpoint_stays_only_if_asked_for(tmp_path: Path) -> None:
    short, long = make_grid(tmp_path).jobs()[0], make_grid(tmp_path, steps=40).jobs()[0]
    folder = tmp_path / short.name
    assert run_job(short, tmp_path, keep_checkpoint=True)
    assert newest_checkpoint(folder) == folder / "checkpoint-30"
    assert run_job(long, tmp_path)
    assert newest_checkpoint(folder) is None
    assert {path.name for path in folder.glob("log-*")} == {"log-0", "log-30"}
    with pytest.raises(ValueError, match="gone on to step 40 from step 30"):
        run_job(short, tmp_path)
    with pytest.raises(ValueError, match="no checkpoint to go on from"):
        run_job(make_grid(tmp_path, steps=50).jobs()[0], tmp_path)


def test_training_past_the_grid_is_not_driven(tmp_path: Path) -> None:
    job = make_grid(tmp_path).jobs()[0]
    run = Run(job.config, ENV_ID, tmp_path / job.name, eval_freq=0)
    run.train(31)
    with pytest.raises(ValueError, match="trained to step 31, past the 30"):
        run_job(job, tmp_path)
    assert not (tmp_path / job.name / "final-30").exists()


def test_stop_in_the_last_evaluation_is_a_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_grid(tmp_path, eval_freq=30).jobs()[0]
    with monkeypatch.context() as patch:
        patch.setattr(train, "evaluate", lambda *args, **kwargs: os.kill(os.getpid(), signal.SIGINT))
        assert not run_job(job, tmp_path)
    assert newest_checkpoint(tmp_path / job.name) == tmp_path / job.name / "checkpoint-30"
    assert run_job(job, tmp_path)


def test_remains_of_a_checkpoint_are_in_nobodys_way(tmp_path: Path) -> None:
    """As when a run was killed while it dropped one of two."""
    job = make_grid(tmp_path).jobs()[0]
    remains = tmp_path / job.name / "checkpoint.partial"
    assert run_job(job, tmp_path, keep_checkpoint=True)
    remains.mkdir()
    (remains / "model.zip").touch()
    assert run_job(job, tmp_path)
    assert not [*(tmp_path / job.name).glob("checkpoint*")]


def test_merge_that_is_cut_off_leaves_no_finished_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = tmp_path / "results"
    first, second, *_ = make_grid(tmp_path, failures={"kinds": ["black"]}).jobs()
    tables = {}
    for job in (first, second):
        assert run_job(job, tmp_path)
        tables[job.name] = collect(job, tmp_path / job.name)
    merge(results, first, tables[first.name])
    before = contents(results)
    whole = files.write_atomically

    for cut in range(6):
        written: list[Path] = []

        def write(path: Path, how: Any, cut: int = cut, written: list[Path] = written) -> None:
            if len(written) == cut:
                how(path.with_name(f"{path.name}.partial"))
                raise OSError("no space left")
            written.append(path)
            whole(path, how)

        monkeypatch.setattr(results_module, "write_atomically", write)
        with pytest.raises(OSError, match="no space"):
            merge(results, second, tables[second.name])
        assert is_finished(results, first) and not is_finished(results, second)
        after = {name: text for name, text in contents(results).items() if not name.endswith(".partial")}
        assert all(after[name].startswith(before[name]) for name in before), "what was there is whole"
    monkeypatch.setattr(results_module, "write_atomically", whole)
    merge(results, second, tables[second.name])
    assert is_finished(results, second)
    assert not read_results([results])["final"].duplicated().any()


def test_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    def write_half(path: Path) -> None:
        path.write_text("ha")
        raise OSError("no space left")

    path = tmp_path / "rows.csv"
    path.write_text("before")
    with pytest.raises(OSError, match="no space"):
        files.write_atomically(path, write_half)
    assert path.read_text() == "before"


def test_missing_ray_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    make_grid(tmp_path)
    where = ["--runs", str(tmp_path / "runs"), "--results", str(tmp_path / "results")]
    with pytest.raises(SystemExit, match=r'pip install "sb3_have\[benchmark\]"'):
        main(["run", str(tmp_path / "mine.yml"), *where])


def test_wrong_command_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2 and "run,report" in capsys.readouterr().err
    assert main(["run", str(tmp_path / "gone.yml")]) == FAILED and "gone.yml" in capsys.readouterr().err
    make_grid(tmp_path)
    arguments = ["run", str(tmp_path / "mine.yml"), "--results", str(tmp_path / "results")]
    assert main([*arguments, "--only", "lve"]) == FAILED and "mine has no 'lve'" in capsys.readouterr().err


def wait_until(happened: Callable[[], bool], process: subprocess.Popen[bytes], seconds: float = 240.0) -> None:
    start = time.monotonic()
    while not happened():
        assert process.poll() is None, f"it ended by itself with code {process.returncode}"
        assert time.monotonic() - start < seconds
        time.sleep(0.05)


def processes_of_session(session: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(fields[3]) == session:
            found.append(int(stat.parent.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the processes to kill in /proc")
def test_benchmark_survives_sigterm_sigkill_and_a_dead_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With Ray for real: stopped in order, then one worker killed, then everything; at last it is all there, once."""
    pytest.importorskip("ray")
    config = {"env_wrapper": "slow_drive.SlowUntil"}
    grid = make_grid(tmp_path, config, seeds=[0], steps=150, save_freq=10, eval_freq=100)
    runs, results, hurry = tmp_path / "runs", tmp_path / "results", tmp_path / "hurry"
    log = tmp_path / "log.txt"
    command = [sys.executable, "-m", "sb3_have.benchmark", "run", "mine.yml", "--workers", "2"]
    command += ["--runs", str(runs), "--results", str(results)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent), "HURRY": str(hurry)}
    started: list[subprocess.Popen[bytes]] = []

    def start() -> subprocess.Popen[bytes]:
        with log.open("w") as output:
            kwargs: dict[str, Any] = {"stdout": output, "stderr": output, "start_new_session": True}
            started.append(subprocess.Popen(command, cwd=tmp_path, env=environment, **kwargs))
        return started[-1]

    def steps(name: str) -> int:
        checkpoint = newest_checkpoint(runs / name)
        return 0 if checkpoint is None else checkpoint_step(checkpoint)

    def pids_of_runs(session: int) -> list[int]:
        return [
            pid for pid in processes_of_session(session) if b"ray::_work" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]

    jobs = grid.jobs()
    names = [job.name for job in jobs]
    try:
        process = start()
        wait_until(lambda: all(stages.steps_done(runs / name) > 5 for name in names), process)
        os.killpg(process.pid, signal.SIGTERM)  # Ray's own processes are hit too
        assert process.wait(120) == STOPPED, log.read_text()
        stopped = {name: steps(name) for name in names}
        assert all(step > 5 for step in stopped.values())

        process = start()
        wait_until(lambda: all(steps(name) > stopped[name] for name in names), process)
        os.kill(pids_of_runs(process.pid)[0], signal.SIGKILL)
        wait_until(lambda: "goes on from its checkpoint, attempt 2 of 3" in log.read_text(), process)
        known = {name: steps(name) for name in names}
        wait_until(lambda: all(steps(name) > known[name] for name in names), process)
        for pid in processes_of_session(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.wait()
    finally:
        for process in started:
            for pid in processes_of_session(process.pid):
                os.kill(pid, signal.SIGKILL)
    killed = {name: steps(name) for name in names}
    assert all(known[name] < killed[name] < 150 for name in names)

    hurry.touch()
    monkeypatch.setenv("HURRY", str(hurry))
    assert Runner(jobs, runs, results).run(LocalPool(lambda job: run_job(job, runs))) == FINISHED
    assert all((runs / name / f"log-{killed[name]}").exists() for name in names)
    read_results([results])
    for job in jobs:
        assert is_finished(results, job)
        assert pd.read_csv(runs / job.name / "monitor.csv", skiprows=1)["l"].sum() <= 150, "no step is counted twice"
        model = algorithms()[job.algo].load(runs / job.name / "model.zip")
        rows = read(results, "episodes").query("method == @job.method and weather == 'slow'")
        driven = evaluate_episodes(model, ENV_ID, ["slow"], 3, FINAL_SEED)
        np.testing.assert_allclose(rows["return"], driven["return"], atol=1e-3, err_msg="it is the model that is kept")
    curve = read(results, "evaluations")
    assert not curve.duplicated(["method", "weather", "step"]).any()
