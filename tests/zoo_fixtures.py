"""Fixtures and helpers for the tests of ``sb3_have.zoo``."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import TIME_LIMIT_PLACES

VECTORS, DRIVING, CARLA = "ReliabilityDrive-v0", "HighwayVision-v0", "CarlaVision-v0"
#: A training of 200 steps that still updates everything, some 25 times.
SMALL = ["learning_starts:150", "buffer_size:300", "batch_size:4"]
SMALL_IMAGES = {"image_size": 36, "vehicles_count": 2, "max_episode_steps": 25}


@pytest.fixture(scope="module", autouse=True)
def zoo_patches() -> None:
    """rl_zoo3's TimeLimit, which it puts into gymnasium only when it is first imported."""
    rl_zoo3 = pytest.importorskip("rl_zoo3.gym_patches", reason="needs pip install 'sb3_have[zoo]'")
    for place in TIME_LIMIT_PLACES:
        place.TimeLimit = rl_zoo3.PatchedTimeLimit


def saved(folder: Path, name: str) -> dict[str, Any]:
    """``args.yml`` or ``config.yml`` of the only run in a folder."""
    (path,) = folder.glob(f"*/*/*/{name}")
    return dict(yaml.load(path.read_text(), Loader=yaml.UnsafeLoader))


def model_path(folder: Path) -> Path:
    """Of the only run in a folder."""
    (path,) = (path for path in folder.glob("*/*/*-v0.zip"))
    return path


def in_python(values: dict[str, Any]) -> list[str]:
    """As the Zoo's options take them."""
    return [f"{key}:{value!r}" for key, value in values.items()]


def evaluations(folder: Path) -> dict[str, np.ndarray]:
    """Of the only run in a folder."""
    (path,) = folder.glob("*/*/evaluations.npz")
    return dict(np.load(path))
