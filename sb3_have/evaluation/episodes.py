"""The one loop that drives episodes, and the environment that works through a queue of them."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

Env = gym.Env[Any, Any]


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
    """
    One episode to drive.

    :param weather: Weather of the episode
    :param seed: Seed of the episode
    :param env_wrapper: Wrapper of the environment; tasks with the same wrapper object may share an environment
    """

    weather: str
    seed: int
    env_wrapper: Callable[[Env], Env] | None = None


class EpisodeQueue(gym.Env[Any, Any]):
    """
    An environment that works through a queue of episodes.

    ``reset`` takes the next episode. Once the queue is empty, the environment idles: it returns its last observation
    without stepping.

    :param make: Makes the environment of a task; it is called again when the weather or the wrapper changes
    :param tasks: The episodes with their numbers; environments in the same process may share a queue
    """

    def __init__(self, make: Callable[[Task], Env], tasks: deque[tuple[int, Task]]) -> None:
        leave_interrupts_to_parent()
        self._make, self._tasks, self._made_for = make, tasks, tasks[0][1]
        self._env = make(self._made_for)
        # Number of the current episode, None if there is none left
        self.number: int | None = None
        # Copy the spaces because VecNormalize writes into the one that it gets
        self.observation_space = deepcopy(self._env.observation_space)
        self.action_space = deepcopy(self._env.action_space)
        self.render_mode, self.metadata, self.spec = self._env.render_mode, self._env.metadata, self._env.spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.number = None
        if self._tasks:
            self.number, task = self._tasks.popleft()
            if task._replace(seed=self._made_for.seed) != self._made_for:
                self._env.close()
                self._env, self._made_for = self._make(task), task
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
    """Ignore Ctrl-C in a worker process: the terminal sends it to all processes, and the parent stops its workers."""
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def close(vec_env: VecEnv) -> None:
    """
    Close environments, also if an exception interrupted one of their steps.

    ``SubprocVecEnv.close`` would then wait for ever for the workers whose answer has been read, so they are terminated.

    :param vec_env: The environments
    """
    workers = vec_env.unwrapped
    if isinstance(workers, SubprocVecEnv) and workers.waiting:
        for process in workers.processes:
            process.terminate()
            process.join()
        workers.closed = True
    vec_env.close()


class Step(NamedTuple):
    """
    One step of n environments. Entries of environments without an episode have no meaning.

    :param numbers: Number of the episode that each environment drives, None if it has none left
    :param t: Steps of each episode before this one, shape (n,)
    :param returns: Return of each episode before this step, shape (n,)
    :param observations: The batch that the model read
    :param infos: The ``info`` of each environment before the step
    :param actions: What the model did, shape (n,) and that of an action
    :param rewards: Shape (n,)
    :param dones: Whether each episode ended with this step, shape (n,)
    :param next_infos: The ``info`` of each environment after the step; of the old episode, if it ended
    """

    numbers: list[int | None]
    t: np.ndarray
    returns: np.ndarray
    observations: Any
    infos: list[dict[str, Any]]
    actions: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray
    next_infos: list[dict[str, Any]]


def drive(model: Predictor, vec_env: VecEnv, deterministic: bool = True) -> Iterator[Step]:
    """
    Drive all episodes of :class:`EpisodeQueue` environments, with one ``predict`` for all environments.

    Environments whose queue is empty are left out of the batch, unless the model returns a recurrent ``state``, which
    has a row for every environment.

    :param model: The driver; a rule-based one gets every ``info`` through ``read_infos``
    :param vec_env: n environments, wrapped for the model
    :param deterministic: Whether to use deterministic actions
    :return: Every step, right after the environments took it
    """
    observations = vec_env.reset()
    infos = list(vec_env.unwrapped.reset_infos)
    numbers: list[int | None] = vec_env.get_attr("number")
    t, returns = np.zeros(len(numbers), dtype=int), np.zeros(len(numbers))
    state, starts = None, np.ones(len(numbers), dtype=bool)
    while any(number is not None for number in numbers):
        # Choose the actions; the array is new in every step because environments may keep their row of it
        rows = [i for i, number in enumerate(numbers) if number is not None or state is not None]
        if hasattr(model, "read_infos"):
            model.read_infos([infos[i] for i in rows])
        actions = np.zeros((len(numbers), *(vec_env.action_space.shape or ())), vec_env.action_space.dtype)
        batch = _select(observations, rows)
        actions[rows], state = model.predict(batch, state, starts[rows], deterministic=deterministic)

        # Step the environments
        next_observations, rewards, dones, next_infos = vec_env.step(actions)
        next_infos = list(next_infos)
        yield Step(numbers, t, returns, observations, infos, actions, rewards, dones, next_infos)

        # SB3 has reset the environments whose episode ended: they drive the next one
        t, returns, infos, numbers = t + 1, returns + rewards, [*next_infos], [*numbers]
        for i in np.flatnonzero(dones).tolist():
            t[i], returns[i], infos[i] = 0, 0.0, vec_env.unwrapped.reset_infos[i]
            numbers[i] = vec_env.get_attr("number", indices=i)[0]
        observations, starts = next_observations, dones


def _select(observations: Any, rows: list[int]) -> Any:
    if isinstance(observations, dict):
        return {key: value[rows] for key, value in observations.items()}
    return observations[rows]
