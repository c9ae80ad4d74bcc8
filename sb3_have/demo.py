"""
Show a trained driver, train another one for a few minutes, and compare them with drivers that do not learn.

    python -m sb3_have.demo [--steps N] [--seed S] [--out runs/demo]

The road is winding ("curves"): a driver that goes straight leaves it after about 100 m. To learn to drive in a few
minutes, the agent gets the encoders of the trained driver, which are frozen. Critics, attention and actor start from
random weights and learn on their features. All drivers meet half as many cars as in the benchmark. Use
:mod:`sb3_have.train` for a full training on images.
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

import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_have.checkpoint.files import write_atomically
from sb3_have.common.memory import keep_freed_memory
from sb3_have.configuration import evaluation_env_kwargs, load_config
from sb3_have.envs.drivers import KeepStraightDriver, RandomDriver
from sb3_have.envs.weather import WEATHERS
from sb3_have.evaluation.episodes import Predictor
from sb3_have.evaluation.evaluation import evaluate, format_table
from sb3_have.evaluation.recording import Recording, record_episode
from sb3_have.have.have import HAVESAC
from sb3_have.plotting import plot_learning_curve, plot_modality_weights, write_gif, write_page
from sb3_have.train import Run, make_training_env
from sb3_have.trained import pretrained
from sb3_have.trained.features import on_features, with_encoders
from sb3_have.watch import ACTIONS

ENV_ID, RULES_ID = "HighwayVision-v0", "RuleDriven-v0"
STEPS = 12_000
# Limit of the training, so that the demo takes at most ten minutes
MINUTES = 7.0
EPISODES = 1
PROCESSES = 2
# Changes to the configuration "have". Small networks and several environments allow more steps in this time, and
# DeepMDP's losses would have no encoders to train.
OVERRIDES = {
    "n_envs": 4,
    "train_freq": 1,
    "gradient_steps": 2,
    "learning_starts": 100,
    "auxiliary": None,
    "policy_kwargs": {"net_arch": [128, 128]},
}
RESULTS = (
    "model.zip",
    "havesac_demo.zip",
    "evaluation.csv",
    "learning_curve.png",
    "modality_weights.png",
    "drive.gif",
    "drive.html",
)
# Half as many cars as usual: less to learn, and faster to simulate
TRAFFIC = {"vehicles_count": 10}
SHOWN = "HardRainNight"
# 20 seconds
SHOWN_STEPS = 100
NAME = "this HAVESAC"


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
    Show the trained driver, train, evaluate and draw.

    :param steps: Number of training steps
    :param time_limit: Limit of the training [s]
    :param n_episodes: Number of evaluation episodes for each driver in each weather
    :param seed: Seed of the training; the evaluation always uses the same episodes
    :param out: Folder for the results
    :return: Evaluation of each driver
    """
    started = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    # An interrupted demo must not leave the results of an earlier one beside its own
    for name in RESULTS:
        (out / name).unlink(missing_ok=True)
    # Leave the cores to the processes of the environments
    th.set_num_threads(1)
    trained = pretrained("have")
    config = load_config("have", ENV_ID) | OVERRIDES
    config["env_kwargs"] = config["env_kwargs"] | TRAFFIC
    env_kwargs = evaluation_env_kwargs(config)
    with phase(f"Recording {SHOWN_STEPS / 5:g} seconds of a trained driver"):
        recording = record_episode(trained, ENV_ID, SHOWN, env_kwargs=env_kwargs, max_steps=SHOWN_STEPS)
        show(recording, out / "trained")

    config["learning_rate"] = Decay(config["learning_rate"], time_limit)
    config["callback"] = {"sb3_have.demo.DistanceLine": {"steps": steps}}
    run = Run(on_features(config), ENV_ID, out, seed=seed, eval_freq=0, save_freq=0, time_limit=time_limit)
    limits = f"{steps} steps or {time_limit / 60:g} minutes"
    with phase(f"Training on the trained driver's encoders for {limits} (press Ctrl-C once to stop earlier)"):
        try:
            run.train(steps, keep_checkpoint=False)
        finally:
            # Even after a second Ctrl-C
            if (out / "model.zip").exists():
                model = join(out, config)
        milliseconds = 1e3 * run.seconds / max(1, model.num_timesteps)
        print(f"{model.num_timesteps} steps in {run.seconds:.0f} s, {milliseconds:.0f} ms per step")

    drivers: dict[str, tuple[Predictor, str]] = {
        NAME: (model, ENV_ID),
        "trained HAVESAC": (trained, ENV_ID),
        "random": (RandomDriver(seed), ENV_ID),
        "straight at 20 m/s": (KeepStraightDriver(20.0), ENV_ID),
        "IDM/MOBIL": (RandomDriver(seed), RULES_ID),  # the environment ignores the actions
    }
    results = {}
    with phase(f"Evaluating {len(drivers)} drivers, {n_episodes} episodes in each of {len(WEATHERS)} weathers"):
        for name, (driver, env_id) in drivers.items():
            print(f"{name}:", flush=True)
            results[name] = evaluate(
                driver,
                env_id,
                WEATHERS,
                n_episodes,
                env_kwargs=env_kwargs,
                n_envs=PROCESSES,
                progress_bar=True,
                vec_env_cls=SubprocVecEnv,
            )
            table = pd.concat(results, names=["driver"]).reset_index(level="driver").reset_index(drop=True)
            table.to_csv(out / "evaluation.csv", index=False)
        print(format_table(results))
        print("ER: reward of an episode, D: its distance, in the mean over the episodes of a weather.")
        print("IDM/MOBIL knows where the traffic is. HAVESAC only sees images, and random and straight see nothing.")

    with phase("Drawing"):
        others = {name: float(rows["distance_mean"].mean()) for name, rows in results.items() if name != NAME}
        curve = plot_learning_curve(load_results(str(out)), references=others)
        curve.savefig(out / "learning_curve.png", dpi=120)
        recording = record_episode(model, ENV_ID, SHOWN, env_kwargs=env_kwargs)
        plot_modality_weights(recording).savefig(out / "modality_weights.png", dpi=120)
        show(recording, out / "drive")
    print(f"Everything is in {out} after {(time.monotonic() - started) / 60:.1f} minutes.")
    return results


