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

from sb3_have.checkpoint.files import write_atomically
from sb3_have.common.encoders import MultiModalEncoder
from sb3_have.export.config import n_stack, policy_of, space_to_json, versions, warn_of_normalization
from sb3_have.export.requirements import require
from sb3_have.have.policies import MultiModalPolicy

OPSET = 18
OUTPUTS = ("action", "weights")
TOLERANCE = 1e-3
"""Difference from ``predict``, in half ranges of the action, with which a file is not written."""
FRAME_ORDER = "oldest first: along the channels of images, along the last axis of vectors"


def export_onnx(
    model: BaseAlgorithm | BasePolicy, path: str | os.PathLike[str], frame_stack: int | None = None
) -> None:
    """
    Write the deterministic policy as an ONNX file that needs neither this package nor PyTorch.

    The inputs are named by the observation keys ("observation" for a Box) and take what the policy reads: batches of
    any size, images as uint8 (B, C, H, W), which is to say what VecFrameStack and VecTransposeImage make of the
    environment's, others in the type of their space. The outputs are ``action``, float32 ``(B, *action shape)``, as
    ``predict(deterministic=True)`` gives it, and, where the policy has weights of modalities (HAVESAC with
    ``value_estimation`` "have" or "lve"), ``weights``, float32 (B, d)::

        session = onnxruntime.InferenceSession("policy.onnx")
        action, weights = session.run(["action", "weights"], {"rgb": rgb, "event": event})

    Everything is computed in float32, whatever the policy's ``precision``. The file's metadata tells, in JSON:
    "observation_space", "action_space" (with bounds), "modalities" (keys of each, in the order of ``weights``),
    "frame_stack" and "frame_order", "algorithm", "value_estimation", "versions".

    Before it is written, the file is run by onnxruntime beside ``predict``.

    :param model: of HAVESAC, SAC, TQC or MultiInputCrossQ, or its policy
    :param path: of the file
    :param frame_stack: frames that VecFrameStack stacks, for the metadata; by default the model's
    :raises ValueError: if it cannot be exported, or if the file would not act as the policy does
    :raises ImportError: without the extra "export"
    """
    for name in ("onnx", "onnxscript", "onnxruntime"):
        require(name)
    policy, path = policy_of(model), Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder, expected the name of a file, such as {path / 'policy.onnx'}.")
    space = policy.observation_space
    if isinstance(space, spaces.Dict) and (taken := [key for key in space.spaces if key in OUTPUTS]):
        raise ValueError(f"observation key {taken[0]!r} is the name of an output of the file; rename the key.")
    warn_of_normalization(model)
    with _float32(policy):
        network = Network(policy)
        proto = _to_proto(network)
        metadata = {
            "algorithm": None if model is policy else type(model).__name__,
            "observation_space": space_to_json(space),
            "action_space": space_to_json(policy.action_space),
            "frame_stack": n_stack(model) if frame_stack is None else frame_stack,
            "frame_order": FRAME_ORDER,
            "versions": versions(),
            **network.about,
        }
        onnx = require("onnx")
        onnx.helper.set_model_props(proto, {key: json.dumps(value) for key, value in metadata.items()})
        onnx.checker.check_model(proto, full_check=True)
        content = proto.SerializeToString()
        _check_parity(content, policy)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, partial(Path.write_bytes, data=content))


class Network(nn.Module):
    """
    What of a policy acts deterministically, on the CPU: observations to the action as ``predict`` scales it and,
    where there are weights of modalities, these.

    :param policy: to copy from
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: BasePolicy):
        super().__init__()
        action_space = policy.action_space
        assert isinstance(action_space, spaces.Box)  # as in every policy that can be exported
        actor: Any = policy.actor
        self.observation_space = policy.observation_space
        self.keys = list(boxes(policy.observation_space))
        self.about: dict[str, Any] = {}
        self.assignment = None
        if isinstance(policy, MultiModalPolicy):
            self.encoder: nn.Module = copy.deepcopy(policy.critic.encoder)
            self.normalize_images = None
            if policy.critic.value_estimation != "gve":
                self.assignment = copy.deepcopy(policy.critic.assignment)
            modalities = policy.critic.encoder.modalities
            self.about = {
                "modalities": {name: list(modality.keys) for name, modality in modalities.items()},
                "value_estimation": policy.critic.value_estimation,
            }
        else:
            self.encoder = copy.deepcopy(actor.features_extractor)
            self.normalize_images = policy.normalize_images
        self.latent_pi, self.mu = copy.deepcopy(actor.latent_pi), copy.deepcopy(actor.mu)
        self.shape = action_space.shape
        self.register_buffer("low", th.as_tensor(action_space.low, dtype=th.float32))
        self.register_buffer("high", th.as_tensor(action_space.high, dtype=th.float32))
        self.eval().requires_grad_(False).to("cpu")

    def forward(self, inputs: list[th.Tensor]) -> tuple[th.Tensor, ...]:
        observations: PyTorchObs = dict(zip(self.keys, inputs, strict=True))
        if not isinstance(self.observation_space, spaces.Dict):
            observations = inputs[0]
        if self.normalize_images is not None:
            observations = preprocess_obs(observations, self.observation_space, self.normalize_images)
        features = self.encoder(observations)
        squashed = th.tanh(self.mu(self.latent_pi(features.flatten(start_dim=1))))
        squashed = squashed.reshape(-1, *self.shape)
        action = self.low + 0.5 * (squashed + 1) * (self.high - self.low)
        return (action,) if self.assignment is None else (action, self.assignment(features))


@contextmanager
def _float32(policy: BasePolicy) -> Iterator[None]:
    """In here the policy's image encoders compute in float32."""
    found = [(module, module.precision) for module in policy.modules() if isinstance(module, MultiModalEncoder)]
    try:
        for module, _ in found:
            module.precision = "float32"
        yield
    finally:
        for module, precision in found:
            module.precision = precision


