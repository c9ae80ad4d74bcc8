"""Evaluate drivers in each weather, all of them over the same episodes."""

from __future__ import annotations

import sys
import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from tqdm import tqdm

from sb3_have.evaluation.episodes import Env, EpisodeQueue, Predictor, Step, Task, close, drive
from sb3_have.evaluation.wrapping import wrap_as_trained


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
    env_wrapper: Callable[[Env], Env] | None = None,
    vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
) -> pd.DataFrame:
    """
    Evaluate a driver in each weather.

    :param model: Anything with SB3's ``predict``; its environments are wrapped as in training, see
        :func:`~sb3_have.evaluation.wrapping.wrap_as_trained`
    :param env_id: Id of a registered environment that takes the keyword ``weather``
    :param weathers: Names of the weathers
    :param n_episodes: Episodes in each weather
    :param seed: Seed of the episodes: the same seed gives every driver the same episodes, whatever ``n_envs`` is.
        (A forward pass rounds differently in batches of different sizes, by about 1e-7 of an action, which may grow
        over an episode.)
    :param env_kwargs: Further keywords for ``gym.make``, the same as in training
    :param n_envs: Number of environments, with one ``predict`` for all of them
    :param deterministic: Whether to use deterministic actions
    :param progress_bar: Whether to show a progress bar over the episodes
    :param env_wrapper: Wrapper of every environment, such as
        ``partial(SensorFailure, modality="rgb", kind="black", severity=3)``; it must be picklable for ``SubprocVecEnv``
    :param vec_env_cls: ``SubprocVecEnv`` steps each environment in its own process
    :return: A row per weather: ``weather, episodes, return_mean, return_std, distance_mean, distance_std`` [m],
        ``steps_mean, crash_share, offroad_share`` (0..1). Standard deviations are over episodes (ddof=0, as in SB3).
        ``distance``, ``crashed`` and ``offroad`` come from the environment's ``info`` and are NaN if it lacks them.
    :raises ValueError: If the environment's observations do not fit the model, or a number is below 1
    """
    episodes = evaluate_episodes(
        model,
        env_id,
        weathers,
        n_episodes,
        seed,
        env_kwargs,
        n_envs,
        deterministic,
        progress_bar,
        env_wrapper,
        vec_env_cls,
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
    env_wrapper: Callable[[Env], Env] | None = None,
    vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
) -> pd.DataFrame:
    """
    Drive the episodes of :func:`evaluate`, which has the same parameters, without averaging them.

    :return: A row per episode: ``weather, seed, return, steps, distance, crashed, offroad``
    """
    tasks = episode_tasks(weathers, n_episodes, seed, env_wrapper)
    episodes = drive_tasks(model, env_id, tasks, env_kwargs, n_envs, deterministic, progress_bar, vec_env_cls)
    order = {weather: i for i, weather in enumerate(weathers)}
    return episodes.sort_values("weather", key=lambda names: names.map(order), kind="stable", ignore_index=True)


def episode_tasks(
    weathers: Sequence[str], n_episodes: int, seed: int, env_wrapper: Callable[[Env], Env] | None = None
) -> list[Task]:
    """List the episodes of :func:`evaluate`, which has the same parameters. Weathers vary fastest."""
    if n_episodes < 1 or not weathers:
        raise ValueError(f"need n_episodes >= 1 and a weather, got {n_episodes} and {list(weathers)}")
    # Every weather has its own traffic, the same for every driver: more situations for the same number of episodes
    seeds = {w: np.random.SeedSequence([seed, zlib.crc32(w.encode())]).generate_state(n_episodes) for w in weathers}
    return [Task(weather, int(seeds[weather][i]), env_wrapper) for i in range(n_episodes) for weather in weathers]


