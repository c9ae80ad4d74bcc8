"""One episode kept whole: what was seen, what was shown, how the modalities were weighted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_have.common.episodes import EpisodeQueue, Predictor, Task, match_observations


@dataclass
class Recording:
    """An episode of T steps; entry t is what the driver knew when it chose action t.

    :param weather: of the episode
    :param seconds: length of a step [s]
    :param observations: the environment's own, T dicts (or arrays) with channel-last images, not stacked
    :param pictures: what ``render()`` gave, T uint8 arrays (H, W, 3)
    :param weights: of each modality, (T,); empty if the model has none
    :param infos: T dicts
    """

    weather: str
    seconds: float
    observations: list[Any] = field(default_factory=list)
    pictures: list[np.ndarray] = field(default_factory=list)
    weights: dict[str, np.ndarray] = field(default_factory=dict)
    infos: list[dict[str, Any]] = field(default_factory=list)


def record_episode(
    model: Predictor,
    env_id: str,
    weather: str,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
    max_steps: int | None = None,
) -> Recording:
    """Drive an episode deterministically and keep it.

    :param model: as for :func:`~sb3_have.common.evaluation.evaluate`; its ``modality_weights``, if any, are recorded
    :param env_id: of an environment that takes the keyword ``weather`` and renders ``"rgb_array"``
    :param weather: of the episode
    :param seed: of the episode
    :param env_kwargs: further keywords for ``gym.make``, the same as in training
    :param max_steps: to record at most
    """
    queue = EpisodeQueue(env_id, [Task(weather, seed)], {**(env_kwargs or {}), "render_mode": "rgb_array"})
    recording = Recording(weather, seconds=1.0 / queue.metadata.get("render_fps", 5))
    vec_env = match_observations(DummyVecEnv([lambda: queue]), model)
    observation = vec_env.reset()
    info, done, state = vec_env.unwrapped.reset_infos[0], False, None
    weights: list[dict[str, np.ndarray]] = []
    weigh = getattr(model, "modality_weights", None)
    if getattr(getattr(model, "critic", None), "value_estimation", None) == "gve":
        weigh = None  # the global critic alone has no weights
    while not done and len(recording.infos) != max_steps:
        recording.observations.append(queue.observation)
        recording.pictures.append(np.array(queue.render()))
        recording.infos.append(info)
        if weigh is not None:
            weights.append(weigh(observation))
        if hasattr(model, "read_infos"):
            model.read_infos([info])
        start = np.array([len(recording.infos) == 1])
        action, state = model.predict(observation, state=state, episode_start=start, deterministic=True)
        observation, _, dones, (info,) = vec_env.step(action)
        done = bool(dones[0])
    vec_env.close()
    recording.weights = {key: np.concatenate([step[key] for step in weights]) for key in (weights or [{}])[0]}
    return recording
