"""The machine and the versions that a measurement was made with."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import cv2
import torch as th

PACKAGES = ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "highway-env", "numpy")


def commit_of(folder: Path) -> str | None:
    """Commit of a git checkout, with "-dirty" where tracked files differ from it; None if it is none.

    :param folder: top of the checkout
    """
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):  # no git here, or it refuses
        return None


COMMIT = commit_of(Path(__file__).resolve().parents[2])
"""Of this package when it was imported: a checkout may go on while a training runs."""


def machine(device: str = "cpu") -> dict[str, str]:
    """The machine and the versions, as columns of a row.

    :param device: on which torch works
    :return: ``machine`` and ``versions``, the latter with the package's commit where it is a checkout
    """
    hardware = f"{cpu_model()}, {'with' if th.cpu._is_amx_tile_supported() else 'no'} AMX"
    if device != "cpu":
        hardware += f", {th.cuda.get_device_name(device)}"
    own = f"sb3_have {version('sb3_have')}" + (f" ({COMMIT})" if COMMIT else "")
    packages = [own, f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in PACKAGES)]
    packages.append(f"opencv {cv2.__version__}")  # its distribution has several names
    return {"machine": hardware, "versions": ", ".join(packages)}


def cpu_model() -> str:
    """Name of the processor, as far as the system tells."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
