"""Learning curves: of one run with its single episodes, and of several runs with a band."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from stable_baselines3.common.monitor import load_results

from sb3_have.evaluation.statistics import iqm, mean, stratified_bootstrap
from sb3_have.plotting.style import CURVES, SMALL, Style, draw_curve, draw_levels

STATISTICS = {"mean": mean, "iqm": iqm}


class Curves(NamedTuple):
    """Scores of several runs at the same training steps."""

    steps: np.ndarray
    """(P,), training steps."""
    scores: np.ndarray
    """(P, n_runs, n_tasks): a task is a weather, or what else there is one score of."""


def plot_learning_curve(
    episodes: pd.DataFrame,
    column: str = "distance",
    label: str = "distance [m]",
    window: int = 20,
    by_weather: bool = False,
    references: Mapping[str, float] | None = None,
) -> Figure:
    """Training episodes over training steps: each a dot, and the mean of the latest as a line.

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
    size = (7.0, 4.0) if not by_weather else (3.0 * columns, 2.3 * rows + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axis, (name, group) in zip(axes.flat, groups, strict=False):
        axis.plot(group["step"], group[column], ".", color="0.65", markersize=4, label="episode")
        running = group[column].rolling(window, min_periods=1).mean()
        axis.plot(group["step"], running, color="#0072B2", linewidth=2, label=f"mean of {window}")
        draw_levels(axis, references or {})
        if group.empty:
            axis.text(0.5, 0.5, "no episode ended yet", ha="center", transform=axis.transAxes)
        axis.set_title(name, fontsize=SMALL)
        axis.grid(alpha=0.3)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes[0, 0].set_xlim(left=0)  # when all are drawn, as it ends the growing of the axis that they share
    for axis in axes.flat[len(groups) :]:
        axis.set_visible(False)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=SMALL, loc="outside upper center", ncols=min(5, len(labels)), frameon=False)
    figure.supxlabel("training steps", fontsize=10)
    figure.supylabel(label, fontsize=10)
    return figure


def plot_learning_curves(
    curves: Mapping[str, Curves],
    label: str = "return",
    statistic: str = "iqm",
    confidence: float = 0.95,
    references: Mapping[str, float] | None = None,
    styles: Mapping[str, Style] | None = None,
    n_resamples: int = 2000,
) -> Figure:
    """What several runs score on the way, each method a curve with its bootstrap interval.

    :param curves: by method, from :func:`evaluation_curves` or :func:`monitor_curves`
    :param label: name and unit of the score
    :param statistic: "iqm" (interquartile mean) or "mean", over runs and tasks
    :param confidence: of the band, which a single run has not
    :param references: levels to draw by name, such as the mean of another driver
    :param styles: looks of some methods; the others have :data:`~sb3_have.plotting.style.CURVES` in order
    :param n_resamples: of the bootstrap, see :func:`~sb3_have.evaluation.statistics.stratified_bootstrap`
    :raises ValueError: if there is nothing to draw, or no such statistic
    """
    if not curves:
        raise ValueError("curves is empty: nothing to draw")
    if statistic not in STATISTICS:
        raise ValueError(f"statistic={statistic!r}: expected one of {tuple(STATISTICS)}")
    looks = {name: CURVES[i % len(CURVES)] for i, name in enumerate(curves)} | dict(styles or {})
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axis = figure.subplots()
    for name, (steps, scores) in curves.items():
        function, n_runs = STATISTICS[statistic], scores.shape[1]
        middle, band = [float(function(table)) for table in scores], None
        if n_runs > 1:
            intervals = [
                stratified_bootstrap(function, table, n_resamples=n_resamples, confidence=confidence)
                for table in scores
            ]
            band = [interval.lower for interval in intervals], [interval.upper for interval in intervals]
        runs = "1 run" if n_runs == 1 else f"{n_runs} runs"
        look = looks[name] if len(steps) <= 40 else looks[name]._replace(marker="")
        draw_curve(axis, steps, middle, band, look, f"{name} ({runs})")
    draw_levels(axis, references or {})
    axis.set(xlabel="training steps", ylabel=f"{'IQM' if statistic == 'iqm' else 'mean'} of {label}")
    axis.set_xlim(left=0)
    axis.grid(alpha=0.3)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    handles, labels = axis.get_legend_handles_labels()
    columns = min(3, len(labels))
    figure.legend(handles, labels, fontsize=SMALL, loc="outside upper center", ncols=columns, frameon=False)
    return figure


