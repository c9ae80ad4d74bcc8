"""Hierarchical adaptive value estimation (HAVE) for multi-modal agents, on Stable-Baselines3."""

from pathlib import Path

from sb3_have import envs as envs  # registers the environments
from sb3_have.common.buffers import ModalityReplayBuffer
from sb3_have.common.evaluation import evaluate
from sb3_have.have import HAVESAC, DeepMDPCallback, MultiModalCritic, MultiModalPolicy

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

__all__ = [
    "HAVESAC",
    "DeepMDPCallback",
    "ModalityReplayBuffer",
    "MultiModalCritic",
    "MultiModalPolicy",
    "__version__",
    "evaluate",
]
