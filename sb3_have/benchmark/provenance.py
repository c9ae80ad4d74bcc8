"""The machine and the versions of a measurement, and a report's section on them, the settings and the commands."""

from __future__ import annotations

import json
import platform
import shlex
import subprocess
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import pandas as pd
import torch as th

from sb3_have.benchmark.reading import Results, grid_of, ordered
from sb3_have.evaluation.evaluation import markdown_table

PACKAGES = ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "highway-env", "numpy")


def commit_of(folder: Path) -> str | None:
    """
    Return the commit of a git checkout, with "-dirty" if tracked files differ from it; None if it is not a checkout.

    :param folder: Top of the checkout
    """
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


# When this package was imported: the checkout may change while a training runs
COMMIT = commit_of(Path(__file__).resolve().parents[2])


def machine(device: str = "cpu") -> dict[str, str]:
    """
    Return the machine and the versions, as columns of a row.

    :param device: Torch device
    :return: ``machine`` and ``versions``, the latter with the package's commit if it is a checkout
    """
    hardware = f"{cpu_model()}, {'with' if th.cpu._is_amx_tile_supported() else 'no'} AMX"
    if device != "cpu":
        hardware += f", {th.cuda.get_device_name(device)}"
    own = f"sb3_have {version('sb3_have')}" + (f" ({COMMIT})" if COMMIT else "")
    packages = [own, f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in PACKAGES)]
    # The distribution of OpenCV has several names
    packages.append(f"opencv {cv2.__version__}")
    return {"machine": hardware, "versions": ", ".join(packages)}


def cpu_model() -> str:
    """Return the name of the processor, if the system has it."""
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def provenance(results: Results, out: Path) -> list[str]:
    """
    Write a report's last section: machines, versions, settings, and the commands that reproduce it.

    :param results: The results
    :param out: Folder of the report
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
    """List the settings that all runs share, and the others by method."""
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
        parts += ["Settings of a method:", markdown_table(["method", "setting", "value"], rows)]
    return parts


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings to dotted names: ``{"a": {"b": 1}}`` becomes ``{"a.b": 1}``."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _shown(path: Path) -> str:
    """Return a path relative to the working directory, if it is inside."""
    absolute = path.resolve()
    return absolute.relative_to(Path.cwd()).as_posix() if absolute.is_relative_to(Path.cwd()) else absolute.as_posix()
