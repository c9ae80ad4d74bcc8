"""Statistics of a driver in each weather: the same episodes for every driver, each counted once."""

from __future__ import annotations

import multiprocessing
import signal
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
import pandas as pd
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecTransposeImage
from tqdm import tqdm


class Predictor(Protocol):
    """An SB3 model or policy, or a :class:`~sb3_have.common.drivers.RuleDriver`."""

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]: ...


class Task(NamedTuple):
    """One episode to drive."""

    weather: str
    seed: int


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
            done_by_env = _drive(model, vec_env, [len(share) for share in shares], deterministic, bar)
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


def _drive(
    model: Predictor, vec_env: VecEnv, quotas: list[int], deterministic: bool, bar: tqdm[Any]
) -> list[list[dict[str, Any]]]:
    """Episodes of each environment in order, as many as its quota."""
    episodes: list[list[dict[str, Any]]] = [[] for _ in quotas]
    returns, steps = np.zeros(len(quotas)), np.zeros(len(quotas), dtype=int)
    observations = vec_env.reset()
    infos: list[dict[str, Any]] = list(vec_env.unwrapped.reset_infos)
    state, starts = None, np.ones(len(quotas), dtype=bool)
    while any(len(done) < quota for done, quota in zip(episodes, quotas, strict=True)):
        if hasattr(model, "read_infos"):
            model.read_infos(infos)
        actions, state = model.predict(observations, state=state, episode_start=starts, deterministic=deterministic)
        observations, rewards, starts, step_infos = vec_env.step(actions)
        returns += rewards
        steps += 1
        # after the end of an episode the newest info is that of the reset
        infos = [vec_env.unwrapped.reset_infos[i] if done else step_infos[i] for i, done in enumerate(starts)]
        for i in np.flatnonzero(starts):
            if len(episodes[i]) < quotas[i]:
                told = {key: float(step_infos[i].get(key, np.nan)) for key in ("distance", "crashed", "offroad")}
                episodes[i].append({"return": returns[i], "steps": int(steps[i]), **told})
                bar.update()
            returns[i], steps[i] = 0.0, 0
    return episodes


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


class EpisodeQueue(gym.Env[Any, Any]):
    """Given episodes one after the other; ``reset`` moves on to the next. It idles at no cost when all are over.

    :param env_id: of the environment, made anew when the weather changes
    :param tasks: weather and seed of each episode
    :param env_kwargs: further keywords for ``gym.make``
    :param env_wrapper: applied to each environment that is made
    """

    def __init__(
        self,
        env_id: str,
        tasks: Sequence[Task],
        env_kwargs: Mapping[str, Any],
        env_wrapper: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None,
    ) -> None:
        leave_interrupts_to_parent()
        self._env: gym.Env[Any, Any]
        self._env_wrapper = env_wrapper
        self._env_id, self._tasks, self._env_kwargs = env_id, list(tasks), dict(env_kwargs)
        self._next, self._weather = 0, ""
        self._make(self._tasks[0].weather)
        self.observation_space, self.action_space = self._env.observation_space, self._env.action_space
        self.render_mode, self.metadata = self._env.render_mode, self._env.metadata

    def _make(self, weather: str) -> None:
        if weather != self._weather:
            if self._weather:
                self._env.close()
            env: gym.Env[Any, Any] = gym.make(self._env_id, weather=weather, **self._env_kwargs)
            self._env = env if self._env_wrapper is None else self._env_wrapper(env)
            self._weather = weather

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._idle = self._next == len(self._tasks)
        if not self._idle:
            task = self._tasks[self._next]
            self._make(task.weather)
            self.observation, self._info = self._env.reset(seed=task.seed)
            self._next += 1
        return self.observation, self._info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._idle:
            return self.observation, 0.0, False, False, self._info
        self.observation, reward, terminated, truncated, info = self._env.step(action)
        return self.observation, float(reward), terminated, truncated, info

    def render(self) -> Any:
        return self._env.render()

    def close(self) -> None:
        self._env.close()


def leave_interrupts_to_parent() -> None:
    """In a worker process, ignore Ctrl-C: the terminal sends it to all, and the parent ends its workers itself."""
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def match_observations(vec_env: VecEnv, model: Any) -> VecEnv:
    """Wrap an environment so that a model can read its observations.

    :param vec_env: the bare environment, images channel-last
    :param model: its ``observation_space`` decides: frames are stacked (``VecFrameStack``) and images transposed
        (``VecTransposeImage``) where that makes the spaces equal; without one, nothing is done
    :raises ValueError: if they cannot be made equal, or the model's environment normalises observations by a
        ``VecNormalize`` (a model loaded without its environment does not tell)
    """
    wanted: spaces.Space[Any] | None = getattr(model, "observation_space", None)
    if wanted is None:
        return vec_env
    normalizer = getattr(model, "get_vec_normalize_env", lambda: None)()
    if normalizer is not None and normalizer.norm_obs:
        raise ValueError(
            "the model was trained under VecNormalize, whose statistics evaluate() does not have; "
            "use stable_baselines3.common.evaluation.evaluate_policy with the saved VecNormalize"
        )
    n_stack = _frame_count(vec_env.observation_space, wanted)
    if n_stack > 1:
        vec_env = VecFrameStack(vec_env, n_stack)
    if vec_env.observation_space != wanted and _has_image(vec_env.observation_space):
        vec_env = VecTransposeImage(vec_env)
    if vec_env.observation_space != wanted:
        raise _mismatch(vec_env.observation_space, wanted)
    return vec_env


def _parts(space: spaces.Space[Any]) -> dict[str, spaces.Space[Any]]:
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}


def _has_image(space: spaces.Space[Any]) -> bool:
    return any(len(part.shape or ()) == 3 for part in _parts(space).values())


def _frame_count(space: spaces.Space[Any], wanted: spaces.Space[Any]) -> int:
    """How many frames of ``space`` make ``wanted``."""
    given, asked = _parts(space), _parts(wanted)
    if set(given) != set(asked):
        raise _mismatch(space, wanted)
    counts = {np.prod(asked[key].shape or (1,)) / np.prod(given[key].shape or (1,)) for key in given}
    count = counts.pop()
    if counts or count < 1 or count % 1:
        raise _mismatch(space, wanted)
    return int(count)


def _mismatch(space: spaces.Space[Any], wanted: spaces.Space[Any]) -> ValueError:
    given, asked = _parts(space), _parts(wanted)
    lines = [f"  {key}: the model has {asked.get(key)}, the environment {given.get(key)}" for key in {**asked, **given}]
    return ValueError(
        "the model's observations cannot be made from the environment's by stacking frames; "
        "give evaluate() the env_kwargs of the training (modalities, image_size, ...)\n" + "\n".join(lines)
    )