def drive_tasks(
    model: Predictor,
    env_id: str,
    tasks: Sequence[Task],
    env_kwargs: Mapping[str, Any] | None = None,
    n_envs: int = 1,
    deterministic: bool = True,
    progress_bar: bool = False,
    vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
    on_step: Callable[[Step], None] | None = None,
) -> pd.DataFrame:
    """
    Drive any episodes. Parameters that :func:`evaluate` has mean the same here.

    :param tasks: The episodes
    :param on_step: Called after each step; ``step.numbers`` are positions in ``tasks``
    :return: A row per episode as from :func:`evaluate_episodes`, in the order of ``tasks``
    """
    if n_envs < 1:
        raise ValueError(f"need n_envs >= 1, got {n_envs}")
    n_envs = min(n_envs, len(tasks))
    # Environments in one process share a queue, so that none waits while there is something left to drive;
    # those in other processes get fixed shares
    numbered = list(enumerate(tasks))
    shares = [numbered] if issubclass(vec_env_cls, DummyVecEnv) else [numbered[i::n_envs] for i in range(n_envs)]
    queues = [deque(share) for share in shares] * (n_envs // len(shares))
    make = partial(_make_env, env_id, dict(env_kwargs or {}))
    vec_env: VecEnv = vec_env_cls([partial(EpisodeQueue, make, queue) for queue in queues])
    outcomes: dict[int | None, dict[str, Any]] = {}
    try:
        vec_env = wrap_as_trained(vec_env, model)
        # rich, which draws SB3's progress bar, would swallow a bar written to stderr
        file = getattr(sys.stderr, "rich_proxied_file", None)
        with tqdm(total=len(tasks), unit="episode", disable=not progress_bar, file=file, leave=file is None) as bar:
            for step in drive(model, vec_env, deterministic):
                if on_step is not None:
                    on_step(step)
                for i in np.flatnonzero(step.dones).tolist():
                    outcomes[step.numbers[i]] = _outcome(step, i)
                    bar.update()
    finally:
        close(vec_env)
    return pd.DataFrame([{"weather": task.weather, "seed": task.seed, **outcomes[i]} for i, task in numbered])


def check_environment(
    env_id: str,
    weather: str,
    env_kwargs: Mapping[str, Any] | None = None,
    env_wrapper: Callable[[Env], Env] | None = None,
    model: Predictor | None = None,
) -> None:
    """
    Check that an environment can be made for :func:`evaluate`, whose parameters mean the same here.

    :param weather: Name of a weather
    :param model: A model that its observations have to fit
    :raises ValueError: If it cannot be made, or does not fit
    """
    try:
        vec_env = DummyVecEnv([partial(_make_env, env_id, dict(env_kwargs or {}), Task(weather, 0, env_wrapper))])
    except (TypeError, ValueError, gym.error.Error) as error:
        raise ValueError(
            f"{env_id} cannot be evaluated in the weather {weather!r}: {error}; fix its keywords, or train without "
            "evaluations (eval_freq=0)"
        ) from error
    try:
        if model is not None:
            wrap_as_trained(vec_env, model)
    finally:
        vec_env.close()


def _make_env(env_id: str, env_kwargs: dict[str, Any], task: Task) -> Env:
    env: Env = gym.make(env_id, weather=task.weather, **env_kwargs)
    return env if task.env_wrapper is None else task.env_wrapper(env)


def _outcome(step: Step, i: int) -> dict[str, Any]:
    """Return the row of an episode that ended with this step."""
    info = step.next_infos[i]
    facts = {key: float(info.get(key, np.nan)) for key in ("distance", "crashed", "offroad")}
    return {"return": step.returns[i] + step.rewards[i], "steps": int(step.t[i]) + 1, **facts}


def summarize(episodes: pd.DataFrame) -> pd.DataFrame:
    """
    Average episodes by weather.

    :param episodes: From :func:`evaluate_episodes`
    :return: A row per weather, as from :func:`evaluate`
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
    """
    Format evaluations side by side, as in the paper's Table 1: episode reward (ER) and distance (D) by weather.

    :param results: From :func:`evaluate`, by driver; all over the same weathers
    :return: A Markdown table of mean ± standard deviation, or just the value where there is one episode; the last rows
        are over all episodes
    :raises ValueError: If the weathers differ
    """
    weathers = [list(frame["weather"]) for frame in results.values()]
    if not weathers or any(names != weathers[0] for names in weathers):
        raise ValueError(f"need the same weathers for every driver, got {dict(zip(results, weathers, strict=True))}")
    rows = []
    for i, weather in enumerate([*weathers[0], "all"]):
        for label, name, digits in [("ER", "return", 1), ("D [m]", "distance", 0)]:
            cells = []
            for frame in results.values():
                mean, std = frame.loc[i, [f"{name}_mean", f"{name}_std"]] if weather != "all" else pooled(frame, name)
                counts = frame["episodes"].to_numpy(int)
                single = (counts.sum() if weather == "all" else counts[i]) == 1
                cells.append(f"{mean:.{digits}f}" if single else f"{mean:.{digits}f} ± {std:.{digits}f}")
            rows.append([weather if label == "ER" else "", label, *cells])
    return markdown_table(["weather", "", *results], rows)


def pooled(frame: pd.DataFrame, name: str) -> tuple[float, float]:
    """
    Compute mean and standard deviation over all episodes, from those of groups of episodes.

    :param frame: Columns ``episodes``, ``<name>_mean`` and ``<name>_std``
    :param name: "return" or "distance"
    """
    counts, means, stds = (frame[column].to_numpy(float) for column in ("episodes", f"{name}_mean", f"{name}_std"))
    mean = float(np.average(means, weights=counts))
    return mean, float(np.sqrt(np.average(stds**2 + (means - mean) ** 2, weights=counts)))


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table whose columns line up in plain text too."""
    table = [[str(cell).replace("|", "\\|") for cell in row] for row in [header, *rows]]
    widths = [max(3, *(len(row[column]) for row in table)) for column in range(len(header))]
    lines = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |" for row in table]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)
