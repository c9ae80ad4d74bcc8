"""A depth camera for any environment, from its rendering or from metres in its observation."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any, get_args

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.checks import describe, parse_size, pick
from sb3_have.sensors.depth import DepthEncoding, depth_from_zbuffer, disparity_noise, encode_depth
from sb3_have.sensors.rendering import (
    DEPTH_MODES,
    Array,
    Observation,
    SensorWrapper,
    check_render_mode,
    resize,
)

# Share of the far plane beyond which a MuJoCo scene with a skybox shows its wall. The wall stands at 0.7, and edges
# blur it below that.
SKY = 0.6

DepthSource = Callable[[gym.Env[Any, Any]], Array]


class DepthObservation(SensorWrapper):
    """
    Adds the image of a depth camera, uint8 (H, W, 1): codes 1..255 of :func:`~sb3_have.sensors.encode_depth`, and 0
    for "nothing there".

    :param env: Any environment. A process that has rendered MuJoCo must not be forked, see
        :mod:`sb3_have.sensors.rendering`.
    :param source: ``"render"``, for render mode ``"depth_array"`` or ``"rgbd_tuple"`` (MuJoCo's depth buffer is
        converted to metres by :func:`rendered_depth`; other environments must render metres). Or a key of the
        observation, float metres (H, W) or (H, W, 1). Or a ``function(env)``, called after every reset and step, that
        returns float metres (H, W). NaN, infinite and not positive mean "nothing there".
    :param encoding: ``"log"``, ``"clipped"`` or ``"inverse"``.
    :param maximum: Farthest distance of ``"clipped"`` and ``"inverse"`` in metres, 100 by default.
    :param limits: Nearest and farthest distance in metres that the camera measures.
    :param noise: None, ``"redwood"`` for the defaults of :func:`~sb3_have.sensors.disparity_noise`, or a dict of its
        parameters. The noise is added at the resolution of the source, before resizing.
    :param dropout: Probability that a pixel measures nothing, drawn at every step.
    :param key: Key of the depth image; it may equal ``source``, whose metres it then replaces.
    :param image_size: Rows and columns in pixels, one number for both or a pair. Each pixel takes the nearest value of
        the source, because a mean over an edge would be a surface that does not exist. By default the size of the
        source; unless that is a key or MuJoCo's rendering, the environment is reset once to find it out. A function
        needs it in a MuJoCo environment.
    :raises ValueError: If the render mode, the source or an option does not fit, or if the key already exists.
    :raises KeyError: If the observation has no key ``source``.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        source: str | DepthSource = "render",
        encoding: DepthEncoding = "log",
        maximum: float | None = None,
        limits: tuple[float, float] = (0.0, np.inf),
        noise: Mapping[str, float] | str | None = None,
        dropout: float = 0.0,
        key: str = "depth",
        image_size: int | tuple[int, int] | None = None,
    ) -> None:
        noise = dict(noise) if isinstance(noise, Mapping) else noise
        # No deep copies, because a function may be a method of the environment
        gym.utils.RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,
            source=source,
            encoding=encoding,
            maximum=maximum,
            limits=limits,
            noise=noise,
            dropout=dropout,
            key=key,
            image_size=image_size,
        )
        SensorWrapper.__init__(self, env, key, replaces=source if isinstance(source, str) else None)
        if encoding == "log" and maximum is not None:
            raise ValueError(
                f"maximum={maximum!r} has no effect with encoding 'log', which has a fixed range; leave it out or "
                f"choose another of {get_args(DepthEncoding)}"
            )
        nearest, farthest = limits
        if not 0 <= nearest < farthest:
            raise ValueError(f"limits must satisfy 0 <= nearest < farthest in metres, got {limits!r}")
        if not 0 <= dropout <= 1:
            raise ValueError(f"dropout must be a probability in 0..1, got {dropout!r}")
        self.source, self.encoding, self.limits, self.dropout = source, encoding, limits, dropout
        self.maximum = 100.0 if maximum is None else maximum
        self.noise = _noise_options(noise)
        # Check the values of the options now instead of at the first step
        encode_depth(np.empty(0), self.encoding, self.maximum)
        if self.noise is not None:
            disparity_noise(np.ones((1, 1)), np.random.default_rng(0), **self.noise)
        self.image_size = self._check_source(parse_size(image_size))
        self._add_space(*self.image_size, 1)

    def sense(self, observation: Observation, start: bool) -> NDArray[np.uint8]:
        """Return the depth codes, uint8 (H, W, 1)."""
        metres = self._metres(observation)
        if self.noise is not None:
            metres = disparity_noise(metres, self._rng, **self.noise)
        # INTER_NEAREST would take the first pixel of an area instead of the middle one
        metres = resize(metres, self.image_size, cv2.INTER_NEAREST_EXACT)
        gone = (metres < self.limits[0]) | (metres > self.limits[1])
        if self.dropout:
            gone |= self._rng.random(metres.shape) < self.dropout
        return encode_depth(np.where(gone, 0, metres), self.encoding, self.maximum)[..., None]

    def _metres(self, observation: Observation) -> Array:
        """Metres along the optical axis, (H, W)."""
        if self.source == "render":
            return rendered_depth(self.env, self.look().depth[-1])
        depth = observation[self.source] if isinstance(self.source, str) else self.source(self.env)
        if not isinstance(depth, np.ndarray) or not _is_depth(depth.shape, depth.dtype):
            raise ValueError(f"DepthObservation: depth must be float metres (H, W), got {describe(depth)}")
        return depth.reshape(depth.shape[:2])

    def _check_source(self, size: tuple[int, int] | None) -> tuple[int, int]:
        """Rows and columns of the camera."""
        if self.source == "render":
            check_render_mode(self.env, DEPTH_MODES, self.class_name())
            return size or self._rendered_size()
        if callable(self.source):
            return size or self._first_size(lambda: self._metres({}))
        space = pick(self.inner_spaces, self.source, self.class_name())
        if not isinstance(space, spaces.Box) or not _is_depth(space.shape, space.dtype):
            raise ValueError(
                f"DepthObservation: {self.source!r} must be float metres (H, W) or (H, W, 1), got {space}; convert "
                "other units and shapes first with gymnasium.wrappers.TransformObservation"
            )
        return size or (space.shape[0], space.shape[1])


