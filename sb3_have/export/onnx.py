"""A policy as ONNX: observations in, deterministic action and modality weights out."""

from __future__ import annotations

import copy
import json
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch._subclasses import FakeTensorMode

from sb3_have.checkpoint.files import write_atomically
from sb3_have.common.encoders import MultiModalEncoder
from sb3_have.export.config import describe, policy_of
from sb3_have.have.policies import MultiModalPolicy

OPSET = 18
OUTPUTS = ("action", "weights")
# Largest difference from `predict`, relative to half the range of the action
TOLERANCE = 1e-3
FRAME_ORDER = "oldest first: along the channels of images, along the last axis of vectors"


def export_onnx(
    model: BaseAlgorithm | BasePolicy, path: str | os.PathLike[str], frame_stack: int | None = None
) -> None:
    """
    Write the deterministic policy as an ONNX file, which runs without PyTorch and this package.

    The inputs have the names of the observation keys ("observation" for a Box) and the types of their spaces. Batches
    can have any size; images are uint8 (B, C, H, W) and stacked as in training. The outputs are float32: ``action``,
    as ``predict(deterministic=True)`` returns it, and ``weights`` (B, d) if the policy has modality weights (HAVESAC
    with ``value_estimation`` "have" or "lve")::

        session = onnxruntime.InferenceSession("policy.onnx")
        action, weights = session.run(["action", "weights"], {"rgb": rgb, "event": event})

    Everything is computed in float32, whatever the policy's ``precision``. The metadata of the file is JSON:
    "observation_space", "action_space", "modalities" (the keys of each, in the order of ``weights``), "frame_stack",
    "frame_order", "algorithm", "value_estimation" and "versions". The actions in onnxruntime are compared with those
    of ``predict`` before the file is written.

    :param model: A model of HAVESAC, SAC, TQC or CrossQ, or its policy
    :param path: Name of the file
    :param frame_stack: Number of stacked frames, for the metadata; by default the model's
    :raises ValueError: if the file would not act as ``predict`` does
    """
    policy, path = policy_of(model), Path(path)
    for key in getattr(policy.observation_space, "spaces", {}):
        if key in OUTPUTS:
            raise ValueError(f"observation key {key!r} is the name of an output of the file: rename the key")
    config = describe(model)
    metadata = {key: config[key] for key in ("algorithm", "observation_space", "action_space", "versions")}
    metadata |= {"frame_stack": frame_stack or config["n_stack"], "frame_order": FRAME_ORDER}
    if isinstance(policy, MultiModalPolicy):
        modalities = policy.critic.encoder.modalities
        metadata["modalities"] = {name: list(modality.keys) for name, modality in modalities.items()}
        metadata["value_estimation"] = policy.critic.value_estimation
    with _float32(policy):
        content = _to_onnx(_Network(policy), {key: json.dumps(value) for key, value in metadata.items()})
        _compare(content, policy)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, partial(Path.write_bytes, data=content))


class _Network(nn.Module):
    """The part of a policy that acts deterministically, copied to the CPU."""

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: BasePolicy):
        super().__init__()
        actor: Any = policy.actor
        action_space: Any = policy.action_space
        self.observation_space = policy.observation_space
        self.action_shape = action_space.shape
        self.assignment: nn.Module | None = None
        self.normalize_images: bool | None = policy.normalize_images
        if isinstance(policy, MultiModalPolicy):
            self.encoder: nn.Module = copy.deepcopy(policy.critic.encoder)
            self.normalize_images = None  # the encoder decodes images itself
            if policy.critic.value_estimation != "gve":
                self.assignment = copy.deepcopy(policy.critic.assignment)
        else:
            self.encoder = copy.deepcopy(actor.features_extractor)
        self.latent_pi, self.mu = copy.deepcopy(actor.latent_pi), copy.deepcopy(actor.mu)
        self.register_buffer("low", th.as_tensor(action_space.low, dtype=th.float32))
        self.register_buffer("high", th.as_tensor(action_space.high, dtype=th.float32))
        self.eval().requires_grad_(False).to("cpu")

    def forward(self, inputs: list[th.Tensor]) -> tuple[th.Tensor, ...]:
        """Compute the action, and the modality weights if there are any."""
        observation: PyTorchObs = inputs[0]
        if isinstance(self.observation_space, spaces.Dict):
            observation = dict(zip(self.observation_space.spaces, inputs, strict=True))
        if self.normalize_images is not None:
            observation = preprocess_obs(observation, self.observation_space, self.normalize_images)
        features = self.encoder(observation)
        squashed = th.tanh(self.mu(self.latent_pi(features.flatten(start_dim=1)))).reshape(-1, *self.action_shape)
        action = self.low + 0.5 * (squashed + 1) * (self.high - self.low)
        return (action,) if self.assignment is None else (action, self.assignment(features))


