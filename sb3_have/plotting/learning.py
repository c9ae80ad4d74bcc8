"""Learning curves of one run, and of several runs with bootstrap intervals."""

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

from sb3_have.evaluation.statistics import iqm, stratified_bootstrap
from sb3_have.plotting.style import CURVES, draw_curve, draw_levels, legend_above


class Curves(NamedTuple):
    """
    Scores of several runs at the same training steps.

    :param steps: Training steps, (P,)
    :param scores: Scores, (P, n_runs, n_tasks); a task is a weather, for example
    """

    steps: np.ndarray
    scores: np.ndarray


def plot_learning_curve(
    episodes: pd.DataFrame,
    column: str = "distance",
    label: str = "distance [m]",
    window: int = 20,
    references: Mapping[str, float] | None = None,
) -> Figure:
    """
    Plot the training episodes of a run as dots, and their running mean as a line.

    :param episodes: Output of SB3's ``load_results``
    :param column: Column to plot
    :param label: Name and unit of the column
    :param window: Number of episodes in the running mean
    :param references: Horizontal lines by label, such as the mean of another driver
    """
    steps = episodes["l"].cumsum()
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axis = figure.subplots()
    axis.plot(steps, episodes[column], ".", color="0.65", markersize=4, label="episode")
    running = episodes[column].rolling(window, min_periods=1).mean()
    axis.plot(steps, running, color="#0072B2", linewidth=2, label=f"mean of {window}")
    draw_levels(axis, references or {})
    if episodes.empty:
        axis.text(0.5, 0.5, "no episode ended yet", ha="center", transform=axis.transAxes)
    axis.set_xlim(left=0)
    axis.grid(alpha=0.3)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    handles, labels = axis.get_legend_handles_labels()
    legend_above(figure, handles, labels, columns=min(5, len(labels)))
    figure.supxlabel("training steps", fontsize=10)
    figure.supylabel(label, fontsize=10)
    return figure


def plot_learning_curves(
    curves: Mapping[str, Curves], label: str = "return", references: Mapping[str, float] | None = None
) -> Figure:
    """
    Plot the interquartile mean of several runs, with a 95% bootstrap interval if a method has more than one run.

    :param curves: Scores by method, from :func:`evaluation_curves` or :func:`monitor_curves`
    :param label: Name and unit of the score
    :param references: Horizontal lines by label, such as the mean of another driver
    """
    if not curves:
        raise ValueError("curves is empty")
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axis = figure.subplots()
    for i, (name, (steps, scores)) in enumerate(curves.items()):
        n_runs = scores.shape[1]
        band = None
        if n_runs > 1:
            intervals = [stratified_bootstrap(iqm, table) for table in scores]
            band = [interval.lower for interval in intervals], [interval.upper for interval in intervals]
        style = CURVES[i % len(CURVES)]
        if len(steps) > 40:
            style = style._replace(marker="")
        runs = "1 run" if n_runs == 1 else f"{n_runs} runs"
        draw_curve(axis, steps, [float(iqm(table)) for table in scores], band, style, f"{name} ({runs})")
    draw_levels(axis, references or {})
    axis.set(xlabel="training steps", ylabel=f"IQM of {label}")
    axis.set_xlim(left=0)
    axis.grid(alpha=0.3)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    handles, labels = axis.get_legend_handles_labels()
    legend_above(figure, handles, labels, columns=min(3, len(labels)))
    return figure


def evaluation_curves(evaluations: pd.DataFrame, column: str = "return_mean") -> dict[str, Curves]:
    """
    Read the evaluations of a benchmark, or of runs of :mod:`sb3_have.train`.

    A method that was never evaluated in all weathers is left out with a warning.

    :param evaluations: ``evaluations.csv`` of a benchmark, or the ``evaluation.csv`` of several runs joined by
        ``pandas.concat``: a row for each run, step and weather, with columns ``seed``, ``step``, ``weather`` and, if
        there are several methods, ``method``
    :param column: The score, "return_mean" or "distance_mean"
    :return: Curves by method ("" without that column), with weathers as tasks; see :func:`whole_evaluations` for the
        runs that count
    """
    if "method" not in evaluations:
        evaluations = evaluations.assign(method="")
    n_weathers = evaluations["weather"].nunique()
    keys = ["step", "seed", "weather"]
    curves = {}
    for method, rows in evaluations.groupby("method", sort=False):
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
    """
    Select the evaluations whose mean over seeds can be compared between steps.

    Averaging different seeds at each step would create jumps, so only the seeds that trained longest are used, at the
    steps that all of them have, in all weathers.

    :param rows: Evaluations of one method, with ``seed``, ``step`` and ``weather``
    :param n_weathers: Number of weathers in a whole evaluation
    """
    count = rows.groupby(["seed", "step"])["weather"].transform("nunique")
    rows = rows[count == n_weathers]
    furthest = rows.groupby("seed")["step"].transform("max") == rows["step"].max()
    rows = rows[furthest]
    seeds = rows.groupby("step")["seed"].transform("nunique")
    return rows[seeds == rows["seed"].nunique()]


def monitor_curves(folders: Sequence[str | Path], column: str = "r", window: int = 20, points: int = 100) -> Curves:
    """
    Read the training episodes of several runs of a method, at steps that all runs have.

    :param folders: Folders with the files of SB3's ``Monitor``, one for each run
    :param column: "r" (return), "l" (steps), or one of ``info_keywords``
    :param window: Number of episodes in the running mean
    :param points: Number of steps, from the first at which all runs have an episode to the end of the shortest run
    :return: Curves with a single task
    """
    runs = []
    for folder in folders:
        episodes = load_results(str(folder))
        if episodes.empty:
            raise ValueError(f"{folder}: no episode has ended yet")
        running = episodes[column].rolling(window, min_periods=1).mean()
        runs.append((episodes["l"].cumsum().to_numpy(), running.to_numpy(float)))
    first, last = max(steps[0] for steps, _ in runs), min(steps[-1] for steps, _ in runs)
    if first > last:
        raise ValueError(f"the shortest run ends at step {last}, before the first episode of another one, at {first}")
    grid = np.linspace(first, last, points)
    # At each step, use the mean up to the last episode that has ended
    values = [running[np.searchsorted(steps, grid, side="right") - 1] for steps, running in runs]
    return Curves(grid, np.stack(values, axis=1)[:, :, None])
