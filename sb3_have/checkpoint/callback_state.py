"""The state of callbacks: whatever is plain data in them, or what they choose."""

from __future__ import annotations

import inspect
import random
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ProgressBarCallback

Callbacks = BaseCallback | Sequence[BaseCallback] | None

PLAIN = (bool, int, float, complex, str, bytes, np.ndarray, np.generic, th.Tensor, type(None))
PLAIN_RANDOM = (np.random.Generator, np.random.RandomState, random.Random)
CONTAINERS = (list, tuple, set, frozenset, deque)


def _flattened(callbacks: Callbacks) -> list[BaseCallback]:
    """Callbacks and those within them, but for mere lists and the progress bar."""
    waiting = [callbacks] if isinstance(callbacks, BaseCallback) else list(callbacks or ())
    found: list[BaseCallback] = []
    while waiting:
        callback = waiting.pop(0)
        if any(callback is each for each in found):
            continue
        found.append(callback)
        for name, value in vars(callback).items():
            children = value if isinstance(value, list | tuple) else [value]
            if name != "parent":
                waiting += [child for child in children if isinstance(child, BaseCallback)]
    return [each for each in found if not isinstance(each, CallbackList | ProgressBarCallback)]


def callbacks_state(callbacks: Callbacks) -> list[tuple[str, Any]]:
    """Class and state of every callback, see :func:`~sb3_have.checkpoint.checkpoint.save_checkpoint`."""
    return [(type(each).__qualname__, _callback_state(each)) for each in _flattened(callbacks)]


def _has_own_state(callback: BaseCallback) -> bool:
    return hasattr(callback, "get_state") and hasattr(callback, "set_state")


def _callback_state(callback: BaseCallback) -> Any:
    if _has_own_state(callback):
        return callback.get_state()  # type: ignore[attr-defined]
    # what the constructor takes is the user's, who may give something else when the training goes on
    constructors = [vars(each)["__init__"] for each in type(callback).__mro__ if "__init__" in vars(each)]
    given = {name for each in constructors for name in inspect.signature(each).parameters} | {
        "locals",
        "globals",
        "parent",
    }
    return {name: value for name, value in vars(callback).items() if name not in given and _is_plain(value)}


def _is_plain(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(_is_plain(each) for pair in value.items() for each in pair)
    if isinstance(value, CONTAINERS):
        return all(map(_is_plain, value))
    return isinstance(value, (*PLAIN, *PLAIN_RANDOM))


def restore_callbacks(callbacks: Callbacks, states: list[tuple[str, Any]]) -> None:
    """Put callbacks into the state that those of the same classes had, in their order."""
    waiting = list(states)
    for callback in _flattened(callbacks):
        name = type(callback).__qualname__
        index = next((index for index, (saved, _) in enumerate(waiting) if saved == name), None)
        if index is None:
            continue  # it was not there then
        _, state = waiting.pop(index)
        if _has_own_state(callback):
            callback.set_state(state)  # type: ignore[attr-defined]
        else:
            vars(callback).update(state)
