"""Depth in metres and its 8-bit forms in observations."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

DepthEncoding = Literal["log", "clipped", "inverse"]

#: Farthest distance of the logarithmic form in metres and its range in log units, as CARLA's logarithmic depth has
#: them: 1 + ln(m / 1000) / 5.70378 runs from 0 at 3.33 m to 1 at 1000 m.
LOG_FAR = 1000.0
LOG_RANGE = 5.70378
#: The inverse form resolves no closer than this many metres.
INVERSE_NEAR = 1.0


def encode_depth(depth: ArrayLike, encoding: DepthEncoding = "log", maximum: float = 100.0) -> NDArray[np.uint8]:
    """
    8-bit form of depth. Codes 1..255 carry distances; 0 says "nothing there": no return (the sky, infinitely far), NaN,
    or a distance that is not positive. Finite distances are clipped to the range of the encoding.

    - ``"log"``: clip(1 + ln(m / 1000) / 5.70378, 0, 1), CARLA's formula; 3.33 m to 1000 m in steps of 2.3%.
    - ``"clipped"``: m / maximum, 0 to ``maximum`` metres in equal steps.
    - ``"inverse"``: 1 / m, between 1 m (code 255) and ``maximum`` metres (code 1).

    :param depth: Metres along the optical axis, any shape.
    :param encoding: One of the three forms.
    :param maximum: Range in metres of ``"clipped"`` and ``"inverse"``.
    :return: uint8 of the same shape.
    """
    low, high = _range(encoding, maximum)
    metres = np.asarray(depth, dtype=np.float32)
    there = np.isfinite(metres) & (metres > 0)
    metres = np.clip(np.where(there, metres, 1.0), low, high)
    if encoding == "log":
        fraction = 1 + np.log(metres / LOG_FAR) / LOG_RANGE
    elif encoding == "clipped":
        fraction = metres / maximum
    else:
        fraction = (1 / metres - 1 / high) / (1 / low - 1 / high)
    codes = 1 + np.rint(254 * np.clip(fraction, 0, 1))
    return np.where(there, codes, 0).astype(np.uint8)


def decode_depth(codes: ArrayLike, encoding: DepthEncoding = "log", maximum: float = 100.0) -> NDArray[np.float32]:
    """
    Inverse of :func:`encode_depth`, up to its 8-bit steps.

    :param codes: uint8 array of any shape.
    :param encoding: The form it was encoded in.
    :param maximum: The range it was encoded with.
    :return: float32 metres of the same shape; 0.0 where there is no data, as depth cameras have it.
    """
    low, high = _range(encoding, maximum)
    codes = np.asarray(codes)
    if codes.dtype != np.uint8:
        raise ValueError(f"depth codes must be uint8, got {codes.dtype}")
    fraction = (codes.astype(np.float32) - 1) / 254
    if encoding == "log":
        metres = LOG_FAR * np.exp(LOG_RANGE * (fraction - 1))
    elif encoding == "clipped":
        metres = fraction * maximum
    else:
        metres = 1 / (fraction * (1 / low - 1 / high) + 1 / high)
    return np.where(codes == 0, np.float32(0), metres).astype(np.float32)


def _range(encoding: str, maximum: float) -> tuple[float, float]:
    if encoding not in get_args(DepthEncoding):
        raise ValueError(f"depth encoding must be one of {get_args(DepthEncoding)}, got {encoding!r}")
    if not INVERSE_NEAR < maximum < np.inf:
        raise ValueError(f"the maximum depth must be finite and above {INVERSE_NEAR} m, got {maximum!r}")
    return {"log": (LOG_FAR * float(np.exp(-LOG_RANGE)), LOG_FAR), "clipped": (0.0, maximum)}.get(
        encoding, (INVERSE_NEAR, maximum)
    )
