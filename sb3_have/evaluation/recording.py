"""One episode kept whole: what was seen and done, how the modalities were weighted, what the critic thought of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from tqdm import tqdm

from sb3_have.evaluation.episodes import Predictor
from sb3_have.evaluation.wrapping import wrap_as_trained

Env = gym.Env[Any, Any]


@dataclass
class Recording:
    """An episode of T steps; entry t is what the driver knew when it chose action t, and what it got for it.

    :param weather: of the episode; empty if the environment has none
    :param seconds: length of a step [s]; None if the environment does not tell (``metadata["render_fps"]``)
    :param observations: the environment's own, T dicts (or arrays) with images as it gives them, not stacked
    :param pictures: what ``render()`` gave, T uint8 arrays (H, W, 3); none if it was not asked to, or cannot
    :param weights: of each modality, (T,); empty if the model has none
    :param infos: T dicts, those before the actions
    :param end: the info after the last action, which tells the whole distance, a crash or why it ended
    :param actions: (T, A), in the environment's units
    :param rewards: (T,), not normalised; reward t is for action t
    :param values: the critic's parts at what was seen and done, of K twins and d modalities: ``q`` (K, T) and, where
        the critic has them, ``q_global`` (K, T), ``q_local`` (K, d, T) in the order of ``weights``, ``q_lve`` (K, T);
        empty if the model has no ``critic.decompose``
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
        """(T,): when each action was chosen, in seconds or, where their length is unknown, in steps."""
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
    """Drive an episode and keep it.

    :param model: as for :func:`~sb3_have.evaluation.evaluation.evaluate`, under ``VecNormalize`` too if it has its
        environment, or ``normalizer`` is given; its ``modality_weights`` and ``critic.decompose``, if any, are recorded
    :param env: id of an environment, or one that was made, which stays open: frame stack and normalisation follow from
        the model
    :param weather: of the episode, for ids of environments that have the keyword; None leaves it to ``env_kwargs``
    :param seed: of the episode
    :param env_kwargs: further keywords for ``gym.make``, the same as in training
    :param max_steps: to record at most
    :param env_wrapper: applied to the environment, e.g. ``partial(SensorFailure, modality="rgb", kind="black")``
    :param deterministic: Whether to use deterministic actions
    :param render: whether to keep the environment's own pictures, if it can give them: a film shows them beside the
        images of the sensors
    :param progress_bar: shown per step
    :param normalizer: whose statistics normalise what a model without its environment sees
    :raises ValueError: if the environment's observations do not fit the model's
    :raises TypeError: if ``env`` is vectorized, or is made and ``weather`` or ``env_kwargs`` are given
    """
    keywords = {**(env_kwargs or {}), **({} if weather is None else {"weather": weather})}
    made = _make(env, keywords, render)
    try:
        made = made if env_wrapper is None else env_wrapper(made)
        episode = _Episode(made, seed)
        vec_env = wrap_as_trained(DummyVecEnv([lambda: episode]), model, normalizer)
        limit = min((n for n in (max_steps, getattr(episode.spec, "max_episode_steps", None)) if n), default=None)
        with tqdm(total=limit, unit="step", disable=not progress_bar) as bar:
            recording = _drive(model, vec_env, episode, weather, max_steps, deterministic, render, bar)
    finally:
        if isinstance(env, str):
            made.close()
    return recording


def _drive(
    model: Any,
    vec_env: VecEnv,
    episode: _Episode,
    weather: str | None,
    max_steps: int | None,
    deterministic: bool,
    render: bool,
    bar: tqdm[Any],
) -> Recording:
    observation = vec_env.reset()
    info, done, state = vec_env.unwrapped.reset_infos[0], False, None
    fps = episode.metadata.get("render_fps")
    recording = Recording(str(info.get("weather", weather or "")), seconds=1.0 / fps if fps else None)
    weights: list[Mapping[str, np.ndarray]] = []
    values: list[Mapping[str, np.ndarray]] = []
    actions: list[np.ndarray] = []
    rewards: list[float] = []
    weigh = weighing(model)
    while not done and len(actions) != max_steps:
        recording.observations.append(deepcopy(episode.observation))
        recording.infos.append(info)
        if render and episode.render_mode == "rgb_array":
            recording.pictures.append(np.array(episode.render()))
        if weigh is not None:
            weights.append(weigh(observation))
        if hasattr(model, "read_infos"):
            model.read_infos([info])
        start = np.array([not actions])
        action, state = model.predict(observation, state=state, episode_start=start, deterministic=deterministic)
        if hasattr(getattr(model, "critic", None), "decompose"):
            values.append(_values(model, observation, action))
        observation, _, dones, (info,) = vec_env.step(action)
        actions.append(np.array(action[0]))
        rewards.append(episode.reward)
        done = bool(dones[0])
        bar.update()
    recording.actions, recording.rewards = np.array(actions), np.array(rewards)
    recording.weights, recording.values = _joined(weights), _joined(values)
    recording.end = {key: value for key, value in info.items() if key != "terminal_observation"}
    return recording


def weighing(model: Any) -> Callable[[Any], Mapping[str, np.ndarray]] | None:
    """``model.modality_weights``, or None if the model has no weights: the global critic alone has none."""
    if getattr(getattr(model, "critic", None), "value_estimation", None) == "gve":
        return None
    method: Callable[[Any], Mapping[str, np.ndarray]] | None = getattr(model, "modality_weights", None)
    return method


def _values(model: Any, observation: Any, action: np.ndarray) -> dict[str, np.ndarray]:
    tensors, _ = model.policy.obs_to_tensor(observation)
    scaled = np.reshape(model.policy.scale_action(action), (len(action), -1))
    with th.no_grad():
        parts = model.critic.decompose(tensors, th.as_tensor(scaled, dtype=th.float32, device=model.device))
    return {name: part.float().cpu().numpy() for name, part in parts.items() if name != "weights"}


def _joined(steps: list[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Joined along time, the last axis."""
    return {key: np.concatenate([step[key] for step in steps], axis=-1) for key in (steps or [{}])[0]}


def _make(env: str | Env, keywords: dict[str, Any], render: bool) -> Env:
    if isinstance(env, str):
        mode = {"render_mode": "rgb_array"} if render and _renders(env) else {}
        made: Env = gym.make(env, **{**keywords, **mode})
        return made
    if isinstance(env, VecEnv):
        raise TypeError("env is vectorized: give the environment inside, the model's wrappers are put on by themselves")
    if keywords:
        raise TypeError(f"{', '.join(keywords)}: for an environment id; this environment is made already")
    return env


def _renders(env_id: str) -> bool:
    """Whether an environment can render to arrays; it need not be made to know."""
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)
    entry_point = gym.spec(name).entry_point
    creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return "rgb_array" in getattr(creator, "metadata", {}).get("render_modes", ())


class _Episode(gym.Env[Any, Any]):
    """One episode of an environment, which is left as it is when that is over: ``DummyVecEnv`` begins another."""

    def __init__(self, env: Env, seed: int) -> None:
        self.env, self._seed, self._begun = env, seed, False
        # VecNormalize writes into the space that it is given
        self.observation_space, self.action_space = deepcopy(env.observation_space), deepcopy(env.action_space)
        self.render_mode, self.metadata, self.spec = env.render_mode, env.metadata, env.spec
        self.observation: Any = None
        self.reward = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if not self._begun:
            self.observation, self._info = self.env.reset(seed=self._seed)
            self._begun = True
        return self.observation, self._info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        self.reward = float(reward)
        return self.observation, self.reward, terminated, truncated, info

    def render(self) -> Any:
        return self.env.render()
