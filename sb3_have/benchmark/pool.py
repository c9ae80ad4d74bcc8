"""Ray's side of a benchmark: runs as tasks of one CPU each, on this machine or a cluster."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
from pathlib import Path
from typing import Any

from sb3_have.benchmark.grid import Job

OBJECT_STORE = 100 * 2**20
"""Bytes of shared memory: the tasks hand over nothing but whether they are finished."""

ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
    # a run without a GPU is told to use the CPU; Ray need not hide the GPUs, nor warn that it will not in future
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}


class RayPool:
    """Where runs are started, waited for and asked to stop.

    :param runs: folder of the runs' folders, seen by all machines
    :param address: of a cluster; None starts Ray here for as long as this lives
    :param workers: runs at a time; None for as many as there are CPUs
    :param gpus: share of a GPU for each run; 0 trains on CPUs
    :param keep_checkpoints: see :func:`~sb3_have.benchmark.stages.run_job`
    :raises SystemExit: if Ray is not installed
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
        quiet: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
        if address is None:
            quiet |= {"num_cpus": workers, "include_dashboard": False, "object_store_memory": OBJECT_STORE}
        # A SIGTERM to the whole process group, as timeout sends it, must not end Ray: without its head everything would
        # die after a minute, and the runs may still be saving. Ray's processes inherit the mask; Ctrl-C they mask
        # themselves.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        try:
            ray.init(address=address, **quiet)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        self._ray = ray
        self.workers = workers or int(ray.cluster_resources().get("CPU", 1))  # type: ignore[no-untyped-call]
        # A process of its own for every run: what one leaves behind (threads, a grown heap) is no burden to the next.
        # Its death is handled here, not by Ray: a run goes on from its checkpoint.
        self._task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=0, max_calls=1)(_work)
        self._options = (runs, "cuda" if gpus else "cpu", keep_checkpoints)
        self._running: dict[Any, Job] = {}

    def start(self, job: Job) -> None:
        """Begin a run, or let it go on."""
        self._running[self._task.remote(job, *self._options)] = job

    @property
    def running(self) -> list[Job]:
        """What has been started and not yet been told of by :meth:`wait`."""
        return [*self._running.values()]

    def wait(self, seconds: float) -> list[tuple[Job, bool | Exception]]:
        """Runs that have come to an end.

        :param seconds: to wait for one at most
        :return: with each, whether it is finished (False: stopped), or what it died of
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
        """Ask all runs to save what they have and end: each gets a KeyboardInterrupt, as from Ctrl-C."""
        for task in self._running:
            self._ray.cancel(task, force=False)

    def close(self) -> None:
        """End Ray, if it was started here, and what still runs."""
        self._ray.shutdown()


def _work(job: Job, runs: Path, device: str, keep_checkpoint: bool) -> bool:
    """A run in its process; what it prints goes to ``output.txt`` in its folder."""
    import torch as th

    from sb3_have.benchmark.stages import run_job
    from sb3_have.common.memory import keep_freed_memory

    keep_freed_memory()
    th.set_num_threads(1)
    folder = runs / job.name
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "output.txt").open("a") as output, contextlib.redirect_stdout(output):
        return run_job(job, runs, device, keep_checkpoint)
