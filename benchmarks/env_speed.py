"""Control steps per second of HighwayVision-v0 on one core.

    OMP_NUM_THREADS=1 python -m benchmarks.env_speed --sizes 64 84 128

Both wall-clock and processor time are given: on a machine with other work only the second says what a core can do.
"""

from __future__ import annotations

import argparse
import platform
import time
from importlib.metadata import version

import cv2
import numpy as np

from sb3_have.envs import HighwayVisionEnv

SUBSETS: list[tuple[str, ...]] = [("rgb", "event", "depth"), ("rgb",), ("event",), ("depth",)]


def measure(env: HighwayVisionEnv, chunks: int, steps: int) -> tuple[float, float]:
    """Median steps per second over chunks, by wall clock and by processor time, keeping straight at about 15 m/s."""
    env.reset(seed=0)
    wall, cpu = [], []
    for chunk in range(chunks + 1):
        start = time.perf_counter(), time.process_time()
        for _ in range(steps):
            throttle = np.clip((15 - env.vehicle.speed) / 3, -1, 1)
            *_, terminated, truncated, _ = env.step(np.array([throttle, 0.0]))
            if terminated or truncated:
                env.reset()
        if chunk:  # the first one warms up
            wall.append(steps / (time.perf_counter() - start[0]))
            cpu.append(steps / (time.process_time() - start[1]))
    return float(np.median(wall)), float(np.median(cpu))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", type=int, default=[64, 84, 128])
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--weathers", nargs="+", default=["ClearNoon", "HardRainNight"])
    parser.add_argument("--chunks", type=int, default=10)
    parser.add_argument("--steps", type=int, default=50, help="control steps per chunk")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    packages = ", ".join(f"{name} {version(name)}" for name in ("highway-env", "numpy", "opencv-python-headless"))
    print(f"Python {platform.python_version()}, {packages}, {platform.machine()}")
    print(f"{args.vehicles} vehicles, 5 Hz control, 20 Hz simulation; median of {args.chunks} x {args.steps} steps")
    print(f"{'size':>5} {'weather':14} {'modalities':16} {'steps/s wall':>13} {'steps/s CPU':>12}")
    for size in args.sizes:
        for weather in args.weathers:
            for modalities in SUBSETS:
                env = HighwayVisionEnv(weather, modalities, size, vehicles_count=args.vehicles)
                wall, cpu = measure(env, args.chunks, args.steps)
                print(f"{size:5d} {weather:14} {'+'.join(modalities):16} {wall:13.0f} {cpu:12.0f}", flush=True)


if __name__ == "__main__":
    main()
