"""Runs as Ray tasks of one CPU each, on this machine or a cluster."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
from pathlib import Path
from typing import Any

from sb3_have.benchmark.grid import Job

# Bytes of shared memory: a task returns nothing but whether its run is finished
OBJECT_STORE = 100 * 2**20

ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
    # A run without a GPU uses the CPU explicitly: Ray need not hide the GPUs, nor warn about it
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}


class RayPool:
    """
    Starts runs, waits for them, and stops them.

    :param runs: Folder of the runs' folders, shared by all machines
    :param address: Address of a cluster; None starts Ray on this machine until :meth:`close`
    :param workers: Number of runs at a time; None for as many as there are CPUs
    :param gpus: Share of a GPU for each run; 0 trains on CPUs
    :param keep_checkpoints: See :func:`~sb3_have.benchmark.stages.run_job`
    :raises SystemExit: If Ray is not installed
    """

    def __init__(
        self,
        runs: Path,
        address: str | None = None,
        workers: int | None = None,
        gpus: float = 0.0,
        keep_checkpoints: bool = False,
    ) -> None:
        os.environ.update(ENVIRONMENT)
        try:
            import ray
        except ModuleNotFoundError:
            raise SystemExit('a benchmark runs on Ray: pip install "sb3_have[benchmark]"') from None
        options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
        if address is None:
            options |= {"num_cpus": workers, "include_dashboard": False, "object_store_memory": OBJECT_STORE}
        # A SIGTERM to the whole process group, as `timeout` sends it, must not end Ray while the runs are saving.
        # Ray's processes inherit this mask; they ignore Ctrl-C by themselves.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        try:
            ray.init(address=address, **options)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        self._ray = ray
        self.workers = workers or int(ray.cluster_resources().get("CPU", 1))  # type: ignore[no-untyped-call]
        # Every run gets a new process, free of the threads and the memory of the last one. If it dies, the runner
        # starts it again from its checkpoint, so Ray must not retry.
        self._task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=0, max_calls=1)(_work)
        self._options = (runs, "cuda" if gpus else "cpu", keep_checkpoints)
        self._running: dict[Any, Job] = {}

    def start(self, job: Job) -> None:
        """Start or resume a run."""
        self._running[self._task.remote(job, *self._options)] = job

    @property
    def running(self) -> list[Job]:
        """Runs that were started and not yet returned by :meth:`wait`."""
        return [*self._running.values()]

    def wait(self, seconds: float) -> list[tuple[Job, bool | Exception]]:
        """
        Wait for a run to end.

        :param seconds: Maximum time to wait
        :return: The runs that ended, each with whether it is finished (False if it was stopped) or its error
        """
        if not self._running:
            return []
        ended, _ = self._ray.wait([*self._running], timeout=seconds)
        return [(self._running.pop(task), self._outcome(task)) for task in ended]

    def _outcome(self, task: Any) -> bool | Exception:
        try:
            return bool(self._ray.get(task))
        except self._ray.exceptions.TaskCancelledError:
            return False
        except self._ray.exceptions.RayError as error:
            return error

    def stop(self) -> None:
        """Let all runs save a checkpoint and end: each gets a KeyboardInterrupt, as from Ctrl-C."""
        for task in self._running:
            self._ray.cancel(task, force=False)

    def close(self) -> None:
        """Shut down Ray if it was started here, with what is still running."""
        self._ray.shutdown()


def _work(job: Job, runs: Path, device: str, keep_checkpoint: bool) -> bool:
    """Work on a run in its process. The output goes to ``output.txt`` in its folder."""
    import torch as th

    from sb3_have.benchmark.stages import run_job
    from sb3_have.common.memory import keep_freed_memory

    keep_freed_memory()
    th.set_num_threads(1)
    folder = runs / job.name
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "output.txt").open("a") as output, contextlib.redirect_stdout(output):
        return run_job(job, runs, device, keep_checkpoint)
