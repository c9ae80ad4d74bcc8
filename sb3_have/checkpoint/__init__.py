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
from sb3_have.checkpoint.files import locked, write_atomically
from sb3_have.checkpoint.random_state import random_states, same_random_numbers, set_random_states
from sb3_have.checkpoint.stopping import StopTrainingOnSignal, handle_signals, stop_training

__all__ = [
    "DamagedCheckpointError",
    "ResumableCheckpointCallback",
    "ResumableEnv",
    "StopTrainingOnSignal",
    "checkpoint_info",
    "checkpoint_step",
    "checkpoints",
    "handle_signals",
    "load_checkpoint",
    "locked",
    "newest_checkpoint",
    "random_states",
    "same_random_numbers",
    "save_checkpoint",
    "set_random_states",
    "stop_training",
    "write_atomically",
]
