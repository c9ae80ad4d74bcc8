"""Which observations make a modality: groups of keys of a Dict space, checked for what encoders can read."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first


class Modality(NamedTuple):
    """One group of observation keys that share an encoder."""

    keys: tuple[str, ...]
    space: spaces.Box
    is_image: bool


def make_modality(name: str, keys: Sequence[str], space: spaces.Dict, normalize_images: bool) -> Modality:
    """
    :param name: of the modality
    :param keys: of the observations that it is made of
    :param space: of all observations
    :param normalize_images: whether images have to be uint8
    :raises ValueError: if they cannot be encoded, or not together; the message names the key and the remedy
    """
    if isinstance(keys, str) or not keys:
        raise ValueError(f"modality {name!r}: expected a non-empty list of observation keys, got {keys!r}.")
    check_known(f"modality {name!r}", keys, space.spaces)
    boxes = [_check_box(key, space[key], normalize_images) for key in keys]
    is_image = [len(box.shape) == 3 for box in boxes]
    if len(keys) == 1:
        return Modality(tuple(keys), boxes[0], is_image[0])
    shapes = {key: box.shape for key, box in zip(keys, boxes, strict=True)}
    if all(is_image) and len({shape[1:] for shape in shapes.values()}) == 1:
        shape = (sum(box.shape[0] for box in boxes), *boxes[0].shape[1:])
        dtypes = {box.dtype for box in boxes}
        if dtypes == {np.dtype(np.uint8)}:
            return Modality(tuple(keys), spaces.Box(0, 255, shape, np.uint8), True)
        return Modality(tuple(keys), spaces.Box(-np.inf, np.inf, shape, np.float32), True)
    if not any(is_image):
        size = sum(int(np.prod(box.shape)) for box in boxes)
        return Modality(tuple(keys), spaces.Box(-np.inf, np.inf, (size,), np.float32), False)
    raise ValueError(
        f"modality {name!r}: its keys must be images of one height and width, or all vectors, got {shapes}; "
        "make them modalities of their own."
    )


def _check_box(key: str, space: spaces.Space[Any], normalize_images: bool) -> spaces.Box:
    where = f"observation key {key!r}"
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"{where}: expected a Box (an image or a vector), got {space}; encode it as numbers, e.g. "
            "by a wrapper that flattens or one-hot encodes this key (gymnasium.spaces.utils.flatten)."
        )
    if len(space.shape) == 2 and space.dtype == np.uint8:
        raise ValueError(
            f"{where}: expected an image (H, W, C) or a vector, got {space.dtype} of shape {space.shape}; give a grey "
            "image a channel axis (gymnasium.wrappers.ReshapeObservation, or image[..., None])."
        )
    if len(space.shape) != 3:
        return space
    if normalize_images and not is_image_space(space):
        raise ValueError(
            f"{where}: expected a uint8 image with bounds 0..255, got {space.dtype} of shape {space.shape} in "
            f"[{space.low.min()}, {space.high.max()}]; convert it to uint8 (under "
            "VecNormalize, leave it out of `norm_obs_keys`), or pass "
            "`policy_kwargs=dict(normalize_images=False)` to feed channel-first images as they are."
        )
    if not is_image_space_channels_first(space):
        raise ValueError(
            f"{where}: expected a channel-first image (C, H, W), got shape {space.shape}; SB3 transposes uint8 images "
            "with bounds 0..255 by itself, others have to be transposed by the environment."
        )
    return space


def check_known(where: str, names: Sequence[str] | Mapping[str, Any], known: Sequence[str] | Mapping[str, Any]) -> None:
    """ValueError if ``names`` are not all among ``known``; ``where`` says what they are."""
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"{where}: unknown {', '.join(map(repr, unknown))}; known are {', '.join(map(repr, known))}.")
