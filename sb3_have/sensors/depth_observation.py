"""A depth camera for any environment, from what it renders or from metres in its observation."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, get_args

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.depth import DepthEncoding, depth_from_zbuffer, disparity_noise, encode_depth
from sb3_have.sensors.rendering import (
    DEPTH_MODES,
    Array,
    Observation,
    SensorWrapper,
    check_render_mode,
    describe,
    parse_size,
    pick,
    resize,
)

DepthSource = Callable[[gym.Env[Any, Any]], Array]


class DepthObservation(SensorWrapper):
    """
    Adds the image of a depth camera, uint8 (H, W, 1) as :func:`~sb3_have.sensors.encode_depth` has it: codes 1..255,
    and 0 for "nothing there".

    :param env: Any environment.
    :param source: ``"render"``, for render mode ``"depth_array"`` or ``"rgbd_tuple"`` (MuJoCo's depth buffer is
        converted to metres with the near and far plane of its model, that of any other environment is taken for
        metres); or a key of the observation, float metres (H, W) or (H, W, 1); or ``function(env)``, called after every
        reset and step, which returns float metres (H, W). NaN, infinite and not positive mean "nothing there".
    :param encoding: ``"log"``, ``"clipped"`` or ``"inverse"``.
    :param maximum: Range in metres of ``"clipped"`` and ``"inverse"``, 100 by default.
    :param limits: Nearest and farthest distance in metres that the camera measures; beyond them there is nothing.
    :param noise: None; ``"redwood"`` for the defaults of :func:`~sb3_have.sensors.disparity_noise`; or a dict of its
        parameters. The noise is that of the rendered resolution, ``image_size`` comes after it.
    :param dropout: Probability that a pixel measures nothing, at every step anew.
    :param key: Key of the depth image; it may be ``source``, whose metres it then replaces.
    :param image_size: Rows and columns, one number for both or a pair; None keeps the source's own. Every pixel takes
        the nearest one: a mean over an edge would be a surface that is not there.
    :raises ValueError: on a wrong render mode, an observation that is not such an image, an unknown option or a key
        that exists already.
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
        # No copies: a function may be a method of the environment.
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
        if len(limits) != 2 or not 0 <= limits[0] < limits[1]:
            raise ValueError(f"limits must be (nearest, farthest) in metres with 0 <= nearest < farthest, got {limits}")
        if not 0 <= dropout <= 1:
            raise ValueError(f"dropout must be a probability 0..1, got {dropout!r}")
        self.source, self.encoding, self.limits, self.dropout = source, encoding, limits, dropout
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
        metres = resize(metres, self.image_size, cv2.INTER_NEAREST)
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
        if not isinstance(self.source, str):
            if size is None:
                self.env.reset()
                size = self._metres({}).shape[:2]
            return size
        space = pick(self.inner_spaces, self.source, self.class_name())
        if not isinstance(space, spaces.Box) or not _is_depth(space.shape, space.dtype):
            raise ValueError(
                f"DepthObservation: {self.source!r} must be float metres (H, W) or (H, W, 1), got {space}; convert "
                "other units with source=function(env)"
            )
        return size or (space.shape[0], space.shape[1])


def rendered_depth(env: gym.Env[Any, Any], depth: Array) -> Array:
    """
    Metres of a depth rendering.

    :param env: Environment that rendered it, wrapped or not.
    :param depth: (H, W), MuJoCo's depth buffer or metres.
    """
    base: Any = env.unwrapped
    model: Any = getattr(base, "model", None)
    if not hasattr(base, "mujoco_renderer") or not hasattr(getattr(model, "vis", None), "map"):
        return depth
    renderer = base.mujoco_renderer
    free = renderer.camera_id is None or renderer.camera_id < 0
    if free:
        orthographic = renderer.viewer.cam.orthographic
    else:
        orthographic = hasattr(model, "cam_projection") and model.cam_projection[renderer.camera_id]
    # MuJoCo gives both planes in units of the size of the model.
    near, far = (float(plane * model.stat.extent) for plane in (model.vis.map.znear, model.vis.map.zfar))
    return depth_from_zbuffer(depth, near, far, bool(orthographic))


def _noise_options(noise: Mapping[str, float] | str | None) -> dict[str, float] | None:
    if noise is None:
        return None
    if isinstance(noise, str):
        if noise != "redwood":
            raise ValueError(f"noise must be None, 'redwood' or a dict of its parameters, got {noise!r}")
        return {}
    known = [name for name in inspect.signature(disparity_noise).parameters if name not in ("depth", "rng")]
    unknown = set(noise) - set(known)
    if unknown:
        raise ValueError(f"unknown noise option {sorted(unknown)}; the options are {', '.join(known)}")
    return dict(noise)


def _is_depth(shape: tuple[int, ...], dtype: Any) -> bool:
    return np.dtype(dtype).kind == "f" and (len(shape) == 2 or (len(shape) == 3 and shape[2] == 1))
