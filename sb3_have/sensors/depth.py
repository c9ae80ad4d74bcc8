"""Depth in metres and its 8-bit forms in observations."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_have.sensors.checks import is_finite

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


def depth_from_zbuffer(zbuffer: ArrayLike, near: float, far: float, orthographic: bool = False) -> NDArray[np.float64]:
    """
    Metres along the optical axis from an OpenGL depth buffer: near / (1 - z (1 - near / far)).

    :param zbuffer: Window depths 0 (near plane) to 1 (far plane), any shape.
    :param near: Distance of the near plane in metres.
    :param far: Distance of the far plane in metres.
    :param orthographic: Whether the projection is parallel; its depth is linear, near + z (far - near).
    :return: Metres of the same shape; infinite on the far plane, where nothing was drawn.
    :raises ValueError: unless 0 < near < far and the depths lie in 0..1.
    """
    if not 0 < near < far:
        raise ValueError(f"need 0 < near < far, got near={near!r} and far={far!r}")
    z = np.asarray(zbuffer, dtype=np.float64)
    if z.size and not (z.min() >= 0 and z.max() <= 1):
        raise ValueError(f"a depth buffer holds numbers in 0..1, got {z.min()!r} to {z.max()!r}; is it in metres?")
    metres = near + z * (far - near) if orthographic else near / (1 - z * (1 - near / far))
    return np.where(z == 1, np.inf, metres)


def disparity_noise(
    depth: ArrayLike,
    rng: np.random.Generator,
    lateral_sigma: float = 0.25,
    baseline_focal: float = 35.130,
    disparity_sigma: float = 1 / 36,
    disparity_step: float = 1 / 8,
) -> NDArray[np.float64]:
    """
    The noise of a structured-light depth camera such as the first Kinect, which measures a disparity
    d = baseline * focal length / z and reports it in steps: an error in d is an error in z that grows as z^2.

        z'(x, y) = bf / round_to_step(bf / z(x + n_x, y + n_y) + n_d)

    The form is that of Handa et al., "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014;
    the defaults are those of the simulator of Choi, Zhou, Koltun, "Robust Reconstruction of Indoor Scenes", CVPR 2015,
    without its table of lens distortion. At 3 m a step is 32 mm, at 6 m 128 mm.

    :param depth: Metres, (H, W); NaN, infinite or not positive is "nothing there" and stays so.
    :param rng: Source of the noise.
    :param lateral_sigma: Standard deviation, in pixels of the image, of n_x and n_y: where a pixel really looks. It
        takes the nearest pixel there.
    :param baseline_focal: bf in pixel metres: the baseline in metres times the focal length in pixels of the camera
        that is simulated, which need not be this image's.
    :param disparity_sigma: Standard deviation of n_d in that camera's pixels.
    :param disparity_step: Smallest step of the disparity in that camera's pixels; 0 for none.
    :return: Metres, (H, W); 0 where there is nothing, or where it is so far that the disparity rounds to zero.
    :raises ValueError: on a wrong shape or a parameter out of its range.
    """
    metres = np.asarray(depth, dtype=np.float64)
    if metres.ndim != 2:
        raise ValueError(f"depth must have shape (H, W), got {metres.shape}")
    for name, value in (
        ("lateral_sigma", lateral_sigma),
        ("disparity_sigma", disparity_sigma),
        ("disparity_step", disparity_step),
    ):
        if not 0 <= value < np.inf:
            raise ValueError(f"{name} must be a finite number of pixels >= 0, got {value!r}")
    if not 0 < baseline_focal < np.inf:
        raise ValueError(f"baseline_focal must be a finite number of pixel metres > 0, got {baseline_focal!r}")
    shift = rng.normal(0, lateral_sigma, (2, *metres.shape))
    row, column = (
        np.clip(np.rint(at + by), 0, size - 1).astype(np.int64)
        for at, by, size in zip(np.indices(metres.shape), shift, metres.shape, strict=True)
    )
    metres = metres[row, column]
    there = np.isfinite(metres) & (metres > 0)
    disparity = baseline_focal / np.where(there, metres, 1) + rng.normal(0, disparity_sigma, metres.shape)
    if disparity_step:
        disparity = np.rint(disparity / disparity_step) * disparity_step
    there &= disparity > 0
    return np.where(there, baseline_focal / np.where(there, disparity, 1), 0)


def _range(encoding: str, maximum: float) -> tuple[float, float]:
    if encoding not in get_args(DepthEncoding):
        raise ValueError(f"depth encoding must be one of {get_args(DepthEncoding)}, got {encoding!r}")
    if not is_finite(maximum) or maximum <= INVERSE_NEAR:
        raise ValueError(f"the maximum depth must be finite and above {INVERSE_NEAR} m, got {maximum!r}")
    return {"log": (LOG_FAR * float(np.exp(-LOG_RANGE)), LOG_FAR), "clipped": (0.0, maximum)}.get(
        encoding, (INVERSE_NEAR, maximum)
    )
