"""
The figures of a benchmark. A method looks the same in all of them, and can be recognised without colour.

They use matplotlib's ``Figure`` and leave pyplot alone. No text is smaller than 9 points.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_have.benchmark.reading import DISTANCE, Measure, Results, ordered
from sb3_have.benchmark.tables import cases_of, score_table
from sb3_have.evaluation.statistics import performance_profile
from sb3_have.plotting import weather as weather_figures
from sb3_have.plotting.learning import whole_evaluations
from sb3_have.plotting.style import (
    MEDIUM,
    SMALL,
    Style,
    draw_curve,
    draw_levels,
    draw_whiskers,
    legend_above,
    modality_styles,
)

# Width of every figure [inch]
WIDTH = 9.0
# Curves in a panel besides the reference: more would be hard to distinguish
PER_PANEL = 7

# Okabe and Ito's colours, which colour-blind readers can distinguish; methods of the same family share a colour and
# differ in line, marker and hatch
STYLES = {
    "rgb": Style("#D55E00", marker="s", hatch="\\\\\\"),
    "event": Style("#0072B2", marker="^", hatch="---"),
    "depth": Style("#009E73", marker="v", hatch="|||"),
    "sac": Style("#888888", marker="D", hatch="xxx"),
    "concat": Style("#888888", ":", "D", "..."),
    "deepmdp": Style("#56B4E9", marker="P"),
    "gve": Style("#56B4E9", "--", "p", "///"),
    "gve-wide": Style("#E69F00", marker="X", hatch="+++"),
    "drq": Style("#888888", "--", "d", "///"),
    "transfuser": Style("#009E73", "--", ">", "///"),
    "efnet": Style("#E69F00", "--", "<", "///"),
    "tqc": Style("#D55E00", "--", "h", "///"),
    "crossq": Style("#0072B2", "--", "8", "///"),
    "lve": Style("#CC79A7", marker="*", hatch="ooo"),
    "lve-paper": Style("#CC79A7", ":", "p", "..."),
    "have-paper": Style("#000000", ":", "p", "..."),
    "have": Style("#000000"),
    "have-dropout": Style("#000000", "--", "H", "///"),
}
SPARE = tuple(Style(colour, "-.", "x", "xxx") for colour in ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"))


def style(method: str) -> Style:
    """Return the style of a method; an unknown one gets a spare style that depends only on its name."""
    return STYLES.get(method) or SPARE[sum(map(ord, method)) % len(SPARE)]


def plot_progress(results: Results, reference: str = "have") -> Figure:
    """
    Plot the mean over weathers against training steps, with a column for each measure.

    A line is the mean over seeds. The reference alone has a band, from its lowest to its highest seed. Only the seeds
    that are as far as their method's furthest one are used: a mean over different seeds at different steps would jump
    where no run did.

    :param results: The results
    :param reference: Method to draw in every panel, with a band
    """
    curves = {method: learning_curves(results["evaluations"], method) for method in results.methods}
    methods = [method for method, of_method in curves.items() if len(of_method)]
    others = [method for method in methods if method != reference]
    groups = [others[i : i + PER_PANEL] for i in range(0, len(others), PER_PANEL)] or [[]]
    measures = list(reversed(results.measures))
    figure = Figure(figsize=(WIDTH, 3.6 * len(groups) + 0.2), layout="constrained")
    axes = figure.subplots(len(groups), len(measures), sharex=True, sharey="col", squeeze=False)
    for row, group in zip(axes, groups, strict=True):
        shown = ordered([*group, *([reference] if reference in methods else [])])
        for axis, measure in zip(row, measures, strict=True):
            for method in shown:
                _draw_curve(axis, method, curves[method], measure, method == reference)
            axis.set(xlabel="training steps", ylabel=f"{measure.label}, mean of weathers")
            axis.grid(alpha=0.3)
            axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    for row in axes:
        for axis, measure in zip(row, measures, strict=True):
            _draw_drivers(axis, results["drivers"], measure)
        # A driver may be within the range of one measure only: take the legend with the most entries
        handles, labels = max((axis.get_legend_handles_labels() for axis in row), key=lambda both: len(both[1]))
        row[-1].legend(handles, labels, fontsize=SMALL, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    # After drawing, because setting a limit ends the autoscaling of the shared axes
    axes[0, 0].set_xlim(left=0)
    for axis, measure in zip(axes[0], measures, strict=True):
        if measure == DISTANCE:
            axis.set_ylim(bottom=0)
    return figure


def learning_curves(evaluations: pd.DataFrame, method: str) -> pd.DataFrame:
    """
    Return the learning curve of each seed that is as far as the method's furthest one.

    :param evaluations: Evaluations of all methods
    :param method: The method
    :return: A row for each seed and step, ``seed``, ``step``, ``return_mean``, ``distance_mean``: means over weathers,
        for the steps that all of these seeds have in every weather
    """
    own = whole_evaluations(evaluations[evaluations["method"] == method], evaluations["weather"].nunique())
    return pd.DataFrame(own.groupby(["seed", "step"], as_index=False)[["return_mean", "distance_mean"]].mean())


def _draw_curve(axis: Axes, method: str, curves: pd.DataFrame, measure: Measure, emphasis: bool) -> None:
    by_step = curves.groupby("step")[f"{measure.name}_mean"]
    mean, lowest, highest = by_step.mean(), by_step.min(), by_step.max()
    seeds = curves["seed"].nunique()
    band = (lowest, highest) if emphasis and seeds > 1 else None
    draw_curve(axis, mean.index, mean, band, style(method), f"{method} ({seeds})", emphasis)


def _draw_drivers(axis: Axes, drivers: pd.DataFrame, measure: Measure) -> None:
    """Draw the untrained drivers as levels; those far above the curves, which would flatten them, as text."""
    means = drivers.groupby("driver", sort=False)[f"{measure.name}_mean"].mean()
    bottom, top = axis.get_ylim()
    limit = bottom + 1.5 * (top - bottom)
    draw_levels(axis, {str(driver): float(level) for driver, level in means.items() if level <= limit})
    above = [f"{driver} {level:.0f}" for driver, level in means.items() if level > limit]
    if above:
        axis.set_title(f"above: {', '.join(above)}", fontsize=SMALL, color="0.35")


def plot_scores(results: Results, reference: str = "have", table: pd.DataFrame | None = None) -> Figure:
    """
    Plot the interquartile mean of each method, with its 95% interval if there are enough seeds.

    :param results: Results with finished runs
    :param reference: As for :func:`~sb3_have.benchmark.tables.score_table`
    :param table: The result of that function, if it is known already
    """
    table = score_table(results, reference) if table is None else table
    return _plot_intervals(results, table, "iqm", results.scored(), "IQM of {}")


def plot_improvement(results: Results, reference: str = "have", table: pd.DataFrame | None = None) -> Figure:
    """
    Plot how often the reference beats each other method in the same weather; parameters as for :func:`plot_scores`.

    :raises ValueError: If the reference or all other methods have no finished run
    """
    others = [method for method in results.scored() if method != reference]
    if not others or len(others) == len(results.scored()):
        raise ValueError(f"need finished runs of {reference!r} and of another method, got {results.scored()}")
    table = score_table(results, reference) if table is None else table
    figure = _plot_intervals(results, table, "improvement", others, f"P({reference} is better) in {{}}")
    for axis in figure.axes:
        axis.axvline(0.5, color="0.35", linestyle="--", linewidth=1, zorder=1)
        axis.set_xlim(-0.03, 1.03)
    return figure


def _plot_intervals(results: Results, table: pd.DataFrame, name: str, methods: list[str], label: str) -> Figure:
    """Draw a dot for each method, hollow if it has no interval, with the first method on top."""
    measures = list(reversed(results.measures))
    figure = Figure(figsize=(WIDTH, 1.1 + 0.3 * len(methods)), layout="constrained")
    axes = figure.subplots(1, len(measures), sharey=True, squeeze=False)[0]
    seeds = {method: len(results.finished_seeds(method)) for method in methods}
    for axis, measure in zip(axes, measures, strict=True):
        rows = {row["method"]: row for row in table[table["measure"] == measure.name].to_dict("records")}
        for place, method in enumerate(methods):
            value, lower, upper = (rows[method][f"{name}{end}"] for end in ("", "_lower", "_upper"))
            look, known = style(method), bool(np.isfinite(lower))
            if known:
                axis.plot(
                    [lower, upper], [place, place], color=look.colour, linewidth=5, alpha=0.45, solid_capstyle="butt"
                )
            face = look.colour if known else "white"
            axis.plot(value, place, look.marker, color=look.colour, markerfacecolor=face, markersize=8)
        axis.set_xlabel(label.format(measure.label))
        axis.set_yticks(range(len(methods)), [f"{method} ({seeds[method]})" for method in methods])
        axis.set_ylim(len(methods) - 0.4, -0.6)
        axis.grid(axis="x", alpha=0.3)
    return figure


def plot_profiles(results: Results, measure: Measure = DISTANCE, reference: str = "have") -> Figure:
    """
    Plot the share of runs, over all weathers, whose mean exceeds a threshold: the higher the line, the better.

    :param results: Results with finished runs
    :param measure: Measure of the thresholds
    :param reference: Method to draw in every panel
    """
    methods = results.scored()
    scores = {method: results.scores(method, measure) for method in methods}
    # The profiles are constant in between
    thresholds = np.unique(np.concatenate([[0.0], *(table.ravel() for table in scores.values())]))
    others = [method for method in methods if method != reference]
    groups = [others[i : i + PER_PANEL] for i in range(0, len(others), PER_PANEL)] or [[]]
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    axes = figure.subplots(1, len(groups), sharex=True, sharey=True, squeeze=False)[0]
    for axis, group in zip(axes, groups, strict=True):
        for number, method in enumerate(ordered([*group, *([reference] if reference in methods else [])])):
            look = style(method)
            profile = performance_profile(scores[method], thresholds)
            width = 2.5 if method == reference else 1.5
            axis.step(
                thresholds,
                profile,
                where="post",
                color=look.colour,
                linestyle=look.line,
                linewidth=width,
                marker=look.marker,
                markersize=6,
                markevery=(0.02 * number, 0.16),  # in parts of the axes, so that the lines' markers do not overlap
                label=method,
            )
        axis.set(xlabel=f"threshold of {measure.label}", ylim=(-0.03, 1.03))
        axis.grid(alpha=0.3)
        if len(groups) == 1:
            axis.legend(fontsize=SMALL, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        else:
            axis.legend(fontsize=SMALL, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    axes[0].set_ylabel("share of runs above it")
    return figure


def plot_weather_weights(results: Results) -> Figure:
    """Plot the mean weight of each modality by weather; see :func:`sb3_have.plotting.plot_weather_weights`."""
    weights = results["weights"]
    weathers = [weather for weather in results.weathers if weather in set(weights["weather"])]
    return weather_figures.plot_weather_weights(weights, weathers or None, ordered(set(weights["method"])))


def plot_episode_weights(results: Results, method: str, seed: int) -> Figure:
    """
    Plot the weight of each modality over one episode of each weather (the paper's Fig. 5).

    :param results: The results
    :param method: Method with weights
    :param seed: Seed of the run
    :raises ValueError: If the run has no weights
    """
    weights = results["weights"]
    weights = weights[(weights["method"] == method) & (weights["seed"] == seed)]
    driven = results["episodes"]
    driven = driven[(driven["method"] == method) & (driven["seed"] == seed)]
    if weights.empty:
        raise ValueError(f"weights.csv has no weights of {method!r} with seed {seed}")
    weathers = [weather for weather in results.weathers if weather in set(weights["weather"])]
    weathers = weathers or list(dict.fromkeys(weights["weather"]))
    styles = modality_styles(dict.fromkeys(weights["modality"]))
    columns = min(4, len(weathers))
    rows = -(-len(weathers) // columns)
    figure = Figure(figsize=(WIDTH, 1.9 * rows + 0.8), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axis, weather in zip(axes.flat, weathers, strict=False):
        of_weather = weights[weights["weather"] == weather]
        episode = of_weather[of_weather["episode_seed"] == of_weather["episode_seed"].iloc[0]]
        for modality, look in styles.items():
            line = episode[episode["modality"] == modality].sort_values("t")
            axis.plot(line["t"], line["weight"], color=look.colour, linestyle=look.line, linewidth=1.2, label=modality)
        ended = driven[(driven["weather"] == weather) & (driven["episode_seed"] == episode["episode_seed"].iloc[0])]
        outcome = f", return {ended['return'].iloc[0]:.0f}" if len(ended) else ""
        axis.set_title(f"{weather}{outcome}", fontsize=SMALL)
        axis.set_ylim(0, 1)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(weathers) :]:
        axis.set_visible(False)
    figure.supxlabel("step of the episode", fontsize=MEDIUM)
    figure.supylabel("weight", fontsize=MEDIUM)
    legend_above(figure, *axes[0, 0].get_legend_handles_labels())
    return figure


def plot_failures(table: pd.DataFrame, measure: Measure) -> Figure:
    """
    Plot every method under each sensor failure.

    Each modality has a row, with a group of bars without a failure and one for each kind of failure. Whiskers reach
    from the lowest to the highest seed.

    :param table: From :func:`~sb3_have.benchmark.tables.failure_table`
    :param measure: Measure of the bars
    """
    modalities = list(modality_styles(set(table.loc[table["kind"] != "none", "modality"])))
    methods = ordered(set(table["method"]))
    figure = Figure(figsize=(WIDTH, 2.5 * len(modalities) + 0.9), layout="constrained")
    axes = figure.subplots(len(modalities), 1, sharey=True, squeeze=False)[:, 0]
    width, handles = 0.84 / len(methods), {}
    for axis, modality in zip(axes, modalities, strict=True):
        cases = {case: name for case, name in cases_of(table).items() if case[0] in ("none", modality)}
        for number, method in enumerate(methods):
            rows = {
                (row["modality"], row["kind"], row["severity"]): row
                for row in table[table["method"] == method].to_dict("records")
            }
            known = [case for case in cases if case in rows]
            # Leave out a method without this modality
            if len(known) < 2:
                continue
            places = [[*cases].index(case) + (number - (len(methods) - 1) / 2) * width for case in known]
            heights, lowest, highest = (
                [rows[case][f"{measure.name}_{what}"] for case in known] for what in ("mean", "lowest", "highest")
            )
            look = style(method)
            handles[method] = axis.bar(
                places, heights, 0.9 * width, color=look.colour, hatch=look.hatch, edgecolor="white", linewidth=0.5
            )
            if max(rows[case]["seeds"] for case in known) > 1:
                draw_whiskers(axis, places, lowest, highest)
        axis.set_xticks(range(len(cases)), [*cases.values()])
        axis.set_title(f"{modality} fails", fontsize=MEDIUM)
        axis.axhline(0.0, color="0.35", linewidth=1)
        axis.set(ylabel=measure.label, axisbelow=True)
        axis.grid(axis="y", alpha=0.3)
    shown = [method for method in methods if method in handles]
    legend_above(figure, [handles[method] for method in shown], shown)
    return figure
