"""
Train HAVESAC on HighwayVision-v0 for a few minutes, compare it with rule-based drivers, and film an episode.

    python -m sb3_have.demo [--steps N] [--seed S] [--out runs/demo]

Hyperparameters are those of ``zoo_configs/have-50k.yml``. Use :mod:`sb3_have.train` for longer runs.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import torch as th
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_have.common.memory import keep_freed_memory
from sb3_have.configuration import evaluation_env_kwargs, load_config
from sb3_have.envs.drivers import KeepStraightDriver, RandomDriver
from sb3_have.envs.weather import WEATHERS
from sb3_have.evaluation.episodes import Predictor
from sb3_have.evaluation.evaluation import evaluate, format_table
from sb3_have.evaluation.recording import record_episode
from sb3_have.plotting import plot_learning_curve, plot_modality_weights, write_gif
from sb3_have.train import Run

ENV_ID = "HighwayVision-v0"
STEPS = 10_000
# Limit of the training, so that the demo takes at most a quarter of an hour on two cores; the evaluation takes 2.4
MINUTES = 11.5
EPISODES = 2
PROCESSES = 2
SHOWN = "HardRainNight"


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.demo``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_have.demo", description=(__doc__ or "").strip().splitlines()[0]
    )
    steps = int(os.environ.get("DEMO_STEPS", STEPS))
    parser.add_argument("--steps", type=int, default=steps, help=f"training steps; default: $DEMO_STEPS or {STEPS}")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="limit of the training; default: %(default)s")
    parser.add_argument(
        "--episodes", type=int, default=EPISODES, help="episodes per weather and driver; default: %(default)s"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/demo"))
    args = parser.parse_args(arguments)
    try:
        demo(args.steps, 60 * args.minutes, args.episodes, args.seed, args.out)
    except KeyboardInterrupt:
        print(f"\nInterrupted, the results so far are in {args.out}.", file=sys.stderr)
        sys.exit(130)


def demo(steps: int, time_limit: float, n_episodes: int, seed: int, out: Path) -> dict[str, pd.DataFrame]:
    """
    Train, evaluate and draw.

    :param steps: Number of training steps
    :param time_limit: Limit of the training [s]
    :param n_episodes: Number of evaluation episodes for each driver in each weather
    :param seed: Seed of the training; the evaluation always uses the same episodes
    :param out: Folder for the results
    :return: Evaluation of each driver
    """
    started = time.monotonic()
    config = load_config("have-50k", ENV_ID)
    run = Run(config, ENV_ID, out, seed=seed, eval_freq=0, save_freq=0, time_limit=time_limit)
    with phase(f"Training for {steps} steps or {time_limit / 60:g} minutes (Ctrl-C to stop earlier)"):
        model = run.train(steps, progress_bar=True, keep_checkpoint=False)
        if not (out / "model.zip").exists():  # interrupted twice, or before the first step
            raise KeyboardInterrupt
        (out / "model.zip").replace(out / "havesac_demo.zip")
        milliseconds = 1e3 * run.seconds / max(1, model.num_timesteps)
        print(f"{model.num_timesteps} steps in {run.seconds:.0f} s, {milliseconds:.0f} ms per step")

    # Leave the cores to the processes of the environments
    th.set_num_threads(1)
    env_kwargs = evaluation_env_kwargs(config)
    drivers: dict[str, Predictor] = {
        "HAVESAC": model,
        "random": RandomDriver(seed),
        "straight at 25 m/s": KeepStraightDriver(25.0),
        "straight at 20 m/s": KeepStraightDriver(20.0),
    }
    with phase(f"Evaluating {len(drivers)} drivers, {n_episodes} episodes in each of {len(WEATHERS)} weathers"):
        results = {
            name: evaluate(
                driver,
                ENV_ID,
                WEATHERS,
                n_episodes,
                env_kwargs=env_kwargs,
                n_envs=PROCESSES,
                progress_bar=True,
                vec_env_cls=SubprocVecEnv,
            )
            for name, driver in drivers.items()
        }
        table = pd.concat(results, names=["driver"]).reset_index(level="driver").reset_index(drop=True)
        table.to_csv(out / "evaluation.csv", index=False)
        print(format_table(results))

    with phase("Drawing"):
        draw(model, results, env_kwargs, out)
    print(f"Everything is in {out} after {(time.monotonic() - started) / 60:.1f} minutes.")
    return results


def draw(model: Any, results: dict[str, pd.DataFrame], env_kwargs: dict[str, Any], out: Path) -> None:
    """
    Write the figures and the film.

    :param model: The trained model
    :param results: Evaluation of each driver
    :param env_kwargs: Keyword arguments of the environment
    :param out: Folder for the results, with the ``monitor.csv`` of the training
    """
    others = {name: float(frame["distance_mean"].mean()) for name, frame in results.items() if name != "HAVESAC"}
    curve = plot_learning_curve(load_results(str(out)), references=others)
    curve.savefig(out / "learning_curve.png", dpi=120)
    recording = record_episode(model, ENV_ID, SHOWN, env_kwargs=env_kwargs)
    plot_modality_weights(recording).savefig(out / "modality_weights.png", dpi=120)
    write_gif(recording, out / "drive.gif")


@contextmanager
def phase(title: str) -> Iterator[None]:
    """
    Print the title and the duration of a phase.

    :param title: Title of the phase
    """
    print(f"\n== {title}", flush=True)
    started = time.monotonic()
    yield
    print(f"-- {time.monotonic() - started:.0f} s", flush=True)


if __name__ == "__main__":
    keep_freed_memory()
    main()
