"""Depth in metres and its 8-bit codes in observations."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_have.sensors.checks import is_finite

DepthEncoding = Literal["log", "clipped", "inverse"]

# Farthest distance [m] and range [log units] of the logarithmic code. They are those of CARLA's logarithmic depth:
# 1 + ln(m / 1000) / 5.70378 runs from 0 at 3.33 m to 1 at 1000 m.
LOG_FAR = 1000.0
LOG_RANGE = 5.70378
# Nearest distance of the inverse code [m]
INVERSE_NEAR = 1.0


def encode_depth(depth: ArrayLike, encoding: DepthEncoding = "log", maximum: float = 100.0) -> NDArray[np.uint8]:
    """
    Encode depth in 8 bits.

    Codes 1..255 are distances, clipped to the range of the encoding. Code 0 means "nothing there": no return (the sky,
    infinitely far), NaN, or a distance that is not positive.

    - ``"log"``: clip(1 + ln(m / 1000) / 5.70378, 0, 1), CARLA's formula: 3.33 m to 1000 m in steps of 2.3%.
    - ``"clipped"``: m / maximum: 0 m to ``maximum`` in equal steps.
    - ``"inverse"``: 1 / m, between 1 m (code 255) and ``maximum`` (code 1).

    :param depth: Distance along the optical axis in metres, any shape.
    :param encoding: One of the three encodings.
    :param maximum: Farthest distance of ``"clipped"`` and ``"inverse"`` in metres.
    :return: uint8 array of the same shape.
    :raises ValueError: If the encoding is unknown, or the maximum not finite and above 1 m.
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
    Invert :func:`encode_depth`, up to the 8-bit steps.

    :param codes: uint8 array of any shape.
    :param encoding: Encoding of the codes.
    :param maximum: Maximum that the codes were made with, in metres.
    :return: Metres, float32 array of the same shape; 0 where there is nothing, as depth cameras return it.
    :raises ValueError: As :func:`encode_depth`, and if the codes are not uint8.
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
    Convert an OpenGL depth buffer to metres along the optical axis: near / (1 - z (1 - near / far)).

    :param zbuffer: Window depth, 0 (near plane) to 1 (far plane), any shape.
    :param near: Distance of the near plane in metres.
    :param far: Distance of the far plane in metres.
    :param orthographic: Whether the projection is parallel; depth is then linear, near + z (far - near).
    :return: Metres, array of the same shape; infinite on the far plane, where nothing was drawn.
    :raises ValueError: If not 0 < near < far, or if a depth lies outside 0..1.
    """
    if not 0 < near < far:
        raise ValueError(f"need 0 < near < far, got near={near!r} and far={far!r}")
    z = np.asarray(zbuffer, dtype=np.float64)
    if z.size and not (z.min() >= 0 and z.max() <= 1):
        raise ValueError(f"a depth buffer holds values in 0..1, got {z.min()!r} to {z.max()!r}; is it in metres?")
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
    Add the noise of a structured-light depth camera such as the first Kinect.

    Such a camera measures the disparity d = baseline * focal length / z in discrete steps, so its error in z grows as
    z^2:

        z'(x, y) = bf / round_to_step(bf / z(x + n_x, y + n_y) + n_d)

    The model is that of Handa et al., "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014.
    The defaults are those of the simulator of Choi, Zhou, Koltun, "Robust Reconstruction of Indoor Scenes", CVPR 2015,
    without its table of lens distortion. A step is 32 mm at 3 m and 128 mm at 6 m.

    :param depth: Metres, (H, W); NaN, infinite and not positive mean "nothing there" and stay so.
    :param rng: Generator of the noise.
    :param lateral_sigma: Standard deviation of n_x and n_y in pixels of the image. Each pixel takes the depth of the
        pixel nearest to the displaced place.
    :param baseline_focal: bf in pixel metres: baseline in metres times focal length in pixels of the simulated camera,
        whose resolution may differ from that of the image.
    :param disparity_sigma: Standard deviation of n_d in pixels of that camera.
    :param disparity_step: Step of the disparity in pixels of that camera; 0 for none.
    :return: Metres, (H, W); 0 where there is nothing, or so far away that the disparity rounds to zero.
    :raises ValueError: If the shape is not (H, W) or a parameter is out of range.
    """
    metres = np.asarray(depth, dtype=np.float64)
    if metres.ndim != 2:
        raise ValueError(f"depth must have shape (H, W), got {metres.shape}")
    # NumPy itself refuses negative standard deviations
    if not disparity_step >= 0 or not baseline_focal > 0:
        raise ValueError(
            f"need disparity_step >= 0 and baseline_focal > 0, got {disparity_step!r} and {baseline_focal!r}"
        )
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
    """Nearest and farthest distance of an encoding in metres."""
    if encoding not in get_args(DepthEncoding):
        raise ValueError(f"depth encoding must be one of {get_args(DepthEncoding)}, got {encoding!r}")
    if not is_finite(maximum) or maximum <= INVERSE_NEAR:
        raise ValueError(f"the maximum depth must be finite and above {INVERSE_NEAR} m, got {maximum!r}")
    if encoding == "log":
        return LOG_FAR * float(np.exp(-LOG_RANGE)), LOG_FAR
    return (0.0 if encoding == "clipped" else INVERSE_NEAR), maximum