@contextmanager
def _float32(policy: BasePolicy) -> Iterator[None]:
    """Let the image encoders of a policy compute in float32 for a while."""
    encoders = [module for module in policy.modules() if isinstance(module, MultiModalEncoder)]
    precisions = [encoder.precision for encoder in encoders]
    try:
        for encoder in encoders:
            encoder.precision = "float32"
        yield
    finally:
        for encoder, precision in zip(encoders, precisions, strict=True):
            encoder.precision = precision


def _to_onnx(network: _Network, metadata: dict[str, str]) -> bytes:
    """Return the content of an ONNX file."""
    from onnx_ir.passes.common import ClearMetadataAndDocStringPass, NameFixPass

    samples = _sample(network.observation_space, 2)
    # All inputs share the size of the batch, so only the first names it
    batch = [{0: th.export.Dim("batch") if i == 0 else th.export.Dim.DYNAMIC} for i in range(len(samples))]
    # It warns that torchvision is not installed, which is not needed here
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        # PyTorch's exporter copies an object of a class that PyTorch has deprecated
        warnings.filterwarnings("ignore", r".*treespec, LeafSpec", FutureWarning)
        program = th.onnx.export(
            network,
            ([th.from_numpy(value) for value in samples.values()],),
            input_names=list(samples),
            output_names=OUTPUTS[: 1 if network.assignment is None else 2],
            dynamic_shapes=(batch,),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None and program.exported_program is not None
    _forget_shapes(program.exported_program)
    # Values inside the graph may have the name of an input
    NameFixPass()(program.model)
    # PyTorch notes the source file of each node
    ClearMetadataAndDocStringPass()(program.model)
    program.model.metadata_props.clear()
    program.model.metadata_props.update(metadata)
    content: bytes = program.model_proto.SerializeToString()
    return content


def _forget_shapes(program: th.export.ExportedProgram) -> None:
    """
    Free the shapes of an export (about 1 MB). Caches refer to them, and they form cycles through C++ objects that
    Python's garbage collector cannot see.
    """
    FakeTensorMode.cache_clear()
    for node in program.graph.nodes:
        mode = getattr(node.meta.get("val"), "fake_mode", None)
        if mode is not None and mode.shape_env is not None:
            vars(mode.shape_env).clear()


def _sample(space: spaces.Space[Any], batch_size: int) -> dict[str, np.ndarray]:
    """Sample observations by input name, without using the space's own random numbers."""
    parts: dict[str, Any] = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
    observations = {}
    for seed, (key, part) in enumerate(parts.items()):
        if isinstance(part, spaces.Box):
            # Bounds that are almost infinite cannot be sampled uniformly, and observations are never that large
            middle = np.clip(0, part.low, part.high)
            low, high = np.maximum(part.low, middle - 1e3), np.minimum(part.high, middle + 1e3)
            part = spaces.Box(low.astype(part.dtype), high.astype(part.dtype), dtype=part.dtype.type)
        part = copy.deepcopy(part)
        part.seed(seed)
        observations[key] = np.stack([part.sample() for _ in range(batch_size)])
    return observations


def _compare(content: bytes, policy: BasePolicy) -> None:
    """Raise a ValueError if onnxruntime does not act as ``predict`` does; a subclass may have its own ``_predict``."""
    from onnxruntime import InferenceSession

    observations = _sample(policy.observation_space, 7)
    (actions,) = InferenceSession(content, providers=["CPUExecutionProvider"]).run(["action"], observations)
    is_dict = isinstance(policy.observation_space, spaces.Dict)
    expected, _ = policy.predict(observations if is_dict else observations["observation"], deterministic=True)
    space: Any = policy.action_space
    difference = np.max(2 * np.abs(actions - expected) / (space.high - space.low))
    if not difference < TOLERANCE:  # NaN included
        raise ValueError(
            f"the actions of {type(policy).__name__} in onnxruntime differ from `predict` by {difference:.2g} half "
            "ranges: only policies that act by `tanh(actor.mu(actor.latent_pi(features)))` can be exported"
        )
