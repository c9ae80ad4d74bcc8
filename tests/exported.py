"""Rewriting an exported policy, for the tests of damaged and poisoned files."""

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import safetensors.torch
import torch as th


def read(folder: Path) -> tuple[Any, dict[str, th.Tensor]]:
    return json.loads((folder / "config.json").read_text()), safetensors.torch.load_file(folder / "model.safetensors")


def write(folder: Path, config: Any, tensors: dict[str, th.Tensor], **metadata: str) -> None:
    """Write two files that belong together."""
    content = json.dumps(config).encode()
    (folder / "config.json").write_bytes(content)
    metadata = {"format": "pt", "config_sha256": sha256(content).hexdigest(), **metadata}
    safetensors.torch.save_file(tensors, folder / "model.safetensors", metadata)
