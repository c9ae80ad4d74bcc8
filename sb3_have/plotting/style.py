"""Colours, lines and legends that all figures share. Modalities and curves can be told apart in greyscale, too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from sb3_have.envs.vision import MODALITIES


class Style(NamedTuple):
    """How a curve or a bar is drawn."""

    colour: str
    line: str = "-"
    marker: str = "o"
    hatch: str = ""


# The colours of Okabe and Ito, which colour-blind people can distinguish
MODALITY_STYLES = {
    "rgb": Style("#D55E00"),
    "event": Style("#0072B2", "--", hatch="///"),
    "depth": Style("#009E73", "-.", hatch="..."),
}
OTHER_MODALITIES = (
    Style("#CC79A7", ":", hatch="xxx"),
    Style("#E69F00", hatch="\\\\\\"),
    Style("#56B4E9", "--", hatch="ooo"),
    Style("#888888", "-."),
)
CURVES = (
    Style("#000000"),
    Style("#D55E00", "--", "s"),
    Style("#0072B2", "-.", "^"),
    Style("#009E73", ":", "v"),
    Style("#CC79A7", "-", "D"),
    Style("#E69F00", "--", "X"),
    Style("#56B4E9", "-.", "P"),
    Style("#888888", ":", "h"),
)
# Font sizes [pt]
SMALL, MEDIUM = 9, 10


def modality_colours(names: Iterable[str]) -> dict[str, str]:
    """
    Return the colour that each modality has in all figures.

    :param names: Names of the modalities
    """
    return {name: style.colour for name, style in modality_styles(names).items()}


def modality_styles(names: Iterable[str]) -> dict[str, Style]:
    """
    Return the style that each modality has in all figures, in the order of the figures.

    :param names: Names of the modalities
    """
    ordered = sorted(names, key=position)
    others = [name for name in ordered if name not in MODALITY_STYLES]
    spare = {name: OTHER_MODALITIES[i % len(OTHER_MODALITIES)] for i, name in enumerate(others)}
    return {name: MODALITY_STYLES.get(name) or spare[name] for name in ordered}


def position(name: str) -> tuple[int, str]:
    """
    Return the sort key of a modality: rgb, event, depth, then the others by name.

    :param name: Name of the modality
    """
    return MODALITIES.index(name) if name in MODALITIES else len(MODALITIES), name


def draw_curve(
    axis: Axes,
    steps: ArrayLike,
    middle: ArrayLike,
    band: tuple[ArrayLike, ArrayLike] | None,
    look: Style,
    label: str,
    emphasis: bool = False,
) -> None:
    """
    Draw a curve and the band around it.

    :param axis: Axis to draw on
    :param steps: Training steps, (P,)
    :param middle: The curve, (P,)
    :param band: Lower and upper end of the band, (P,) each
    :param look: Style of the curve
    :param label: Label in the legend
    :param emphasis: Whether to draw the curve thicker and above the others
    """
    axis.plot(
        np.asarray(steps),
        np.asarray(middle),
        color=look.colour,
        linestyle=look.line,
        marker=look.marker,
        markersize=5,
        linewidth=2.5 if emphasis else 1.5,
        zorder=3 if emphasis else 2,
        label=label,
    )
    if band is not None:
        lower, upper = map(np.asarray, band)
        axis.fill_between(np.asarray(steps), lower, upper, color=look.colour, alpha=0.13, linewidth=0)


def draw_whiskers(axis: Axes, places: Sequence[float], lowest: ArrayLike, highest: ArrayLike) -> None:
    """
    Draw vertical lines with a white outline, which are visible on a black bar, too.

    :param axis: Axis to draw on
    :param places: Horizontal position of each line
    :param lowest: Lower end of each line
    :param highest: Upper end of each line
    """
    outline = withStroke(linewidth=2.6, foreground="white")
    axis.vlines(places, lowest, highest, color="0.3", linewidth=1.2, zorder=3, path_effects=[outline])


def draw_levels(axis: Axes, levels: Mapping[str, float]) -> None:
    """
    Draw horizontal lines to compare with.

    :param axis: Axis to draw on
    :param levels: Height of each line by label
    """
    lines: list[Any] = ["--", ":", "-.", (0, (12, 3))]
    for i, (name, level) in enumerate(levels.items()):
        axis.axhline(level, color="0.35", linestyle=lines[i % len(lines)], linewidth=1, label=name, zorder=1)


def legend_above(figure: Figure, handles: Sequence[Any], labels: Sequence[str], columns: int = 8) -> None:
    """
    Draw one legend above all panels.

    :param figure: Figure to draw on
    :param handles: Lines or bars to explain
    :param labels: Their labels
    :param columns: Number of columns
    """
    figure.legend(handles, labels, fontsize=SMALL, loc="outside upper center", ncols=columns, frameon=False)
