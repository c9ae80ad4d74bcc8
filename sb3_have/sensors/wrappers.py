"""
Wrappers that turn observations into a Dict of uint8 (H, W, C) images, the form that multi-modal policies expect.

To keep only some keys of a Dict, use ``gymnasium.wrappers.FilterObservation``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.checks import describe, pick
from sb3_have.sensors.rendering import STATE, Array, Observation


class DictObservation(gym.ObservationWrapper[Observation, Any, Any], gym.utils.RecordConstructorArgs):
    """
    Puts an observation into a Dict with one key.

    :param env: Environment whose observation is not a Dict.
    :param key: Key of the observation.
    :raises ValueError: If the observation is already a Dict.
    """

    def __init__(self, env: gym.Env[Any, Any], key: str = STATE) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, key=key)
        gym.ObservationWrapper.__init__(self, env)
        if isinstance(env.observation_space, spaces.Dict):
            raise ValueError(f"DictObservation: already a Dict with keys {list(env.observation_space)}")
        self.key = key
        self.observation_space = spaces.Dict({key: env.observation_space})

    def observation(self, observation: Any) -> Observation:
        """Return the observation under its key."""
        return {self.key: observation}


class ChannelLastImages(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """
    Converts images to uint8 (H, W, C).

    Moves the channels last, adds a channel to grey (H, W) images, and rescales values in 0..1 or 0..255 to whole
    numbers in 0..255. The smallest of the three sizes is taken for the channels; if two are equal, the last one.

    :param env: Environment with a Dict observation, or with a single image.
    :param keys: Keys of the images (``"state"`` for an observation that is itself an image). By default, every
        three-dimensional Box with bounds 0..1 or 0..255; grey (H, W) images must be named.
    :raises ValueError: If a named key is not an image, if there is no image, or, later, if an image does not fit its
        space.
    :raises KeyError: If a key does not exist.
    """

    def __init__(self, env: gym.Env[Any, Any], keys: Sequence[str] | None = None) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, keys=keys)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        self._is_dict = isinstance(space, spaces.Dict)
        inner: dict[str, spaces.Space[Any]] = dict(space.spaces) if isinstance(space, spaces.Dict) else {STATE: space}
        if isinstance(keys, str):
            raise ValueError(f"ChannelLastImages: keys must be a list of keys, got {keys!r}")
        if keys is None:
            keys = [key for key, part in inner.items() if image_fault(part) is None and len(part.shape or ()) == 3]
            if not keys:
                raise ValueError(
                    f"ChannelLastImages: none of {inner} is a three-dimensional image with bounds 0..1 or 0..255; "
                    "name grey images with keys=[...]"
                )
        for key in keys:
            fault = image_fault(pick(inner, key, "ChannelLastImages"))
            if fault is not None:
                raise ValueError(f"ChannelLastImages: {key!r} is not an image: {fault}, got {inner[key]}")
        self.keys = tuple(keys)
        # Spaces of the images before the conversion
        self.sources: dict[str, Any] = {key: inner[key] for key in self.keys}
        outer = dict(inner)
        for key, part in self.sources.items():
            shape = _channels_last(np.empty(part.shape, np.bool_)).shape
            outer[key] = spaces.Box(0, 255, shape, np.uint8)
        self.observation_space = (
            spaces.Dict(outer, sort_keys=space.sort_keys) if isinstance(space, spaces.Dict) else outer[STATE]
        )

    def observation(self, observation: Any) -> Any:
        """Return the observation with its images converted."""
        if not self._is_dict:
            return self._convert(STATE, observation)
        return {**observation, **{key: self._convert(key, observation[key]) for key in self.keys}}

    def _convert(self, key: str, image: Array) -> NDArray[np.uint8]:
        space = self.sources[key]
        fits = isinstance(image, np.ndarray) and image.shape == space.shape
        if not fits or not np.can_cast(image.dtype, space.dtype, "same_kind"):
            raise ValueError(
                f"ChannelLastImages: {key!r} must be {space.dtype} {space.shape} like its space, got {describe(image)}"
            )
        high = float(space.high.max())
        if image.dtype != np.uint8 or high != 255:
            # Written so that NaN fails too
            if not (image.min() >= 0 and image.max() <= high):
                raise ValueError(
                    f"ChannelLastImages: {key!r} has bounds 0..{high:g} but holds {image.min()!r} to {image.max()!r}; "
                    "clip it, or declare bounds 0..1 or 0..255"
                )
            image = np.rint(image * (255 / high))
        return np.array(_channels_last(image), dtype=np.uint8, order="C")


def image_fault(space: Any) -> str | None:
    """
    Explain why a space is not an image.

    :param space: Space to check.
    :return: What is wrong; None for an image.
    """
    if not isinstance(space, spaces.Box) or len(space.shape) not in (2, 3):
        return "an image is a Box of shape (H, W), (H, W, C) or (C, H, W)"
    highest = np.unique(space.high)
    if np.dtype(space.dtype).kind not in "uif" or (space.low != 0).any() or highest.tolist() not in ([1], [255]):
        return "its bounds must be 0..1 or 0..255"
    if len(space.shape) == 3 and int(np.argmin(space.shape[::-1])) == 1:
        return "its second size is the smallest, so its channels are neither first nor last"
    return None


def _channels_last(image: Array) -> Array:
    if image.ndim == 2:
        return image[..., None]
    return np.moveaxis(image, 0, -1) if image.shape[0] < min(image.shape[1:]) else image
