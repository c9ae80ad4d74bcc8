"""
Draw the pictures of the README: the three sensors of HighwayVision-v0 in three weathers and on other roads.

    python -m benchmarks.sensor_picture                   # docs/sensors.png, docs/scenarios.png

On the highway the ego vehicle keeps straight; on the other roads highway-env's IDM/MOBIL driver drives.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from sb3_have.envs import HighwayVisionEnv
from sb3_have.envs.rule_driven import RuleDrivenEnv


class Shot(NamedTuple):
    """A row of a picture: RGB, events and depth after ``steps`` control steps."""

    weather: str
    scenario: str = "highway"
    seed: int = 6
    steps: int = 42


PICTURES = {
    "sensors.png": (Shot("ClearNoon"), Shot("ClearNight"), Shot("HardRainNight")),
    "scenarios.png": (
        Shot("ClearNoon", "merge", 1, 36),
        Shot("ClearNoon", "curves", 2, 43),
        Shot("ClearNight", "curves", 2, 43),
    ),
}


def picture(shot: Shot) -> np.ndarray:
    """Render a shot. The traffic is the same in every weather."""
    env_class = HighwayVisionEnv if shot.scenario == "highway" else RuleDrivenEnv
    env: Any = env_class(shot.weather, image_size=128, render_mode="rgb_array", scenario=shot.scenario)
    _, info = env.reset(seed=shot.seed)
    for _ in range(shot.steps):
        throttle = float(np.clip(25 - info["speed"], -1, 1))
        _, _, _, _, info = env.step(np.array([throttle, 0.0], dtype=np.float32))
    frame = np.asarray(env.render())
    env.close()
    return cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", nargs="+", choices=list(PICTURES), default=list(PICTURES))
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.pictures:
        rows = np.concatenate([picture(shot) for shot in PICTURES[name]])
        cv2.imwrite(str(args.out / name), rows[..., ::-1])
        print(f"wrote {args.out / name} ({rows.shape[1]}x{rows.shape[0]})")


if __name__ == "__main__":
    main()
