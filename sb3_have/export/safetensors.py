"""
Weights as safetensors with a JSON configuration beside them: a policy in a folder that nothing executes.

The folder has the two files that users of the Hugging Face Hub know, so that ``HfApi().upload_folder`` publishes it and
``load_policy(snapshot_download("user/repo"))`` reads it::

    policy/
        config.json          spaces, policy class and arguments, algorithm, frame stack, versions
        model.safetensors    every tensor of the policy's ``state_dict``

SB3's zip files are another thing: ``HAVESAC.load`` unpickles them, and so executes what they hold.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from sb3_have.checkpoint.files import write_atomically
from sb3_have.export.config import build, describe, policy_of, warn_of_normalization
from sb3_have.export.requirements import require

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
MAX_HEADER_SIZE = 100_000_000
"""Bytes of JSON that safetensors reads at most; the configuration's limit too."""


def export_safetensors(model: BaseAlgorithm | BasePolicy, path: str | os.PathLike[str]) -> None:
    """
    Write a policy as ``config.json`` and ``model.safetensors``, for :func:`load_policy`.

    Everything in the policy's ``state_dict`` is written, target networks and auxiliary heads too, so that the policy
    can be trained further; optimizers, entropy temperature and replay buffer are not
    (:func:`sb3_have.save_checkpoint` has those).

    :param model: of HAVESAC, SAC, TQC or MultiInputCrossQ, or its policy
    :param path: folder to write to; what else it holds stays
    :raises ValueError: if it cannot be exported, or weights are not finite
    :raises ImportError: without the extra "export"
    """
    safetensors = require("safetensors", "safetensors.torch")
    folder, policy = Path(path), policy_of(model)
    if folder.suffix in (".safetensors", ".json", ".zip") or (folder.exists() and not folder.is_dir()):
        raise ValueError(f"{folder}: expected the name of a folder, in which {CONFIG_FILE} and {WEIGHTS_FILE} will be.")
    tensors = {}
    for name, value in policy.state_dict().items():
        if not isinstance(value, th.Tensor):
            raise ValueError(
                f"{name!r} of {type(policy).__name__} is {type(value).__name__}, and only tensors are exported; make "
                "it a buffer, or drop its `get_extra_state`."
            )
        _check_finite(type(policy).__name__, name, value, "train again from before it diverged")
        # in the usual order in memory, and in memory of its own
        tensors[name] = value.detach().cpu().clone(memory_format=th.contiguous_format)
    warn_of_normalization(model)
    config = (json.dumps(describe(model), indent=2, allow_nan=False) + "\n").encode()
    if len(config) > MAX_HEADER_SIZE:
        raise ValueError(f"the configuration has {len(config)} bytes, over the limit of {MAX_HEADER_SIZE}.")

    def write_weights(unfinished: Path) -> None:
        metadata = {"format": "pt", "config_sha256": hashlib.sha256(config).hexdigest()}
        safetensors.torch.save_file(tensors, unfinished, metadata)
        with _open(unfinished):  # the limits of the format are the reader's
            pass

    def write_both(unfinished: Path) -> None:
        unfinished.write_bytes(config)
        write_atomically(folder / WEIGHTS_FILE, write_weights)

    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / CONFIG_FILE, write_both)  # whatever fails, it fails before either is replaced


