"""
Slow references of the fusions of feature maps, for one sample: loops over tokens, channels and pixels in float64,
written from the papers' formulas and not from the modules. Parameters are NumPy arrays by their names in a state_dict.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

Parameters = dict[str, Any]
Map = np.ndarray  # (C, H, W), of one sample


def linear(x: np.ndarray, parameters: Parameters, name: str) -> np.ndarray:
    """W x + b of one vector."""
    out: np.ndarray = parameters[f"{name}.weight"] @ x
    out += parameters[f"{name}.bias"]
    return out


def layer_norm(x: np.ndarray, parameters: Parameters, name: str) -> np.ndarray:
    """Of one vector."""
    mean = sum(x) / len(x)
    variance = sum((value - mean) ** 2 for value in x) / len(x)
    out: np.ndarray = (x - mean) / math.sqrt(variance + 1e-5) * parameters[f"{name}.weight"]
    out += parameters[f"{name}.bias"]
    return out


def softmax(x: Sequence[float]) -> np.ndarray:
    powers = [math.exp(value - max(x)) for value in x]
    return np.array([power / sum(powers) for power in powers])


def pool(image: Map, rows: int, columns: int) -> Map:
    """Averages over ``rows`` x ``columns`` areas; they overlap by a pixel where these do not divide the map."""
    channels, height, width = image.shape
    out = np.zeros((channels, rows, columns))
    for row in range(rows):
        for column in range(columns):
            top, bottom = row * height // rows, math.ceil((row + 1) * height / rows)
            left, right = column * width // columns, math.ceil((column + 1) * width / columns)
            for channel in range(channels):
                out[channel, row, column] = image[channel, top:bottom, left:right].mean()
    return out


def resize(image: Map, height: int, width: int) -> Map:
    """Bilinear, pixels as areas: the centre of pixel i lies at i + 1/2; outside of the outer centres it is constant."""
    channels, rows, columns = image.shape
    out = np.zeros((channels, height, width))
    for i in range(height):
        y = min(max((i + 0.5) * rows / height - 0.5, 0), rows - 1)
        y0 = min(int(y), rows - 1)
        y1 = min(y0 + 1, rows - 1)
        for j in range(width):
            x = min(max((j + 0.5) * columns / width - 0.5, 0), columns - 1)
            x0 = min(int(x), columns - 1)
            x1 = min(x0 + 1, columns - 1)
            above = image[:, y0, x0] * (1 - (x - x0)) + image[:, y0, x1] * (x - x0)
            below = image[:, y1, x0] * (1 - (x - x0)) + image[:, y1, x1] * (x - x0)
            out[:, i, j] = above * (1 - (y - y0)) + below * (y - y0)
    return out


def self_attention(tokens: list[np.ndarray], n_heads: int, parameters: Parameters, name: str) -> list[np.ndarray]:
    """softmax(Q K^T / sqrt(size of a head)) V over tokens, head by head, and a linear layer (Vaswani et al. 2017)."""
    width = len(tokens[0])
    size = width // n_heads
    # one layer gives query, key and value, in this order
    both = [linear(token, parameters, f"{name}.qkv") for token in tokens]
    attended = []
    for asking in both:
        out = np.zeros(width)
        for head in range(n_heads):
            part = slice(head * size, (head + 1) * size)
            query = asking[:width][part]
            scores = [float(query @ asked[width : 2 * width][part]) / math.sqrt(size) for asked in both]
            for weight, asked in zip(softmax(scores), both, strict=True):
                out[part] += weight * asked[2 * width :][part]
        attended.append(linear(out, parameters, f"{name}.projection"))
    return attended


def transfuser(maps: Sequence[Map], parameters: Parameters, n_layers: int, n_heads: int, grid: int = 8) -> list[Map]:
    """TransFuser (Prakash et al. 2021): the maps of one sample after one stage."""
    tokens: list[np.ndarray] = []
    places: list[tuple[int, int, int]] = []  # modality, row, column of each token
    for i, image in enumerate(maps):
        _, height, width = image.shape
        pooled = pool(image, min(grid, height), min(grid, width))
        for row in range(pooled.shape[1]):
            for column in range(pooled.shape[2]):
                token = pooled[:, row, column]
                if f"inputs.{i}.weight" in parameters:
                    token = linear(token, parameters, f"inputs.{i}")
                tokens.append(token + parameters["positions"][len(tokens)])
                places.append((i, row, column))
    for layer in range(n_layers):
        normed = [layer_norm(token, parameters, f"layers.{layer}.attention_norm") for token in tokens]
        updates = self_attention(normed, n_heads, parameters, f"layers.{layer}.attention")
        tokens = [token + update for token, update in zip(tokens, updates, strict=True)]
        for t, token in enumerate(tokens):
            hidden = linear(
                layer_norm(token, parameters, f"layers.{layer}.mlp_norm"), parameters, f"layers.{layer}.mlp.0"
            )
            tokens[t] = token + linear(np.maximum(hidden, 0), parameters, f"layers.{layer}.mlp.2")
    fused = []
    for i, image in enumerate(maps):
        channels, height, width = image.shape
        update = np.zeros((channels, min(grid, height), min(grid, width)))
        for token, (modality, row, column) in zip(tokens, places, strict=True):
            if modality == i:
                out = layer_norm(token, parameters, "norm")
                update[:, row, column] = (
                    parameters[f"outputs.{i}.weight"] @ out if f"outputs.{i}.weight" in parameters else out
                )
        fused.append(image + resize(update, height, width))
    return fused


def pixelwise(image: Map, parameters: Parameters, name: str) -> Map:
    """A 1x1 convolution."""
    weight, bias = parameters[f"{name}.weight"], parameters[f"{name}.bias"]
    out = np.zeros((len(weight), *image.shape[1:]))
    for o in range(len(weight)):
        for c in range(image.shape[0]):
            out[o] += weight[o].reshape(-1)[c] * image[c]
        out[o] += bias[o]
    return out


def channel_norm(image: Map, parameters: Parameters, name: str) -> Map:
    """A LayerNorm over the channels of each pixel."""
    out = np.zeros(image.shape)
    for row in range(image.shape[1]):
        for column in range(image.shape[2]):
            out[:, row, column] = layer_norm(image[:, row, column], parameters, name)
    return out


def gelu(x: np.ndarray) -> np.ndarray:
    out: np.ndarray = x * np.reshape([(1 + math.erf(value / math.sqrt(2))) / 2 for value in x.flat], x.shape)
    return out


def channel_attention(maps: Sequence[Map], parameters: Parameters, n_heads: int) -> list[Map]:
    """
    EICA (EFNet, Sun et al. 2022): the maps of one sample. The channels of each modality attend to those of the others;
    with three modalities and more, to the channels of all the others at once.
    """
    normed = [channel_norm(image, parameters, f"modalities.{i}.norm") for i, image in enumerate(maps)]
    fused = []
    for i, image in enumerate(maps):
        channels, height, width = image.shape
        query = pixelwise(normed[i], parameters, f"modalities.{i}.query")
        others = [j for j in range(len(maps)) if j != i] or [i]
        keys = [resize(pixelwise(normed[j], parameters, f"modalities.{j}.key"), height, width) for j in others]
        values = [resize(pixelwise(normed[j], parameters, f"modalities.{j}.value"), height, width) for j in others]
        attended = np.zeros(image.shape)
        size = channels // n_heads
        for head in range(n_heads):
            head_keys, head_values = [], []
            for key, value in zip(keys, values, strict=True):
                other_size = len(key) // n_heads
                head_keys += list(key[head * other_size : (head + 1) * other_size])
                head_values += list(value[head * other_size : (head + 1) * other_size])
            temperature = parameters[f"modalities.{i}.temperature"][head]
            for c in range(head * size, (head + 1) * size):
                unit = query[c] / np.sqrt((query[c] ** 2).sum())
                scores = [temperature * (unit * key / np.sqrt((key**2).sum())).sum() for key in head_keys]
                for weight, value in zip(softmax(scores), head_values, strict=True):
                    attended[c] += weight * value
        mixed = image + pixelwise(attended, parameters, f"modalities.{i}.projection")
        hidden = pixelwise(
            channel_norm(mixed, parameters, f"modalities.{i}.mlp_norm"), parameters, f"modalities.{i}.mlp.0"
        )
        fused.append(mixed + pixelwise(gelu(hidden), parameters, f"modalities.{i}.mlp.2"))
    return fused
