"""Replay buffers of Stable-Baselines3 in a checkpoint."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

OBSERVATIONS = ("observations", "next_observations")
"""What SB3's buffers hold their observations in: arrays (buffer_size, n_envs, ...), or dicts of such."""


def filled_part(buffer: ReplayBuffer) -> ReplayBuffer:
    """A buffer to write: of observations it has only what has been stored, and shares the memory.

    :param buffer: of any class; those without SB3's arrays are returned as they are
    """
    # with `optimize_memory_usage` the row after the last transition is its next observation
    n_rows = buffer.pos + 1
    if buffer.full or n_rows >= buffer.buffer_size:
        return buffer
    return _with_observations(buffer, buffer.buffer_size, lambda array: array[:n_rows])


def at_full_size(part: ReplayBuffer) -> ReplayBuffer:
    """The buffer of :func:`filled_part`, with room for all of ``buffer_size``; one array after the other is copied."""

    def extended(array: np.ndarray) -> np.ndarray:
        full = np.zeros((part.buffer_size, *array.shape[1:]), array.dtype)
        full[: len(array)] = array
        return full

    n_rows = part.pos + 1
    return part if part.full or n_rows >= part.buffer_size else _with_observations(part, n_rows, extended)


def _with_observations(buffer: ReplayBuffer, n_rows: int, change: Callable[[np.ndarray], np.ndarray]) -> ReplayBuffer:
    """A shallow copy in which the observations' arrays of so many rows are changed."""

    def changed(array: Any) -> Any:
        fits = isinstance(array, np.ndarray) and array.shape[:2] == (n_rows, buffer.n_envs)
        return change(array) if fits else array

    other = copy.copy(buffer)
    for name in OBSERVATIONS:
        value = vars(buffer).get(name)
        if isinstance(value, dict):
            vars(other)[name] = {key: changed(array) for key, array in value.items()}
        elif value is not None:
            vars(other)[name] = changed(value)
    return other


def end_last_episode(buffer: ReplayBuffer) -> None:
    """Let no return and no next observation run from the last transition into what is stored next."""
    if hasattr(buffer, "truncate_last_trajectory"):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The last trajectory in the replay buffer will be truncated")
            buffer.truncate_last_trajectory()
    elif buffer.size() > 0 and (buffer.optimize_memory_usage or isinstance(buffer, NStepReplayBuffer)):
        last = buffer.pos - 1
        if buffer.handle_timeout_termination:
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], 1 - buffer.dones[last])
        # without that a cut is a termination, as SB3 makes it when `learn` begins anew
        buffer.dones[last] = 1
