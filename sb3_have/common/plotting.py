"""Pictures of a training run and of an episode. They draw on ``Figure`` objects: a user's pyplot stays untouched."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image, ImageDraw, ImageFont

from sb3_have.common.recording import Recording
from sb3_have.envs.vision import MODALITIES, compose

COLOURS = {"rgb": "#D55E00", "event": "#0072B2", "depth": "#009E73"}
SPARE_COLOURS = ("#CC79A7", "#E69F00", "#56B4E9", "#888888")


def modality_colours(names: Mapping[str, Any] | list[str]) -> dict[str, str]:
    """The same colour for a modality in every picture, and the same order of modalities.

    :param names: of the modalities
    """
    names = sorted(names, key=_position)
    others = [name for name in names if name not in COLOURS]
    return {name: COLOURS.get(name) or SPARE_COLOURS[others.index(name) % len(SPARE_COLOURS)] for name in names}


def plot_learning_curve(
    episodes: pd.DataFrame,
    column: str = "distance",
    label: str = "distance [m]",
    window: int = 20,
    by_weather: bool = False,
    references: Mapping[str, float] | None = None,
) -> Figure:
    """Training episodes over environment steps: each a dot, and the mean of the latest as a line.

    :param episodes: in order of time, from SB3's ``load_results``: ``l`` (steps) and the columns named here
    :param column: to show
    :param label: its name and unit
    :param window: episodes of the running mean; at the start, as many as there are
    :param by_weather: a panel for each value of the column ``weather`` instead of one for all
    :param references: levels to draw by name, such as the mean of another driver
    """
    episodes = episodes.assign(step=episodes["l"].cumsum())
    groups = [(str(name), group) for name, group in episodes.groupby("weather")] if by_weather else [("", episodes)]
    columns = min(4, max(1, len(groups)))
    rows = max(1, -(-len(groups) // columns))
    size = (7.0, 4.0) if not by_weather else (3.0 * columns, 2.3 * rows)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axis, (name, group) in zip(axes.flat, groups, strict=False):
        axis.plot(group["step"], group[column], ".", color="0.65", markersize=4, label="episode")
        running = group[column].rolling(window, min_periods=1).mean()
        axis.plot(group["step"], running, color="#0072B2", linewidth=2, label=f"mean of {window}")
        for style, (reference, level) in zip(cycle(("--", ":", "-.")), (references or {}).items(), strict=False):
            axis.axhline(level, color="0.3", linestyle=style, linewidth=1, label=reference)
        if group.empty:
            axis.text(0.5, 0.5, "no episode ended yet", ha="center", transform=axis.transAxes)
        axis.set_title(name, fontsize=9)
        axis.grid(alpha=0.3)
        axis.set_xlim(left=0)
    for axis in axes.flat[len(groups) :]:
        axis.set_visible(False)
    axes[0, 0].legend(fontsize=8, loc="upper left")
    figure.supxlabel("environment steps", fontsize=10)
    figure.supylabel(label, fontsize=10)
    return figure


def plot_modality_weights(recording: Recording, columns: int = 8) -> Figure:
    """How much each modality counted over an episode, under what was seen (as the paper's Fig. 5).

    :param recording: of a model with modality weights
    :param columns: instants to show, equally spaced; each thumbnail stands over its time
    :raises ValueError: if the recording has no weights
    """
    if not recording.weights:
        raise ValueError("the recording has no modality weights: record a model that has modality_weights()")
    steps = len(recording.infos)
    seconds = recording.seconds * np.arange(steps)
    # the middles of equal parts of the episode, so that thumbnails and time axis line up
    shown = ((np.arange(columns) + 0.5) / columns * steps).astype(int)
    names = list(_images(recording.observations[0]))
    layout = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    figure = Figure(figsize=(1.25 * columns + 0.8, 1.25 * len(names) + 2.6), layout=layout)
    grid = figure.add_gridspec(len(names) + 1, columns, height_ratios=[1.0] * len(names) + [1.7])
    for row, name in enumerate(names):
        for column, step in enumerate(shown):
            axis = figure.add_subplot(grid[row, column])
            axis.imshow(_images(recording.observations[step])[name], interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            if column == 0:
                axis.set_ylabel(name, fontsize=10)
    axis = figure.add_subplot(grid[-1, :])
    for name, colour in modality_colours(recording.weights).items():
        axis.plot(seconds, recording.weights[name], color=colour, linewidth=1.5, label=name)
    for step in shown:
        axis.axvline(seconds[step], color="0.85", linewidth=0.8, zorder=0)
    _finish_weights(axis, recording.seconds * steps)
    figure.suptitle(f"Weight of each modality, {recording.weather}", fontsize=11)
    return figure


def _finish_weights(axis: Axes, end: float) -> None:
    axis.set(xlabel="time [s]", ylabel="weight", ylim=(0, 1), xlim=(0, end))
    axis.grid(axis="y", alpha=0.3)
    axis.legend(fontsize=8, ncols=4, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.2, frameon=False)


def _images(observation: Any) -> dict[str, np.ndarray]:
    """Pictures (H, W, 3) of the image modalities of an observation, for people to look at."""
    parts = observation if isinstance(observation, Mapping) else {"observation": observation}
    images = {}
    for name, image in sorted(parts.items(), key=lambda item: _position(item[0])):
        if np.ndim(image) != 3:
            continue
        if name in MODALITIES:
            images[name] = compose({name: image}, scale=1)
        else:
            images[name] = np.repeat(image[..., -1:], 3, axis=-1) if image.shape[-1] != 3 else image
    return images


def _position(name: str) -> int:
    return MODALITIES.index(name) if name in MODALITIES else len(MODALITIES)


def write_gif(
    recording: Recording, path: Path | str, width: int = 480, max_frames: int = 100, max_bytes: int = 1_000_000
) -> None:
    """The episode as a looped animation: ``render()`` with the weights as bars below it.

    :param recording: to show; played at twice its speed or faster, as its length demands
    :param path: of the file
    :param width: of the animation [px]
    :param max_frames: every n-th step is shown so that there are no more
    :param max_bytes: frames are left out until the file is no larger
    :raises ValueError: if the recording is empty
    """
    if not recording.pictures:
        raise ValueError("the recording is empty")
    stride = -(-len(recording.pictures) // max_frames)
    while True:
        steps = range(0, len(recording.pictures), stride)
        frames = [_frame(recording, step, width) for step in steps]
        # one palette for all: the background does not flicker, and the file is smaller
        palette = Image.fromarray(np.concatenate([np.asarray(f) for f in frames[:: max(1, len(frames) // 8)]]))
        colours = palette.quantize(64)
        images = [frame.quantize(palette=colours, dither=Image.Dither.NONE) for frame in frames]
        images[0].save(path, save_all=True, append_images=images[1:], duration=100, loop=0, optimize=False)
        if Path(path).stat().st_size <= max_bytes or len(frames) == 1:
            return
        stride *= 2


def _frame(recording: Recording, step: int, width: int) -> Image.Image:
    """One frame: a line of facts, the picture, a bar for each modality."""
    picture = Image.fromarray(recording.pictures[step]).convert("RGB")
    picture = picture.resize((width, round(width * picture.height / picture.width)), Image.Resampling.BOX)
    line, font = 16, ImageFont.load_default(11)
    frame = Image.new("RGB", (width, picture.height + line * (1 + len(recording.weights)) + 4), "white")
    frame.paste(picture, (0, line))
    draw = ImageDraw.Draw(frame)
    info = recording.infos[step]
    facts = [recording.weather, f"{step * recording.seconds:.1f} s"]
    facts += [f"{info['speed']:.0f} m/s"] if "speed" in info else []
    facts += [f"{info['distance']:.0f} m"] if "distance" in info else []
    draw.text((4, 1), " | ".join(facts), fill="black", font=font)
    for row, (name, colour) in enumerate(modality_colours(recording.weights).items()):
        weight, top = float(recording.weights[name][step]), line + picture.height + 3 + row * line
        draw.text((4, top), name, fill="black", font=font)
        draw.rectangle((60, top + 2, width - 45, top + 12), fill="#eeeeee")
        if weight > 0:
            draw.rectangle((60, top + 2, 60 + weight * (width - 105), top + 12), fill=colour)
        draw.text((width - 38, top), f"{100 * weight:.0f} %", fill="black", font=font)
    return frame
