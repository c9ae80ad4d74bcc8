"""An environment of one's own, wrapped as that of a model's training was."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from stable_baselines3.common.vec_env import (
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_have.common.episodes import match_observations


def wrap_as_trained(vec_env: VecEnv, model: Any) -> VecEnv:
    """Wrap an environment so that a model reads it as it reads its own.

    :param vec_env: the bare environment
    :param model: a model that has its training environment, whose ``VecFrameStack``, ``VecNormalize`` (a copy of its
        statistics, which no longer change), ``VecTransposeImage`` and ``VecExtractDictObs`` are put on in the same
        order; without one, see :func:`~sb3_have.common.episodes.match_observations`
    :return: rewards are not normalised
    :raises ValueError: if the result has not the observation space of the model, or another wrapper of the training
        changed the observations
    """
    trained: VecEnv | None = getattr(model, "get_env", lambda: None)()
    if trained is None:
        return match_observations(vec_env, model)
    layers = []
    while isinstance(trained, VecEnvWrapper):
        layers.append(trained)
        trained = trained.venv
    for layer in reversed(layers):
        vec_env = _same_layer(layer, vec_env)
    if vec_env.observation_space != model.observation_space:
        raise ValueError(
            f"the environment's observations do not fit the model:\n  the model has {model.observation_space}\n"
            f"  the environment {vec_env.observation_space}, wrapped as in training; make it as that of the training"
        )
    return vec_env


def _same_layer(layer: VecEnvWrapper, vec_env: VecEnv) -> VecEnv:
    """``vec_env`` with one more wrapper, or as it is if the wrapper does not change observations."""
    if isinstance(layer, VecFrameStack):
        stacked = layer.stacked_obs
        order: Any = {key: _order(part) for key, part in getattr(stacked, "sub_stacked_observations", {}).items()}
        return VecFrameStack(vec_env, stacked.n_stack, order or _order(stacked))
    if isinstance(layer, VecTransposeImage):
        return VecTransposeImage(vec_env)
    if isinstance(layer, VecExtractDictObs):
        return VecExtractDictObs(vec_env, layer.key)
    if isinstance(layer, VecNormalize):
        options = {name: getattr(layer, name) for name in ("norm_obs", "norm_obs_keys", "clip_obs", "epsilon")}
        normalized = VecNormalize(vec_env, training=False, norm_reward=False, **options)
        if layer.norm_obs:
            normalized.obs_rms = deepcopy(layer.obs_rms)
        return normalized
    if layer.observation_space != layer.venv.observation_space:
        raise ValueError(
            f"{type(layer).__name__} changed the observations of the training and is not known here; "
            "do the same by a gymnasium wrapper on the environment"
        )
    return vec_env


def _order(stacked: StackedObservations[Any]) -> str:
    return "first" if stacked.channels_first else "last"
