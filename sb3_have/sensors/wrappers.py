"""Wrappers that bring observations into the form that multi-modal policies take: a Dict of (H, W, C) uint8 images."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.checks import describe, pick
from sb3_have.sensors.rendering import STATE, Array, Observation


class DictObservation(gym.ObservationWrapper[Observation, Any, Any], gym.utils.RecordConstructorArgs):
    """
    An observation as the only entry of a Dict.

    :param env: Environment whose observation is not a Dict.
    :param key: Its key.
    :raises ValueError: if the observation is a Dict already.
    """

    def __init__(self, env: gym.Env[Any, Any], key: str = STATE) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, key=key)
        gym.ObservationWrapper.__init__(self, env)
        if not isinstance(key, str):
            raise ValueError(f"DictObservation: key must be a string, got {key!r}")
        if isinstance(env.observation_space, spaces.Dict):
            raise ValueError(
                f"DictObservation: the observation is a Dict already, with keys {list(env.observation_space.spaces)}; "
                "leave DictObservation out, or keep some of them with SelectModalities"
            )
        self.key = key
        self.observation_space = spaces.Dict({key: env.observation_space})

    def observation(self, observation: Any) -> Observation:
        """The observation under its key."""
        return {self.key: observation}


class SelectModalities(gym.ObservationWrapper[Observation, Any, Observation], gym.utils.RecordConstructorArgs):
    """
    Some entries of a Dict observation.

    :param env: Environment with a Dict observation.
    :param keys: Those to keep, at least one.
    :raises ValueError: if the observation is no Dict or nothing would be left.
    :raises KeyError: if a key is missing.
    """

    def __init__(self, env: gym.Env[Any, Any], keys: Collection[str]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, keys=keys)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Dict):
            raise ValueError(f"SelectModalities needs a Dict observation, got {space}; use DictObservation first")
        self.keys = _key_list(keys, "SelectModalities")
        self.observation_space = spaces.Dict(
            {key: pick(space.spaces, key, "SelectModalities") for key in self.keys}, sort_keys=space.sort_keys
        )

    def observation(self, observation: Observation) -> Observation:
        """The chosen entries."""
        return {key: observation[key] for key in self.keys}


class ChannelLastImages(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """
    Images as uint8 (H, W, C), whatever their form: channels first become last, (H, W) becomes (H, W, 1), and numbers
    in 0..1 or 0..255, floats or whole ones, are scaled and rounded to 0..255.

    The channels are the smallest of the three sizes; between equal ones, the last.

    :param env: Environment with a Dict observation, or with one image.
    :param keys: Keys of the images; the key of an observation that is itself an image is ``"state"``. None takes every
        Box of three sizes with bounds 0..1 or 0..255; grey (H, W) images must be named.
    :raises ValueError: if a named key is no image, if there is none, or on an image that is not of its space: its
        shape, its kind of number, or its bounds.
    :raises KeyError: if a key is missing.
    """

    def __init__(self, env: gym.Env[Any, Any], keys: Collection[str] | None = None) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, keys=keys)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        self._is_dict = isinstance(space, spaces.Dict)
        inner: dict[str, spaces.Space[Any]] = dict(space.spaces) if isinstance(space, spaces.Dict) else {STATE: space}
        if keys is not None:
            keys = _key_list(keys, "ChannelLastImages")
        else:
            keys = [key for key, part in inner.items() if image_fault(part) is None and len(part.shape or ()) == 3]
            if not keys:
                raise ValueError(
                    f"ChannelLastImages: no image of three sizes with bounds 0..1 or 0..255 among {inner}; "
                    "name grey images: keys=[...]"
                )
        for key in keys:
            fault = image_fault(pick(inner, key, "ChannelLastImages"))
            if fault is not None:
                raise ValueError(f"ChannelLastImages: {key!r} is not an image: {fault}, got {inner[key]}")
        self.keys = tuple(keys)
        #: Spaces of the images before the conversion.
        self.sources: dict[str, Any] = {key: inner[key] for key in self.keys}
        outer = dict(inner)
        for key, part in self.sources.items():
            shape = _channels_last(np.empty(part.shape, np.bool_)).shape
            outer[key] = spaces.Box(0, 255, shape, np.uint8)
        self.observation_space = (
            spaces.Dict(outer, sort_keys=space.sort_keys) if isinstance(space, spaces.Dict) else outer[STATE]
        )

    def observation(self, observation: Any) -> Any:
        """The observation with its images converted."""
        if not self._is_dict:
            return self._convert(STATE, observation)
        return {**observation, **{key: self._convert(key, observation[key]) for key in self.keys}}

    def _convert(self, key: str, image: Array) -> NDArray[np.uint8]:
        space = self.sources[key]
        same = isinstance(image, np.ndarray) and image.shape == space.shape
        if not same or not np.can_cast(image.dtype, space.dtype, "same_kind"):
            raise ValueError(
                f"ChannelLastImages: {key!r} should be {space.dtype} {space.shape}, as its space says, got "
                f"{describe(image)}"
            )
        high = float(space.high.max())
        if image.dtype != np.uint8 or high != 255:
            # Written so that NaN fails too.
            if not (image.min() >= 0 and image.max() <= high):
                raise ValueError(
                    f"ChannelLastImages: {key!r} is declared within 0..{high:g} and holds {image.min()!r} to "
                    f"{image.max()!r}; clip it, or declare its range: an image has bounds 0..1 or 0..255"
                )
            image = np.rint(image * (255 / high))
        return np.array(_channels_last(image), dtype=np.uint8, order="C")


def _key_list(keys: Any, wrapper: str) -> tuple[str, ...]:
    if isinstance(keys, str) or not isinstance(keys, Collection) or not keys:
        raise ValueError(f"{wrapper}: keys must be a non-empty list of keys, got {keys!r}")
    return tuple(keys)


def image_fault(space: Any) -> str | None:
    """What keeps a space from being an image; None if nothing does."""
    if not isinstance(space, spaces.Box) or len(space.shape) not in (2, 3):
        return "an image is a Box of shape (H, W), (H, W, C) or (C, H, W)"
    highest = np.unique(space.high)
    if np.dtype(space.dtype).kind not in "uif" or (space.low != 0).any() or highest.tolist() not in ([1], [255]):
        return "its bounds must be 0..1 or 0..255"
    if len(space.shape) == 3 and int(np.argmin(space.shape[::-1])) == 1:
        return "its channels would be the second size"
    return None


def _channels_last(image: Array) -> Array:
    if image.ndim == 2:
        return image[..., None]
    return np.moveaxis(image, 0, -1) if image.shape[0] < min(image.shape[1:]) else image
