"""Hierarchical adaptive value estimation (HAVE) for multi-modal agents, on Stable-Baselines3."""

from pathlib import Path

from sb3_have import envs as envs  # registers the environments
from sb3_have.common.buffers import ModalityReplayBuffer
from sb3_have.common.checkpoint import ResumableCheckpointCallback, load_checkpoint, save_checkpoint
from sb3_have.common.evaluation import evaluate
from sb3_have.common.recording import Recording, record_episode
from sb3_have.export import export_onnx, export_safetensors, load_policy
from sb3_have.have import HAVESAC, DeepMDPCallback, ModalityWeightsCallback, MultiModalCritic, MultiModalPolicy

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
    "record_episode",
    "save_checkpoint",
]
