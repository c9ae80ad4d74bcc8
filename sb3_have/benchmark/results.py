"""The results folder of a benchmark: a run's rows come in whole, once, and never mixed with those of other settings."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_have.benchmark.grid import GridError, Job
from sb3_have.benchmark.reading import FILES
from sb3_have.checkpoint.files import write_atomically

RUN_FILES = ("evaluations", "final", "episodes", "weights", "failures", "runs")
"""What a run adds to, in the order of writing: the row in ``runs.csv`` says that the others are there."""


def read_text_table(path: Path) -> pd.DataFrame:
    """A CSV file letter by letter, so that rows which are not touched are written back as they were."""
    return pd.read_csv(path, dtype=str, keep_default_na=False)


def merge(results: Path, job: Job, tables: dict[str, pd.DataFrame]) -> None:
    """Put a run's rows in place of those that it had, in every file.

    :param results: folder
    :param job: the run
    :param tables: its rows by the names of :data:`RUN_FILES`, in the columns of
        :data:`~sb3_have.benchmark.reading.FILES`; a file without rows is not begun
    """
    results.mkdir(parents=True, exist_ok=True)
    for name in RUN_FILES:
        path, columns = results / f"{name}.csv", [*FILES[name].columns]
        rows = tables.get(name, pd.DataFrame())
        if path.exists():
            old = read_text_table(path)
            old = old[(old["method"] != job.method) | (old["seed"] != str(job.seed))]
        else:
            old = pd.DataFrame(columns=columns)
        if rows.empty and not path.exists():
            continue
        whole = pd.concat([frame for frame in (old, rows) if len(frame)]) if len(rows) or len(old) else old
        # seed by seed, methods in the order in which they came
        order = whole["seed"].astype(int)
        whole = whole.iloc[order.argsort(kind="stable")]
        write_atomically(path, partial(whole[columns].to_csv, index=False))


def is_finished(results: Path, job: Job) -> bool:
    """Whether a run and all that is asked of it is in the results.

    :raises GridError: if they hold it with other settings
    """
    row = _row(results / "runs.csv", job)
    final = results / "final.csv"
    if row is None or not final.exists():
        return False
    settings, then = {**job.settings, **_asked(job)}, json.loads(row["settings"])
    rows = read_text_table(final)
    rows = rows[(rows["method"] == job.method) & (rows["seed"] == str(job.seed))]
    here = {"steps": job.grid.steps, "weathers": sorted(job.grid.weathers), **settings}
    there = {"steps": int(row["steps"]), "weathers": sorted(rows["weather"]), **then}
    here_failures, there_failures = here.pop("failures", None), there.pop("failures", None)
    if told := difference(there, here):
        raise GridError(
            f"{results} holds {job.name} with other settings ({told}); "
            "choose another --results (a copy of the grid under another name does), or remove that run's rows"
        )
    return here_failures in (None, there_failures)


def _row(path: Path, job: Job) -> pd.Series[Any] | None:
    if not path.exists():
        return None
    runs = read_text_table(path)
    runs = runs[(runs["method"] == job.method) & (runs["seed"] == str(job.seed))]
    return runs.iloc[-1] if len(runs) else None


def _asked(job: Job) -> dict[str, Any]:
    """What a grid asks of a run after training."""
    grid, asked = job.grid, dict[str, Any]()
    asked["final_episodes"] = grid.final_episodes
    if grid.failures is not None:
        failures = grid.failures
        asked["failures"] = {**vars(failures), "kinds": sorted(failures.kinds)}
    return asked


def settings_column(job: Job) -> str:
    """For ``runs.csv``: the run's configuration, and how it was examined."""
    return json.dumps({**job.settings, **_asked(job)}, sort_keys=True)


def difference(there: Any, here: Any, name: str = "") -> str:
    """In words, where two settings differ; empty if they do not."""
    if isinstance(there, dict) and isinstance(here, dict):
        nothing = object()
        parts = [
            difference(there.get(key, nothing), here.get(key, nothing), f"{name}.{key}" if name else str(key))
            if key in there and key in here
            else f"{name}.{key}".lstrip(".") + (f": {there[key]!r}, not given now" if key in there else " is new")
            for key in sorted({*there, *here})
        ]
        return "; ".join(part for part in parts if part)
    return "" if there == here else f"{name}: {there!r}, now {here!r}"
