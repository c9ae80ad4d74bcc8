"""The complete state of environments, with all wrappers, in the middle of an episode."""

from __future__ import annotations

import inspect
import random
import re
from collections.abc import Sequence
from numbers import Number
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper

from sb3_have.checkpoint.archive import dumps, loads

NO_STATE = ("spec", "_cached_spec", "render_mode")
"""Attributes of an environment that tell how it was made."""

NO_VEC_STATE = ("class_attributes", "remotes", "work_remotes", "processes", "render_mode")
"""Attributes of a ``VecEnv`` that tell its class and how it draws, or lead to other processes."""

DRAWING = ("pygame", "highway_env.envs.common.graphics")
"""Modules whose windows and surfaces an environment makes anew when it draws."""

RANDOM = (np.random.Generator, np.random.RandomState, random.Random, spaces.Space)


class LayersState(NamedTuple):
    """Of some environments and wrappers."""

    names: list[str]
    pickled: bytes
    lost: list[str]  # what cannot be pickled; not empty: the rest is of no use but for what is random in it
    settings: Sequence[dict[str, Any]] = ()  # what they were made with, as far as it can be compared


class EnvironmentsState(NamedTuple):
    """Of a ``VecEnv`` and all that is in it."""

    layers: LayersState
    workers: list[Any]  # of environments in other processes

    @property
    def lost(self) -> list[str]:
        """What could not be pickled, by class and attribute; if there is anything, the episodes begin anew."""
        return [
            *self.layers.lost,
            *(name for state in self.workers if isinstance(state, LayersState) for name in state.lost),
            *(OUT_OF_REACH for state in self.workers[:1] if not isinstance(state, LayersState)),
        ]


OUT_OF_REACH = "environments of SubprocVecEnv whose outermost wrapper is not sb3_have.checkpoint.env_state.ResumableEnv"


class ResumableEnv(gym.Wrapper[Any, Any, Any, Any]):
    """
    Lets a checkpoint have the state of an environment in a worker process of ``SubprocVecEnv``; it does nothing else,
    and ``DummyVecEnv`` needs none of it. It is the outermost wrapper::

        SubprocVecEnv([lambda: ResumableEnv(Monitor(gym.make("HighwayVision-v0")))] * 4)

    and in the Zoo's configurations ``env_wrapper: sb3_have.checkpoint.env_state.ResumableEnv``.
    """

    def checkpoint_state(self) -> LayersState:
        """State of the environment and of the process's own random numbers."""
        return _capture(_gym_layers(self), (random.getstate(), np.random.get_state()))

    def checkpoint_layers(self) -> list[tuple[str, dict[str, Any]]]:
        """Classes that the state is of, outermost first, and what they were made with."""
        return _described(_gym_layers(self))

    def restore_checkpoint_state(self, state: LayersState) -> None:
        """
        :raises ValueError: if the state is of another environment
        """
        python, numpy = _restore(_gym_layers(self), state)
        random.setstate(python)
        np.random.set_state(numpy)


def environments_state(vec_env: VecEnv, shared: Any = None) -> EnvironmentsState:
    """All that decides what environments do next.

    Every attribute of every wrapper and environment is pickled, together, so that what they share stays shared; but
    for windows to draw in and Monitor's open file.

    :param vec_env: with any wrappers
    :param shared: further objects that may share parts with them
    :return: can be pickled whatever the environments are; where their state cannot, it is named in ``lost`` and the
        random generators are all there is
    """
    layers = _vec_layers(vec_env)
    base, workers = layers[-1], []
    if isinstance(base, DummyVecEnv):
        layers = [*layers, *(layer for env in base.envs for layer in _gym_layers(env))]
    elif isinstance(base, SubprocVecEnv):
        resumable = _are_resumable(base)
        workers = base.env_method("checkpoint_state") if resumable else base.get_attr("np_random")
    state = _capture(layers, shared)
    if not isinstance(base, DummyVecEnv | SubprocVecEnv):
        state.lost.append(f"{type(base).__name__} (its environments are out of reach)")
    return EnvironmentsState(state, workers)


def restore_environments(vec_env: VecEnv, state: EnvironmentsState) -> Any:
    """Put environments into a state.

    :param vec_env: made like those that the state is of. Other settings would be overridden by the state, and are
        refused where that can be told: of what gymnasium knows to have been given to ``gym.make`` and to its own
        wrappers, numbers, text, None and sequences of these are compared; dicts, sets, arrays and objects are not
    :param state: of :func:`environments_state`
    :return: what was ``shared``
    :raises ValueError: if they have other wrappers or settings, or are more or fewer
    """
    layers = _vec_layers(vec_env)
    base = layers[-1]
    if isinstance(base, DummyVecEnv):
        layers = [*layers, *(layer for env in base.envs for layer in _gym_layers(env))]
    if len(state.workers) not in (0, vec_env.num_envs):
        raise ValueError(f"a checkpoint of {len(state.workers)} environments was given {vec_env.num_envs}")
    shared = _restore(layers, state.layers)
    if any(isinstance(worker, LayersState) for worker in state.workers):
        # here, as an error in a worker would be its end
        if not _are_resumable(base):
            raise ValueError(
                f"the checkpoint has the state of environments in ResumableEnv, and was given {OUT_OF_REACH}"
            )
        for described, worker in zip(base.env_method("checkpoint_layers"), state.workers, strict=True):
            _check_made_alike(worker, described)
    for index, worker in enumerate(state.workers):
        if isinstance(worker, LayersState):
            base.env_method("restore_checkpoint_state", worker, indices=index)
        else:
            base.set_attr("np_random", worker, indices=index)
    return shared


