"""One episode: the modality weights below the observations, and the parts of the critic's value."""

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

THUMBNAILS = 8


def plot_modality_weights(recording: Recording) -> Figure:
    """
    Plot the weight of each modality over an episode, below what the sensors saw (Fig. 5 of the paper).

    :param recording: Episode of a model with modality weights; without images, only the curves are drawn
    """
    if not recording.weights:
        raise ValueError("the recording has no modality weights: record a model that has modality_weights()")
    # Show the middles of equal parts of the episode, so that each thumbnail stands above its time
    shown = ((np.arange(THUMBNAILS) + 0.5) / THUMBNAILS * len(recording.infos)).astype(int)
    seen = [images(recording.observations[step]) for step in shown]
    names = list(seen[0])
    layout = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    figure = Figure(figsize=(1.25 * THUMBNAILS + 0.8, 1.25 * len(names) + 2.6), layout=layout)
    grid = figure.add_gridspec(len(names) + 1, THUMBNAILS, height_ratios=[1.0] * len(names) + [1.7])
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
    figure.suptitle(_title("Weight of each modality", recording), fontsize=11)
    return figure


def plot_decomposition(recording: Recording, gamma: float | None = None) -> Figure:
    """
    Plot the parts of the critic's value over an episode: H, the global, the weighted local and each local value.

    Every step shows the twin with the lower H, which is the one that the actor and the target use. The modality weights
    and the reward are drawn below.

    :param recording: Episode of a model whose critic has ``decompose``
    :param gamma: Discount factor. If given, the discounted return is drawn beside the values. It differs from them by
        the entropy bonus, by what comes after a truncated episode, and by the scale of the rewards under
        ``VecNormalize`` with ``norm_reward``.
    """
    if not recording.values:
        raise ValueError("the recording has no values: record a model whose critic has decompose()")
    ratios = [3.0, 1.3, 1.0] if recording.weights else [3.0, 1.0]
    figure = Figure(figsize=(8.0, 2.0 + 1.6 * len(ratios)), layout="constrained")
    axes = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios)
    for label, style, width, values in value_curves(recording):
        axes[0].plot(recording.times, values, style.line, color=style.colour, linewidth=width, label=label)
    if gamma is not None:
        returns = _discounted(recording.rewards, gamma)
        axes[0].plot(recording.times, returns, color="0.6", linewidth=3, alpha=0.6, zorder=1, label="discounted return")
    axes[0].set_ylabel("value")
    if recording.weights:
        _draw_weights(axes[1], recording)
    axes[-1].plot(recording.times, recording.rewards, color="0.35", linewidth=1.2, label="reward")
    axes[-1].set(ylabel="reward", xlabel=recording.time_label, xlim=(0, recording.times[-1] or 1.0))
    for axis in axes:
        axis.grid(alpha=0.3)
    for axis in axes[:-1]:
        axis.legend(fontsize=SMALL, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.align_ylabels(list(axes))
    figure.suptitle(_title("Value of the actions", recording), fontsize=11)
    return figure


def value_curves(recording: Recording) -> Iterator[tuple[str, Style, float, np.ndarray]]:
    """
    Yield the curves of :func:`plot_decomposition`: label, style, width of the line [pt] and values (T,).

    :param recording: Episode of a model whose critic has ``decompose``
    """
    values, step = recording.values, np.arange(len(recording.infos))
    twins = values["q"].argmin(axis=0)
    if "q_local" in values:
        order = list(recording.weights)
        for name, style in modality_styles(order).items():
            yield f"local: {name}", style, 1.2, values["q_local"][twins, order.index(name), step]
    # Without re-fusion, the global or the weighted local value is H itself
    mixed = "q_global" in values and "q_lve" in values
    for key, label, line in (
        ("q_global", "global", "--"),
        ("q_lve", "weighted local", ":"),
        ("q", "H, re-fusion of both", "-"),
    ):
        if key in values and (mixed or key != "q"):
            yield label, Style("#000000", line), 2.2 if key == "q" or not mixed else 1.5, values[key][twins, step]


def _discounted(rewards: np.ndarray, gamma: float) -> np.ndarray:
    returns, total = np.zeros(len(rewards)), 0.0
    for step in reversed(range(len(rewards))):
        returns[step] = total = rewards[step] + gamma * total
    return returns


def _draw_weights(axis: Axes, recording: Recording) -> None:
    for name, style in modality_styles(recording.weights).items():
        weights = recording.weights[name]
        axis.plot(recording.times, weights, style.line, color=style.colour, linewidth=1.5, label=name)
    end = len(recording.infos) * (1.0 if recording.seconds is None else recording.seconds)
    axis.set(ylabel="weight", ylim=(0, 1), xlim=(0, end))
    axis.grid(axis="y", alpha=0.3)


def _title(words: str, recording: Recording) -> str:
    return f"{words}, {recording.weather}" if recording.weather else words


def images(observation: Any) -> dict[str, np.ndarray]:
    """
    Convert the images in an observation to RGB.

    :param observation: Observation of an environment; a Box is called "observation"
    :return: uint8 (H, W, 3) by modality. Of stacked frames the newest is shown, except that events are added up.
        Numbers other than uint8 are scaled to their range.
    """
    parts = observation if isinstance(observation, Mapping) else {"observation": observation}
    pictures = {}
    for name in sorted(parts, key=position):
        image = np.asarray(parts[name])
        if image.ndim != 3:
            continue
        if image.shape[0] < min(image.shape[1:]):  # channels first
            image = image.transpose(1, 2, 0)
        is_uint8 = image.dtype == np.uint8
        if not is_uint8:
            image = image.astype(float)
            image = (255 * (image - image.min()) / (float(np.ptp(image)) or 1.0)).astype(np.uint8)
        if is_uint8 and name in ("event", "depth"):  # the encoding of the sensors in this package
            pictures[name] = compose({name: image}, scale=1)
        else:
            pictures[name] = image[..., -3:] if image.shape[-1] % 3 == 0 else np.repeat(image[..., -1:], 3, axis=-1)
    return pictures
