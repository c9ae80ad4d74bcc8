"""
Checkpoints: training that resumes bit for bit, whether it was stopped or killed.

What saves, restores or ends a training run in good order belongs here; what evaluates it, plots it or exports its
weights does not, and nothing here knows of a particular algorithm or environment.
"""

from sb3_have.checkpoint.archive import DamagedCheckpointError
from sb3_have.checkpoint.callback import ResumableCheckpointCallback
from sb3_have.checkpoint.checkpoint import (
    checkpoint_info,
    checkpoint_step,
    checkpoints,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
)
from sb3_have.checkpoint.env_state import ResumableEnv
from sb3_have.checkpoint.stopping import StopTrainingOnSignal

__all__ = [
    "DamagedCheckpointError",
    "ResumableCheckpointCallback",
    "ResumableEnv",
    "StopTrainingOnSignal",
    "checkpoint_info",
    "checkpoint_step",
    "checkpoints",
    "load_checkpoint",
    "newest_checkpoint",
    "save_checkpoint",
]
