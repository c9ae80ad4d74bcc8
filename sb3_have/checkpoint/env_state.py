"""The state of environments and all their wrappers in the middle of an episode."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper

from sb3_have.checkpoint.archive import dumps, loads

# Attributes of an environment and of a VecEnv that describe how they were made, or belong to other processes
NO_STATE = ("spec", "_cached_spec", "render_mode")
NO_VEC_STATE = ("class_attributes", "remotes", "work_remotes", "processes", "render_mode")

# Modules whose windows and surfaces an environment creates again when it draws
DRAWING = ("pygame", "highway_env.envs.common.graphics")

# What is kept of an environment that cannot be pickled
RANDOM = (np.random.Generator, np.random.RandomState, random.Random, spaces.Space)


class LayersState(NamedTuple):
    """State of an environment and its wrappers: their classes, their attributes, and what cannot be pickled."""

    names: list[str]
    pickled: bytes
    lost: list[str]


class EnvironmentsState(NamedTuple):
    """State of a ``VecEnv``; ``workers`` has that of environments in other processes."""

    layers: LayersState
    workers: list[LayersState]

    @property
    def lost(self) -> list[str]:
        """What could not be pickled, by class and attribute; if there is anything, new episodes begin."""
        return [name for state in (self.layers, *self.workers) for name in state.lost]


class ResumableEnv(gym.Wrapper[Any, Any, Any, Any]):
    """
    Gives checkpoints access to an environment in a worker process of ``SubprocVecEnv``.

    It has to be the outermost wrapper, and has no other effect. ``DummyVecEnv`` does not need it::

        SubprocVecEnv([lambda: ResumableEnv(Monitor(gym.make("HighwayVision-v0")))] * 4)

    In the Zoo's configurations: ``env_wrapper: sb3_have.checkpoint.ResumableEnv``.
    """

    def checkpoint_state(self) -> LayersState:
        """Return the state of the environment and of the process's random numbers."""
        return _capture(_gym_layers(self), (random.getstate(), np.random.get_state()))

    def restore_checkpoint_state(self, state: LayersState) -> str:
        """Restore the state of :meth:`checkpoint_state`, and return an error instead of ending the worker."""
        try:
            python, numpy = _restore(_gym_layers(self), state)
        except ValueError as error:
            return str(error)
        random.setstate(python)
        np.random.set_state(numpy)
        return ""


def environments_state(vec_env: VecEnv, shared: Any = None) -> EnvironmentsState:
    """
    Capture everything that decides what environments do next.

    All attributes of all wrappers and environments are pickled together, so that shared objects stay shared. Windows
    and Monitor's open file are left out.

    :param vec_env: Environments with any wrappers
    :param shared: Other objects that may share parts with them
    :return: The state; where it cannot be pickled, ``lost`` names the reason, and only random
        generators of environments in this process are kept
    """
    state, base = _capture(_vec_layers(vec_env), shared), vec_env.unwrapped
    if _are_resumable(base):
        return EnvironmentsState(state, base.env_method("checkpoint_state"))
    if not isinstance(base, DummyVecEnv):
        state.lost.append(f"environments of {type(base).__name__}, which need ResumableEnv as the outermost wrapper")
    return EnvironmentsState(state, [])


def restore_environments(vec_env: VecEnv, state: EnvironmentsState) -> Any:
    """
    Restore the state of environments.

    :param vec_env: Environments made in the same way; the state overrides other settings
    :param state: Result of :func:`environments_state`
    :return: The objects that were ``shared``
    :raises ValueError: If they differ in number, or have other wrappers
    """
    if len(state.workers) not in (0, vec_env.num_envs):
        raise ValueError(f"the checkpoint has {len(state.workers)} environments, but {vec_env.num_envs} were passed")
    shared = _restore(_vec_layers(vec_env), state.layers)
    base = vec_env.unwrapped
    if state.workers and not _are_resumable(base):
        raise ValueError("the checkpoint has environments in ResumableEnv, which has to be the outermost wrapper here")
    for index, worker in enumerate(state.workers):
        if error := base.env_method("restore_checkpoint_state", worker, indices=index)[0]:
            raise ValueError(error)
    return shared


def _are_resumable(base: VecEnv) -> bool:
    """Whether environments are in worker processes, with ``ResumableEnv`` as the outermost wrapper."""
    if not isinstance(base, SubprocVecEnv) or not all(base.env_is_wrapped(ResumableEnv)):
        return False
    return set(base.env_method("class_name")) == {ResumableEnv.__name__}


def _vec_layers(vec_env: VecEnv) -> list[Any]:
    """List the wrappers and environments of a ``VecEnv`` in this process, outermost first."""
    layers: list[Any] = [vec_env]
    while isinstance(layers[-1], VecEnvWrapper):
        layers.append(layers[-1].venv)
    for env in layers[-1].envs if isinstance(layers[-1], DummyVecEnv) else ():
        layers += _gym_layers(env)
    return layers


def _gym_layers(env: gym.Env[Any, Any]) -> list[Any]:
    """List an environment and its wrappers, outermost first."""
    layers = [env]
    while isinstance(layers[-1], gym.Wrapper):
        layers.append(layers[-1].env)
    return layers


def _names(layers: Sequence[Any]) -> list[str]:
    return [type(layer).__qualname__ for layer in layers]


def _capture(layers: Sequence[Any], shared: Any) -> LayersState:
    names, states = _names(layers), [_attributes(layer) for layer in layers]
    known = [set(vars(layer)) for layer in layers]
    try:
        return LayersState(names, dumps((states, known, shared), layers), [])
    except Exception:  # objects of the environment may raise anything
        pass
    # Keep the statistics of VecNormalize and the random generators
    lost = []
    for name, layer, state in zip(names, layers, states, strict=True):
        for attribute, value in list(state.items()):
            if failure := _failure(value, layers):
                lost.append(f"{name}.{attribute} ({failure})")
            if failure or not (isinstance(layer, VecEnv) or isinstance(value, RANDOM)):
                del state[attribute]
    return LayersState(names, dumps((states, known, shared), layers), lost)


def _attributes(layer: Any) -> dict[str, Any]:
    """Return the attributes that belong to the state of an environment or wrapper."""
    no_state = NO_VEC_STATE if isinstance(layer, VecEnv) else NO_STATE
    return {
        name: value
        for name, value in vars(layer).items()
        if name not in no_state
        and not isinstance(value, ResultsWriter)
        and not type(value).__module__.startswith(DRAWING)
    }


def _failure(value: Any, layers: Sequence[Any]) -> str:
    """Return why an object cannot be pickled, or an empty string."""
    try:
        dumps(value, layers)
    except Exception as error:
        # Remove addresses, so that Python shows a repeated warning once
        return re.sub(r" at 0x[0-9a-fA-F]+", "", f"{type(error).__name__}: {error}")
    return ""


def _restore(layers: Sequence[Any], state: LayersState) -> Any:
    if (names := _names(layers)) != state.names:
        raise ValueError(
            f"the checkpoint was saved with the wrappers {' > '.join(state.names)}, but the environment has "
            f"{' > '.join(names)}; wrap it as in the training"
        )
    states, known, shared = loads(state.pickled, layers)
    for layer, attributes, known_names in zip(layers, states, known, strict=True):
        if not state.lost:
            # Forget what the environment has computed and kept (functools.cached_property) from its old state
            for name in vars(layer).keys() - known_names:
                del vars(layer)[name]
        vars(layer).update(attributes)
    return shared
