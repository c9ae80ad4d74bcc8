"""Draws the README's picture: what the three sensors of HighwayVision-v0 see in three weathers.

python -m benchmarks.sensor_picture [--out docs/sensors.png]
"""

import argparse
from pathlib import Path

import cv2
import gymnasium as gym
import numpy as np

import sb3_have  # noqa: F401 (registers the environment)

SEED = 6
STEPS = 42
WEATHERS = ("ClearNoon", "ClearNight", "HardRainNight")


def picture(weather: str) -> np.ndarray:
    """RGB | event | depth after some seconds of keeping straight, the same traffic in every weather."""
    env = gym.make("HighwayVision-v0", image_size=128, weather=weather, render_mode="rgb_array")
    _, info = env.reset(seed=SEED)
    for _ in range(STEPS):
        throttle = float(np.clip(25 - info["speed"], -1, 1))
        _, _, _, _, info = env.step(np.array([throttle, 0.0], dtype=np.float32))
    frame = np.asarray(env.render())
    env.close()
    return cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/sensors.png"))
    out = parser.parse_args().out
    out.parent.mkdir(parents=True, exist_ok=True)
    rows = np.concatenate([picture(weather) for weather in WEATHERS])
    cv2.imwrite(str(out), rows[..., ::-1])
    print(f"wrote {out} ({rows.shape[1]}x{rows.shape[0]})")


if __name__ == "__main__":
    main()
