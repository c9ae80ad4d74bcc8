"""Checks of spaces and observations for what would otherwise fail silently or late."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import (
    get_flattened_obs_dim,
    is_image_space,
    is_image_space_channels_first,
)

# The smallest image in pixels that the default encoders can read
MIN_IMAGE_SIZE = 15


class Modality(NamedTuple):
    """A group of observation keys that share an encoder."""

    keys: tuple[str, ...]
    space: spaces.Box
    is_image: bool


def make_modality(
    name: str, keys: Sequence[str], space: spaces.Dict, normalize_images: bool, channels_first: bool
) -> Modality:
    """
    Check that an encoder can read these observations, and return their joint space.

    :param name: Name of the modality
    :param keys: Its observation keys
    :param space: Observation space
    :param normalize_images: Whether images have to be uint8
    :param channels_first: Whether to accept images whose shape does not show which axis holds the channels
    :raises ValueError: if an observation cannot be encoded, or they cannot be encoded together
    """
    if isinstance(keys, str) or not keys:
        raise ValueError(f"modality {name!r}: expected a non-empty list of observation keys, got {keys!r}.")
    check_known(f"modality {name!r}", keys, space.spaces)
    boxes = [_as_box(key, space[key], normalize_images, channels_first) for key in keys]
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
        "make each of them a modality."
    )


def _as_box(key: str, space: spaces.Space[Any], normalize_images: bool, channels_first: bool) -> spaces.Box:
    """Return the space that an encoder reads for an observation, which is one-hot encoded if it is discrete."""
    where = f"observation key {key!r}"
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        if isinstance(space, spaces.MultiBinary):
            _check_matrix(where, space)
        if isinstance(space, spaces.MultiDiscrete) and len(space.shape) > 1:  # as in SB3
            raise ValueError(f"{where}: expected a MultiDiscrete of one axis, got {space}; flatten it in a wrapper.")
        return spaces.Box(0.0, 1.0, (get_flattened_obs_dim(space),), np.float32)
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"{where}: expected a Box (an image or a vector), Discrete, MultiDiscrete or MultiBinary, got {space}; "
            "encode it as numbers in a wrapper (gymnasium.spaces.utils.flatten)."
        )
    if len(space.shape) != 3:
        _check_matrix(where, space)
        return space
    if normalize_images and not is_image_space(space):
        raise ValueError(
            f"{where}: expected a uint8 image with bounds 0..255, got {space.dtype} of shape {space.shape} in "
            f"[{space.low.min()}, {space.high.max()}]; convert it to uint8 (under "
            "VecNormalize, leave it out of `norm_obs_keys`), or pass "
            "`policy_kwargs=dict(normalize_images=False)` to feed channel-first images as they are."
        )
    if channels_first:
        return space
    if not is_image_space_channels_first(space):
        raise ValueError(
            f"{where}: expected a channel-first image (C, H, W), got shape {space.shape}; SB3 transposes uint8 images "
            "with bounds 0..255 by itself, others have to be transposed by the environment."
        )
    channels, height, width = space.shape
    # The smallest axis is certainly that of the channels if the others are equal or much larger
    if not (channels < height == width or 2 * channels <= min(height, width)):
        raise ValueError(
            f"{where}: the shape {space.shape} does not show which axis holds the channels, because there are almost "
            f"as many channels as rows or columns. SB3 takes the smallest: {channels} channels of {height}x{width} "
            "pixels. If that is right, pass `policy_kwargs=dict(channels_first=True)`; otherwise use fewer channels "
            "(event bins, stacked frames) or a larger image."
        )
    return space


def _check_matrix(where: str, space: spaces.Box | spaces.MultiBinary) -> None:
    """Refuse what is probably an image, but would be flattened to a vector."""
    shape = space.shape
    is_large = sum(size >= MIN_IMAGE_SIZE for size in shape) >= 2
    is_gray = len(shape) == 2 and space.dtype == np.uint8 and np.all(getattr(space, "high", 0) == 255)
    if is_large or is_gray:
        remedy = (
            "stack frames by SB3's VecFrameStack instead of gymnasium's FrameStackObservation"
            if len(shape) > 3
            else "give a gray image a channel axis (gymnasium.wrappers.ReshapeObservation, or image[..., None]) and "
            "convert it to uint8 (DepthObservation does for depth), or flatten it if it is a vector"
        )
        raise ValueError(
            f"{where}: expected an image (H, W, C) or a vector, got {space.dtype} of shape {shape}; {remedy}."
        )


def check_known(where: str, names: Sequence[str] | Mapping[str, Any], known: Sequence[str] | Mapping[str, Any]) -> None:
    """Raise a ValueError about ``where`` if some of the ``names`` are not ``known``."""
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"{where}: unknown {', '.join(map(repr, unknown))}; known are {', '.join(map(repr, known))}.")


def check_action_space(space: spaces.Space[Any]) -> None:
    """
    Check that an agent with continuous actions can act in an environment.

    :param space: Action space of the environment
    :raises ValueError: if it is not a Box of floats with finite and different bounds
    """
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"action space: HAVESAC needs continuous actions (Box), got {space}; use a wrapper that maps a Box to "
            "these actions, or an algorithm for discrete actions such as SB3's DQN."
        )
    if not np.issubdtype(space.dtype, np.floating):
        raise ValueError(
            f"action space: expected a Box of floats, got {space.dtype}, to which SB3 would truncate the actions in "
            "the replay buffer; use gymnasium.wrappers.TransformAction to round actions of a float32 Box."
        )
    with np.errstate(over="ignore"):
        width = space.high - space.low
    if not (np.isfinite(width).all() and (width > 0).all()):
        raise ValueError(
            f"action space: high - low must be finite and positive, got {width} for {space}; use "
            "gymnasium.wrappers.RescaleAction, or remove action dimensions that allow only one value."
        )


def check_observation(observation: np.ndarray | dict[str, np.ndarray], space: spaces.Space[Any]) -> None:
    """
    Check observations before a policy reads them or a replay buffer stores them.

    :param observation: One observation or a batch of observations
    :param space: Observation space
    :raises ValueError: if a key is missing or unknown, or a value has another shape, is a float image where bytes are
        expected, or is not finite; the message names the key
    """
    if isinstance(space, spaces.Dict):
        if not isinstance(observation, dict):
            raise ValueError(
                f"Expected a dict with the keys {list(space.spaces)}, got {type(observation).__name__}; "
                "pass the observation as the environment returns it."
            )
        missing = [key for key in space.spaces if key not in observation]
        unknown = [key for key in observation if key not in space.spaces]
        if missing or unknown:
            raise ValueError(
                f"observation keys {list(observation)} do not match the {list(space.spaces)} that the policy was "
                f"built for: missing {missing}, unknown {unknown}; give every key of the training environment "
                "(a failed sensor's image as zeros) and no other."
            )
    elif isinstance(observation, dict):
        raise ValueError(f"Expected an array of shape {space.shape}, got a dict with the keys {list(observation)}.")
    items = observation.items() if isinstance(observation, dict) else [("observation", observation)]
    for key, value in items:
        _check_value(key, np.asarray(value), space[key] if isinstance(space, spaces.Dict) else space)


def cast_observation(
    observation: np.ndarray | dict[str, np.ndarray], space: spaces.Space[Any]
) -> np.ndarray | dict[str, np.ndarray]:
    """
    Cast an observation to the data type and shape of its space, as SB3's vectorized environments cast all observations
    but the last one of an episode.

    :param observation: One observation
    :param space: Observation space
    """
    if isinstance(space, spaces.Dict):
        subspaces = space.spaces
        return {key: cast_observation(value, subspaces[key]) for key, value in observation.items() if key in subspaces}  # type: ignore[misc, union-attr]
    array = np.asarray(observation)
    if len(space.shape or ()) == 3:  # an image, which check_observation checks
        return array
    array = array.astype(space.dtype, copy=False)
    return array.reshape(space.shape) if array.size == np.prod(space.shape or ()) else array


def check_stored_observation(observation: np.ndarray | dict[str, np.ndarray], space: spaces.Space[Any]) -> None:
    """
    Check that the observations have their final shape before VecNormalize, because SB3 stores them from there.

    :param observation: Batch of observations, as SB3 will store them
    :param space: Observation space of the policy
    :raises ValueError: if VecNormalize is not the outermost wrapper that changes shapes
    """
    items = observation.items() if isinstance(observation, dict) else [("observation", observation)]
    for key, value in items:
        expected = (space[key] if isinstance(space, spaces.Dict) else space).shape
        if value.shape[1:] != expected:
            raise ValueError(
                f"observation key {key!r}: VecNormalize gets the shape {value.shape[1:]}, the policy reads {expected}; "
                "wrap in the order VecNormalize(VecTransposeImage(VecFrameStack(env, n)), norm_obs_keys=[...])."
            )


def _check_value(key: str, value: np.ndarray, space: spaces.Space[Any]) -> None:
    assert space.shape is not None
    shapes = [space.shape]
    is_image = len(space.shape) == 3 and space.dtype == np.uint8
    if is_image:  # SB3 transposes it, from what the environment returns to what the policy reads
        shapes.append((*space.shape[1:], space.shape[0]))
    if value.shape not in shapes and value.shape[1:] not in shapes:
        raise ValueError(
            f"observation key {key!r}: expected the shape {' or '.join(map(str, shapes))}, or a batch of it, got "
            f"{value.shape}; pass it as in training, including frame stacking and image size."
        )
    if not np.issubdtype(value.dtype, np.floating):
        return
    if is_image:
        raise ValueError(
            f"observation key {key!r}: expected a uint8 image in 0..255, got {value.dtype}; convert it to uint8, or "
            "train on float images with `policy_kwargs=dict(normalize_images=False)`."
        )
    if not np.isfinite(value).all():
        raise ValueError(
            f"observation key {key!r}: {np.count_nonzero(~np.isfinite(value))} of {np.size(value)} values are NaN "
            "or infinite; fix the environment (SB3's VecCheckNan shows where they come from)."
        )
