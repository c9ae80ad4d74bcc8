"""Episodes with known weather and seed, one after the other, in the form in which a model reads them."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecTransposeImage
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


def drive(
    model: Predictor, vec_env: VecEnv, quotas: list[int], deterministic: bool, bar: tqdm[Any]
) -> list[list[dict[str, Any]]]:
    """Drive episodes, one after the other in each environment.

    :param model: reads the observations; rule-based drivers are shown every ``info`` by ``read_infos``
    :param vec_env: of n environments
    :param quotas: how many episodes of each environment count, (n,)
    :param deterministic: whether the policy's mode is driven rather than a sample of it
    :param bar: moved on after each episode
    :return: the episodes of each environment in order, as many as its quota: ``return, steps, distance, crashed,
        offroad``; what the environment's ``info`` does not tell is NaN
    """
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
