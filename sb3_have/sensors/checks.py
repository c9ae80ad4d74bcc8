"""Checks of options, shared by the sensors and the environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np


def is_number(value: Any, kind: type = Real) -> bool:
    """Check for a single number of Python or NumPy, not a bool; with ``kind=Integral`` for a whole number."""
    return isinstance(value, kind) and not isinstance(value, bool)


def is_finite(value: Any) -> bool:
    """Check for a single number that is neither infinite nor NaN."""
    return is_number(value) and bool(-np.inf < value < np.inf)


def is_pair(value: Any) -> bool:
    """Check for two finite numbers in a tuple, list or array."""
    parts = value.tolist() if isinstance(value, np.ndarray) else value
    return isinstance(parts, tuple | list) and len(parts) == 2 and all(map(is_finite, parts))


def check_whole(name: str, value: Any, least: int, most: int | None = None) -> None:
    """
    Check an option that must be a whole number.

    :param name: Name of the option, for the message.
    :param value: Value of the option.
    :param least: Smallest value allowed.
    :param most: Largest value allowed, if any.
    :raises ValueError: If the value is not a whole number in this range.
    """
    if not is_number(value, Integral) or value < least or (most is not None and value > most):
        bounds = f">= {least}" if most is None else f"in {least}..{most}"
        raise ValueError(f"{name} must be a whole number {bounds}, got {value!r}")


def positive_pair(name: str, value: Any) -> tuple[float, float]:
    """
    Return a positive number twice, or a pair of positive numbers as it is.

    :param name: Name of the option, for the message.
    :param value: Value of the option.
    :raises ValueError: If the value is neither.
    """
    pair = value if is_pair(value) else (value, value)
    if not all(is_finite(part) and part > 0 for part in pair):
        raise ValueError(f"{name} must be a positive number or a pair (positive, negative), got {value!r}")
    return float(pair[0]), float(pair[1])


def describe(value: Any) -> str:
    """Describe a value in an error message: dtype and shape of an array, or the type."""
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__


def parse_size(image_size: int | Sequence[int] | None) -> tuple[int, int] | None:
    """
    Return the (rows, columns) of an option ``image_size``.

    :param image_size: One number for both, a pair, or None.
    :raises ValueError: If these are not whole numbers >= 1.
    """
    if image_size is None:
        return None
    size = tuple(image_size) if isinstance(image_size, Sequence) else (image_size, image_size)
    if len(size) != 2 or not all(is_number(side, Integral) and int(side) > 0 for side in size):
        raise ValueError(f"image_size must be a whole number or a pair (rows, columns), got {image_size!r}")
    return int(size[0]), int(size[1])


def pick(available: Mapping[str, Any], key: str, wrapper: str) -> Any:
    """
    Return the space of an observation key.

    :param available: Spaces by key.
    :param key: Key to look up.
    :param wrapper: Name of the wrapper, for the message.
    :raises KeyError: If there is no such key; the message lists the keys.
    """
    if key not in available:
        raise KeyError(f"{wrapper}: the observation has no key {key!r}, only {list(available)}")
    return available[key]
