"""A benchmark on Ray: runs that are stopped and killed are all finished in the end, once."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fake_drive import ENV_ID
from tiny_grid import LocalPool, make_grid, read

from sb3_have.algorithms import ALGORITHMS
from sb3_have.benchmark.grid import FINAL_SEED
from sb3_have.benchmark.reading import read_results
from sb3_have.benchmark.results import is_finished
from sb3_have.benchmark.runner import FINISHED, STOPPED, Runner
from sb3_have.benchmark.stages import run_job
from sb3_have.checkpoint import checkpoint_step, newest_checkpoint
from sb3_have.evaluation.evaluation import evaluate_episodes


def wait_until(happened: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    while not happened():
        assert process.poll() is None, f"the process ended with code {process.returncode}"
        time.sleep(0.05)


def processes_of_session(session: int, name: bytes = b"") -> list[int]:
    """List the processes of a session whose command line contains a name."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            fields = (process / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and name in (process / "cmdline").read_bytes():
                found.append(int(process.name))
        except OSError:  # the process has just ended
            continue
    return found


def kill_session(session: int) -> None:
    for pid in processes_of_session(session):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the processes to kill in /proc")
def test_benchmark_survives_sigterm_sigkill_and_a_dead_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the benchmark, kill one worker, kill everything; in the end every run is finished, once."""
    pytest.importorskip("ray")
    config = {"env_wrapper": "slow_drive.Held"}
    grid = make_grid(tmp_path, config, seeds=[0], steps=150, save_freq=10, eval_freq=100)
    runs, results, held = tmp_path / "runs", tmp_path / "results", tmp_path / "held"
    held.mkdir()
    log = tmp_path / "log.txt"
    command = [sys.executable, "-m", "sb3_have.benchmark", "run", "mine.yml", "--workers", "2"]
    command += [
        "--runs",
        str(runs),
        "--results",
        str(results),
        "--time-limit",
        "1800",
    ]  # not to outlive pytest for long
    paths = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "HELD": str(held)}
    started: list[subprocess.Popen[bytes]] = []

    def start() -> subprocess.Popen[bytes]:
        with log.open("w") as output:
            kwargs: dict[str, Any] = {"stdout": output, "stderr": output, "start_new_session": True}
            started.append(subprocess.Popen(command, cwd=tmp_path, env=environment, **kwargs))
        return started[-1]

    def steps(name: str) -> int:
        checkpoint = newest_checkpoint(runs / name)
        return 0 if checkpoint is None else checkpoint_step(checkpoint)

    def pids_of_runs() -> list[int]:
        return processes_of_session(started[-1].pid, b"ray::_work")

    def both_held() -> bool:
        pids = pids_of_runs()
        return len(pids) == 2 and all((held / str(pid)).exists() for pid in pids)

    jobs = grid.jobs()
    names = [job.name for job in jobs]
    try:
        process = start()
        wait_until(both_held, process)
        os.killpg(process.pid, signal.SIGTERM)  # Ray's own processes are hit too
        wait_until(lambda: "stopping:" in log.read_text(), process)
        (held / "slowly").touch()
        assert process.wait() == STOPPED, log.read_text()
        (held / "slowly").unlink()
        stopped = {name: steps(name) for name in names}
        assert all(stopped.values())

        process = start()
        wait_until(both_held, process)
        known = {name: steps(name) for name in names}
        assert all(known[name] > stopped[name] for name in names)
        os.kill(pids_of_runs()[0], signal.SIGKILL)
        wait_until(lambda: "resuming from its checkpoint, attempt 2 of 3" in log.read_text(), process)
        wait_until(both_held, process)
        kill_session(process.pid)
        process.wait()
    finally:
        for process in started:
            kill_session(process.pid)
    killed = {name: steps(name) for name in names}
    assert sorted(killed[name] > known[name] for name in names) == [False, True], "only one of them was resumed"

    (held / "freely").touch()
    monkeypatch.setenv("HELD", str(held))
    assert Runner(jobs, runs, results).run(LocalPool(lambda job: run_job(job, runs))) == FINISHED
    assert all((runs / name / f"log-{killed[name]}").exists() for name in names)
    read_results([results])
    for job in jobs:
        assert is_finished(results, job)
        assert pd.read_csv(runs / job.name / "monitor.csv", skiprows=1)["l"].sum() <= 150, "no step is counted twice"
        model = ALGORITHMS[job.algo].load(runs / job.name / "model.zip")
        rows = read(results, "episodes").query("method == @job.method and weather == 'slow'")
        driven = evaluate_episodes(model, ENV_ID, ["slow"], 3, FINAL_SEED)
        np.testing.assert_allclose(rows["return"], driven["return"], atol=1e-3, err_msg="of the saved model")
    curve = read(results, "evaluations")
    assert not curve.duplicated(["method", "weather", "step"]).any()
