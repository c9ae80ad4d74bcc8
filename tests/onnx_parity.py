"""Shared by the tests of exported ONNX files: observations of every brightness, and the comparison with PyTorch."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch as th
from envs import RandomSensors
from gymnasium import spaces

from sb3_have import MultiModalPolicy

Observations = dict[str, np.ndarray]
N_OBSERVATIONS = 1000


def observations(space: spaces.Space[Any], n: int = N_OBSERVATIONS, seed: int = 0) -> Observations:
    """Random bytes between random bounds for images, zeros ("no data") among them; others from their space."""
    rng = np.random.default_rng(seed)
    boxes = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
    found = {}
    for key, box in boxes.items():
        if not isinstance(box, spaces.Box):
            box.seed(seed)
            found[key] = np.stack([box.sample() for _ in range(n)])
        elif box.dtype == np.uint8:
            low, high = np.sort(rng.integers(0, 257, (2, n, *[1] * len(box.shape))), axis=0)
            images = rng.integers(low, np.maximum(high, low + 1), (n, *box.shape))
            found[key] = np.minimum(images, 255).astype(np.uint8)
            found[key][rng.uniform(size=found[key].shape) < 0.1] = 0
        else:
            found[key] = rng.normal(size=(n, *box.shape)).clip(box.low, box.high).astype(box.dtype)
    return found


def run(path: Path, inputs: Observations, batch_size: int) -> dict[str, np.ndarray]:
    """The outputs of a file for all inputs, ``batch_size`` at a time."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    n = len(next(iter(inputs.values())))
    batches = [
        session.run(names, {key: value[start : start + batch_size] for key, value in inputs.items()})
        for start in range(0, n, batch_size)
    ]
    return {name: np.concatenate(parts) for name, parts in zip(names, zip(*batches, strict=True), strict=True)}


def assert_parity(path: Path, policy: Any) -> None:
    """Actions and weights as PyTorch's within 1e-4 on 1,000 observations, and in batches of 1, 7 and 64."""
    space = policy.observation_space
    is_dict = isinstance(space, spaces.Dict)
    inputs = observations(space)
    raw: Any = inputs if is_dict else inputs["observation"]
    outputs = run(path, inputs, 64)
    expected, _ = policy.predict(raw, deterministic=True)
    assert outputs["action"].dtype == np.float32 and outputs["action"].shape == expected.shape
    np.testing.assert_allclose(outputs["action"], expected, rtol=0, atol=1e-4)
    # constants would agree too
    assert (expected.std(axis=0) > 1e-3).all(), expected.std(axis=0)
    if isinstance(policy, MultiModalPolicy) and policy.critic.value_estimation != "gve":
        weights = np.stack(list(policy.modality_weights(raw).values()), axis=1)
        np.testing.assert_allclose(outputs["weights"], weights, rtol=0, atol=1e-4)
        assert (weights.std(axis=0) > 1e-3).all(), weights.std(axis=0)
    else:
        assert list(outputs) == ["action"]
    for batch_size in (1, 7):
        few = run(path, {key: value[:21] for key, value in inputs.items()}, batch_size)
        for name, values in few.items():
            np.testing.assert_allclose(values, outputs[name][:21], rtol=0, atol=1e-5)


def metadata(path: Path) -> dict[str, Any]:
    return {prop.key: json.loads(prop.value) for prop in onnx.load(path).metadata_props}


def input_types(path: Path) -> dict[str, tuple[str, list[Any]]]:
    """Type and shape of each input in onnxruntime."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return {entry.name: (entry.type, entry.shape) for entry in session.get_inputs()}


class Uneven(RandomSensors):
    """An environment with actions of two rows, each value with its own bounds."""

    def __init__(self, space: spaces.Space[Any]):
        super().__init__(space)
        low, high = [[-2, 0, 5], [-1, -1, -1]], [[1, 7, 6], [1, 0, 3]]
        self.action_space = spaces.Box(np.array(low, np.float32), np.array(high, np.float32))


def enliven(policy: Any) -> None:
    """Larger weights in actor and attention, so that actions and weights of modalities differ between observations."""
    with th.no_grad():
        for name, parameter in policy.named_parameters():
            if name.startswith(("actor.mu", "critic.assignment")) and name.endswith("weight"):
                parameter.mul_(4)