def boxes(space: spaces.Space[Any]) -> dict[str, spaces.Space[Any]]:
    """The spaces of the inputs by name."""
    return space.spaces if isinstance(space, spaces.Dict) else {"observation": space}


def _observations(space: spaces.Space[Any], batch_size: int) -> dict[str, np.ndarray]:
    """Random observations by input name; the space's own generator is left alone."""
    observations = {}
    for number, (key, box) in enumerate(boxes(space).items()):
        box = copy.deepcopy(box)
        box.seed(number)
        observations[key] = np.stack([box.sample() for _ in range(batch_size)])
    return observations


def _to_proto(network: Network) -> Any:
    """The network as an ONNX model, without the places in source files that PyTorch notes at each node."""
    inputs = [th.from_numpy(value) for value in _observations(network.observation_space, 2).values()]
    # the name of one batch is that of all, as they have to be equal
    batch = [{0: th.export.Dim("batch") if number == 0 else th.export.Dim.DYNAMIC} for number in range(len(inputs))]
    # it tells everybody who has no torchvision that some operators are left out
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            # PyTorch's exporter copies an object of a class that PyTorch has deprecated
            warnings.filterwarnings("ignore", r".*treespec, LeafSpec", FutureWarning)
            program = th.onnx.export(
                network,
                (inputs,),
                output_names=list(OUTPUTS[: 1 if network.assignment is None else 2]),
                dynamic_shapes=(batch,),
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
            )
    finally:
        logger.setLevel(level)
    assert program is not None
    proto = program.model_proto
    graph = proto.graph
    for part in (proto, graph, *graph.node, *graph.value_info, *graph.input, *graph.output):
        del part.metadata_props[:]
    _name_inputs(graph, network.keys)
    return proto


def _name_inputs(graph: Any, keys: list[str]) -> None:
    """Names the inputs by the observation keys, and values that already have such a name otherwise."""
    values = [*graph.input, *graph.output, *graph.value_info, *graph.initializer]
    existing = {value.name for value in values} | {name for node in graph.node for name in (*node.input, *node.output)}
    names = dict(zip((value.name for value in graph.input), keys, strict=True))
    for name in existing.intersection(keys) - names.keys():
        names[name] = f"{name}_"
        while names[name] in existing.union(keys):
            names[name] += "_"
    for value in values:
        value.name = names.get(value.name, value.name)
    for node in graph.node:
        node.input[:] = [names.get(name, name) for name in node.input]
        node.output[:] = [names.get(name, name) for name in node.output]


def _check_parity(content: bytes, policy: BasePolicy) -> None:
    """ValueError if onnxruntime makes of the file something else than ``predict`` does, as for an own ``_predict``."""
    observations = _observations(policy.observation_space, 7)
    session = require("onnxruntime").InferenceSession(content, providers=["CPUExecutionProvider"])
    found = session.run(["action"], observations)[0]
    is_dict = isinstance(policy.observation_space, spaces.Dict)
    expected, _ = policy.predict(observations if is_dict else observations["observation"], deterministic=True)
    space = policy.action_space
    assert isinstance(space, spaces.Box)
    difference = float(np.max(2 * np.abs(found - expected) / (space.high - space.low)))
    if not difference < TOLERANCE:
        raise ValueError(
            f"in onnxruntime the actions of {type(policy).__name__} differ from those of `predict` by up to "
            f"{difference:.2g} half ranges of the action, more than {TOLERANCE}: export_onnx knows policies that act "
            "by `tanh(actor.mu(actor.latent_pi(features)))`; nothing was written."
        )
