"""
Hierarchical adaptive value estimation (HAVE) for multi-modal agents, on Stable-Baselines3.

Importing the package registers its environments. Everything else is imported when it is first used, so that
``import sb3_have`` takes no longer than ``import gymnasium``.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_have import envs as envs  # registers the environments

if TYPE_CHECKING:
    from sb3_have.checkpoint import ResumableCheckpointCallback, load_checkpoint, save_checkpoint
    from sb3_have.common.buffers import ModalityReplayBuffer
    from sb3_have.evaluation import Recording, evaluate, record_episode
    from sb3_have.export import export_onnx, export_safetensors, load_policy
    from sb3_have.have import HAVESAC, DeepMDPCallback, ModalityWeightsCallback, MultiModalCritic, MultiModalPolicy
    from sb3_have.trained import pretrained

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

__all__ = [
    "HAVESAC",
    "DeepMDPCallback",
    "ModalityReplayBuffer",
    "ModalityWeightsCallback",
    "MultiModalCritic",
    "MultiModalPolicy",
    "Recording",
    "ResumableCheckpointCallback",
    "__version__",
    "evaluate",
    "export_onnx",
    "export_safetensors",
    "load_checkpoint",
    "load_policy",
    "pretrained",
    "record_episode",
    "save_checkpoint",
]

_MODULES = {
    "HAVESAC": "have",
    "DeepMDPCallback": "have",
    "ModalityReplayBuffer": "common.buffers",
    "ModalityWeightsCallback": "have",
    "MultiModalCritic": "have",
    "MultiModalPolicy": "have",
    "Recording": "evaluation",
    "ResumableCheckpointCallback": "checkpoint",
    "evaluate": "evaluation",
    "export_onnx": "export",
    "export_safetensors": "export",
    "load_checkpoint": "checkpoint",
    "load_policy": "export",
    "pretrained": "trained",
    "record_episode": "evaluation",
    "save_checkpoint": "checkpoint",
}
_PACKAGES = ("checkpoint", "common", "evaluation", "export", "have", "plotting", "sensors", "trained")


def __getattr__(name: str) -> Any:
    """Import a public name, or one of the packages inside, on first use (PEP 562)."""
    if name in _MODULES:
        value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    elif name in _PACKAGES:
        value = import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_PACKAGES})
