"""Write the results of a benchmark: rows of a run are written once, atomically, and never mixed."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_have.benchmark.grid import GridError, Job
from sb3_have.benchmark.provenance import flatten
from sb3_have.benchmark.reading import FILES
from sb3_have.checkpoint.files import write_atomically

# The files of a run in the order of writing: a row in ``runs.csv`` implies that all others are complete
RUN_FILES = ("evaluations", "final", "episodes", "weights", "failures", "runs")


def read_text_table(path: Path) -> pd.DataFrame:
    """Read a CSV file as text, so that untouched rows are written back as they were."""
    return pd.read_csv(path, dtype=str, keep_default_na=False)


def of_run(rows: pd.DataFrame, job: Job) -> pd.Series[bool]:
    """Select the rows of a run in a text table."""
    return (rows["method"] == job.method) & (rows["seed"] == str(job.seed))


def merge(results: Path, job: Job, tables: dict[str, pd.DataFrame]) -> None:
    """
    Replace the rows of a run in every file.

    :param results: Results folder
    :param job: The run
    :param tables: Its rows by the names of :data:`RUN_FILES`, in the columns of
        :data:`~sb3_have.benchmark.reading.FILES`
    """
    results.mkdir(parents=True, exist_ok=True)
    for name in RUN_FILES:
        path, columns = results / f"{name}.csv", [*FILES[name].columns]
        old = read_text_table(path) if path.exists() else pd.DataFrame(columns=columns, dtype=str)
        parts = [part for part in (old[~of_run(old, job)], tables.get(name, pd.DataFrame())) if len(part)]
        if parts or path.exists():
            rows = pd.concat(parts) if parts else old[:0]
            # Order by seed; methods stay in the order of their first run
            rows = rows.iloc[rows["seed"].astype(int).argsort(kind="stable")]
            write_atomically(path, partial(rows[columns].to_csv, index=False))


def is_finished(results: Path, job: Job) -> bool:
    """
    Return whether the results contain a run with everything that the grid asks for.

    :raises GridError: If they contain it with other settings
    """
    paths = results / "runs.csv", results / "final.csv"
    if not all(path.exists() for path in paths):
        return False
    runs, final = map(read_text_table, paths)
    runs, final = runs[of_run(runs, job)], final[of_run(final, job)]
    if runs.empty:
        return False
    # Compare the settings; failures may be added later
    there, here = json.loads(runs["settings"].iloc[-1]), json.loads(settings_column(job))
    failures_there, failures_here = there.pop("failures", None), here.pop("failures", None)
    there |= {"steps": int(runs["steps"].iloc[-1]), "weathers": sorted(final["weather"])}
    here |= {"steps": job.grid.steps, "weathers": sorted(job.grid.weathers)}
    if differences := difference(there, here):
        raise GridError(
            f"{results} contains {job.name} with other settings ({differences}); "
            "choose another --results (a copy of the grid under another name does), or remove the rows of that run"
        )
    return failures_here in (None, failures_there)


def settings_column(job: Job) -> str:
    """Return the run's configuration and how it was evaluated, for ``runs.csv``."""
    settings = {**job.settings, "final_episodes": job.grid.final_episodes}
    if (failures := job.grid.failures) is not None:
        settings["failures"] = {**failures.model_dump(), "kinds": sorted(failures.kinds)}
    return json.dumps(settings, sort_keys=True)


def difference(there: dict[str, Any], here: dict[str, Any]) -> str:
    """Describe where two settings differ; empty if they are equal."""
    old, new = flatten(there), flatten(here)
    parts = [f"{key}: {old[key]!r}, not given now" for key in sorted(old.keys() - new.keys())]
    parts += [f"{key} is new" for key in sorted(new.keys() - old.keys())]
    parts += [f"{k}: {old[k]!r}, now {new[k]!r}" for k in sorted(old.keys() & new.keys()) if old[k] != new[k]]
    return "; ".join(parts)
