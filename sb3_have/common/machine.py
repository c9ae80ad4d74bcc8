"""The machine and the versions that a measurement was made with."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path

import torch as th

PACKAGES = ("torch", "stable-baselines3", "numpy")


def machine(device: str = "cpu") -> dict[str, str]:
    """The machine and the versions, as columns of a row.

    :param device: on which torch works
    :return: ``machine`` and ``versions``
    """
    hardware = f"{cpu_model()}, {'with' if th.cpu._is_amx_tile_supported() else 'no'} AMX"
    if device != "cpu":
        hardware += f", {th.cuda.get_device_name(device)}"
    packages = [f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in PACKAGES)]
    return {"machine": hardware, "versions": ", ".join(packages)}


def cpu_model() -> str:
    """Name of the processor, as far as the system tells."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
