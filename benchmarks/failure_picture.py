"""
Draw a contact sheet of all sensor failures at three severities on the sensors of HighwayVision-v0.

    python -m benchmarks.failure_picture [--out docs/failures.png]
"""

import argparse
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image

import sb3_have  # noqa: F401 (registers the environment)
from sb3_have.envs.vision import MODALITIES, compose
from sb3_have.sensors import FAILURES, SensorFailure, failures_for

SEED = 6
STEPS = 42
SIZE = 84
GAP = 4
LABELS = 118  # width of the column of names
HEADER = 22
SEVERITIES = (1, 2, 3)
PAPER = 255

Picture = NDArray[np.uint8]


def drive(modality: str | None = None, kind: str = "", severity: int = 1) -> dict[str, Picture]:
    """Return the observation after :data:`STEPS` steps straight ahead; the failure begins three steps before."""
    env: gym.Env[Any, Any] = gym.make("HighwayVision-v0", image_size=SIZE, weather="ClearNoon")
    if modality is not None:
        env = SensorFailure(env, modality, kind, severity, schedule=(STEPS - 3, None))
    observation, info = env.reset(seed=SEED)
    for _ in range(STEPS):
        throttle = float(np.clip(25 - info["speed"], -1, 1))
        observation, _, _, _, info = env.step(np.array([throttle, 0.0], dtype=np.float32))
    env.close()
    return dict(observation)


def sheet(kinds: tuple[str, ...] = tuple(FAILURES)) -> Picture:
    """Draw a row for the intact sensors and one per kind, with a column per sensor and severity."""
    step = SIZE + GAP
    width = LABELS + len(MODALITIES) * (len(SEVERITIES) * step + GAP)
    paper = np.full((HEADER + (1 + len(kinds)) * step, width, 3), PAPER, np.uint8)
    clean = drive()
    for row, kind in enumerate(("intact", *kinds)):
        top = HEADER + row * step
        write(paper, kind.replace("_", " "), 4, top + SIZE // 2 + 4)
        for block, modality in enumerate(MODALITIES):
            left = LABELS + block * (len(SEVERITIES) * step + GAP)
            for column, severity in enumerate(SEVERITIES):
                if row == 0 and column == 0:
                    image = clean[modality]
                elif row and kind in failures_for(modality):
                    image = drive(modality, kind, severity)[modality]
                else:
                    continue
                x = left + column * step
                paper[top : top + SIZE, x : x + SIZE] = compose({modality: image}, scale=1)
                cv2.rectangle(paper, (x - 1, top - 1), (x + SIZE, top + SIZE), (190, 190, 190), 1)
    for block, modality in enumerate(MODALITIES):
        for column, severity in enumerate(SEVERITIES):
            write(paper, f"{modality} {severity}", LABELS + block * (len(SEVERITIES) * step + GAP) + column * step, 15)
    return paper


def write(paper: Picture, text: str, x: int, y: int) -> None:
    cv2.putText(paper, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 40), 1, cv2.LINE_AA)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/failures.png"))
    out = parser.parse_args().out
    out.parent.mkdir(parents=True, exist_ok=True)
    paper = sheet()
    Image.fromarray(paper).save(out, optimize=True)
    print(f"wrote {out} ({paper.shape[1]}x{paper.shape[0]}, {out.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    main()
