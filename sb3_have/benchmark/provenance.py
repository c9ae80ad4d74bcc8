"""On what a benchmark was run: machines, versions, settings, and the commands that make it again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_have.benchmark.reading import Results, grid_of, ordered
from sb3_have.benchmark.tables import markdown


def provenance(results: Results, out: Path) -> list[str]:
    """On what the runs were made, with which settings, and by which commands.

    :param out: folder of the report
    """
    runs, parts = results["runs"], []
    if runs.empty:
        parts.append("There is no `runs.csv`: machine, versions and settings are not known.")
    else:
        for name, title in (("machine", "Machines"), ("versions", "Versions")):
            counts = runs[name].value_counts()
            parts.append(f"{title}:\n\n" + "\n".join(f"- {text} ({n} runs)" for text, n in counts.items()))
        parts += _settings(runs)
    grids = [grid_of(folder) for folder in results.folders]
    shown = [shlex.quote(_shown(grid) if grid.exists() else grid.name) for grid in grids]
    commands = [f"python -m sb3_have.benchmark run {grid}" for grid in shown]
    folders = [shlex.quote(_shown(folder)) for folder in results.folders]
    commands.append(f"python -m sb3_have.benchmark report {' '.join(folders)} --out {shlex.quote(_shown(out))}")
    return [*parts, "Commands:", "```\n" + "\n".join(commands) + "\n```"]


def _settings(runs: pd.DataFrame) -> list[str]:
    """The settings that all runs share, and by method those that they do not."""
    of_runs = [flatten(json.loads(text)) for text in runs["settings"]]
    keys = list(dict.fromkeys(key for settings in of_runs for key in settings))
    same = [key for key in keys if all(key in s and s[key] == of_runs[0][key] for s in of_runs)]
    shared = "\n".join(f"{key}: {json.dumps(of_runs[0][key])}" for key in same)
    parts = ["Settings of all runs:", f"```yaml\n{shared}\n```"] if same else []
    rows = []
    for method in ordered(set(runs["method"])):
        own = [settings for settings, name in zip(of_runs, runs["method"], strict=True) if name == method]
        for key in (key for key in keys if key not in same):
            values = list(dict.fromkeys(json.dumps(settings[key]) for settings in own if key in settings))
            if values:
                rows.append([method, key, " or ".join(values)])
    if rows:
        parts += ["Settings of a method:", markdown(["method", "setting", "value"], rows)]
    return parts


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted names: ``{"a": {"b": 1}}`` is ``{"a.b": 1}``."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _shown(path: Path) -> str:
    """A path relative to the working directory where it lies in there."""
    absolute = path.resolve()
    return absolute.relative_to(Path.cwd()).as_posix() if absolute.is_relative_to(Path.cwd()) else absolute.as_posix()