def join(out: Path, config: dict[str, Any]) -> HAVESAC:
    """
    Replace ``model.zip``, which reads features, with ``havesac_demo.zip``, which has the encoders and reads images.

    :param out: Folder of the demo
    :param config: Configuration of the training on images
    :return: The model that reads images
    """
    env = make_training_env(ENV_ID, {**config, "n_envs": 1})
    model = with_encoders(HAVESAC.load(out / "model.zip"), config, env)
    env.close()
    write_atomically(out / "havesac_demo.zip", model.save)
    (out / "model.zip").unlink()
    return model


def show(recording: Recording, path: Path) -> None:
    """
    Write an episode as a GIF and as a page for a browser.

    :param recording: The episode
    :param path: Path of both files without their endings
    """
    write_gif(recording, path.with_suffix(".gif"))
    write_page(recording, path.with_suffix(".html"), ACTIONS)
    print(f"{recording.end['distance']:.0f} m: see {path}.gif, or open {path}.html in a browser")


class Decay:
    """
    Learning rate schedule that decays linearly to 0 over the steps or the time of a training, whichever ends first.

    :param initial_value: Initial learning rate
    :param seconds: Limit of the training [s], counted from the first call
    """

    def __init__(self, initial_value: float, seconds: float) -> None:
        self.initial_value, self.seconds = initial_value, seconds
        self.started: float | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "started": None}

    def __call__(self, progress_remaining: float) -> float:
        if self.started is None:
            self.started = time.monotonic()
        time_remaining = 1 - (time.monotonic() - self.started) / self.seconds
        return self.initial_value * max(0.0, min(progress_remaining, time_remaining))


class DistanceLine(BaseCallback):
    """
    Callback that shows the distance of the training episodes over the steps, as a line of small bars.

    The highest bar stands for the largest distance so far. In a terminal, the line is redrawn at the end of each
    episode; elsewhere it is printed after each tenth of the steps.

    :param steps: Number of training steps
    """

    BARS = " ▁▂▃▄▅▆▇█"
    WIDTH = 30

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps
        self.episodes: list[tuple[int, float]] = []
        self.printed = 0

    def _on_step(self) -> bool:
        ends = [info["distance"] for info in self.locals["infos"] if "episode" in info]
        self.episodes += [(self.num_timesteps, distance) for distance in ends]
        if sys.stdout.isatty():
            if ends:
                print(f"\r{self.line()}", end="", flush=True)
        elif (tenth := 10 * self.num_timesteps // self.steps) > self.printed:
            self.printed = tenth
            print(self.line(), flush=True)
        return True

    def _on_training_end(self) -> None:
        if sys.stdout.isatty():
            print()

    def line(self) -> str:
        """Return the line: steps, bars, and the mean distance of the last ten episodes."""
        sums, counts = np.zeros(self.WIDTH), np.zeros(self.WIDTH)
        for step, distance in self.episodes:
            column = min(self.WIDTH - 1, self.WIDTH * step // self.steps)
            sums[column] += distance
            counts[column] += 1
        means = sums / np.maximum(1, counts)
        levels = np.ceil(means / max(1.0, means.max()) * (len(self.BARS) - 1)).astype(int)
        last = [distance for _, distance in self.episodes[-10:]]
        mean = f"{np.mean(last):5.0f} m (mean of last {len(last)})" if last else ""
        return f"step {self.num_timesteps:6d} |{''.join(self.BARS[level] for level in levels)}| {mean}"


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
