"""Random shifts of images, the augmentation of DrQ (Kostrikov et al. 2020), for observations of several sensors."""

from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, PyTorchObs, ReplayBufferSamples

Samples = TypeVar("Samples", ReplayBufferSamples, DictReplayBufferSamples)


def shifted_copies(samples: Samples, pixels: int, n_copies: int = 1) -> Samples:
    """
    Copies of a batch of transitions, one behind the other, that differ by the random shifts of their images.

    :param samples: B transitions
    :param pixels: largest shift in each direction
    :param n_copies: M
    :return: M*B transitions; observations and next observations are shifted independently of each other
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
    DrQ's averaged target: every copy of a sample gets the mean of the copies' values.

    :param values: (M*B,), in the order of :func:`shifted_copies`
    :param n_copies: M
    :return: (M*B,)
    """
    return values.view(n_copies, -1).mean(dim=0).repeat(n_copies)


def random_shift(observations: PyTorchObs, pixels: int, n_copies: int = 1) -> PyTorchObs:
    """
    Shifts the images by whole pixels; what comes in from outside repeats the image's edge. That is padding by
    replication and cropping at random. All images of an observation, and all frames in them, move alike, so that what
    several sensors see in one place stays in one place; vectors stay as they are.

    :param observations: images (B, C, H, W) of any dtype and memory layout, vectors (B, n)
    :param pixels: each direction's shift is uniform over -pixels..pixels, drawn by PyTorch's generator
    :param n_copies: M, independently shifted copies
    :return: (M*B, ...), the copies one behind the other, images contiguous
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
    :param images: (B, C, H, W)
    :param shifts: (M*B, 2) pixels, of the rows and the columns: the pixel at (y, x) is what was at (y + dy, x + dx)
    :return: (M*B, C, H, W), contiguous, the i-th from image i modulo B
    """
    batch, channels, height, width = images.shape
    rows = (th.arange(height, device=images.device) + shifts[:, :1]).clamp(0, height - 1)
    columns = (th.arange(width, device=images.device) + shifts[:, 1:]).clamp(0, width - 1)
    # A gather moves bytes as they are, in a quarter of the time of indexing by rows and columns
    index = (rows[:, :, None] * width + columns[:, None, :]).view(-1, batch, 1, height * width)
    pixels = images.flatten(start_dim=2).expand(len(index), -1, -1, -1)
    return pixels.gather(3, index.expand(-1, -1, channels, -1)).view(-1, channels, height, width)


def check_random_shift(space: spaces.Space[Any], pixels: int, n_copies: int) -> None:
    """
    :param space: observation space, images channel-first
    :param pixels: HAVESAC's ``random_shift``
    :param n_copies: HAVESAC's ``n_augmentations``
    :raises ValueError: if they are no numbers of pixels and copies, if there is no image to shift, or none left of it
    """
    for name, value, least in [("random_shift", pixels, 0), ("n_augmentations", n_copies, 1)]:
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise ValueError(f"{name}={value!r}: expected a whole number, from {least} on.")
    if pixels == 0:
        if n_copies > 1:
            raise ValueError(
                f"n_augmentations={n_copies} with random_shift=0: all copies would be the same; give the shift too, 4 "
                "pixels in DrQ."
            )
        return
    shapes = {"observation": space.shape}
    if isinstance(space, spaces.Dict):
        shapes = {key: subspace.shape for key, subspace in space.spaces.items()}
    images = {key: shape for key, shape in shapes.items() if shape is not None and len(shape) == 3}
    if not images:
        raise ValueError(
            f"random_shift={pixels}: nothing would be shifted, there are no images among the observations {shapes}; "
            "leave it at 0."
        )
    for key, shape in images.items():
        if pixels >= min(shape[1:]):
            raise ValueError(
                f"random_shift={pixels}: observation key {key!r} has only {shape[1]}x{shape[2]} pixels, nothing would "
                "be left of it; take a smaller shift, DrQ's 4 for 84x84."
            )
