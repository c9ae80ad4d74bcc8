"""
Make the trained drivers of the package, and check the distances that their JSON files state.

    python -m benchmarks.pretrained make RUN NAME --commit COMMIT --command "python -m sb3_have.train ..."
    python -m benchmarks.pretrained check NAME

RUN is the folder of a run of ``sb3_have.train`` or of the benchmark. ``check`` drives the same episodes again, and
fails if their mean distance is outside of the interval in the JSON file.
"""

from __future__ import annotations

import argparse
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_have import MultiModalPolicy
from sb3_have.benchmark.provenance import PACKAGES, cpu_model
from sb3_have.configuration import evaluation_env_kwargs
from sb3_have.envs.weather import WEATHERS
from sb3_have.evaluation.evaluation import evaluate_episodes
from sb3_have.evaluation.statistics import mean, stratified_bootstrap
from sb3_have.trained import PretrainedPolicy, pretrained, save_driver
from sb3_have.watch import environment, load_model, model_file

ENV_ID = "HighwayVision-v0"
# Episodes that no training has evaluated in
SEED = 4_000_000
EPISODES = 5


def drive(name: str, policy: PretrainedPolicy, processes: int, episodes: int, seed: int) -> pd.DataFrame:
    """Drive the driver's episodes: a row per episode."""
    print(f"{name}: {episodes} episodes in each of {len(WEATHERS)} weathers")
    return evaluate_episodes(
        policy,
        ENV_ID,
        WEATHERS,
        episodes,
        seed,
        policy.env_kwargs,
        n_envs=processes,
        progress_bar=True,
        vec_env_cls=SubprocVecEnv,
    )


def summary(episodes: pd.DataFrame) -> dict[str, Any]:
    """Summarize episodes as the JSON file does: means and 95% bootstrap intervals of the distance [m]."""
    distances = {weather: group["distance"].to_numpy() for weather, group in episodes.groupby("weather", sort=False)}
    intervals = {weather: stratified_bootstrap(mean, values[:, None]) for weather, values in distances.items()}
    intervals["all"] = stratified_bootstrap(mean, np.stack(list(distances.values()), axis=1))
    return {
        "seed": SEED,
        "episodes_per_weather": EPISODES,
        "distance_mean_lower_upper": {name: np.round(interval, 1).tolist() for name, interval in intervals.items()},
        "crash_share": round(float(episodes["crashed"].mean()), 3),
    }


def make(run: Path, name: str, commit: str, command: str, processes: int) -> None:
    """Write the files of a driver, drive it, and add its distances."""
    model, settings = load_model(model_file(run))
    assert isinstance(model.policy, MultiModalPolicy)
    _, env_kwargs, _ = environment(model, settings, ENV_ID, "have")
    card: dict[str, Any] = {
        "env_id": ENV_ID,
        "env_kwargs": evaluation_env_kwargs({"env_kwargs": env_kwargs}),
        "training": {
            "commit": commit,
            "command": command,
            "steps": model.num_timesteps,
            "seed": model.seed,
            "machine": cpu_model(),
            "versions": {package: version(package) for package in PACKAGES},
        },
    }
    save_driver(model.policy, name, card)
    card["evaluation"] = summary(drive(name, pretrained(name), processes, EPISODES, SEED))
    save_driver(model.policy, name, card)
    print(card["evaluation"])


def check(name: str, processes: int) -> bool:
    """Return whether the mean distance is within the interval of the JSON file."""
    policy = pretrained(name)
    card = policy.card["evaluation"]
    episodes = drive(name, policy, processes, card["episodes_per_weather"], card["seed"])
    found = summary(episodes)["distance_mean_lower_upper"]["all"][0]
    stated, lower, upper = card["distance_mean_lower_upper"]["all"]
    print(f"{name}: {found:.1f} m, stated {stated:.1f} m [{lower:.1f}, {upper:.1f}]")
    return bool(lower <= found <= upper)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--processes", type=int, default=2, help="environments, each in its own process")
    actions = parser.add_subparsers(dest="action", required=True)
    making = actions.add_parser("make")
    making.add_argument("run", type=Path)
    making.add_argument("name")
    making.add_argument("--commit", required=True, help="commit of the training")
    making.add_argument("--command", required=True, help="command of the training")
    actions.add_parser("check").add_argument("name")
    args = parser.parse_args()
    if args.action == "make":
        make(args.run, args.name, args.commit, args.command, args.processes)
    elif not check(args.name, args.processes):
        sys.exit(1)


if __name__ == "__main__":
    main()
