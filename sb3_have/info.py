"""
Print what a bug report needs: the machine, versions, installed extras, and what "auto" selects here.

    python -m sb3_have.info
"""

from __future__ import annotations

import argparse
import os
import platform
from importlib.metadata import PackageNotFoundError, metadata, requires, version

import torch as th
from packaging.requirements import Requirement
from stable_baselines3.common.utils import get_device

from sb3_have.benchmark.provenance import machine
from sb3_have.common.encoders import has_native_bfloat16
from sb3_have.configuration import config_folder, config_names


def info() -> dict[str, str]:
    """Return the lines of the report by their titles, in order."""
    device = get_device("auto")
    facts = machine(device.type)
    extras = metadata("sb3_have").get_all("Provides-Extra") or []
    return {
        **dict(package.split(" ", 1) for package in facts["versions"].split(", ")),
        "platform": platform.platform(),
        "machine": f"{facts['machine']}, {os.cpu_count()} cores, {th.backends.cpu.get_cpu_capability()} kernels",
        "CUDA": f"{th.version.cuda or 'not built into torch'}, {th.cuda.device_count()} devices",
        "device": f"{device.type} (auto)",
        "precision": f"{'bfloat16' if has_native_bfloat16(device.type) else 'float32'} (auto)",
        "extras": ", ".join(extra for extra in extras if has_extra("sb3_have", extra)) or "none",
        "configurations": f"{len(config_names())} in {config_folder()}",
    }


def has_extra(package: str, extra: str) -> bool:
    """
    Whether everything that an extra of an installed package requires on this platform is installed.

    :param package: Name of the distribution
    :param extra: Name of the extra
    """
    required = [Requirement(line) for line in requires(package) or ()]
    of_extra = [r for r in required if r.marker and r.marker.evaluate({"extra": extra})]
    return all(is_installed(requirement) for requirement in of_extra)


def is_installed(requirement: Requirement) -> bool:
    """Whether a requirement is installed in a version that it allows, with its own extras."""
    try:
        installed = version(requirement.name)
    except PackageNotFoundError:
        return False
    right_version = requirement.specifier.contains(installed, prereleases=True)
    return right_version and all(has_extra(requirement.name, extra) for extra in requirement.extras)


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.info``."""
    parser = argparse.ArgumentParser(prog="python -m sb3_have.info", description=(__doc__ or "").strip().split("\n")[0])
    parser.parse_args(arguments)
    for title, text in info().items():
        print(f"{title}: {text}")


if __name__ == "__main__":
    main()