def rendered_depth(env: gym.Env[Any, Any], depth: Array) -> Array:
    """
    Convert a depth rendering to metres along the optical axis, infinite where there is nothing.

    MuJoCo draws a skybox as a wall around the camera at 0.7 of the far plane. With a skybox, everything farther than
    0.6 of the far plane along the line of sight counts as nothing (120 m in Hopper-v5, 240 m in HalfCheetah-v5).

    :param env: Environment that rendered the depth, wrapped or not.
    :param depth: MuJoCo's depth buffer, or metres of any other environment, (H, W).
    """
    renderer: Any = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is None:
        return depth
    mujoco: Any = importlib.import_module("mujoco")  # an optional dependency

    scene = renderer.viewer.scn
    eye = scene.camera[0]
    near, far, parallel = float(eye.frustum_near), float(eye.frustum_far), bool(eye.orthographic)
    metres = depth_from_zbuffer(depth, near, far, parallel)
    skybox = (renderer.model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any()
    if not skybox or not scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX]:
        return metres
    # Line of sight of every pixel. The frustum is given at the near plane, upwards and to the right.
    height, width = depth.shape
    half = eye.frustum_width or (eye.frustum_top - eye.frustum_bottom) / 2 * width / height
    up = _pixel_centres(eye.frustum_top, eye.frustum_bottom, height)[:, None]
    right = _pixel_centres(eye.frustum_center - half, eye.frustum_center + half, width)
    aside = np.hypot(up, right) * (1 if parallel else metres / near)
    return np.where(np.hypot(metres, aside) < SKY * far, metres, np.inf)


def _pixel_centres(first: float, last: float, number: int) -> NDArray[np.float64]:
    return first + (last - first) * (np.arange(number) + 0.5) / number


def _noise_options(noise: Mapping[str, float] | str | None) -> dict[str, float] | None:
    if noise is None:
        return None
    if noise == "redwood":
        return {}
    if not isinstance(noise, Mapping):
        raise ValueError(f"noise must be None, 'redwood' or a dict of parameters, got {noise!r}")
    return dict(noise)


def _is_depth(shape: tuple[int, ...], dtype: Any) -> bool:
    return np.dtype(dtype).kind == "f" and (len(shape) == 2 or (len(shape) == 3 and shape[2] == 1))
