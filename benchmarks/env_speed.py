"""
Control steps per second of HighwayVision-v0 on one core, compared with highway-env without rendering.

    OMP_NUM_THREADS=1 python -m benchmarks.env_speed

There are 20 vehicles, and the ego vehicle keeps straight at about 15 m/s. A step is 0.1 s or 0.2 s (the default) of
simulation at 20 Hz. The contenders take turns in one process, where possible in the same traffic (see
``benchmarks/road_identity.py``). The time includes the resets between episodes. Rows, printed and written to
benchmarks/results/env_speed.csv:

- ``HighwayVision-v0``: for image sizes, weathers and modalities;
- ``HighwayVision-v0, driven``: its scenarios with an IDM/MOBIL driver, who follows the bends; and the task of the
  benchmark, "curves" with the colour and the event camera, in all chosen weathers;
- ``no sensors``: its dynamics; ``stock road, no sensors``: the same with highway-env's own road and drivers;
- ``highway-v0``: highway-env's environment with continuous actions and its default observation, 5 vehicles in numbers.

Columns: median and quartiles of the wall-clock time of a step; ``cpu_ms``, median processor time, which is more
reliable on a busy machine; ``steps_per_s`` and ``cpu_steps_per_s`` from these medians; ``vs_stock``, how many times
faster than ``stock road, no sensors``, the median over the rounds of the ratio within a round, in processor time.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import gymnasium as gym
import highway_env  # noqa: F401 (registers highway-v0)
import numpy as np
import torch as th

from benchmarks.measure import RESULTS, Row, interleave, machine, median_ratio, quartiles, save, show
from benchmarks.road_identity import BlindEnv, StockEnv
from sb3_have.envs import HighwayVisionEnv
from sb3_have.envs.road_shape import SCENARIOS
from sb3_have.envs.rule_driven import RuleDrivenEnv
from sb3_have.envs.weather import WEATHERS

SPEED = 15.0
ALL = ("rgb", "event", "depth")
COLUMNS = (
    *("contender", "scenario", "image_size", "weather", "modalities", "median_ms", "q25_ms", "q75_ms", "cpu_ms"),
    *("steps_per_s", "cpu_steps_per_s", "vs_stock"),
)


class Contender(NamedTuple):
    """Environment to time; only those with sensors have more than a name."""

    contender: str
    image_size: int | None = None
    weather: str = ""
    modalities: tuple[str, ...] = ()
    scenario: str = ""


STOCK = Contender("stock road, no sensors")
DRIVEN = "HighwayVision-v0, driven"


def make_env(contender: Contender, control_frequency: int, vehicles: int) -> gym.Env[Any, Any]:
    """Create the environment of a contender."""
    frequencies = {"simulation_frequency": 20, "policy_frequency": control_frequency}
    if contender.contender == "highway-v0":
        config = {"action": {"type": "ContinuousAction"}, "lanes_count": 4, "vehicles_count": vehicles, **frequencies}
        return gym.make("highway-v0", config=config)
    kwargs: dict[str, Any] = {"vehicles_count": vehicles, **frequencies}
    if contender == STOCK:
        return StockEnv(**kwargs)
    if contender.image_size is None:
        return BlindEnv(**kwargs)
    env_class = RuleDrivenEnv if contender.contender == DRIVEN else HighwayVisionEnv
    kwargs["scenario"] = contender.scenario or "highway"
    return env_class(contender.weather, contender.modalities, contender.image_size, **kwargs)


class Driver:
    """Keeps straight; each call is one control step."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env = env
        self.vehicle_of: Any = env.unwrapped
        env.reset(seed=0)

    def __call__(self) -> None:
        throttle = min(max((SPEED - self.vehicle_of.vehicle.speed) / 3, -1), 1)
        *_, terminated, truncated, _ = self.env.step(np.array([throttle, 0.0]))
        if terminated or truncated:
            self.env.reset()


def measure(contenders: Sequence[Contender], control_frequency: int, args: argparse.Namespace) -> list[Row]:
    """Return one row per contender at one control frequency."""
    drivers = {contender: Driver(make_env(contender, control_frequency, args.vehicles)) for contender in contenders}
    times = interleave(drivers, args.rounds, args.steps)
    where = machine()
    packages = ", ".join(f"{name} {version(name)}" for name in ("highway-env", "opencv-python-headless"))
    rows = []
    for contender, (wall, cpu) in times.items():
        cpu_ms = float(np.median(cpu))
        row = {"threads": 1, "vehicles": args.vehicles, "control_hz": control_frequency, **contender._asdict()}
        row |= {"image_size": contender.image_size or "", "modalities": "+".join(contender.modalities)}
        row |= {**quartiles(wall), "cpu_ms": round(cpu_ms, 3)}
        row |= {"steps_per_s": round(1e3 / float(np.median(wall)), 1), "cpu_steps_per_s": round(1e3 / cpu_ms, 1)}
        row |= {"vs_stock": round(median_ratio(times[STOCK].cpu, cpu), 2)}
        rows.append({**row, "rounds": args.rounds, "steps": args.steps, **where})
        rows[-1]["versions"] += f", {packages}"
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", type=int, default=[64, 84, 128])
    parser.add_argument("--weathers", nargs="+", choices=WEATHERS, default=["ClearNoon", "HardRainNight"])
    parser.add_argument("--control", nargs="+", type=int, default=[10, 5], help="control frequencies [Hz]")
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--steps", type=int, default=25, help="control steps of each contender in each round")
    parser.add_argument("--out", type=Path, default=RESULTS / "env_speed.csv")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    th.set_num_threads(1)
    contenders = [STOCK, Contender("no sensors"), Contender("highway-v0")]
    contenders += [
        Contender("HighwayVision-v0", size, weather, ALL, "highway") for size in args.sizes for weather in args.weathers
    ]
    contenders += [Contender("HighwayVision-v0", 84, "ClearNoon", (name,), "highway") for name in ALL]
    contenders += [Contender(DRIVEN, 64, "ClearNoon", ALL, scenario) for scenario in SCENARIOS]
    contenders += [Contender(DRIVEN, 64, weather, ("rgb", "event"), "curves") for weather in args.weathers]
    for control_frequency in args.control:
        rows = measure(contenders, control_frequency, args)
        save(rows, args.out, ("machine", "vehicles", "control_hz"))
        print(f"{control_frequency} Hz control over 20 Hz simulation, {args.rounds} x {args.steps} steps")
        show(rows, COLUMNS)
    print(rows[0]["machine"], rows[0]["versions"], sep="\n")


if __name__ == "__main__":
    main()
