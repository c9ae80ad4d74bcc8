"""
Weights as safetensors with a JSON configuration beside them, the two files that the Hugging Face Hub expects::

    policy/
        config.json          class, arguments and spaces of the policy, algorithm, frame stack, versions
        model.safetensors    the policy's ``state_dict``

Reading them executes nothing, whereas SB3's zip files are unpickled.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from sb3_have.checkpoint.files import write_atomically
from sb3_have.export.config import build, describe, policy_of

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
# Bytes of a configuration; the safetensors library has the same limit for its header
MAX_CONFIG_SIZE = 100_000_000


def export_safetensors(model: BaseAlgorithm | BasePolicy, path: str | os.PathLike[str]) -> None:
    """
    Write a policy as ``config.json`` and ``model.safetensors``, for :func:`load_policy`.

    The whole ``state_dict`` is written, including target networks and auxiliary heads. Optimizers, the entropy
    coefficient and the replay buffer are not, see :func:`sb3_have.save_checkpoint`.

    :param model: A model of HAVESAC, SAC, TQC or CrossQ, or its policy
    :param path: Folder to write to
    """
    from safetensors.torch import save_file

    folder, policy = Path(path), policy_of(model)
    # safetensors accepts only contiguous tensors that do not share memory
    tensors = {
        name: tensor.detach().cpu().clone(memory_format=th.contiguous_format)
        for name, tensor in policy.state_dict().items()
    }
    _check_finite(type(policy).__name__, tensors)
    config = (json.dumps(describe(model), indent=2, allow_nan=False) + "\n").encode()
    metadata = {"format": "pt", "config_sha256": hashlib.sha256(config).hexdigest()}

    def write_both(unfinished: Path) -> None:
        unfinished.write_bytes(config)
        # Replace the old weights only once both files are written
        write_atomically(folder / WEIGHTS_FILE, lambda file: save_file(tensors, file, metadata))

    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / CONFIG_FILE, write_both)


def load_policy(
    path: str | os.PathLike[str],
    device: th.device | str = "auto",
    policy_class: type[BasePolicy] | None = None,
    policy_kwargs: Mapping[str, Any] | None = None,
) -> BasePolicy:
    """
    Load a policy that :func:`export_safetensors` wrote, ready for ``predict``.

    Nothing in the folder is executed: no pickle is read, and a file can only name classes of SB3, PyTorch and this
    package. Pass your own classes, such as an encoder::

        load_policy("policy", policy_kwargs={"encoder_classes": {"lidar": LidarEncoder}})

    :param path: The folder
    :param device: Device of the policy
    :param policy_class: Your own subclass of a policy
    :param policy_kwargs: Arguments of the policy that replace those in the file
    :return: The policy; for HAVESAC a :class:`~sb3_have.MultiModalPolicy` with ``modality_weights`` and
        ``critic.decompose``
    :raises ValueError: if a file is damaged, or a class has to be passed
    """
    from safetensors import SafetensorError, safe_open

    # Read both files
    config_file, file = Path(path) / CONFIG_FILE, Path(path) / WEIGHTS_FILE
    config = read_config(path)
    try:
        with safe_open(file, framework="pt", device="cpu") as opened:
            metadata = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{file}: {error}") from error
    if metadata.get("config_sha256") != hashlib.sha256(config_file.read_bytes()).hexdigest():
        raise ValueError(
            f"{config_file} and {WEIGHTS_FILE} were not written together: export the policy again, and use "
            "`policy_kwargs` to change arguments"
        )

    # Build the policy; its random initial weights must not use up the caller's random numbers
    size = sum(tensor.numel() + 1 for tensor in tensors.values())
    try:
        with th.random.fork_rng(devices=[]):
            policy = build(config, size, policy_class, policy_kwargs)
    except Exception as error:  # whatever a damaged file leads to
        raise ValueError(f"{config_file}: cannot build the policy: {type(error).__name__}: {error}") from error

    # Load the weights
    for name, own in policy.state_dict().items():
        if name in tensors and tensors[name].dtype != own.dtype:  # PyTorch would convert it
            raise ValueError(f"{file}: {name} is of {tensors[name].dtype}, expected {own.dtype}")
    _check_finite(file, tensors)
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as error:
        raise ValueError(f"{file}: {error}") from error
    policy.to(get_device(device))
    policy.set_training_mode(False)

    # Sample gSDE's noise with the loaded standard deviations
    if getattr(policy.actor, "use_sde", False):
        noisy: Any = policy
        with th.random.fork_rng(devices=[]):
            noisy.reset_noise()
    return policy


def read_config(path: str | os.PathLike[str]) -> dict[str, Any]:
    """
    Read the configuration that :func:`export_safetensors` wrote, with "algorithm", "n_stack", "versions" and others.

    :param path: The folder
    """
    file = Path(path) / CONFIG_FILE
    if file.stat().st_size > MAX_CONFIG_SIZE:
        raise ValueError(f"{file}: {file.stat().st_size} bytes, more than {MAX_CONFIG_SIZE}")
    try:
        config: dict[str, Any] = json.loads(file.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not valid JSON: {error}") from error
    return config


def _check_finite(where: object, tensors: Mapping[str, th.Tensor]) -> None:
    bad = [name for name, tensor in tensors.items() if tensor.is_floating_point() and not tensor.isfinite().all()]
    if bad:
        raise ValueError(f"{where}: NaN or infinity in {', '.join(bad)}; did the training diverge?")
