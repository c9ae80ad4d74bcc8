"""Record one episode: observations, actions and rewards, the weights of the modalities, and the critic's values."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from tqdm import tqdm

from sb3_have.evaluation.episodes import Env, EpisodeQueue, Predictor, Task, drive
from sb3_have.evaluation.wrapping import wrap_as_trained


@dataclass
class Recording:
    """
    An episode of T steps. Entry t is what the driver knew when it chose action t, and the reward for that action.

    :param weather: Weather of the episode; empty if the environment has none
    :param seconds: Length of a step [s]; None if the environment has no ``metadata["render_fps"]``
    :param observations: T observations of the environment itself: not stacked, images as the environment gives them
    :param pictures: T uint8 arrays (H, W, 3) from ``render()``; empty if not requested or not supported
    :param weights: The weight of each modality, (T,); empty if the model has none
    :param infos: T dicts, each from before the action
    :param end: The ``info`` after the last action, with the whole distance, a crash or the reason of the end
    :param actions: (T, A), in the environment's units
    :param rewards: (T,), not normalised
    :param values: The critic's values of K twins and d modalities: ``q`` (K, T) and, where the critic has them,
        ``q_global`` (K, T), ``q_local`` (K, d, T) in the order of ``weights``, ``q_lve`` (K, T); empty if the model has
        no ``critic.decompose``
    """

    weather: str
    seconds: float | None
    observations: list[Any] = field(default_factory=list)
    pictures: list[np.ndarray] = field(default_factory=list)
    weights: dict[str, np.ndarray] = field(default_factory=dict)
    infos: list[dict[str, Any]] = field(default_factory=list)
    end: dict[str, Any] = field(default_factory=dict)
    actions: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    rewards: np.ndarray = field(default_factory=lambda: np.empty(0))
    values: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def times(self) -> np.ndarray:
        """(T,): the time of each action, in seconds or, where the length of a step is unknown, in steps."""
        return np.arange(len(self.infos)) * (1.0 if self.seconds is None else self.seconds)

    @property
    def time_label(self) -> str:
        """Name and unit of :attr:`times`."""
        return "step" if self.seconds is None else "time [s]"


def record_episode(
    model: Predictor,
    env: str | Env,
    weather: str | None = None,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
    max_steps: int | None = None,
    env_wrapper: Callable[[Env], Env] | None = None,
    deterministic: bool = True,
    render: bool = False,
    progress_bar: bool = False,
    normalizer: VecNormalize | None = None,
) -> Recording:
    """
    Drive one episode and record it.

    :param model: Anything with SB3's ``predict``; the environment is wrapped as in training, see
        :func:`~sb3_have.evaluation.wrapping.wrap_as_trained`. ``modality_weights`` and ``critic.decompose`` are
        recorded if the model has them.
    :param env: Id of an environment, or a (not vectorized) environment, which is left open
    :param weather: Weather of the episode, for ids of environments that take it; None leaves it to ``env_kwargs``
    :param seed: Seed of the episode
    :param env_kwargs: Further keywords for ``gym.make``, the same as in training
    :param max_steps: Maximum number of steps to record
    :param env_wrapper: Wrapper of the environment, such as ``partial(SensorFailure, modality="rgb", kind="black")``
    :param deterministic: Whether to use deterministic actions
    :param render: Whether to record the pictures of ``render()`` too, if the environment supports it
    :param progress_bar: Whether to show a progress bar over the steps
    :param normalizer: ``VecNormalize`` of the training, for a model without its environment
    :raises ValueError: If the environment's observations do not fit the model
    :raises TypeError: If ``env`` is vectorized, or ``weather`` or ``env_kwargs`` are given with an environment
    """
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps={max_steps}: expected a whole number >= 1, or None for the whole episode")
    keywords = {**(env_kwargs or {}), **({} if weather is None else {"weather": weather})}
    made = _make(env, keywords, render)
    try:
        made = made if env_wrapper is None else env_wrapper(made)
        episode = _RecordedEpisode(made, seed, render)
        vec_env = wrap_as_trained(DummyVecEnv([lambda: episode]), model, normalizer)
        limits = (max_steps, getattr(episode.spec, "max_episode_steps", None))
        with tqdm(total=min(filter(None, limits), default=None), unit="step", disable=not progress_bar) as bar:
            return _record(model, vec_env, episode, weather, max_steps, deterministic, bar)
    finally:
        if isinstance(env, str):
            made.close()


def _record(
    model: Any,
    vec_env: VecEnv,
    episode: _RecordedEpisode,
    weather: str | None,
    max_steps: int | None,
    deterministic: bool,
    bar: tqdm[Any],
) -> Recording:
    fps = episode.metadata.get("render_fps")
    recording = Recording(weather or "", seconds=1.0 / fps if fps else None)
    actions: list[np.ndarray] = []
    weights: list[Mapping[str, np.ndarray]] = []
    values: list[Mapping[str, np.ndarray]] = []
    weigh = weighing(model)
    for step in drive(model, vec_env, deterministic):
        actions.append(np.array(step.actions[0]))
        recording.infos.append(step.infos[0])
        recording.end = {key: value for key, value in step.next_infos[0].items() if key != "terminal_observation"}
        if weigh is not None:
            weights.append(weigh(step.observations))
        if hasattr(getattr(model, "critic", None), "decompose"):
            values.append(_values(model, step.observations, step.actions))
        bar.update()
        if len(actions) == max_steps:
            break
    recording.weather = str(recording.infos[0].get("weather", recording.weather))
    recording.observations, recording.pictures = episode.observations, episode.pictures
    recording.actions, recording.rewards = np.array(actions), np.array(episode.rewards)
    recording.weights, recording.values = _join(weights), _join(values)
    return recording


def weighing(model: Any) -> Callable[[Any], Mapping[str, np.ndarray]] | None:
    """Return ``model.modality_weights``, or None if the model has no weights, as with ``value_estimation="gve"``."""
    if getattr(getattr(model, "critic", None), "value_estimation", None) == "gve":
        return None
    method: Callable[[Any], Mapping[str, np.ndarray]] | None = getattr(model, "modality_weights", None)
    return method


def _values(model: Any, observations: Any, actions: np.ndarray) -> dict[str, np.ndarray]:
    policy = getattr(model, "policy", model)
    tensors, _ = policy.obs_to_tensor(observations)
    scaled = np.reshape(policy.scale_action(actions), (len(actions), -1))
    with th.no_grad():
        parts = model.critic.decompose(tensors, th.as_tensor(scaled, dtype=th.float32, device=model.device))
    return {name: part.float().cpu().numpy() for name, part in parts.items() if name != "weights"}


def _join(steps: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenate along time, the last axis."""
    return {key: np.concatenate([step[key] for step in steps], axis=-1) for key in (steps or [{}])[0]}