def evaluation_curves(evaluations: pd.DataFrame, column: str = "return_mean") -> dict[str, Curves]:
    """The curves of a benchmark, or of runs of :mod:`sb3_have.train`.

    :param evaluations: a row for each run, step and weather: ``evaluations.csv`` of a benchmark, or the
        ``evaluation.csv`` of several runs joined by ``pandas.concat``; columns ``seed``, ``step``, ``weather`` and,
        if there are several methods, ``method``
    :param column: score, "return_mean" or "distance_mean"
    :return: by method ("" without that column); runs as in :func:`whole_evaluations`, weathers as tasks. A method
        without an evaluation in all of the weathers is left out, and a warning tells
    :raises ValueError: if a method has two rows for the same seed, step and weather
    """
    if "method" not in evaluations:
        evaluations = evaluations.assign(method="")
    n_weathers = evaluations["weather"].nunique()
    curves = {}
    for method, rows in evaluations.groupby("method", sort=False):
        keys = ["step", "seed", "weather"]
        if rows.duplicated(keys).any():
            raise ValueError(f"{method!r} has several rows for the same {', '.join(keys)}: give each method a name")
        table = whole_evaluations(rows, n_weathers).sort_values(keys)
        if table.empty:
            warnings.warn(f"{method!r} has no evaluation in all {n_weathers} weathers: no curve", stacklevel=2)
            continue
        shape = (table["step"].nunique(), table["seed"].nunique(), n_weathers)
        curves[str(method)] = Curves(table["step"].unique(), table[column].to_numpy(float).reshape(shape))
    return curves


def whole_evaluations(rows: pd.DataFrame, n_weathers: int) -> pd.DataFrame:
    """Those evaluations of a method of which a mean over seeds can be followed over steps.

    A mean of other seeds at other steps would jump where no run did: so the seeds count that have come as far as the
    furthest, and the steps that all of these have, in every weather.

    :param rows: of one method, with ``seed``, ``step``, ``weather``
    :param n_weathers: that a whole evaluation has
    """
    count = rows.groupby(["seed", "step"])["weather"].transform("nunique")
    rows = rows[count == n_weathers]
    furthest = rows.groupby("seed")["step"].transform("max") == rows["step"].max()
    rows = rows[furthest]
    seeds = rows.groupby("step")["seed"].transform("nunique")
    return rows[seeds == rows["seed"].nunique()]


def monitor_curves(folders: Sequence[str | Path], column: str = "r", window: int = 20, points: int = 100) -> Curves:
    """The training episodes of several runs of one method: the mean of the latest, at steps that all runs have.

    :param folders: of the runs, with the files of SB3's ``Monitor`` (``monitor.csv``, ``0.monitor.csv`` ...)
    :param column: "r" (return), "l" (steps), or one of ``info_keywords``
    :param window: episodes of the running mean
    :param points: of the curve, equally spaced up to the end of the shortest run
    :return: one task; a run counts from its first episode's end on
    :raises ValueError: if a run has no finished episode, or ends before another one's first episode
    """
    runs = []
    for folder in folders:
        episodes = load_results(str(folder))
        if episodes.empty:
            raise ValueError(f"{folder}: no episode has ended yet")
        running = episodes[column].rolling(window, min_periods=1).mean()
        runs.append((episodes["l"].cumsum().to_numpy(), running.to_numpy(float)))
    if not runs:
        raise ValueError("folders is empty: nothing to read")
    first, last = max(steps[0] for steps, _ in runs), min(steps[-1] for steps, _ in runs)
    if first > last:
        raise ValueError(f"the shortest run ends at step {last}, before the first episode of another, at {first}")
    grid = np.linspace(first, last, points)
    # what was known at that step: the mean after the last episode that had ended
    values = [running[np.searchsorted(steps, grid, side="right") - 1] for steps, running in runs]
    return Curves(grid, np.stack(values, axis=1)[:, :, None])
