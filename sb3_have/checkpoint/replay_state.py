"""The replay buffers of SB3 in a checkpoint, without the rows that hold no transition yet."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer


def filled_part(buffer: ReplayBuffer) -> ReplayBuffer:
    """
    Return a buffer to save, which has only the stored observations and shares their memory.

    :param buffer: A buffer of any class; one without SB3's arrays is returned as it is
    """
    # With `optimize_memory_usage` the row after the last transition holds its next observation
    n_rows = buffer.pos + 1
    if buffer.full or n_rows >= buffer.buffer_size:
        return buffer
    return _with_observations(buffer, buffer.buffer_size, lambda array: array[:n_rows])


def at_full_size(part: ReplayBuffer) -> ReplayBuffer:
    """
    Return the buffer of :func:`filled_part` with room for all of ``buffer_size``.

    :param part: The buffer of a checkpoint
    """

    def extended(array: np.ndarray) -> np.ndarray:
        # The system provides memory for zeros only when they are overwritten
        full = np.zeros((part.buffer_size, *array.shape[1:]), array.dtype)
        full[: len(array)] = array
        return full

    n_rows = part.pos + 1
    return part if part.full or n_rows >= part.buffer_size else _with_observations(part, n_rows, extended)


def _with_observations(buffer: ReplayBuffer, n_rows: int, change: Callable[[np.ndarray], np.ndarray]) -> ReplayBuffer:
    """Copy a buffer, but not its arrays, and change its observations' arrays of this many rows."""

    def changed(array: Any) -> Any:
        fits = isinstance(array, np.ndarray) and array.shape[:2] == (n_rows, buffer.n_envs)
        return change(array) if fits else array

    other = copy.copy(buffer)
    for name in ("observations", "next_observations"):
        value = vars(buffer).get(name)
        if isinstance(value, dict):
            vars(other)[name] = {key: changed(array) for key, array in value.items()}
        elif value is not None:
            vars(other)[name] = changed(value)
    return other
