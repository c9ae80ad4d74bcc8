"""Wrap an environment as in the training of a model."""

from __future__ import annotations

import pickle
import zipfile
from copy import deepcopy
from pathlib import Path
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
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


def wrap_as_trained(vec_env: VecEnv, model: Any, normalizer: VecNormalize | None = None) -> VecEnv:
    """
    Wrap an environment so that a model reads it as in training.

    :param vec_env: The bare environment, images channel-last
    :param model: If it has its training environment, the wrappers of that one are repeated: ``VecFrameStack``,
        ``VecNormalize`` (with a copy of its statistics, which are not updated), ``VecTransposeImage`` and
        ``VecExtractDictObs``. Otherwise frames are stacked and images transposed as its ``observation_space`` requires.
        A rule-based driver, which has neither, gets the bare environment.
    :param normalizer: ``VecNormalize`` of the training, for a model without its environment
    :return: The wrapped environment; rewards are not normalised
    :raises ValueError: If the observations do not fit the model, or the training environment has another wrapper that
        changes them
    """
    expected = getattr(model, "observation_space", None)
    trained: VecEnv | None = getattr(model, "get_env", lambda: None)()
    layers: list[VecEnvWrapper] = []
    if trained is None:
        vec_env = vec_env if expected is None else _stack_and_transpose(vec_env, expected)
        layers = [] if normalizer is None else [normalizer]
    while isinstance(trained, VecEnvWrapper):
        layers.insert(0, trained)
        trained = trained.venv
    for layer in layers:
        vec_env = _repeat(layer, vec_env)
    if expected is not None and vec_env.observation_space != expected:
        raise ValueError(
            "the environment's observations do not fit the model; use the env_kwargs of the training (modalities, "
            f"image_size, ...)\n{_differences(expected, vec_env.observation_space)}"
        )
    return vec_env


def _stack_and_transpose(vec_env: VecEnv, expected: spaces.Space[Any]) -> VecEnv:
    """Stack frames if the model expects them stacked, and transpose images if that is needed to match its space."""
    n_stack = spaces.flatdim(expected) / spaces.flatdim(vec_env.observation_space)
    if n_stack > 1 and n_stack.is_integer():
        vec_env = VecFrameStack(vec_env, int(n_stack))
    space = vec_env.observation_space
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    if space != expected and any(map(is_image_space, parts)):
        transposed = VecTransposeImage(vec_env)
        return transposed if transposed.observation_space == expected else vec_env
    return vec_env


def _repeat(layer: VecEnvWrapper, vec_env: VecEnv) -> VecEnv:
    """Wrap an environment as ``layer`` wraps its own; a wrapper that leaves observations alone is left out."""
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
            f"{type(layer).__name__} changed the observations in training, and cannot be repeated here; "
            "use a gymnasium wrapper on the environment instead"
        )
    return vec_env


def _order(stacked: StackedObservations[Any]) -> str:
    return "first" if stacked.channels_first else "last"


def _differences(expected: spaces.Space[Any], given: spaces.Space[Any]) -> str:
    parts = [dict(s.spaces) if isinstance(s, spaces.Dict) else {"observation": s} for s in (expected, given)]
    keys = dict.fromkeys([*parts[0], *parts[1]])
    return "\n".join(f"  {key}: the model has {parts[0].get(key)}, the environment {parts[1].get(key)}" for key in keys)


def saved_normalizer(file: Path) -> VecNormalize | None:
    """
    Read the ``VecNormalize`` of a training from a file, which is unpickled.

    :param file: A checkpoint, or a file that ``VecNormalize.save`` wrote
    :return: None if a checkpoint has none
    :raises ValueError: If the file holds another pickled object
    """
    if not zipfile.is_zipfile(file):
        with file.open("rb") as pickled:
            saved = pickle.load(pickled)
        if not isinstance(saved, VecNormalize):
            raise ValueError(f"{file} holds a {type(saved).__name__}, not a VecNormalize")
        return saved
    with zipfile.ZipFile(file) as archive:
        # Avoid reading the replay buffer where there is nothing to find
        if b"norm_obs" not in archive.read("state.pkl"):
            return None
    layers = read_archive(file)[2]["environments"].layers
    states, *_ = loads(layers.pickled, [_Absent()] * len(layers.names))
    for state in states:
        # Subclasses of VecNormalize have other names
        if state.keys() >= {"norm_obs", "clip_obs", "ret_rms"}:
            normalizer = VecNormalize.__new__(VecNormalize)
            vars(normalizer).update(state)
            return normalizer
    return None


class _Absent:
    """Stands for the environments that a checkpoint refers to, and for all their attributes."""

    def __getattr__(self, name: str) -> _Absent:
        return self
