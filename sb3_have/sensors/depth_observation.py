"""A depth camera for any environment, from what it renders or from metres in its observation."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.checks import describe, is_number, parse_size, pick
from sb3_have.sensors.depth import DepthEncoding, depth_from_zbuffer, disparity_noise, encode_depth
from sb3_have.sensors.rendering import (
    DEPTH_MODES,
    Array,
    Observation,
    SensorWrapper,
    check_render_mode,
)

#: Share of the far plane from which on a MuJoCo scene with a skybox shows its wall; edges blur it below 0.7.
SKY = 0.6

DepthSource = Callable[[gym.Env[Any, Any]], Array]


class DepthObservation(SensorWrapper):
    """
    Adds the image of a depth camera, uint8 (H, W, 1) as :func:`~sb3_have.sensors.encode_depth` has it: codes 1..255,
    and 0 for "nothing there".

    :param env: Any environment. A process that has rendered MuJoCo must not be forked, see
        :mod:`sb3_have.sensors.rendering`.
    :param source: ``"render"``, for render mode ``"depth_array"`` or ``"rgbd_tuple"`` (MuJoCo's depth buffer is
        converted to metres by :func:`rendered_depth`, that of any other environment is taken for metres); or a key of
        the observation, float metres (H, W) or (H, W, 1); or ``function(env)``, called after every reset and step,
        which returns float metres (H, W). NaN, infinite and not positive mean "nothing there".
    :param encoding: ``"log"``, ``"clipped"`` or ``"inverse"``.
    :param maximum: Range in metres of ``"clipped"`` and ``"inverse"``, 100 by default.
    :param limits: Nearest and farthest distance in metres that the camera measures; beyond them there is nothing.
    :param noise: None; ``"redwood"`` for the defaults of :func:`~sb3_have.sensors.disparity_noise`; or a dict of its
        parameters. The noise is that of the rendered resolution, ``image_size`` comes after it.
    :param dropout: Probability that a pixel measures nothing, at every step anew.
    :param key: Key of the depth image; it may be ``source``, whose metres it then replaces.
    :param image_size: Rows and columns, one number for both or a pair. Every pixel takes the nearest one: a mean over
        an edge would be a surface that is not there. None keeps the source's own; unless it is a key or MuJoCo's
        rendering, that takes a first image: the environment is reset when it is wrapped, which ends an episode under
        way and takes a draw from its generator. With a function over MuJoCo a size must be given.
    :raises ValueError: on a wrong render mode, an observation that is not such an image, an unknown option, a key
        that exists already, or a source whose size changes.
    :raises KeyError: if the observation has no key ``source``.
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
        # No deep copies: a function may be a method of the environment.
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
                f"maximum={maximum!r} has no effect with encoding 'log', whose range is fixed; leave it out or choose "
                f"another of {get_args(DepthEncoding)}"
            )
        pair = isinstance(limits, Sequence) and len(limits) == 2 and all(map(is_number, limits))
        if not pair or not 0 <= limits[0] < limits[1]:
            raise ValueError(
                f"limits must be (nearest, farthest) in metres with 0 <= nearest < farthest, got {limits!r}"
            )
        if not is_number(dropout) or not 0 <= dropout <= 1:
            raise ValueError(f"dropout must be a probability 0..1, got {dropout!r}")
        self.source, self.encoding, self.limits, self.dropout = source, encoding, limits, dropout
        if maximum is not None and not is_number(maximum):
            raise ValueError(f"maximum must be a number of metres, got {maximum!r}")
        self.maximum = 100.0 if maximum is None else float(maximum)
        self.noise = _noise_options(noise)
        # Complain about a wrong value now, not at the first step.
        encode_depth(np.empty(0), self.encoding, self.maximum)
        if self.noise is not None:
            disparity_noise(np.ones((1, 1)), np.random.default_rng(0), **self.noise)
        self.image_size = self._check_source(parse_size(image_size))
        self._announce(*self.image_size, 1)

    def sense(self, observation: Observation, start: bool) -> NDArray[np.uint8]:
        """The depth code now, uint8 (H, W, 1)."""
        metres = self._metres(observation)
        if self.noise is not None:
            metres = disparity_noise(metres, self._rng, **self.noise)
        # INTER_NEAREST would take the first pixel of an area instead of the middle one.
        metres = self.fit(metres, self.image_size, cv2.INTER_NEAREST_EXACT)
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
            return size or self._rendered_size(DEPTH_MODES)
        if callable(self.source):
            return size or self._first_size(lambda: self._metres({}))
        if not isinstance(self.source, str):
            raise ValueError(f"DepthObservation: source must be 'render', a key or function(env), got {self.source!r}")
        space = pick(self.inner_spaces, self.source, self.class_name())
        if not isinstance(space, spaces.Box) or not _is_depth(space.shape, space.dtype):
            raise ValueError(
                f"DepthObservation: {self.source!r} must be float metres (H, W) or (H, W, 1), got {space}; convert "
                "other units and shapes before with gymnasium.wrappers.TransformObservation"
            )
        self._source_size = space.shape[:2]
        return size or (space.shape[0], space.shape[1])


def rendered_depth(env: gym.Env[Any, Any], depth: Array) -> Array:
    """
    Metres along the optical axis of a depth rendering, infinite where there is nothing. MuJoCo draws a skybox as a wall
    around the camera at 0.7 of the far plane: with one, nothing is there from 0.6 of the far plane on (120 m in
    Hopper-v5, 240 m in HalfCheetah-v5), measured along the line of sight.

    :param env: Environment that rendered it, wrapped or not.
    :param depth: (H, W), MuJoCo's depth buffer, or metres from any other environment.
    """
    renderer: Any = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is None:
        return depth
    mujoco: Any = importlib.import_module("mujoco")  # an extra

    scene = renderer.viewer.scn
    eye = scene.camera[0]
    near, far, parallel = float(eye.frustum_near), float(eye.frustum_far), bool(eye.orthographic)
    metres = depth_from_zbuffer(depth, near, far, parallel)
    skybox = (renderer.model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any()
    if not skybox or not scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX]:
        return metres
    # The frustum is given where it meets the near plane, upwards and to the right.
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
        raise ValueError(f"noise must be None, 'redwood' or a dict of its parameters, got {noise!r}")
    known = [name for name in inspect.signature(disparity_noise).parameters if name not in ("depth", "rng")]
    unknown = set(noise) - set(known)
    if unknown:
        raise ValueError(f"unknown noise option {sorted(unknown)}; the options are {', '.join(known)}")
    if not all(map(is_number, noise.values())):
        raise ValueError(f"the noise options are numbers, got {dict(noise)}")
    return dict(noise)


def _is_depth(shape: tuple[int, ...], dtype: Any) -> bool:
    return np.dtype(dtype).kind == "f" and (len(shape) == 2 or (len(shape) == 3 and shape[2] == 1))
