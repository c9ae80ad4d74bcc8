"""
Run a grid of methods x seeds, which can be stopped and resumed at any moment.

    python -m sb3_have.benchmark run benchmarks/grids/core.yml

On Ctrl-C, SIGTERM or after ``--time-limit`` every run saves a checkpoint; the same command resumes, also after a crash
of the machine. Finished runs are not repeated. The runs are in RUNS/<method>-<seed>/, the results in RESULTS/*.csv,
which grow by one run at a time.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

from tqdm import tqdm

from sb3_have.benchmark.grid import GridError, Job, read_grid
from sb3_have.benchmark.pool import RayPool
from sb3_have.benchmark.results import is_finished, merge
from sb3_have.benchmark.stages import collect, steps_done
from sb3_have.checkpoint.files import locked

RETRIES = 2
REFRESH_SECONDS = 2.0
# How long the runs may take to save their checkpoints, with replay buffers, after a stop
GRACE_SECONDS = 300.0

FINISHED, FAILED, STOPPED = 0, 1, 3


class Pool(Protocol):
    """The interface of :class:`~sb3_have.benchmark.pool.RayPool`."""

    workers: int

    @property
    def running(self) -> list[Job]: ...
    def start(self, job: Job) -> None: ...
    def wait(self, seconds: float) -> list[tuple[Job, bool | Exception]]: ...
    def stop(self) -> None: ...


class Runner:
    """
    Works through the runs of a grid and collects their results.

    :param jobs: Runs in the order of work
    :param runs: Folder of the runs' folders
    :param results: Folder of the results
    :param retries: How often to restart a run that fails
    :param time_limit: Time after which to stop [s]; None for none
    :raises GridError: If the results contain one of the runs with other settings
    """

    def __init__(
        self, jobs: Sequence[Job], runs: Path, results: Path, retries: int = RETRIES, time_limit: float | None = None
    ) -> None:
        self.jobs, self.runs, self.results, self.retries = jobs, runs, results, retries
        self.finished = {job.name for job in jobs if is_finished(results, job)}
        self.failed: list[str] = []
        self.stopping = False
        self._todo = deque(job for job in jobs if job.name not in self.finished)
        self._attempts = dict.fromkeys((job.name for job in jobs), 0)
        self._deadline = None if time_limit is None else time.monotonic() + time_limit

    @property
    def is_done(self) -> bool:
        """Whether there is nothing left to do."""
        return not self._todo

    def run(self, pool: Pool) -> int:
        """
        Work until everything is done, or until a stop.

        :return: Exit code: 0 if every run is finished, 1 if one failed, 3 if stopped before the end
        """
        total = sum(job.grid.steps for job in self.jobs)
        # Refresh the bar often in a terminal, and rarely in a log file
        interval = 0.1 if sys.stderr.isatty() else 60.0
        with tqdm(total=total, initial=self._steps(), unit="step", smoothing=0, mininterval=interval) as bar:
            with self._signals():
                self._work(pool, bar)
            bar.n = self._steps()
        return self.conclude()

    def _work(self, pool: Pool, bar: tqdm[Any]) -> None:
        stopped_at = None
        while pool.running or (self._todo and not self.stopping):
            # Stop all runs if requested
            if self._deadline is not None and time.monotonic() > self._deadline:
                self.stopping = True
            if self.stopping and stopped_at is None:
                stopped_at = time.monotonic()
                _write(bar, f"stopping: {len(pool.running)} runs are saving checkpoints")
                pool.stop()
            elif stopped_at is not None and time.monotonic() - stopped_at > GRACE_SECONDS:
                _write(bar, f"gave up waiting for {', '.join(job.name for job in pool.running)}")
                return
            # Start runs on free workers and collect those that ended
            while self._todo and len(pool.running) < pool.workers and not self.stopping:
                pool.start(self._todo.popleft())
            for job, outcome in pool.wait(REFRESH_SECONDS):
                _write(bar, self._settle(job, outcome))
            bar.set_postfix_str(", ".join(job.name for job in pool.running), refresh=False)
            bar.n = self._steps()
            bar.update(0)

    def _settle(self, job: Job, outcome: bool | Exception) -> str:
        """Handle the end of a run, and describe it in a line."""
        folder = self.runs / job.name
        if outcome is True:
            tables = collect(job, folder)
            merge(self.results, job, tables)
            self.finished.add(job.name)
            (folder / "traceback.txt").unlink(missing_ok=True)
            last, minutes = tables["final"], float(tables["runs"]["minutes"].iloc[0])
            return (
                f"{job.name}: return {last['return_mean'].mean():.1f}, distance {last['distance_mean'].mean():.0f} m "
                f"over {len(last)} weathers, {minutes:.1f} min; {len(self.finished)} of {len(self.jobs)} runs finished"
            )
        if outcome is False and self.stopping:
            return f"{job.name}: stopped after step {steps_done(folder)}"

        # The run failed: start it again, or give up
        reason = "it was stopped from outside" if outcome is False else str(outcome).strip() or type(outcome).__name__
        path = folder / "traceback.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{reason}\n")
        self._attempts[job.name] += 1
        attempt, attempts, last_line = self._attempts[job.name], self.retries + 1, reason.splitlines()[-1]
        if attempt == attempts:
            self.failed.append(job.name)
            return f"{job.name} died ({last_line}): failed {attempt} times, giving up; see {path}"
        self._todo.appendleft(job)
        return f"{job.name} died ({last_line}): resuming from its checkpoint, attempt {attempt + 1} of {attempts}"

    def _steps(self) -> int:
        """Count the training steps of all runs so far."""
        return sum(
            job.grid.steps if job.name in self.finished else min(steps_done(self.runs / job.name), job.grid.steps)
            for job in self.jobs
        )

    def conclude(self) -> int:
        """Print what is finished and what failed, and return the exit code."""
        print(f"{len(self.finished)} of {len(self.jobs)} runs finished, results in {self.results}")
        for name in self.failed:
            print(f"failed: {name}, {self.runs / name / 'traceback.txt'}")
        if self.failed:
            return FAILED
        if len(self.finished) < len(self.jobs):
            print("stopped; the same command resumes")
            return STOPPED
        return FINISHED

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Let the runs save checkpoints on the first Ctrl-C or SIGTERM, and stop at once on the second."""

        def stop(number: int, frame: FrameType | None) -> None:
            if self.stopping:
                raise KeyboardInterrupt
            self.stopping = True

        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _write(bar: tqdm[Any], line: str) -> None:
    """Print a line above the bar, at once even into a file."""
    bar.write(line)
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Command line of ``python -m sb3_have.benchmark run``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_have.benchmark run",
        description=(__doc__ or "").strip().splitlines()[0],
        epilog="Exit code: 0 if all runs are finished, 1 if some failed, 3 if stopped before the end.",
    )
    parser.add_argument("grid", type=Path, help="YAML file, see sb3_have.benchmark.grid")
    parser.add_argument(
        "--address",
        help="address of a Ray cluster (auto, host:6379); RUNS must be on a file system that all of its machines share "
        "under the same path",
    )
    parser.add_argument("--runs", type=Path, help="folder of the runs; default: runs/<name of the grid>")
    parser.add_argument(
        "--results", type=Path, help="folder of the results; default: benchmarks/results/<name of the grid>"
    )
    parser.add_argument("--workers", type=int, help="number of runs at a time; default: one for each CPU")
    parser.add_argument(
        "--gpus", type=float, default=0.0, help="share of a GPU for each run, such as 0.125; default: none"
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="METHOD", help="run these methods only")
    parser.add_argument("--time-limit", type=float, metavar="SECONDS", help="stop after this time, as on Ctrl-C")
    parser.add_argument(
        "--keep-checkpoints",
        action="store_true",
        help="keep the checkpoints of finished runs, so that a grid of more steps can continue them",
    )
    args = parser.parse_args(arguments)
    if args.workers is not None and args.workers < 1:
        parser.error(f"--workers must be >= 1, got {args.workers}")

    try:
        grid = read_grid(args.grid)
        jobs = grid.jobs(args.only)
        # Ray's workers may have another working directory
        runs = (args.runs or Path("runs") / grid.name).resolve()
        results = (args.results or Path("benchmarks") / "results" / grid.name).resolve()
        results.mkdir(parents=True, exist_ok=True)
        with locked(results):
            runner = Runner(jobs, runs, results, time_limit=args.time_limit)
            done = len(runner.finished)
            print(f"{grid.name}: {len(jobs)} runs of {grid.steps} steps, {done} already finished", flush=True)
            if runner.is_done:
                return runner.conclude()
            pool = RayPool(runs, args.address, args.workers, args.gpus, args.keep_checkpoints)
            try:
                return runner.run(pool)
            finally:
                pool.close()
    except (GridError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("stopped at once; the same command resumes from the last checkpoints", file=sys.stderr)
        return STOPPED
