"""An episode over time: the weight of each modality under what was seen, and the parts of the critic's value."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from sb3_have.envs.vision import compose
from sb3_have.evaluation.recording import Recording
from sb3_have.plotting.style import MEDIUM, SMALL, Style, modality_styles, position

FUSED = {
    "q": Style("#000000", "-"),
    "q_global": Style("#000000", "--"),
    "q_lve": Style("#000000", ":"),
}
"""The values that stand for all modalities are black, those of one have its colour."""


def plot_modality_weights(recording: Recording, columns: int = 8) -> Figure:
    """How much each modality counted over an episode, under what was seen (as the paper's Fig. 5).

    :param recording: of a model with modality weights; without images there are the curves alone
    :param columns: instants to show, equally spaced; each thumbnail stands over its time
    :raises ValueError: if the recording has no weights
    """
    if not recording.weights:
        raise ValueError("the recording has no modality weights: record a model that has modality_weights()")
    if columns < 1:
        raise ValueError(f"columns={columns}: expected 1 or more")
    steps = len(recording.infos)
    # the middles of equal parts of the episode, so that thumbnails and time axis line up
    shown = ((np.arange(columns) + 0.5) / columns * steps).astype(int)
    seen = [images(recording.observations[step]) for step in shown]
    names = list(seen[0])
    layout = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    figure = Figure(figsize=(1.25 * columns + 0.8, 1.25 * len(names) + 2.6), layout=layout)
    grid = figure.add_gridspec(len(names) + 1, columns, height_ratios=[1.0] * len(names) + [1.7])
    for row, name in enumerate(names):
        for column, pictures in enumerate(seen):
            axis = figure.add_subplot(grid[row, column])
            axis.imshow(pictures[name], interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            if column == 0:
                axis.set_ylabel(name, fontsize=MEDIUM)
    axis = figure.add_subplot(grid[-1, :])
    _draw_weights(axis, recording)
    if names:
        axis.vlines(recording.times[shown], 0, 1, color="0.85", linewidth=0.8, zorder=0)
    axis.set_xlabel(recording.time_label)
    axis.legend(fontsize=SMALL, ncols=4, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.2, frameon=False)
    figure.suptitle(_titled("Weight of each modality", recording), fontsize=11)
    return figure


def plot_decomposition(recording: Recording, gamma: float | None = None, twin: int | None = None) -> Figure:
    """The critic's value over an episode, in its parts: H, the global value, the weighted local one and each local one.

    Below them are the weights of the modalities and the reward, where there are any.

    :param recording: of a model whose critic has ``decompose``
    :param gamma: discount factor; where given, the discounted sum of the rewards that came is drawn beside the values
        (which hold an entropy bonus, too, and what would have come after the end of a truncated episode; under
        ``VecNormalize`` with ``norm_reward`` they are of normalised rewards and cannot be compared)
    :param twin: number of the twin to show; by default, at every instant, the one that acts: the lower H
    :raises ValueError: if the recording has no values, or no such twin
    """
    if not recording.values:
        raise ValueError("the recording has no values: record a model whose critic has decompose()")
    n_critics = len(recording.values["q"])
    if twin is not None and not 0 <= twin < n_critics:
        raise ValueError(f"twin={twin}: the critic has {n_critics}")
    panels = 2 + bool(recording.weights)
    ratios = [3.0, 1.3, 1.0] if recording.weights else [3.0, 1.0]
    figure = Figure(figsize=(8.0, 2.0 + 1.6 * panels), layout="constrained")
    axes = figure.subplots(panels, 1, sharex=True, height_ratios=ratios)
    for label, values, look, width in _curves(recording, twin):
        axes[0].plot(recording.times, values, color=look.colour, linestyle=look.line, linewidth=width, label=label)
    if gamma is not None:
        came = _discounted(recording.rewards, gamma)
        axes[0].plot(recording.times, came, color="0.6", linewidth=3, alpha=0.6, zorder=1, label="return that came")
    axes[0].set_ylabel("value")
    if recording.weights:
        _draw_weights(axes[1], recording)
    axes[-1].plot(recording.times, recording.rewards, color="0.35", linewidth=1.2, label="reward")
    axes[-1].set(ylabel="reward", xlabel=recording.time_label, xlim=(0, recording.times[-1] or 1.0))
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=SMALL, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    if recording.weights:
        axes[1].legend(fontsize=SMALL, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.align_ylabels(list(axes))
    figure.suptitle(_titled("Value of what was done", recording), fontsize=11)
    return figure


def _curves(recording: Recording, twin: int | None) -> Iterator[tuple[str, np.ndarray, Style, float]]:
    """Label, values (T,), look and width of each curve, those of single modalities first."""
    values = recording.values
    time = np.arange(values["q"].shape[1])
    twins = values["q"].argmin(axis=0) if twin is None else np.full(len(time), twin)
    if "q_local" in values:
        styles, order = modality_styles(recording.weights), list(recording.weights)
        for name, look in styles.items():
            yield f"local: {name}", values["q_local"][twins, order.index(name), time], look, 1.2
    mixed = "q_global" in values and "q_lve" in values
    labels = {"q_global": "global", "q_lve": "weighted local", "q": "H, re-fusion of both"}
    for key, label in labels.items():
        if key in values and (mixed or key != "q"):  # alone, the global or the local value is the one that acts
            yield label, values[key][twins, time], FUSED[key], 2.2 if key == "q" or not mixed else 1.5


def _discounted(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """(T,): the discounted sum of the rewards from each instant to the end."""
    came, total = np.zeros(len(rewards)), 0.0
    for step in reversed(range(len(rewards))):
        came[step] = total = rewards[step] + gamma * total
    return came


def _draw_weights(axis: Axes, recording: Recording) -> None:
    for name, look in modality_styles(recording.weights).items():
        axis.plot(
            recording.times,
            recording.weights[name],
            color=look.colour,
            linestyle=look.line,
            linewidth=1.5,
            label=name,
        )
    end = len(recording.infos) * (1.0 if recording.seconds is None else recording.seconds)
    axis.set(ylabel="weight", ylim=(0, 1), xlim=(0, end))
    axis.grid(axis="y", alpha=0.3)


def _titled(words: str, recording: Recording) -> str:
    return f"{words}, {recording.weather}" if recording.weather else words


def images(observation: Any) -> dict[str, np.ndarray]:
    """Pictures of the image modalities of an observation, for people to look at.

    :param observation: of an environment; a Box is called "observation"
    :return: by modality, uint8 (H, W, 3): the newest frame where several are stacked (of events all, added up), other
        numbers than uint8 scaled to what they span
    """
    parts = observation if isinstance(observation, Mapping) else {"observation": observation}
    pictures = {}
    for name, value in sorted(parts.items(), key=lambda item: position(item[0])):
        image = np.asarray(value)
        if image.ndim != 3 or min(image.shape[:2]) < 1:
            continue
        if image.shape[0] < min(image.shape[1:]):  # channels first
            image = image.transpose(1, 2, 0)
        coded = image.dtype == np.uint8
        if not coded:
            image = image.astype(float)
            image = (255 * (image - image.min()) / (float(np.ptp(image)) or 1.0)).astype(np.uint8)
        if coded and name in ("event", "depth"):  # as the sensors of this package write them
            pictures[name] = compose({name: image}, scale=1)
        else:
            pictures[name] = image[..., -3:] if image.shape[-1] % 3 == 0 else np.repeat(image[..., -1:], 3, axis=-1)
    return pictures
