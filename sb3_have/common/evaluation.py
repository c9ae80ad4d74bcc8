"""Statistics of a driver in each weather: the same episodes for every driver, each counted once."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from tqdm import tqdm

from sb3_have.common.episodes import EpisodeQueue, Predictor, Task, drive, match_observations


def evaluate(
    model: Predictor,
    env_id: str,
    weathers: Sequence[str],
    n_episodes: int = 10,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
    n_envs: int = 1,
    deterministic: bool = True,
    progress_bar: bool = False,
    env_wrapper: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None,
) -> pd.DataFrame:
    """Return and distance of a driver in each weather.

    :param model: anything with SB3's ``predict``; frame stacking and image transposition follow from its
        ``observation_space``, rule-based drivers without one get the bare environment
    :param env_id: of a registered environment that takes the keyword ``weather``
    :param weathers: names of the weathers
    :param n_episodes: episodes in each weather
    :param seed: of the episodes; the same seed gives every driver the same episodes, whatever
        ``n_envs`` is
    :param env_kwargs: further keywords for ``gym.make``, the same as in training
    :param n_envs: environments at a time, each in a process of its own when there are several
    :param deterministic: whether the policy's mode is driven rather than a sample of it
    :param progress_bar: shown per episode
    :param env_wrapper: applied to every environment, e.g. ``partial(SensorFailure, modality="rgb", kind="black",
        severity=3)``; a function or class that can be pickled if there are several environments
    :return: a row per weather: ``weather, episodes, return_mean, return_std, distance_mean, distance_std`` [m],
        ``steps_mean, crash_share, offroad_share`` (0..1). Standard deviations are over episodes (ddof=0, as SB3's);
        what the environment's ``info`` does not tell (``distance, crashed, offroad``) is NaN
    :raises ValueError: if the model's observation space cannot be made from the environment's, or counts are < 1
    """
    episodes = evaluate_episodes(
        model, env_id, weathers, n_episodes, seed, env_kwargs, n_envs, deterministic, progress_bar, env_wrapper
    )
    return summarize(episodes)


def evaluate_episodes(
    model: Predictor,
    env_id: str,
    weathers: Sequence[str],
    n_episodes: int = 10,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
    n_envs: int = 1,
    deterministic: bool = True,
    progress_bar: bool = False,
    env_wrapper: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None,
) -> pd.DataFrame:
    """The single episodes behind :func:`evaluate`, which has the same parameters.

    :return: a row per episode: ``weather, seed, return, distance, steps, crashed, offroad``
    """
    if n_episodes < 1 or n_envs < 1 or not weathers:
        raise ValueError(f"need n_episodes, n_envs >= 1 and a weather, got {n_episodes}, {n_envs}, {list(weathers)}")
    # Every weather has traffic of its own, the same for every driver: more situations for the same number of episodes.
    seeds = {w: np.random.SeedSequence([seed, zlib.crc32(w.encode())]).generate_state(n_episodes) for w in weathers}
    # Weathers vary fastest, so that the shares of the environments are alike.
    tasks = [Task(weather, int(seeds[weather][i])) for i in range(n_episodes) for weather in weathers]
    n_envs = min(n_envs, len(tasks))
    # A fixed share for each environment: taking whatever ends first would favour short episodes.
    shares = [tasks[i::n_envs] for i in range(n_envs)]
    makers = [partial(EpisodeQueue, env_id, share, dict(env_kwargs or {}), env_wrapper) for share in shares]
    vec_env: VecEnv = SubprocVecEnv(makers) if n_envs > 1 else DummyVecEnv(makers)  # type: ignore[arg-type]
    try:
        vec_env = match_observations(vec_env, model)
        with tqdm(total=len(tasks), unit="episode", disable=not progress_bar) as bar:
            done_by_env = drive(model, vec_env, [len(share) for share in shares], deterministic, bar)
    finally:
        vec_env.close()
    rows = [
        {"weather": task.weather, "seed": task.seed, **episode}
        for share, episodes in zip(shares, done_by_env, strict=True)
        for task, episode in zip(share, episodes, strict=True)
    ]
    order = {weather: i for i, weather in enumerate(weathers)}
    rows.sort(key=lambda row: order[row["weather"]])
    return pd.DataFrame(rows)


def summarize(episodes: pd.DataFrame) -> pd.DataFrame:
    """A row per weather, as :func:`evaluate` returns it.

    :param episodes: from :func:`evaluate_episodes`
    """
    rows = []
    for weather, group in episodes.groupby("weather", sort=False):
        row: dict[str, Any] = {"weather": weather, "episodes": len(group)}
        for name in ("return", "distance"):
            row[f"{name}_mean"], row[f"{name}_std"] = group[name].mean(), group[name].std(ddof=0)
        row["steps_mean"] = group["steps"].mean()
        row["crash_share"], row["offroad_share"] = group["crashed"].mean(), group["offroad"].mean()
        rows.append(row)
    return pd.DataFrame(rows)


def format_table(results: Mapping[str, pd.DataFrame]) -> str:
    """Drivers side by side in the shape of the paper's Table 1: episode reward (ER) and distance (D) per weather.

    :param results: from :func:`evaluate`, by driver; all over the same weathers
    :return: a Markdown table of mean ± standard deviation, the last rows over all episodes
    :raises ValueError: if the weathers differ
    """
    weathers = [list(frame["weather"]) for frame in results.values()]
    if not weathers or any(names != weathers[0] for names in weathers):
        raise ValueError(f"need the same weathers for every driver, got {dict(zip(results, weathers, strict=True))}")
    table = [["weather", "", *results]]
    for i, weather in enumerate([*weathers[0], "all"]):
        for label, name, digits in [("ER", "return", 1), ("D [m]", "distance", 0)]:
            cells = []
            for frame in results.values():
                mean, std = _pooled(frame, name) if weather == "all" else frame.loc[i, [f"{name}_mean", f"{name}_std"]]
                cells.append(f"{mean:.{digits}f} ± {std:.{digits}f}")
            table.append([weather if label == "ER" else "", label, *cells])
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    lines = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |" for row in table]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)


def _pooled(frame: pd.DataFrame, name: str) -> tuple[float, float]:
    """Mean and standard deviation over the episodes of all weathers, from those of each."""
    weight, mean = frame["episodes"].to_numpy(float), frame[f"{name}_mean"].to_numpy(float)
    pooled = float(np.average(mean, weights=weight))
    variance = np.average(frame[f"{name}_std"].to_numpy(float) ** 2 + (mean - pooled) ** 2, weights=weight)
    return pooled, float(np.sqrt(variance))