def _make(env: str | Env, keywords: dict[str, Any], render: bool) -> Env:
    if isinstance(env, str):
        made: Env = gym.make(env, **keywords)
        if render and "rgb_array" in made.metadata.get("render_modes", ()):
            made.close()
            made = gym.make(env, **{**keywords, "render_mode": "rgb_array"})
        return made
    if isinstance(env, VecEnv):
        raise TypeError("env is vectorized: pass a single environment, which will be wrapped as in training")
    if keywords:
        raise TypeError(f"{', '.join(keywords)}: can only be used with the id of an environment")
    return env


class _RecordedEpisode(EpisodeQueue):
    """
    One episode of an environment, with the environment's own observations, rewards and pictures.

    ``DummyVecEnv`` resets it at the end, which leaves the environment as it is because the queue is empty.
    """

    def __init__(self, env: Env, seed: int, render: bool) -> None:
        super().__init__(lambda task: env, deque([(0, Task("", seed))]))
        self._renders = render and env.render_mode == "rgb_array"
        self.observations: list[Any] = []
        self.rewards: list[float] = []
        self.pictures: list[np.ndarray] = []

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.observations.append(deepcopy(self.observation))
        if self._renders:
            self.pictures.append(np.array(self.render()))
        result = super().step(action)
        self.rewards.append(result[1])
        return result
