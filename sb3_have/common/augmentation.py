"""Random shifts of images, the augmentation of DrQ (Kostrikov et al. 2020), for observations of several sensors."""

from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, PyTorchObs, ReplayBufferSamples

Samples = TypeVar("Samples", ReplayBufferSamples, DictReplayBufferSamples)


def shifted_copies(samples: Samples, pixels: int, n_copies: int = 1) -> Samples:
    """
    Concatenate copies of a batch of transitions whose images are shifted randomly.

    :param samples: B transitions
    :param pixels: Largest shift in each direction
    :param n_copies: Number of copies (M)
    :return: M*B transitions; observations and next observations are shifted independently
    """
    changed: dict[str, Any] = {
        name: value.repeat(n_copies, 1)
        for name, value in samples._asdict().items()
        if isinstance(value, th.Tensor) and value.dim() == 2
    }
    for name in ("observations", "next_observations"):
        changed[name] = random_shift(getattr(samples, name), pixels, n_copies)
    return samples._replace(**changed)


def mean_over_copies(values: th.Tensor, n_copies: int) -> th.Tensor:
    """
    Average the values of the copies of each sample (the target of DrQ).

    :param values: (M*B,), in the order of :func:`shifted_copies`
    :param n_copies: Number of copies (M)
    :return: (M*B,), the same mean for every copy of a sample
    """
    return values.view(n_copies, -1).mean(dim=0).repeat(n_copies)


def random_shift(observations: PyTorchObs, pixels: int, n_copies: int = 1) -> PyTorchObs:
    """
    Shift images by whole pixels and repeat their edges, as padding by replication and a random crop do.

    All images of an observation and all frames in them are shifted by the same amount, so that what several sensors see
    in one place stays in one place. Vectors are not changed.

    :param observations: Images (B, C, H, W) of any dtype and memory layout, and vectors (B, n)
    :param pixels: Shifts are uniform over -pixels..pixels in each direction, drawn by PyTorch's generator
    :param n_copies: Number of independently shifted copies (M)
    :return: (M*B, ...), the concatenated copies; images are contiguous
    """
    values = observations if isinstance(observations, dict) else {"observation": observations}
    first = next(iter(values.values()))
    shifts = th.randint(-pixels, pixels + 1, (n_copies * len(first), 2), device=first.device)
    moved = {
        key: shift_images(value, shifts) if value.dim() == 4 else value.repeat(n_copies, *[1] * (value.dim() - 1))
        for key, value in values.items()
    }
    return moved if isinstance(observations, dict) else moved["observation"]


def shift_images(images: th.Tensor, shifts: th.Tensor) -> th.Tensor:
    """
    Shift each image by its own number of rows and columns.

    :param images: (B, C, H, W)
    :param shifts: (M*B, 2) rows dy and columns dx [pixels]: the new pixel at (y, x) is the old one at (y + dy, x + dx)
    :return: (M*B, C, H, W), contiguous; the i-th is made from image i modulo B
    """
    batch, channels, height, width = images.shape
    rows = (th.arange(height, device=images.device) + shifts[:, :1]).clamp(0, height - 1)
    columns = (th.arange(width, device=images.device) + shifts[:, 1:]).clamp(0, width - 1)
    # Gathering bytes takes a quarter of the time of indexing by rows and columns
    index = (rows[:, :, None] * width + columns[:, None, :]).view(-1, batch, 1, height * width)
    pixels = images.flatten(start_dim=2).expand(len(index), -1, -1, -1)
    return pixels.gather(3, index.expand(-1, -1, channels, -1)).view(-1, channels, height, width)


def check_random_shift(space: spaces.Space[Any], pixels: int, n_copies: int) -> None:
    """
    Check the arguments for random shifts.

    :param space: Observation space with channel-first images
    :param pixels: HAVESAC's ``random_shift``
    :param n_copies: HAVESAC's ``n_augmentations``
    :raises ValueError: if they are out of range, if there are no images, or if an image is smaller than the shift
    """
    for name, value, least in [("random_shift", pixels, 0), ("n_augmentations", n_copies, 1)]:
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
            raise ValueError(f"{name}={value!r}: expected a whole number >= {least}.")
    if pixels == 0:
        if n_copies > 1:
            raise ValueError(
                f"n_augmentations={n_copies} with random_shift=0: all copies would be the same; set random_shift too "
                "(DrQ uses 4 pixels)."
            )
        return
    shapes = {"observation": space.shape}
    if isinstance(space, spaces.Dict):
        shapes = {key: subspace.shape for key, subspace in space.spaces.items()}
    images = {key: shape for key, shape in shapes.items() if shape is not None and len(shape) == 3}
    if not images:
        raise ValueError(f"random_shift={pixels}: there are no images among the observations {shapes}; leave it at 0.")
    for key, shape in images.items():
        if pixels >= min(shape[1:]):
            raise ValueError(
                f"random_shift={pixels}: observation key {key!r} has only {shape[1]}x{shape[2]} pixels; use a smaller "
                "shift (DrQ uses 4 for 84x84)."
            )
