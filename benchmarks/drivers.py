"""Drive untrained drivers in the episodes of a grid's final evaluation, for comparison in its report.

    python -m benchmarks.drivers benchmarks/grids/core.yml

They are a random driver, one that goes straight ahead at 20 m/s, and highway-env's own, which knows all traffic
(IDM/MOBIL). The script writes ``drivers.csv`` beside the results of the methods.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pandas as pd
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_have.benchmark.grid import Grid, read_grid
from sb3_have.benchmark.reading import FILES
from sb3_have.benchmark.stages import DIGITS
from sb3_have.checkpoint.files import write_atomically
from sb3_have.configuration import evaluation_env_kwargs
from sb3_have.envs.drivers import KeepStraightDriver, RandomDriver
from sb3_have.evaluation import Predictor, evaluate


def drive(grid: Grid, processes: int = 1) -> pd.DataFrame:
    """Drive each driver in each weather, in the environment of the grid's first method.

    :param grid: A grid on HighwayVision-v0
    :param processes: Number of processes; the random driver's actions depend on it
    :return: Rows of ``drivers.csv``
    :raises ValueError: If the grid has another environment
    """
    if grid.env != "HighwayVision-v0":
        raise ValueError(f"these drivers need HighwayVision-v0, and the grid's env is {grid.env}")
    env_kwargs = evaluation_env_kwargs(grid.jobs()[0].config)
    drivers: dict[str, tuple[Predictor, str]] = {
        "random": (RandomDriver(0), grid.env),
        "straight at 20 m/s": (KeepStraightDriver(20.0), grid.env),
        "IDM/MOBIL": (RandomDriver(0), "RuleDriven-v0"),  # the environment ignores its actions
    }
    parts = []
    for name, (driver, env_id) in drivers.items():
        rows = evaluate(
            driver,
            env_id,
            grid.weathers,
            grid.final_episodes,
            grid.final_seed,
            env_kwargs,
            n_envs=processes,
            vec_env_cls=SubprocVecEnv if processes > 1 else DummyVecEnv,
        )
        print(
            f"{name}: return {rows['return_mean'].mean():.1f}, distance {rows['distance_mean'].mean():.0f} m",
            flush=True,
        )
        parts.append(rows.assign(driver=name))
    return pd.concat(parts)[[*FILES["drivers"].columns]].round(DIGITS)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write ``drivers.csv``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drivers", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("grid", type=Path, help="YAML file, see sb3_have.benchmark.grid")
    parser.add_argument(
        "--results", type=Path, help="folder of the results; default: benchmarks/results/<name of the grid>"
    )
    parser.add_argument("--processes", type=int, default=1, help="number of processes")
    args = parser.parse_args(arguments)
    grid = read_grid(args.grid)
    results = args.results or Path("benchmarks") / "results" / grid.name
    results.mkdir(parents=True, exist_ok=True)
    write_atomically(results / "drivers.csv", partial(drive(grid, args.processes).to_csv, index=False))


if __name__ == "__main__":
    main()
