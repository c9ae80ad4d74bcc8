"""Encoders: from a Dict of raw observations to one feature vector for each modality."""

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.preprocessing import (
    preprocess_obs,
)
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_have.common.fusion import encode_fused, make_fusions
from sb3_have.common.validation import MIN_IMAGE_SIZE, Modality, check_known, make_modality

# One event is 0.125, about the contrast of a clearly visible edge in an image scaled to [0, 1]
EVENT_SCALE = 1 / 8
PRECISIONS = ("auto", "float32", "bfloat16")
# Images of at least this many pixels get the paper's encoder by default, smaller ones that of the Nature DQN
PAPER_ENCODER_MIN_SIZE = 112


class ImageEncoder(nn.Module):
    """
    Convolutions, a linear layer and a LayerNorm: float (batch, channels, height, width) to (batch, features_dim).

    :param observation_space: Box of shape (channels, height, width)
    :param features_dim: Number of features
    :param layers: Filters, kernel size and stride of each convolution. By default they depend on the size of the image:
        the four 3x3 layers of the paper (as in SAC-AE, Yarats et al. 2021) from 112 pixels up, the three layers of the
        Nature DQN (Mnih et al. 2015) from 36 pixels up, and three 3x3 layers below that.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 50,
        layers: Sequence[tuple[int, int, int]] | None = None,
    ):
        super().__init__()
        channels, height, width = observation_space.shape
        if layers is None:
            layers = default_layers(min(height, width))
        modules: list[nn.Module] = []
        for filters, kernel_size, stride in layers:
            conv_class = nn.Conv2d if modules else BlockConv2d
            modules += [conv_class(channels, filters, kernel_size, stride), nn.ReLU(inplace=True)]
            channels = filters
        self.convolutions = nn.Sequential(*modules)
        _, kernel_size, stride = layers[0] if layers else (0, 1, 1)
        fits = kernel_size > stride and kernel_size % stride == height % stride == width % stride == 0
        # Side of the blocks of pixels that :class:`BlockConv2d` reads fastest; 1 means single pixels
        self.block_size = stride if fits and stride in (2, 4, 8) and has_avx512() else 1
        with th.no_grad():
            n_flatten = self.convolutions(th.zeros(1, *observation_space.shape)).numel()
        self.output = nn.Sequential(nn.Linear(n_flatten, features_dim), nn.LayerNorm(features_dim))
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.features(self.convolutions(observations.contiguous(memory_format=th.channels_last)))

    @property
    def stages(self) -> list[nn.Module]:
        """Each convolution with its ReLU. A fusion acts between them."""
        return [self.convolutions[i : i + 2] for i in range(0, len(self.convolutions), 2)]

    def features(self, maps: th.Tensor) -> th.Tensor:
        """Features (batch, features_dim) from the maps after the last stage."""
        features: th.Tensor = self.output(maps.permute(0, 2, 3, 1).flatten(start_dim=1))  # a view, not a copy
        return features


class BlockConv2d(nn.Conv2d):
    """
    A convolution that also accepts images in blocks of stride x stride pixels (space to depth), see :func:`_look_up`.

    The sums are the same: 8x8 with stride 4 on pixels is 2x2 with stride 1 on blocks of 4x4. The latter is faster on a
    CPU with AVX-512 and slower without it, because of the backward pass (``benchmarks.block_conv``).
    """

    def forward(self, images: th.Tensor) -> th.Tensor:
        if images.shape[1] == self.in_channels:
            return super().forward(images)
        stride, n = self.stride[0], self.kernel_size[0] // self.stride[0]
        weight = self.weight.view(self.out_channels, self.in_channels, n, stride, n, stride)
        weight = weight.permute(0, 3, 1, 5, 2, 4)  # (filters, row in block, channel, column in block, n, n)
        return F.conv2d(images, weight.reshape(self.out_channels, -1, n, n), self.bias)


def default_layers(size: int) -> list[tuple[int, int, int]]:
    """Return filters, kernel size and stride of each convolution for an image whose shorter side is ``size`` pixels."""
    if size >= PAPER_ENCODER_MIN_SIZE:
        return [(32, 3, 2), (32, 3, 1), (32, 3, 1), (32, 3, 1)]
    if size >= 36:
        return [(32, 8, 4), (64, 4, 2), (64, 3, 1)]
    if size >= MIN_IMAGE_SIZE:
        return [(32, 3, 2), (64, 3, 2), (64, 3, 1)]
    raise ValueError(
        f"The default image encoders need at least 15x15 pixels, got {size}: enlarge the image, "
        "or give `encoder_kwargs={<modality>: dict(layers=[(filters, kernel_size, stride), ...])}` in `policy_kwargs`."
    )


class VectorEncoder(nn.Module):
    """
    A multi-layer perceptron and a LayerNorm: float (batch, n) to (batch, features_dim).

    :param observation_space: Box of shape (n,)
    :param features_dim: Number of features
    :param net_arch: Widths of the hidden layers
    """

    def __init__(self, observation_space: spaces.Box, features_dim: int = 50, net_arch: Sequence[int] = (64,)):
        super().__init__()
        widths = [int(np.prod(observation_space.shape)), *net_arch]
        hidden = [module for n_in, n_out in pairwise(widths) for module in (nn.Linear(n_in, n_out), nn.ReLU())]
        self.net = nn.Sequential(*hidden, nn.Linear(widths[-1], features_dim), nn.LayerNorm(features_dim))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features: th.Tensor = self.net(observations)
        return features


class MultiModalEncoder(nn.Module):
    """
    One encoder per modality: z_i = Enc_i(o_i), stacked to (batch, d, features_dim).

    The encoder decodes raw observations by fixed scales and never by statistics of the batch, so that acting and
    training see the same numbers. uint8 images are divided by 255. Images of signed counts (128 means none, as for an
    event camera) become ``(value - 128) / 8``; 0 means "no data" and decodes to 0 like "no event", because frame
    stacking pads with zeros at reset. Vectors are taken as they are, and all images with ``normalize_images=False``.
    Discrete, MultiDiscrete and MultiBinary observations are vectors, encoded one-hot as in SB3.

    :param observation_space: Dict of images (channel-first Box), vectors and discrete spaces, or one such space, a
        single modality named ``observation``
    :param features_dim: Number of features of each modality (F)
    :param modalities: The observation keys of each modality, such as
        ``{"vision": ["rgb", "depth"], "event": ["event"]}``. The keys of a modality are all images of one size or all
        vectors. By default every key is a modality.
    :param encoder_classes: Custom encoder classes for some modalities, called as
        ``cls(space, features_dim=F, **kwargs)``; SB3's features extractors fit
    :param encoder_kwargs: Keyword arguments for the encoders of some modalities
    :param signed_keys: Image keys that hold signed counts around 128; by default those with "event" in their name
    :param normalize_images: Whether to decode uint8 images as described above
    :param precision: Arithmetic of the image encoders: "float32", "bfloat16" (weights and features stay float32), or
        "auto", which uses bfloat16 where the hardware multiplies it natively (a CPU with AMX, CUDA from sm80 on)
    :param fusion: Fusion of the modalities' feature maps: "concat" (none: the features are concatenated later),
        "transfuser", "efnet", or a custom class, see :mod:`sb3_have.common.fusion`. All modalities must be images.
    :param fusion_kwargs: Keyword arguments for the fusion, and ``stages``, the convolutions after which it is applied,
        each time with its own parameters: "last" (default), "all", or their numbers starting at 0
    :param channels_first: Whether to read images as (channels, height, width) even if their shape does not show which
        axis holds the channels, because there are almost as many channels as rows or columns
    :raises ValueError: for a space, key or modality that cannot be encoded
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        features_dim: int = 50,
        modalities: Mapping[str, Sequence[str]] | None = None,
        encoder_classes: Mapping[str, type[nn.Module]] | None = None,
        encoder_kwargs: Mapping[str, Mapping[str, Any]] | None = None,
        signed_keys: Sequence[str] | None = None,
        normalize_images: bool = True,
        precision: str = "auto",
        fusion: str | type[nn.Module] = "concat",
        fusion_kwargs: Mapping[str, Any] | None = None,
        channels_first: bool = False,
    ):
        super().__init__()
        if precision not in PRECISIONS:
            raise ValueError(f"precision={precision!r}: expected one of {PRECISIONS}.")
        if not isinstance(observation_space, spaces.Dict):
            observation_space = spaces.Dict({"observation": observation_space})
        keys = list(observation_space.spaces)
        if modalities is None:
            modalities = {key: [key] for key in keys}
        self.modalities = {
            name: make_modality(name, group, observation_space, normalize_images, channels_first)
            for name, group in modalities.items()
        }
        if not self.modalities:
            raise ValueError("`modalities` is empty: name at least one modality and its observation keys.")
        encoder_classes, encoder_kwargs = encoder_classes or {}, encoder_kwargs or {}
        check_known("encoder_classes", encoder_classes, self.modalities)
        check_known("encoder_kwargs", encoder_kwargs, self.modalities)
        if signed_keys is None:
            signed_keys = [key for key in keys if "event" in key]
        else:
            check_known(
                "signed_keys", signed_keys, [key for key in keys if len(observation_space[key].shape or ()) == 3]
            )
        self.discrete_spaces = {
            key: space for key, space in observation_space.spaces.items() if not isinstance(space, spaces.Box)
        }
        self.features_dim = features_dim
        self.signed_keys = frozenset(signed_keys)
        self.normalize_images = normalize_images
        self.precision = precision
        self.encoders = nn.ModuleList()
        for name, modality in self.modalities.items():
            default_class = ImageEncoder if modality.is_image else VectorEncoder
            encoder_class = encoder_classes.get(name, default_class)
            self.encoders.append(
                encoder_class(modality.space, features_dim=features_dim, **encoder_kwargs.get(name, {}))
            )
        self.fusions = nn.ModuleDict()
        if fusion != "concat":
            encoders = dict(zip(self.modalities, self.encoders, strict=True))
            shapes = {name: modality.space.shape for name, modality in self.modalities.items()}
            self.fusions = make_fusions(fusion, encoders, shapes, **(fusion_kwargs or {}))
        elif fusion_kwargs:
            raise ValueError(
                f'fusion="concat" takes no fusion_kwargs, got {fusion_kwargs}; name the fusion they are for.'
            )

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        if not isinstance(observations, dict):
            observations = {"observation": observations}
        if self.fusions:
            modules = zip(self.encoders, self.modalities.values(), strict=True)
            images = [self._inputs(encoder, modality, observations) for encoder, modality in modules]
            with _autocast(images[0]):
                encoded = encode_fused(list(self.encoders), self.fusions, images)
        else:
            encoded = []
            for encoder, modality in zip(self.encoders, self.modalities.values(), strict=True):
                inputs = self._inputs(encoder, modality, observations)
                with _autocast(inputs):
                    encoded.append(encoder(inputs))
        for (name, modality), encoder, features in zip(self.modalities.items(), self.encoders, encoded, strict=True):
            expected = (observations[modality.keys[0]].shape[0], self.features_dim)
            if features.shape != expected:
                raise ValueError(
                    f"modality {name!r}: {type(encoder).__name__} gave features of shape {tuple(features.shape)}, "
                    f"expected {expected}; its output must have `features_dim` units."
                )
        return th.stack([features.float() for features in encoded], dim=1)

    def image_dtype(self, device: th.device) -> th.dtype:
        """Return the data type in which the image encoders compute on ``device``."""
        bfloat16 = self.precision == "bfloat16" or (self.precision == "auto" and has_native_bfloat16(device.type))
        return th.bfloat16 if bfloat16 else th.float32

    def _inputs(self, encoder: nn.Module, modality: Modality, observations: dict[str, th.Tensor]) -> th.Tensor:
        """Decode the observations of a modality for its encoder."""
        dtype = self.image_dtype(observations[modality.keys[0]].device) if modality.is_image else th.float32
        # Subclasses may expect pixels, and the channels of several images cannot be joined in blocks
        block_size = encoder.block_size if type(encoder) is ImageEncoder and len(modality.keys) == 1 else 1
        decoded = [self._decode(key, observations[key], modality.is_image, dtype, block_size) for key in modality.keys]
        return decoded[0] if len(decoded) == 1 else th.cat(decoded, dim=1)

    def _decode(
        self, key: str, observation: th.Tensor, is_image: bool, dtype: th.dtype, block_size: int = 1
    ) -> th.Tensor:
        if not is_image:
            if key in self.discrete_spaces and not observation.is_floating_point():  # else SB3 has encoded it
                observation = one_hot(observation, self.discrete_spaces[key])
            return observation.to(dtype).flatten(start_dim=1)
        signed = key in self.signed_keys
        # A traced graph cannot contain the look-up table, which is a NumPy array
        traced = th.compiler.is_compiling() or th.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
        if self.normalize_images and observation.dtype == th.uint8 and observation.device.type == "cpu" and not traced:
            return _look_up(observation, signed, dtype, block_size)
        # Transpose before the conversion to a wider data type, when there are fewer bytes to move
        observation = observation.contiguous(memory_format=th.channels_last)
        return (decode_bytes(observation, signed) if self.normalize_images else observation).to(dtype)


