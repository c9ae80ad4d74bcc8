"""
Fusion of feature maps: image encoders exchange information between their convolutions.

Shapes: B batch, d modalities; the map of modality i has C_i channels, H_i rows and W_i columns. A fusion follows a
stage (a convolution and its ReLU) of all encoders. Each encoder then continues with its own fused map, so there is
still one feature vector per modality, as without a fusion.

Fusions are initialised so that they add zero to the maps, and learning starts as without them. With PyTorch's default
initialisation the added values are 4 to 60 times as large as the maps after the last convolution.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch as th
import torch.nn.functional as F
from torch import nn

Shape = tuple[int, int, int]


class FeatureFusion(nn.Module):
    """
    Base class of fusions. A subclass implements ``forward``, from the maps of all modalities after a stage to maps of
    the same shapes.

    :param shapes: Shape (C_i, H_i, W_i) of each modality's map
    """

    def __init__(self, shapes: Sequence[Shape]):
        super().__init__()
        self.shapes = list(shapes)

    def forward(self, maps: Sequence[th.Tensor]) -> list[th.Tensor]:
        """Fuse the maps (B, C_i, H_i, W_i). This is called under autocast, so they may be bfloat16."""
        raise NotImplementedError


class Transfuser(FeatureFusion):
    """
    Transformer over the maps of all modalities, as in TransFuser (Prakash et al. 2021).

    Each map is pooled to at most 8x8 areas, and the channels of an area are a token. A learned embedding of modality
    and position is added to the tokens of all modalities, and the transformer processes them together. Its output is
    resized bilinearly to each map's size and added to the map. Maps smaller than 8x8 give one token per pixel. Maps
    with fewer channels than the widest one are projected to its width and back.

    It has 102,144 parameters for HighwayVision-v0 with two modalities of 64 pixels and the default encoders.

    :param shapes: Shape (C_i, H_i, W_i) of each modality's map
    :param n_layers: Number of attention and MLP blocks
    :param n_heads: Number of attention heads
    :param mlp_ratio: Width of the MLPs' hidden layer, in multiples of a token's width
    :param grid_size: Maximum number of rows and columns of areas
    :raises ValueError: if the channels cannot be divided among the heads
    """

    def __init__(
        self, shapes: Sequence[Shape], n_layers: int = 2, n_heads: int = 4, mlp_ratio: int = 4, grid_size: int = 8
    ):
        super().__init__(shapes)
        width = max(channels for channels, _, _ in shapes)
        _check_heads(width, n_heads)
        self.grids = [(min(grid_size, height), min(grid_size, width)) for _, height, width in shapes]
        self.sizes = [rows * columns for rows, columns in self.grids]
        projected = [channels != width for channels, _, _ in shapes]
        self.inputs = nn.ModuleList(
            nn.Linear(shape[0], width) if needed else nn.Identity()
            for shape, needed in zip(shapes, projected, strict=True)
        )
        self.positions = nn.Parameter(th.randn(sum(self.sizes), width) * 0.02)
        self.layers = nn.ModuleList(TransformerLayer(width, n_heads, mlp_ratio) for _ in range(n_layers))
        self.norm = nn.LayerNorm(width)
        nn.init.zeros_(self.norm.weight)  # add zero at first
        self.outputs = nn.ModuleList(
            nn.Linear(width, shape[0], bias=False) if needed else nn.Identity()  # the norm has a bias
            for shape, needed in zip(shapes, projected, strict=True)
        )

    def forward(self, maps: Sequence[th.Tensor]) -> list[th.Tensor]:
        pooled = [F.adaptive_avg_pool2d(image, grid) for image, grid in zip(maps, self.grids, strict=True)]
        tokens = [
            project(image.permute(0, 2, 3, 1).flatten(1, 2))  # row by row
            for image, project in zip(pooled, self.inputs, strict=True)
        ]
        x = th.cat(tokens, dim=1) + self.positions
        for layer in self.layers:
            x = layer(x)
        fused = []
        updates = self.norm(x).split(self.sizes, dim=1)
        for image, update, grid, project in zip(maps, updates, self.grids, self.outputs, strict=True):
            areas = project(update).unflatten(1, grid).permute(0, 3, 1, 2)
            fused.append(image + _resize(areas, image).to(image.dtype))
        return fused


class TransformerLayer(nn.Module):
    """
    Self-attention and an MLP, each after a LayerNorm and with a skip connection; from tokens (B, T, width) to the same.

    ``nn.TransformerEncoderLayer(norm_first=True)`` computes the same, but its fused attention has a slow backward pass
    in bfloat16 on a CPU.

    :param width: Size of a token
    :param n_heads: Number of attention heads
    :param mlp_ratio: Width of the MLP's hidden layer, in multiples of ``width``
    """

    def __init__(self, width: int, n_heads: int, mlp_ratio: int):
        super().__init__()
        self.attention_norm = nn.LayerNorm(width)
        self.attention = SelfAttention(width, n_heads)
        self.mlp_norm = nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, mlp_ratio * width), nn.ReLU(), nn.Linear(mlp_ratio * width, width))

    def forward(self, x: th.Tensor) -> th.Tensor:
        x = x + self.attention(self.attention_norm(x))
        x = x + self.mlp(self.mlp_norm(x))
        return x


class SelfAttention(nn.Module):
    """
    Scaled dot-product attention between tokens (Vaswani et al. 2017), from (B, T, width) to the same.

    :param width: Size of a token
    :param n_heads: Number of heads
    """

    def __init__(self, width: int, n_heads: int):
        super().__init__()
        self.n_heads = n_heads
        self.qkv = nn.Linear(width, 3 * width)
        self.projection = nn.Linear(width, width)

    def forward(self, x: th.Tensor) -> th.Tensor:
        query, key, value = self.qkv(x).unflatten(2, (3, self.n_heads, -1)).permute(2, 0, 3, 1, 4)
        # Each of them is (B, heads, T, size)
        scores = query @ key.transpose(2, 3) / math.sqrt(query.shape[3])
        weights = F.softmax(scores, dim=3, dtype=th.promote_types(scores.dtype, th.float32))
        attended = weights.to(value.dtype) @ value
        out: th.Tensor = self.projection(attended.transpose(1, 2).flatten(2))
        return out


class CrossModalChannelAttention(FeatureFusion):
    """
    Attention from each modality's channels to those of the other modalities: the EICA block of EFNet (Sun et al. 2022).

    The queries come from the modality itself, the keys and values from the others. Two channels are compared by the
    cosine similarity of their values over all pixels, times a learned temperature for each head. The result is added to
    the map, followed by an MLP at each pixel with a skip connection. With three or more modalities a channel attends to
    the channels of all others at once; a single modality attends to itself. Keys and values of maps of another size are
    resized bilinearly.

    It has 66,952 parameters for HighwayVision-v0 with two modalities of 64 pixels and the default encoders.

    :param shapes: Shape (C_i, H_i, W_i) of each modality's map
    :param n_heads: Number of heads, among which the channels of each modality are divided
    :param mlp_ratio: Width of the MLPs' hidden layer, in multiples of the map's channels
    :raises ValueError: if the channels cannot be divided among the heads
    """

    def __init__(self, shapes: Sequence[Shape], n_heads: int = 4, mlp_ratio: int = 2):
        super().__init__(shapes)
        for channels, _, _ in shapes:
            _check_heads(channels, n_heads)
        self.n_heads = n_heads
        self.modalities = nn.ModuleList(_ChannelAttention(shape[0], n_heads, mlp_ratio) for shape in shapes)

    def forward(self, maps: Sequence[th.Tensor]) -> list[th.Tensor]:
        blocks: list[Any] = list(self.modalities)
        normed = [block.norm(_pixels(image)) for block, image in zip(blocks, maps, strict=True)]
        keys = [_maps(block.key(pixels)) for block, pixels in zip(blocks, normed, strict=True)]
        values = [_maps(block.value(pixels)) for block, pixels in zip(blocks, normed, strict=True)]
        fused = []
        for i, (block, image) in enumerate(zip(blocks, maps, strict=True)):
            others = [j for j in range(len(maps)) if j != i] or [i]
            key = th.cat([self._by_head(_resize(keys[j], image)) for j in others], dim=2)
            value = th.cat([self._by_head(_resize(values[j], image)) for j in others], dim=2)
            query = self._by_head(_maps(block.query(normed[i])))
            fused.append(block(image, query, key, value))
        return fused

    def _by_head(self, image: th.Tensor) -> th.Tensor:
        """(B, C, H, W) to (B, heads, C / heads, H * W)."""
        batch, channels, height, width = image.shape
        return image.reshape(batch, self.n_heads, channels // self.n_heads, height * width)


class _ChannelAttention(nn.Module):
    """The part of one modality. Its linear layers act on the channels of each pixel, as 1x1 convolutions do."""

    def __init__(self, channels: int, n_heads: int, mlp_ratio: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels)
        self.value = nn.Linear(channels, channels)
        self.temperature = nn.Parameter(th.ones(n_heads))
        self.projection = nn.Linear(channels, channels)
        self.mlp_norm = nn.LayerNorm(channels)
        self.mlp = nn.Sequential(
            nn.Linear(channels, mlp_ratio * channels), nn.GELU(), nn.Linear(mlp_ratio * channels, channels)
        )
        for parameter in (*self.projection.parameters(), *self.mlp[2].parameters()):
            nn.init.zeros_(parameter)  # add zero at first

    def forward(self, image: th.Tensor, query: th.Tensor, key: th.Tensor, value: th.Tensor) -> th.Tensor:
        """
        Update a map.

        :param image: Map (B, C, H, W)
        :param query: From the map itself, as :meth:`CrossModalChannelAttention._by_head` returns it
        :param key: From the maps of the other modalities
        :param value: From the maps of the other modalities
        """
        # Compute sums over all pixels and the softmax at least in float32
        precise = th.promote_types(query.dtype, th.float32)
        query, key = F.normalize(query.to(precise), dim=3), F.normalize(key.to(precise), dim=3)
        scores = (query @ key.transpose(2, 3)).to(precise) * self.temperature.view(-1, 1, 1)
        attended = F.softmax(scores, dim=3).to(value.dtype) @ value
        pixels = _pixels(image) + self.projection(_pixels(attended.reshape(image.shape)))
        pixels = pixels + self.mlp(self.mlp_norm(pixels))
        return _maps(pixels).to(image.dtype)


FUSIONS: dict[str, type[FeatureFusion]] = {"transfuser": Transfuser, "efnet": CrossModalChannelAttention}


def make_fusions(
    fusion: str | type[nn.Module],
    encoders: Mapping[str, nn.Module],
    shapes: Mapping[str, tuple[int, ...]],
    stages: str | Sequence[int] = "last",
    **kwargs: Any,
) -> nn.ModuleDict:
    """
    Create a fusion for each of the chosen stages.

    :param fusion: Name in :data:`FUSIONS`, or a module class, which is called as ``cls(shapes, **kwargs)``
    :param encoders: Encoder of each modality. As in :class:`~sb3_have.common.encoders.ImageEncoder`, ``stages`` is a
        list of modules to call one after the other, and ``features`` computes the features from the last maps.
    :param shapes: Shape (C, H, W) of each modality's images, or the shape of its vectors
    :param stages: Stages after which to fuse: "last", "all", or their numbers starting at 0
    :param kwargs: Keyword arguments for the fusion
    :return: The fusions by number of the stage
    :raises ValueError: if there is no such fusion or stage, or if an encoder has no stages or overrides only
        ``forward``, which would not be called
    """
    if isinstance(fusion, str):
        if fusion not in FUSIONS:
            raise ValueError(f'fusion={fusion!r}: expected "concat", one of {list(FUSIONS)}, or a module class.')
        fusion = FUSIONS[fusion]
    for name, encoder in encoders.items():
        if len(shapes[name]) != 3 or not (hasattr(encoder, "stages") and hasattr(encoder, "features")):
            raise ValueError(
                f"modality {name!r}: {fusion.__name__} fuses feature maps of images, but {type(encoder).__name__} has "
                f"none for observations of shape {shapes[name]}; leave the modality out by `modalities`, use an "
                'encoder with `stages` and `features` such as ImageEncoder, or use fusion="concat".'
            )
        if _replaces_forward_alone(type(encoder)):
            raise ValueError(
                f"modality {name!r}: {type(encoder).__name__} overrides `forward`, which {fusion.__name__} does not "
                "call: it calls the encoder's `stages` one after the other and then `features`. Override one of these "
                'instead, or use fusion="concat".'
            )
    numbers = {name: len(encoder.stages) for name, encoder in encoders.items()}  # type: ignore[arg-type]
    if len(set(numbers.values())) != 1:
        raise ValueError(
            f"{fusion.__name__} needs encoders with the same number of stages, got {numbers}; set their layers "
            "by `encoder_kwargs={<modality>: dict(layers=[(filters, kernel_size, stride), ...])}`."
        )
    n_stages = next(iter(numbers.values()))
    chosen = {"last": [n_stages - 1], "all": list(range(n_stages))}.get(stages) if isinstance(stages, str) else stages
    if not chosen or not set(chosen) <= set(range(n_stages)):
        raise ValueError(f'stages={stages!r}: expected "last", "all", or some of the numbers 0 to {n_stages - 1}.')
    map_shapes: list[list[Shape]] = [[] for _ in range(n_stages)]
    with th.no_grad():
        for name, encoder in encoders.items():
            maps = th.zeros(1, *shapes[name])
            for stage, module in enumerate(encoder.stages):  # type: ignore[arg-type]
                maps = module(maps)
                map_shapes[stage].append((maps.shape[1], maps.shape[2], maps.shape[3]))
    return nn.ModuleDict({str(stage): fusion(map_shapes[stage], **kwargs) for stage in sorted(set(chosen))})


def encode_fused(encoders: Sequence[nn.Module], fusions: nn.ModuleDict, images: Sequence[th.Tensor]) -> list[th.Tensor]:
    """
    Run the encoders stage by stage, with the fusions between the stages.

    :param encoders: Encoder of each modality
    :param fusions: The fusions by number of the stage
    :param images: Images (B, C, H, W) of each modality
    :return: Features (B, F) of each modality
    :raises ValueError: if a fusion changes the shapes of the maps
    """
    maps = [image.contiguous(memory_format=th.channels_last) for image in images]
    for number, modules in enumerate(zip(*(encoder.stages for encoder in encoders), strict=True)):
        maps = [module(image) for module, image in zip(modules, maps, strict=True)]
        if str(number) in fusions:
            shapes = [tuple(image.shape) for image in maps]
            maps = fusions[str(number)](maps)
            if [tuple(image.shape) for image in maps] != shapes:
                raise ValueError(
                    f"{type(fusions[str(number)]).__name__} returned maps of the shapes "
                    f"{[tuple(image.shape) for image in maps]}, expected {shapes}; a fusion must keep them."
                )
    return [encoder.features(image) for encoder, image in zip(encoders, maps, strict=True)]  # type: ignore[operator]


def _replaces_forward_alone(encoder_class: type[nn.Module]) -> bool:
    """Whether a subclass overrides ``forward`` but inherits ``stages`` and ``features``."""

    def depth(name: str) -> int:  # 0 also for an attribute that no class has
        return next((depth for depth, base in enumerate(encoder_class.__mro__) if name in vars(base)), 0)

    return depth("forward") < min(depth("stages"), depth("features"))


def _check_heads(channels: int, n_heads: int) -> None:
    if channels % n_heads:
        raise ValueError(
            f"A map of {channels} channels cannot be divided among {n_heads} heads; choose a divisor by "
            "`fusion_kwargs=dict(n_heads=...)`, or other filters in the encoders' `layers`."
        )


def _resize(maps: th.Tensor, like: th.Tensor) -> th.Tensor:
    """Resize ``maps`` to the height and width of ``like``."""
    size = like.shape[2:]
    return maps if maps.shape[2:] == size else F.interpolate(maps, size, mode="bilinear", align_corners=False)


def _pixels(maps: th.Tensor) -> th.Tensor:
    """View (B, C, H, W) as (B, H, W, C); this is contiguous if the maps are in channels-last memory."""
    return maps.permute(0, 2, 3, 1)


def _maps(pixels: th.Tensor) -> th.Tensor:
    """View (B, H, W, C) as (B, C, H, W) in channels-last memory."""
    return pixels.permute(0, 3, 1, 2)
