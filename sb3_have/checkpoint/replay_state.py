"""Replay buffers of Stable-Baselines3 in a checkpoint."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer


def filled_part(buffer: ReplayBuffer) -> ReplayBuffer:
    """Return a copy whose observations are cut to what has been stored; it shares the memory.

    :param buffer: Buffer of any class; one without SB3's arrays is returned as it is
    """
    # With `optimize_memory_usage` the row after the last transition is its next observation
    n_rows = buffer.pos + 1
    if buffer.full or n_rows >= buffer.buffer_size:
        return buffer
    return _with_observations(buffer, buffer.buffer_size, lambda array: array[:n_rows])


def at_full_size(part: ReplayBuffer) -> ReplayBuffer:
    """Undo :func:`filled_part`; one array after the other is copied."""

    def extended(array: np.ndarray) -> np.ndarray:
        full = np.zeros((part.buffer_size, *array.shape[1:]), array.dtype)
        full[: len(array)] = array
        return full

    n_rows = part.pos + 1
    return part if part.full or n_rows >= part.buffer_size else _with_observations(part, n_rows, extended)


def _with_observations(buffer: ReplayBuffer, n_rows: int, change: Callable[[np.ndarray], np.ndarray]) -> ReplayBuffer:
    """Return a shallow copy with changed observations, where they are arrays (n_rows, n_envs, ...) or dicts of such."""

    def changed(array: Any) -> Any:
        fits = isinstance(array, np.ndarray) and array.shape[:2] == (n_rows, buffer.n_envs)
        return change(array) if fits else array

    other = copy.copy(buffer)
    for name in vars(buffer).keys() & {"observations", "next_observations"}:
        value = getattr(buffer, name)
        if isinstance(value, dict):
            setattr(other, name, {key: changed(array) for key, array in value.items()})
        else:
            setattr(other, name, changed(value))
    return other


def end_last_episode(buffer: ReplayBuffer) -> None:
    """End the last episode, so that no return and no next observation reaches into what is stored next."""
    if hasattr(buffer, "truncate_last_trajectory"):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The last trajectory in the replay buffer will be truncated")
            buffer.truncate_last_trajectory()
    elif buffer.size() > 0 and (buffer.optimize_memory_usage or isinstance(buffer, NStepReplayBuffer)):
        last = buffer.pos - 1
        # Without handling of timeouts the cut is a termination, as in SB3's `learn`
        if buffer.handle_timeout_termination:
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], 1 - buffer.dones[last])
        buffer.dones[last] = 1