def _are_resumable(base: SubprocVecEnv) -> bool:
    """Whether ``ResumableEnv`` is around everything else in all workers."""
    wrapped = all(base.env_is_wrapped(ResumableEnv))
    return wrapped and set(base.env_method("class_name")) == {ResumableEnv.__name__}


def _vec_layers(vec_env: VecEnv) -> list[Any]:
    """A ``VecEnv``, outermost wrapper first."""
    layers = [vec_env]
    while isinstance(layers[-1], VecEnvWrapper):
        layers.append(layers[-1].venv)
    return layers


def _gym_layers(env: gym.Env[Any, Any]) -> list[Any]:
    """An environment, outermost wrapper first."""
    layers = [env]
    while isinstance(layers[-1], gym.Wrapper):
        layers.append(layers[-1].env)
    return layers


def _capture(layers: Sequence[Any], shared: Any) -> LayersState:
    names, settings = zip(*_described(layers), strict=True)
    states = [_attributes(layer) for layer in layers]
    known = [set(vars(layer)) for layer in layers]
    try:
        return LayersState([*names], dumps((states, known, shared), layers), [], settings)
    except Exception:  # whatever the environment's objects raise when they are asked for their state
        lost = [
            {name: reason for name, value in state.items() if (reason := _failure(value, layers))} for state in states
        ]
    # VecNormalize's statistics must not suffer from an environment that cannot be pickled
    rest = [
        {
            name: value
            for name, value in state.items()
            if name not in failures and (isinstance(layer, VecEnv) or isinstance(value, RANDOM))
        }
        for layer, state, failures in zip(layers, states, lost, strict=True)
    ]
    told = [
        f"{owner}.{name} ({reason})"
        for owner, failures in zip(names, lost, strict=True)
        for name, reason in failures.items()
    ]
    return LayersState([*names], dumps((rest, known, shared), layers), told, settings)


def _attributes(layer: Any) -> dict[str, Any]:
    """What belongs to the state of an environment or wrapper."""
    no_state = NO_VEC_STATE if isinstance(layer, VecEnv) else NO_STATE
    return {
        name: value
        for name, value in vars(layer).items()
        if name not in no_state
        and not isinstance(value, ResultsWriter)
        and not type(value).__module__.startswith(DRAWING)
    }


def _failure(value: Any, layers: Sequence[Any]) -> str:
    """Why an object cannot be pickled, empty if it can."""
    try:
        dumps(value, layers)
    except Exception as error:
        return _without_addresses(f"{type(error).__name__}: {error}")  # they make every warning another one
    return ""


def _without_addresses(text: str) -> str:
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def _described(layers: Sequence[Any]) -> list[tuple[str, dict[str, Any]]]:
    return [(type(layer).__qualname__, _settings(layer)) for layer in layers]


def _settings(layer: Any) -> dict[str, Any]:
    """Plain values that an environment or wrapper was made with and gymnasium keeps, but for how it draws."""
    settings: dict[str, Any] = vars(layer).get("_saved_kwargs", {})  # of gymnasium's own wrappers
    if not isinstance(layer, VecEnv | gym.Wrapper) and layer.spec is not None:
        parameters = inspect.signature(type(layer).__init__).parameters
        defaults = {name: each.default for name, each in parameters.items() if each.default is not each.empty}
        settings = defaults | layer.spec.kwargs
    return {name: value for name, value in settings.items() if name != "render_mode" and _is_plain(value)}


def _is_plain(value: Any) -> bool:
    """Whether a value stays what it was given as: an environment may write into dicts and objects."""
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | Number | np.bool_)


def _are_same(first: Any, second: Any) -> bool:
    """Whether plain values are the same, whatever the types of numbers and sequences; true is not 1."""
    if isinstance(first, list | tuple) and isinstance(second, list | tuple):
        return len(first) == len(second) and all(map(_are_same, first, second))
    if isinstance(first, bool | np.bool_) != isinstance(second, bool | np.bool_):
        return False
    return bool(first == second or (first != first and second != second))  # NaN


def _check_made_alike(state: LayersState, described: list[tuple[str, dict[str, Any]]]) -> None:
    """
    :raises ValueError: if layers are not those of a state, or were made with other settings
    """
    names = [name for name, _ in described]
    if names != state.names:
        raise ValueError(
            f"the checkpoint is of environments with other wrappers: {' > '.join(state.names)}, and it was given "
            f"{' > '.join(names)}; make them as in the training that wrote it"
        )
    if state.lost:
        return  # their settings stay as they are
    for (name, given), saved in zip(described, state.settings, strict=False):
        for key in sorted(given.keys() & saved.keys()):
            if not _are_same(saved[key], given[key]):
                raise ValueError(
                    f"the checkpoint's {name} was made with {key}: {saved[key]!r}, and it was given one with {key}: "
                    f"{given[key]!r}, which its state would override; make it as in the training that wrote it, and "
                    "to train on in another environment, give that to the loaded model by `set_env`"
                )


def _restore(layers: Sequence[Any], state: LayersState) -> Any:
    _check_made_alike(state, _described(layers))
    states, known, shared = loads(state.pickled, layers)
    for layer, attributes, names in zip(layers, states, known, strict=True):
        if not state.lost:  # what is computed once and kept (functools.cached_property) may be of the old state
            for name in vars(layer).keys() - names:
                del vars(layer)[name]
        vars(layer).update(attributes)
    return shared
