"""An environment of one's own, wrapped as that of a model's training was."""

from __future__ import annotations

import pickle
import zipfile
from copy import deepcopy
from pathlib import Path
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

from sb3_have.checkpoint.archive import loads, read_archive
from sb3_have.evaluation.episodes import match_observations


def wrap_as_trained(vec_env: VecEnv, model: Any, normalizer: VecNormalize | None = None) -> VecEnv:
    """Wrap an environment so that a model reads it as it reads its own.

    :param vec_env: the bare environment
    :param model: a model that has its training environment, whose ``VecFrameStack``, ``VecNormalize`` (a copy of its
        statistics, which no longer change), ``VecTransposeImage`` and ``VecExtractDictObs`` are put on in the same
        order; without one, see :func:`~sb3_have.evaluation.episodes.match_observations`
    :param normalizer: of the training of a model without its environment; see :func:`saved_normalizer`
    :return: rewards are not normalised
    :raises ValueError: if the result has not the observation space of the model, another wrapper of the training
        changed the observations, or the normalizer's statistics are of other shapes, as those of one within
        ``VecFrameStack`` are
    """
    trained: VecEnv | None = getattr(model, "get_env", lambda: None)()
    if trained is None:
        vec_env = match_observations(vec_env, model)
        return vec_env if normalizer is None else _same_layer(normalizer, vec_env)
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


def saved_normalizer(file: Path) -> VecNormalize | None:
    """The ``VecNormalize`` that a model was trained under, without its environment.

    :param file: a checkpoint, or what ``VecNormalize.save`` wrote; it is unpickled. Of a subclass, a checkpoint gives
        the statistics as VecNormalize
    :return: None if a checkpoint has none
    :raises ValueError: if something else is pickled in the file
    """
    if not zipfile.is_zipfile(file):
        with file.open("rb") as pickled:
            saved = pickle.load(pickled)
        if not isinstance(saved, VecNormalize):
            raise ValueError(f"{file} holds a {type(saved).__name__}, not a VecNormalize")
        return saved
    with zipfile.ZipFile(file) as archive:
        if b"norm_obs" not in archive.read("state.pkl"):
            return None  # which spares us the replay buffer
    layers = read_archive(file)[2]["environments"].layers
    states, *_ = loads(layers.pickled, [_Absent()] * len(layers.names))
    for state in states:
        if state.keys() >= {"norm_obs", "clip_obs", "ret_rms"}:  # subclasses have other names
            normalizer = VecNormalize.__new__(VecNormalize)
            vars(normalizer).update(state)
            return normalizer
    return None


class _Absent:
    """An environment, and all that it has, for those who need neither."""

    def __getattr__(self, name: str) -> _Absent:
        return self


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
            if (found := _shapes(layer)) != (expected := _shapes(normalized)):
                raise ValueError(
                    f"the statistics of VecNormalize have the shapes {found}, and the observations that the model "
                    f"reads {expected}: in training it stood elsewhere among the wrappers (within VecFrameStack or "
                    "VecTransposeImage), or was another one; load the model with its environment"
                )
            normalized.obs_rms = deepcopy(layer.obs_rms)
        return normalized
    if layer.observation_space != layer.venv.observation_space:
        raise ValueError(
            f"{type(layer).__name__} changed the observations of the training and is not known here; "
            "do the same by a gymnasium wrapper on the environment"
        )
    return vec_env


def _shapes(normalizer: VecNormalize) -> dict[str, tuple[int, ...]]:
    statistics: Any = normalizer.obs_rms
    parts = statistics if isinstance(statistics, dict) else {"observation": statistics}
    return {key: part.mean.shape for key, part in parts.items()}


def _order(stacked: StackedObservations[Any]) -> str:
    return "first" if stacked.channels_first else "last"
