"""A grid of small runs in the fake driving environment, and a pool that works in this process."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from fake_drive import CONFIG, ENV_ID

from sb3_have.benchmark.grid import Grid, Job, read_grid

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
    """Runs one job after the other in this process.

    :param work: Called in place of a run; its exception is the run's
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


def read(folder: Path, name: str) -> pd.DataFrame:
    return pd.read_csv(folder / f"{name}.csv", keep_default_na=False)


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in sorted(folder.iterdir())}
