"""Modality weights by weather."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_have.evaluation.recording import Recording
from sb3_have.plotting.style import MEDIUM, SMALL, Style, draw_whiskers, legend_above, modality_styles

EQUAL = "equal weights"


def weights_table(recordings: Iterable[Recording]) -> pd.DataFrame:
    """
    Collect the weights of recorded episodes in a table.

    :param recordings: Episodes of a model with modality weights
    :return: A row for each step and modality, with columns ``weather, episode, t, modality, weight``
    """
    rows = [
        {"weather": recording.weather, "episode": episode, "t": t, "modality": name, "weight": float(weight)}
        for episode, recording in enumerate(recordings)
        for name, weights in recording.weights.items()
        for t, weight in enumerate(weights)
    ]
    return pd.DataFrame(rows, columns=["weather", "episode", "t", "modality", "weight"])


def weather_weights(weights: pd.DataFrame) -> pd.DataFrame:
    """
    Average the weight of each modality over the episodes in a weather.

    :param weights: A row for each step and modality, with columns ``weather, modality, weight`` and, if there are
        several, ``seed`` and ``method``
    :return: A row for each method, weather and modality, with the ``mean`` over seeds, the ``lowest`` and ``highest``
        seed and the number of ``seeds``
    """
    for name, value in (("method", ""), ("seed", 0)):
        if name not in weights:
            weights = weights.assign(**{name: value})
    keys = ["method", "weather", "modality"]
    of_seeds = weights.groupby([*keys, "seed"], sort=False)["weight"].mean()
    grouped = of_seeds.groupby(level=keys, sort=False)
    return grouped.agg(mean="mean", lowest="min", highest="max", seeds="count").reset_index()


def plot_weather_weights(
    weights: pd.DataFrame, weathers: Sequence[str] | None = None, methods: Sequence[str] | None = None
) -> Figure:
    """
    Plot the mean weight of each modality by weather, in a panel for each method.

    Whiskers extend from the lowest to the highest seed.

    :param weights: Output of :func:`weights_table`, or ``weights.csv`` of a benchmark; see :func:`weather_weights`
    :param weathers: Weathers to show, in this order; by default all
    :param methods: Methods to show, in this order; by default all
    """
    if weights.empty:
        raise ValueError("weights is empty: record a model that has modality_weights()")
    table = weather_weights(weights)
    methods = list(dict.fromkeys(table["method"])) if methods is None else list(methods)
    weathers = list(dict.fromkeys(table["weather"])) if weathers is None else list(weathers)
    styles = modality_styles(dict.fromkeys(table["modality"]))
    figure = Figure(figsize=(9.0, 1.9 * len(methods) + 1.0), layout="constrained")
    axes = figure.subplots(len(methods), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axis, method in zip(axes, methods, strict=True):
        _draw_weather_weights(axis, table[table["method"] == method], weathers, styles)
        title = [method] if method else []
        if "seed" in weights:
            seeds = sorted(set(weights.loc[weights["method"] == method, "seed"] if method else weights["seed"]))
            title.append(f"{'seed' if len(seeds) == 1 else 'mean of seeds'} {', '.join(map(str, seeds))}")
        axis.set_title(", ".join(title), fontsize=MEDIUM)
    axes[-1].set_xticks(range(len(weathers)), [_on_two_lines(weather) for weather in weathers], fontsize=SMALL)
    # A method may have modalities that another one does not have
    drawn = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    labels = [*(name for name in styles if name in drawn), EQUAL]
    legend_above(figure, [drawn[label] for label in labels], labels)
    return figure


def _draw_weather_weights(axis: Axes, table: pd.DataFrame, weathers: list[str], styles: dict[str, Style]) -> None:
    width = 0.8 / len(styles)
    for i, (modality, style) in enumerate(styles.items()):
        rows = table[table["modality"] == modality].set_index("weather")
        known = [weather for weather in weathers if weather in rows.index]
        if not known:
            continue
        places = [weathers.index(weather) + (i - (len(styles) - 1) / 2) * width for weather in known]
        axis.bar(
            places,
            rows.loc[known, "mean"],
            0.92 * width,
            color=style.colour,
            hatch=style.hatch,
            edgecolor="white",
            linewidth=0,
            label=modality,
        )
        if rows.loc[known, "seeds"].max() > 1:
            draw_whiskers(axis, places, rows.loc[known, "lowest"], rows.loc[known, "highest"])
    axis.axhline(1 / max(1, table["modality"].nunique()), color="0.35", linestyle=":", linewidth=1, label=EQUAL)
    axis.set(ylabel="weight", ylim=(0, 1), axisbelow=True)
    axis.grid(axis="y", alpha=0.3)


def _on_two_lines(weather: str) -> str:
    for end in ("Noon", "Night"):
        if weather.endswith(end):
            return f"{weather.removesuffix(end)}\n{end}"
    return weather