class MultiModalExtractor(BaseFeaturesExtractor):
    """
    The encoders of HAVESAC for SB3's other algorithms: the concatenated features of :class:`MultiModalEncoder`::

        TQC("MultiInputPolicy", env,
            policy_kwargs=dict(features_extractor_class=MultiModalExtractor, normalize_images=False))

    With ``normalize_images=False`` SB3 does not divide images by 255; the encoder decodes them, and signed counts have
    another scale.

    :param observation_space: Observation space, see :class:`MultiModalEncoder`
    :param features_dim: Number of features of each modality (F); SB3's attribute ``features_dim`` is d * F
    :param encoder_kwargs: Additional arguments for :class:`MultiModalEncoder`
    :raises ValueError: see :class:`MultiModalEncoder`; also in ``forward``, if SB3 has already scaled the images
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 50, **encoder_kwargs: Any):
        encoder = MultiModalEncoder(observation_space, features_dim, **encoder_kwargs)
        super().__init__(observation_space, len(encoder.modalities) * features_dim)
        self.encoder = encoder
        # SB3 passes floats; convert them back to bytes, which are twice as fast to decode
        self.byte_keys = [
            key
            for modality in encoder.modalities.values()
            for key in modality.keys
            if modality.is_image and encoder.normalize_images
        ]
        self._has_seen_bytes = False

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """Return features (B, d*F) of observations whose images hold 0..255, in any data type."""
        raw = dict(observations) if isinstance(observations, dict) else {"observation": observations}
        for key in self.byte_keys:
            self._check_scale(key, raw[key])
            raw[key] = raw[key].to(th.uint8)
        features: th.Tensor = self.encoder(raw).flatten(start_dim=1)
        return features

    def _check_scale(self, key: str, images: th.Tensor) -> None:
        if self._has_seen_bytes or th.compiler.is_compiling():
            return
        if images.is_floating_point() and (images != images.round()).any():
            raise ValueError(
                f"observation key {key!r}: expected the bytes of an image, 0..255, got fractions such as "
                f"{images[images != images.round()][0]:.3g}; keep SB3 from scaling it, by "
                "`policy_kwargs=dict(features_extractor_class=MultiModalExtractor, normalize_images=False)`."
            )
        self._has_seen_bytes = bool((images > 1).any())  # never true of images that SB3 has scaled


def one_hot(observations: th.Tensor, space: spaces.Space[Any]) -> th.Tensor:
    """Encode the observations (B, ...) of a discrete space as SB3 does, even if its values do not start at 0."""
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        observations = observations - th.as_tensor(space.start, device=observations.device)
    if isinstance(space, spaces.MultiDiscrete):
        observations = observations.flatten(start_dim=1)
    encoded: th.Tensor = preprocess_obs(observations, space, normalize_images=False)  # type: ignore[assignment]
    return encoded


def decode_bytes(values: th.Tensor, signed: bool) -> th.Tensor:
    """Decode the bytes of an image to float32, see :class:`MultiModalEncoder`."""
    if signed:
        return F.threshold(values.to(th.float32) - 128, -127.5, 0.0) * EVENT_SCALE  # 0 is "no data"
    return values.to(th.float32) / 255


def _look_up(images: th.Tensor, signed: bool, dtype: th.dtype, block_size: int = 1) -> th.Tensor:
    """
    Apply :func:`decode_bytes` to uint8 images on a CPU by a look-up table, which is faster than arithmetic.

    :param images: (B, C, H, W)
    :param signed: Whether the bytes are signed counts
    :param dtype: float32 or bfloat16
    :param block_size: Side n of the blocks of pixels for :class:`BlockConv2d`: 2, 4 or 8, or 1 for no blocks
    :return: (B, n*n*C, H/n, W/n) in channels-last memory; channels are ordered by row in block, channel, column in
        block
    """
    batch, channels, height, width = images.shape
    table = _table(signed, dtype)
    if block_size > 1 and batch > 0:
        # Move the pixels in a row of a block as one integer
        rows = images.contiguous().numpy().view(f"u{block_size}")
        rows = rows.reshape(batch, channels, height // block_size, block_size, width // block_size)
        blocks = np.ascontiguousarray(rows.transpose(0, 2, 4, 3, 1)).view(np.uint8)
        decoded = th.from_numpy(cv2.LUT(blocks.reshape(1, -1), table)).view(dtype)
        return decoded.view(batch, height // block_size, width // block_size, -1).permute(0, 3, 1, 2)
    # Go image by image, so that the bytes stay in the processor's cache between transposition and look-up
    values = np.empty((batch, 1, height * width * channels), table.dtype)
    transposed = np.empty((height * width, channels), np.uint8)
    for image, decoded in zip(images.contiguous().numpy(), values, strict=True):
        cv2.transpose(image.reshape(channels, -1), transposed)
        cv2.LUT(transposed.reshape(1, -1), table, decoded)
    return th.from_numpy(values).view(dtype).view(batch, height, width, channels).permute(0, 3, 1, 2)


@cache
def _table(signed: bool, dtype: th.dtype) -> np.ndarray:
    """Return the 256 values of :func:`decode_bytes`; the bits of bfloat16 as integers for OpenCV."""
    table = decode_bytes(th.arange(256, device="cpu"), signed).to(dtype)
    return (table.view(th.int16) if dtype == th.bfloat16 else table).numpy()


def _autocast(inputs: th.Tensor) -> th.autocast:
    """Compute in the data type of ``inputs``."""
    return th.autocast(inputs.device.type, dtype=inputs.dtype, enabled=inputs.dtype != th.float32)


def has_avx512() -> bool:
    """Whether the CPU has AVX-512."""
    return th.backends.cpu.get_cpu_capability() == "AVX512"


def has_native_bfloat16(device_type: str) -> bool:
    """Whether the hardware multiplies bfloat16 matrices natively: a CPU with AMX, or CUDA from sm80 on."""
    if device_type == "cuda":
        return th.cuda.get_device_capability() >= (8, 0)
    return device_type == "cpu" and th.cpu._is_amx_tile_supported()


# The compiler cannot query the hardware. `th.compiler.assume_constant_result` would do the same, but importing the
# compiler takes as long as importing the rest of PyTorch.
has_native_bfloat16._dynamo_marked_constant = True  # type: ignore[attr-defined]
