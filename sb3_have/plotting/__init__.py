"""
Figures of training runs and recorded episodes. The figures of a benchmark are in :mod:`sb3_have.benchmark`.

Each function returns a matplotlib ``Figure`` and leaves pyplot alone. Save it with ``figure.savefig("name.png")``; a
notebook displays it after ``%matplotlib inline``.
"""

from sb3_have.plotting.animation import Frames, write_animation, write_gif
from sb3_have.plotting.episode import plot_decomposition, plot_modality_weights
from sb3_have.plotting.learning import (
    Curves,
    evaluation_curves,
    monitor_curves,
    plot_learning_curve,
    plot_learning_curves,
)
from sb3_have.plotting.page import write_page
from sb3_have.plotting.refusion import Response, plot_refusion, refusion_response
from sb3_have.plotting.style import modality_colours, modality_styles
from sb3_have.plotting.weather import plot_weather_weights, weather_weights, weights_table

__all__ = [
    "Curves",
    "Frames",
    "Response",
    "evaluation_curves",
    "modality_colours",
    "modality_styles",
    "monitor_curves",
    "plot_decomposition",
    "plot_learning_curve",
    "plot_learning_curves",
    "plot_modality_weights",
    "plot_refusion",
    "plot_weather_weights",
    "refusion_response",
    "weather_weights",
    "weights_table",
    "write_animation",
    "write_gif",
    "write_page",
]
