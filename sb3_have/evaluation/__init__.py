"""
Drive and evaluate models and rule-based drivers, record episodes, and compute statistics over runs.

Training and figures do not belong here.
"""

from sb3_have.evaluation.episodes import Predictor, Step, Task, drive
from sb3_have.evaluation.evaluation import evaluate, evaluate_episodes, format_table, summarize
from sb3_have.evaluation.recording import Recording, record_episode
from sb3_have.evaluation.wrapping import saved_normalizer, wrap_as_trained

__all__ = [
    "Predictor",
    "Recording",
    "Step",
    "Task",
    "drive",
    "evaluate",
    "evaluate_episodes",
    "format_table",
    "record_episode",
    "saved_normalizer",
    "summarize",
    "wrap_as_trained",
]
