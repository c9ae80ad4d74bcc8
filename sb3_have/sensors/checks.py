"""Checks of options and observations, with errors that name them. Nothing here depends on an environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np


def is_number(value: Any, kind: type = Real) -> bool:
    """Whether this is one number of Python or numpy, a whole one with ``kind=Integral``; a bool is not."""
    return isinstance(value, kind) and not isinstance(value, bool)


def is_finite(value: Any) -> bool:
    """Whether this is one number of Python or numpy, neither infinite nor NaN; a bool is not."""
    return is_number(value) and bool(-np.inf < value < np.inf)


def is_pair(value: Any) -> bool:
    """Whether these are two finite numbers in a tuple, list or array."""
    parts = value.tolist() if isinstance(value, np.ndarray) else value
    return isinstance(parts, tuple | list) and len(parts) == 2 and all(map(is_finite, parts))


def check_whole(name: str, value: Any, least: int, most: int | None = None) -> None:
    """
    :param name: Of the option, for the message.
    :param value: What was given.
    :param least: Smallest value.
    :param most: Greatest value, if there is one.
    :raises ValueError: unless it is a whole number of Python or numpy in these bounds.
    """
    if not is_number(value, Integral) or value < least or (most is not None and value > most):
        bounds = f">= {least}" if most is None else f"in {least}..{most}"
        raise ValueError(f"{name} must be a whole number {bounds}, got {value!r}")


def positive_pair(name: str, value: Any) -> tuple[float, float]:
    """
    One positive number, twice, or a pair of them.

    :param name: Of the option, for the message.
    :param value: What was given.
    :raises ValueError: if it is neither.
    """
    pair = value if is_pair(value) else (value, value)
    if not all(is_finite(part) and part > 0 for part in pair):
        raise ValueError(f"{name} must be one positive number or a pair (positive, negative), got {value!r}")
    return float(pair[0]), float(pair[1])


def describe(value: Any) -> str:
    """Dtype and shape of an array, the type of anything else."""
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__


def parse_size(image_size: int | Sequence[int] | None) -> tuple[int, int] | None:
    """
    (rows, columns) of one number or a pair.

    :raises ValueError: unless these are whole numbers of at least 1.
    """
    if image_size is None:
        return None
    size = tuple(image_size) if isinstance(image_size, Sequence) else (image_size, image_size)
    if len(size) != 2 or not all(is_number(side, Integral) and int(side) > 0 for side in size):
        raise ValueError(f"image_size must be a whole number or a pair (rows, columns), got {image_size!r}")
    return int(size[0]), int(size[1])


def pick(available: Mapping[str, Any], key: str, wrapper: str) -> Any:
    """
    :raises KeyError: if there is no such key; lists those there are.
    """
    if key not in available:
        raise KeyError(f"{wrapper}: the observation has no key {key!r}, only {list(available)}; name one of them")
    return available[key]
