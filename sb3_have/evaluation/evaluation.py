"""Drivers in each weather, over the same episodes for each; and statistics of their scores over training runs."""

from __future__ import annotations

import sys
import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from tqdm import tqdm

from sb3_have.evaluation.episodes import EpisodeQueue, Predictor, Task, drive, match_observations


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
    vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
) -> pd.DataFrame:
    """Return and distance of a driver in each weather.

    :param model: anything with SB3's ``predict``; frame stacking and image transposition follow from its
        ``observation_space``, rule-based drivers without one get the bare environment
    :param env_id: of a registered environment that takes the keyword ``weather``
    :param weathers: names of the weathers
    :param n_episodes: episodes in each weather
    :param seed: of the episodes; the same seed gives every driver the same episodes, whatever ``n_envs`` is. A forward
        pass rounds differently in batches of different sizes, by 1e-7 of an action, which may grow over an episode
    :param env_kwargs: further keywords for ``gym.make``, the same as in training
    :param n_envs: environments at a time, with one ``predict`` for all of them
    :param deterministic: Whether to use deterministic actions
    :param progress_bar: shown per episode, within a training below that of SB3's ``learn``
    :param env_wrapper: applied to every environment, e.g. ``partial(SensorFailure, modality="rgb", kind="black",
        severity=3)``; a function or class that can be pickled if ``vec_env_cls`` is ``SubprocVecEnv``
    :param vec_env_cls: ``SubprocVecEnv`` steps each environment in a process of its own
    :return: a row per weather: ``weather, episodes, return_mean, return_std, distance_mean, distance_std`` [m],
        ``steps_mean, crash_share, offroad_share`` (0..1). Standard deviations are over episodes (ddof=0, as SB3's);
        what the environment's ``info`` does not tell (``distance, crashed, offroad``) is NaN
    :raises ValueError: if the model's observation space cannot be made from the environment's, or counts are < 1
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
    env_wrapper: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None,
    vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
) -> pd.DataFrame:
    """The single episodes behind :func:`evaluate`, which has the same parameters.

    :return: a row per episode: ``weather, seed, return, distance, steps, crashed, offroad``
    """
    tasks = episode_tasks(weathers, n_episodes, seed, env_wrapper)
    episodes = drive_tasks(model, env_id, tasks, env_kwargs, n_envs, deterministic, progress_bar, vec_env_cls)
    order = {weather: i for i, weather in enumerate(weathers)}
    return episodes.sort_values("weather", key=lambda names: names.map(order), kind="stable", ignore_index=True)


def episode_tasks(
    weathers: Sequence[str],
    n_episodes: int,
    seed: int,
    env_wrapper: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None,
) -> list[Task]:
    """The episodes of :func:`evaluate_episodes`, which has the same parameters; weathers vary fastest."""
    if n_episodes < 1 or not weathers:
        raise ValueError(f"need n_episodes >= 1 and a weather, got {n_episodes} and {list(weathers)}")
    # Every weather has traffic of its own, the same for every driver: more situations for the same number of episodes.
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
) -> pd.DataFrame:
    """Any episodes, driven as by :func:`evaluate`, which has the same parameters.

    :param tasks: the episodes
    :return: as :func:`evaluate_episodes`, in the order of ``tasks``
    """
    if n_envs < 1:
        raise ValueError(f"need n_envs >= 1, got {n_envs}")
    n_envs = min(n_envs, len(tasks))
    # All tasks are driven to their end, so it does not matter which environment drives which. Environments of one
    # process share a queue, and none waits while there is something left; processes have fixed shares.
    numbered = list(enumerate(tasks))
    shares = [numbered] if issubclass(vec_env_cls, DummyVecEnv) else [numbered[i::n_envs] for i in range(n_envs)]
    queues = [deque(share) for share in shares] * (n_envs // len(shares))
    makers: list[Any] = [partial(EpisodeQueue, env_id, queue, dict(env_kwargs or {})) for queue in queues]
    vec_env: VecEnv = vec_env_cls(makers)
    done: dict[int, dict[str, Any]] = {}
    try:
        vec_env = match_observations(vec_env, model)
        # SB3's bar is drawn by rich, which swallows what others write to stderr as long as it is there
        below = getattr(sys.stderr, "rich_proxied_file", None)
        with tqdm(total=len(tasks), unit="episode", disable=not progress_bar, file=below, leave=below is None) as bar:
            for number, episode in drive(model, vec_env, deterministic):
                done[number] = episode
                bar.update()
    finally:
        vec_env.close()
    return pd.DataFrame([{"weather": task.weather, "seed": task.seed, **done[number]} for number, task in numbered])


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


# Statistics over runs, after Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice"
# (NeurIPS 2021). A table of scores has a row for each run (seed) and a column for each task (weather). Every statistic
# also takes a stack of tables, (..., n_runs, n_tasks), and gives one value for each: so the bootstrap needs no loop.


class Interval(NamedTuple):
    """A statistic with its confidence interval."""

    estimate: float
    lower: float
    upper: float


class Band(NamedTuple):
    """A curve with its confidence interval at each point, all of shape (n_points,)."""

    estimate: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def mean(scores: ArrayLike) -> Any:
    """Mean over runs and tasks.

    :param scores: (n_runs, n_tasks), or a stack of such tables (..., n_runs, n_tasks)
    :return: a float, or (...) for a stack
    :raises ValueError: if scores are not such a table, or not finite
    """
    return _table(scores).mean(axis=(-2, -1))


def median(scores: ArrayLike) -> Any:
    """Median over tasks of the mean over runs; parameters as for :func:`mean`."""
    return np.median(_table(scores).mean(axis=-2), axis=-1)


def iqm(scores: ArrayLike) -> Any:
    """Interquartile mean: of all runs on all tasks together, the mean without the lowest and the highest quarter.

    A quarter of n scores is ``n // 4``, so fewer than four are all kept. Parameters as for :func:`mean`.
    """
    table = _table(scores)
    pooled = np.sort(table.reshape(*table.shape[:-2], -1), axis=-1)
    cut = pooled.shape[-1] // 4
    return pooled[..., cut : pooled.shape[-1] - cut].mean(axis=-1)


def optimality_gap(scores: ArrayLike, target: float = 1.0) -> Any:
    """By how much scores fall short of a target, on average; what exceeds it does not make up for it.

    :param scores: as for :func:`mean`
    :param target: in the scores' unit
    :return: at least 0, a float, or (...) for a stack
    """
    return np.maximum(target - _table(scores), 0.0).mean(axis=(-2, -1))


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> Any:
    """How often a run of ``x`` beats one of ``y`` on the same task: mean over tasks of Mann-Whitney's U / (N M).

    :param x: (N, n_tasks) scores, or a stack (..., N, n_tasks)
    :param y: (M, n_tasks) scores on the same tasks, in a stack of the same shape
    :return: 0..1, ties count half; a float, or (...) for stacks
    :raises ValueError: if tasks differ in number, or scores are not tables or not finite
    """
    left, right = _table(x), _table(y)
    if left.shape[:-2] != right.shape[:-2] or left.shape[-1] != right.shape[-1]:
        raise ValueError(f"x and y need the same tasks (columns), got shapes {left.shape} and {right.shape}")
    left, right = left[..., :, None, :], right[..., None, :, :]
    wins = np.mean(left > right, axis=(-3, -2, -1))
    return wins + 0.5 * np.mean(left == right, axis=(-3, -2, -1))


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> np.ndarray:
    """Share of runs, over all tasks, that score above each threshold.

    :param scores: as for :func:`mean`
    :param thresholds: (n_thresholds,), in the scores' unit
    :return: (n_thresholds,), or (..., n_thresholds) for a stack, 0..1
    :raises ValueError: if thresholds are no vector of finite numbers, or scores no finite table
    """
    table, levels = _table(scores), np.asarray(thresholds, dtype=float)
    if levels.ndim != 1 or not levels.size or not np.isfinite(levels).all():
        raise ValueError(f"thresholds must be a vector of finite numbers, got {thresholds!r}")
    return np.stack([np.mean(table > level, axis=(-2, -1)) for level in levels], axis=-1)


def stratified_bootstrap(
    statistic: Callable[..., Any],
    *scores: ArrayLike,
    n_resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
    whole_runs: bool = False,
) -> Interval:
    """Percentile bootstrap that draws runs anew within each task, for each task and each table on its own.

    ``stratified_bootstrap(iqm, scores)`` and ``stratified_bootstrap(probability_of_improvement, x, y)`` are its uses.
    With few runs it is too narrow, as nothing lies beyond the best and the worst of them: for normal scores of one
    task, a 95% interval of the mean holds the truth in about 75% of cases with three runs, in 90% with eight. It is
    also too narrow where one agent's scores on several tasks rise and fall together, as it takes each for evidence of
    its own (which they are with agents trained on each task apart); ``whole_runs`` keeps them together.

    :param statistic: of tables, reduces their last two axes: one of this module's, or e.g.
        ``partial(optimality_gap, target=500.0)``
    :param scores: its tables (n_runs, n_tasks), at least two runs each
    :param n_resamples: of the bootstrap
    :param confidence: between 0 and 1
    :param seed: of the resampling
    :param whole_runs: whether rows are drawn rather than single scores: the same runs for every task
    :raises ValueError: if a table has one run only (nothing would vary), or is no finite table, or
        ``n_resamples`` or ``confidence`` are out of range
    """
    estimate, lower, upper = _bootstrap(statistic, scores, n_resamples, confidence, seed, whole_runs)
    return Interval(float(estimate), float(lower), float(upper))


def performance_profile_band(
    scores: ArrayLike,
    thresholds: ArrayLike,
    n_resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
    whole_runs: bool = False,
) -> Band:
    """:func:`performance_profile` with its pointwise confidence interval; parameters as there and as for
    :func:`stratified_bootstrap`."""
    profile = partial(performance_profile, thresholds=thresholds)
    return Band(*_bootstrap(profile, (scores,), n_resamples, confidence, seed, whole_runs))


def _bootstrap(
    statistic: Callable[..., Any],
    scores: Sequence[ArrayLike],
    n_resamples: int,
    confidence: float,
    seed: int,
    whole_runs: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimate, lower and upper bound, each of the statistic's shape."""
    if n_resamples < 1 or not 0 < confidence < 1:
        raise ValueError(f"need n_resamples >= 1 and 0 < confidence < 1, got {n_resamples} and {confidence}")
    tables = [_table(table) for table in scores]
    for table in tables:
        if table.ndim != 2:
            raise ValueError(f"the bootstrap takes single tables (n_runs, n_tasks), got shape {table.shape}")
        if len(table) < 2:
            raise ValueError(
                f"a confidence interval needs at least 2 runs, got scores of shape {table.shape}: "
                "resamples of a single run are all alike; add seeds, or report the estimate alone"
            )
    rng = np.random.default_rng(seed)
    resampled = []
    for table in tables:
        n_runs, n_tasks = table.shape
        runs = rng.integers(n_runs, size=(n_resamples, n_runs, 1 if whole_runs else n_tasks))
        resampled.append(table[runs, np.arange(n_tasks)])
    estimate, values = np.asarray(statistic(*tables)), np.asarray(statistic(*resampled))
    if values.shape != (n_resamples, *estimate.shape):
        raise ValueError(f"the statistic must reduce the last two axes, (..., n_runs, n_tasks); got {statistic}")
    tail = (1.0 - confidence) / 2
    lower, upper = np.quantile(values, [tail, 1.0 - tail], axis=0)
    return estimate, lower, upper


def _table(scores: ArrayLike) -> np.ndarray:
    """Scores as float64 (..., n_runs, n_tasks)."""
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim < 2 or 0 in table.shape:
        raise ValueError(
            f"scores must be a table (n_runs, n_tasks) with at least one of each, got shape {table.shape}; "
            "for a single task give scores[:, None]"
        )
    if not np.isfinite(table).all():
        raise ValueError(f"scores must be finite, got {np.count_nonzero(~np.isfinite(table))} NaN or infinite values")
    return table
