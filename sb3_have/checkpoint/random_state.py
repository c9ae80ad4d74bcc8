"""The global random generators of Python, NumPy and PyTorch."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th


def _cuda_is_in_use() -> bool:
    """Whether CUDA has been initialized, which asking for its random numbers would do."""
    return bool(th.cuda.is_initialized())  # type: ignore[no-untyped-call, unused-ignore]


def random_states() -> dict[str, Any]:
    """Return the states of the global random generators, including CUDA's where it is in use."""
    cuda = th.cuda.get_rng_state_all() if _cuda_is_in_use() else []
    return {"python": random.getstate(), "numpy": np.random.get_state(), "torch": th.get_rng_state(), "cuda": cuda}


def set_random_states(states: Mapping[str, Any]) -> None:
    """Restore the states of :func:`random_states`."""
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if _cuda_is_in_use() and len(states["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(states["cuda"])


@contextmanager
def same_random_numbers() -> Iterator[None]:
    """Restore the random generators at the end of a ``with`` block, so that it does not change a seeded run."""
    states = random_states()
    try:
        yield
    finally:
        set_random_states(states)
