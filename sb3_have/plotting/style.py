"""How things look in every picture: the same colour and line for the same modality, legible in greyscale too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from sb3_have.envs.vision import MODALITIES

# Okabe and Ito's colours, told apart by colour-blind people too
COLOURS = {"rgb": "#D55E00", "event": "#0072B2", "depth": "#009E73"}
SPARE_COLOURS = ("#CC79A7", "#E69F00", "#56B4E9", "#888888")
LINES = {"rgb": "-", "event": "--", "depth": "-."}
SPARE_LINES = (":", "-", "--", "-.")
HATCHES = {"rgb": "", "event": "///", "depth": "..."}
SPARE_HATCHES = ("xxx", "\\\\\\", "ooo", "")
SMALL, MEDIUM = 9, 10
"""Sizes of letters [pt]."""


class Style(NamedTuple):
    """How a curve, or a method, is drawn."""

    colour: str
    line: str = "-"
    marker: str = "o"
    hatch: str = ""


CURVES = (
    *(
        Style("#000000", marker="o"),
        Style("#D55E00", "--", "s"),
        Style("#0072B2", "-.", "^"),
        Style("#009E73", ":", "v"),
    ),
    *(
        Style("#CC79A7", marker="D"),
        Style("#E69F00", "--", "X"),
        Style("#56B4E9", "-.", "P"),
        Style("#888888", ":", "h"),
    ),
)
"""Looks of curves without one of their own, in order."""


def modality_colours(names: Iterable[str]) -> dict[str, str]:
    """The same colour for a modality in every picture, and the same order of modalities.

    :param names: of the modalities
    """
    return {name: look.colour for name, look in modality_styles(names).items()}


def modality_styles(names: Iterable[str]) -> dict[str, Style]:
    """Colour, line and hatch of modalities, in the order in which every picture shows them.

    :param names: of the modalities
    """
    ordered = sorted(names, key=position)
    others = [name for name in ordered if name not in COLOURS]
    looks = {}
    for name in ordered:
        spare = others.index(name) % len(SPARE_COLOURS) if name in others else 0
        looks[name] = Style(
            COLOURS.get(name, SPARE_COLOURS[spare]),
            LINES.get(name, SPARE_LINES[spare]),
            hatch=HATCHES.get(name, SPARE_HATCHES[spare]),
        )
    return looks


def position(name: str) -> tuple[int, str]:
    """Place of a modality among the others: rgb, event, depth, then those that are not known here by name."""
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
    """A curve and the band around it.

    :param axis: to draw on
    :param steps: (P,)
    :param middle: (P,)
    :param band: lowest and highest, (P,) each
    :param look: of the curve
    :param label: for the legend
    :param emphasis: whether it is drawn thicker and above the others
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
        lowest, highest = band
        axis.fill_between(
            np.asarray(steps), np.asarray(lowest), np.asarray(highest), color=look.colour, alpha=0.13, linewidth=0
        )


def draw_whiskers(axis: Axes, places: Sequence[float], lowest: ArrayLike, highest: ArrayLike) -> None:
    """Lines from the lowest to the highest, seen on a black bar too."""
    outline = withStroke(linewidth=2.6, foreground="white")
    axis.vlines(places, lowest, highest, color="0.3", linewidth=1.2, zorder=3, path_effects=[outline])


def legend_above(figure: Figure, handles: Sequence[Any], labels: Sequence[str], columns: int = 8) -> None:
    """One legend for all panels, outside of them."""
    figure.legend(handles, labels, fontsize=SMALL, loc="outside upper center", ncols=columns, frameon=False)


def draw_levels(axis: Axes, levels: Mapping[str, float]) -> None:
    """Horizontal lines to compare with, by name."""
    styles = ("--", ":", "-.")
    for number, (name, level) in enumerate(levels.items()):
        axis.axhline(level, color="0.35", linestyle=styles[number % 3], linewidth=1, label=name, zorder=1)