def load_policy(
    path: str | os.PathLike[str],
    device: th.device | str = "auto",
    policy_class: type[BasePolicy] | None = None,
    policy_kwargs: Mapping[str, Any] | None = None,
) -> BasePolicy:
    """
    A policy written by :func:`export_safetensors`, ready for ``predict``: a :class:`~sb3_have.MultiModalPolicy` for
    HAVESAC, with its ``modality_weights`` and ``critic.decompose``.

    Nothing in the folder is executed: no pickle is read and nothing is imported by a name in a file. Classes come from
    a closed list, SB3's and this package's; others, such as an encoder of your own, are given in the call::

        load_policy("policy", policy_kwargs={"encoder_classes": {"lidar": LidarEncoder}})

    :param path: the folder
    :param device: of the policy
    :param policy_class: a subclass of your own
    :param policy_kwargs: arguments of the policy in place of the file's, merged key by key
    :raises FileNotFoundError: if a file is missing
    :raises ValueError: if a file is damaged, of a newer format, does not fit the policy, or a class has to be given
    :raises ImportError: without the extra "export"
    """
    folder = Path(path)
    config, digest = _read_config(folder)
    file = folder / WEIGHTS_FILE
    with _open(file) as opened:
        metadata = opened.metadata() or {}
        if metadata.get("config_sha256") != digest:
            raise ValueError(
                f"{file}: it was not written together with this {CONFIG_FILE}; export the policy again, and change "
                "arguments by `policy_kwargs` rather than in the file."
            )
        with th.random.fork_rng(devices=[]):  # initial weights are drawn, and drawn for nothing
            size = sum(math.prod(opened.get_slice(name).get_shape()) + 1 for name in opened.keys())  # noqa: SIM118
            policy = build(config, folder / CONFIG_FILE, size, policy_class, policy_kwargs)
        expected = policy.state_dict()
        _check_names(file, expected.keys() - set(opened.keys()), set(opened.keys()) - expected.keys())
        tensors = {}
        for name, own in expected.items():
            tensor = opened.get_tensor(name)
            if (tensor.shape, tensor.dtype) != (own.shape, own.dtype):
                raise ValueError(
                    f"{file}: tensor {name!r}: expected {_kind(own)}, found {_kind(tensor)}; if the policy or a class "
                    "of it was given, give it as in training, else export it again."
                )
            _check_finite(str(file), name, tensor, "export a policy that has not diverged")
            tensors[name] = tensor
    policy.load_state_dict(tensors)
    policy.to(get_device(device))
    policy.set_training_mode(False)
    if getattr(policy.actor, "use_sde", False):
        noisy: Any = policy
        with th.random.fork_rng(devices=[]):
            noisy.reset_noise()  # of the loaded standard deviations, and on the device
    return policy


def read_config(path: str | os.PathLike[str]) -> dict[str, Any]:
    """
    The configuration in a folder of :func:`export_safetensors`: "algorithm", "n_stack", "versions" and others.

    :param path: the folder
    :raises FileNotFoundError: if it is missing
    :raises ValueError: if it cannot be read
    """
    return _read_config(Path(path))[0]


def _read_config(folder: Path) -> tuple[dict[str, Any], str]:
    """The configuration, and the SHA-256 of its file."""
    file = folder / CONFIG_FILE
    if folder.is_file():
        raise ValueError(
            f"{folder} is a file, expected a folder with {CONFIG_FILE} and {WEIGHTS_FILE}; SB3's zip files are loaded "
            "by `HAVESAC.load`, which executes what they hold, so only where you trust them."
        )
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; export_safetensors writes a folder that has it.")
    if file.stat().st_size > MAX_HEADER_SIZE:
        raise ValueError(f"{file}: {file.stat().st_size} bytes, over the limit of {MAX_HEADER_SIZE}.")
    content = file.read_bytes()
    try:
        config = json.loads(content)
        if not isinstance(config, dict):
            raise ValueError(f"a {type(config).__name__} at the top, expected an object")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not the JSON of export_safetensors: {error}; export the policy again.") from error
    return config, hashlib.sha256(content).hexdigest()


def _open(file: Path) -> Any:
    safetensors = require("safetensors")
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; export_safetensors writes a folder that has it.")
    try:
        return safetensors.safe_open(file, framework="pt", device="cpu")
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise ValueError(
            f"{file}: {file.stat().st_size} bytes that are not a whole safetensors file: {error}; copy or export it "
            "again."
        ) from error


def _check_names(file: Path, missing: set[str], extra: set[str]) -> None:
    if missing or extra:
        found = [f"{word} {_some(names)}" for word, names in (("lacks", missing), ("also has", extra)) if names]
        raise ValueError(
            f"{file}: its tensors are not the policy's: it {' and '.join(found)}; if the policy or a class of it was "
            "given, give it as in training, else export it again."
        )


def _some(names: set[str], limit: int = 5) -> str:
    shown = ", ".join(map(repr, sorted(names)[:limit]))
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} others"


def _kind(tensor: th.Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"


def _check_finite(where: str, name: str, tensor: th.Tensor, remedy: str) -> None:
    n_bad = int((~th.isfinite(tensor)).sum()) if tensor.is_floating_point() else 0
    if n_bad:
        raise ValueError(
            f"{where}: tensor {name!r}: expected finite numbers, found {n_bad} of {tensor.numel()} that are not; "
            f"{remedy}."
        )
