"""Episodes with known weather and seed, one after the other, in the form in which a model reads them."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecTransposeImage


class Predictor(Protocol):
    """An SB3 model or policy, or a :class:`~sb3_have.envs.drivers.RuleDriver`."""

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]: ...


class Task(NamedTuple):
    """One episode to drive.

    :param weather: Weather in which to drive
    :param seed: Seed of the episode
    :param env_wrapper: Wrapper of the environment; tasks with the same object may share an environment
    """

    weather: str
    seed: int
    env_wrapper: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None


class EpisodeQueue(gym.Env[Any, Any]):
    """Given episodes one after the other; ``reset`` takes the next one. It idles at no cost when none is left.

    :param env_id: of the environment, made again when weather or wrapper change
    :param tasks: the episodes with their numbers; several environments of one process may share a queue
    :param env_kwargs: further keywords for ``gym.make``
    """

    def __init__(self, env_id: str, tasks: deque[tuple[int, Task]], env_kwargs: Mapping[str, Any]) -> None:
        leave_interrupts_to_parent()
        self._env_id, self._tasks, self._env_kwargs = env_id, tasks, dict(env_kwargs)
        self._env = self._make(tasks[0][1])
        self.number: int | None = None
        """Of the episode that is driven; None when none is left."""
        self.observation_space, self.action_space = self._env.observation_space, self._env.action_space
        self.render_mode, self.metadata = self._env.render_mode, self._env.metadata

    def _make(self, task: Task) -> gym.Env[Any, Any]:
        self._made_for = task
        env: gym.Env[Any, Any] = gym.make(self._env_id, weather=task.weather, **self._env_kwargs)
        return env if task.env_wrapper is None else task.env_wrapper(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.number = None
        if self._tasks:
            self.number, task = self._tasks.popleft()
            if task._replace(seed=self._made_for.seed) != self._made_for:
                self._env.close()
                self._env = self._make(task)
            self.observation, self._info = self._env.reset(seed=task.seed)
        return self.observation, self._info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.number is None:
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


def drive(model: Predictor, vec_env: VecEnv, deterministic: bool = True) -> Iterator[tuple[int, dict[str, Any]]]:
    """Drive the episodes of :class:`EpisodeQueue` environments, all environments by one ``predict``.

    Environments with an empty queue are left out of the batch, so the rows of a batch may become fewer, unless the
    model returns a recurrent ``state``, which has a row for every environment.

    :param model: The driver; a rule-based one gets every ``info`` through ``read_infos``
    :param vec_env: n environments
    :param deterministic: Whether to use deterministic actions
    :return: The number of each episode as it ends, and its ``return, steps, distance, crashed, offroad``; a value that
        the environment's ``info`` does not have is NaN
    """
    observations = vec_env.reset()
    infos: list[dict[str, Any]] = list(vec_env.unwrapped.reset_infos)
    numbers: list[int | None] = vec_env.get_attr("number")
    returns, steps = np.zeros(len(numbers)), np.zeros(len(numbers), dtype=int)
    action_shape = (len(numbers), *(vec_env.action_space.shape or ()))
    state, starts = None, np.ones(len(numbers), dtype=bool)
    while any(number is not None for number in numbers):
        rows = [i for i, number in enumerate(numbers) if number is not None or state is not None]
        if hasattr(model, "read_infos"):
            model.read_infos([infos[i] for i in rows])
        actions = np.zeros(action_shape, vec_env.action_space.dtype)  # environments may keep their row of it
        actions[rows], state = model.predict(
            _rows_of(observations, rows), state=state, episode_start=starts[rows], deterministic=deterministic
        )
        observations, rewards, starts, step_infos = vec_env.step(actions)
        returns += rewards
        steps += 1
        infos = list(step_infos)
        for i, number in enumerate(numbers):
            if number is None or not starts[i]:
                continue
            outcome = {key: float(infos[i].get(key, np.nan)) for key in ("distance", "crashed", "offroad")}
            yield number, {"return": returns[i], "steps": int(steps[i]), **outcome}
            returns[i], steps[i] = 0.0, 0
            # the newest info and number are those of the next episode, which the reset began
            infos[i], numbers[i] = vec_env.unwrapped.reset_infos[i], vec_env.get_attr("number", indices=i)[0]


def _rows_of(observations: Any, rows: list[int]) -> Any:
    if isinstance(observations, dict):
        return {key: part[rows] for key, part in observations.items()}
    return observations[rows]


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
