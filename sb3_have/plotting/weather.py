"""Which modality counts in which weather."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_have.evaluation.recording import Recording
from sb3_have.plotting.style import MEDIUM, SMALL, Style, draw_whiskers, legend_above, modality_styles

EQUAL = "equal weights"
"""Line of a method's panel."""


def weights_table(recordings: Iterable[Recording]) -> pd.DataFrame:
    """The weights of recorded episodes as a table.

    :param recordings: of a model with modality weights
    :return: a row for each instant and modality: ``weather, episode, t, modality, weight``
    """
    rows = [
        {"weather": recording.weather, "episode": number, "t": t, "modality": name, "weight": float(weight)}
        for number, recording in enumerate(recordings)
        for name, weights in recording.weights.items()
        for t, weight in enumerate(weights)
    ]
    return pd.DataFrame(rows, columns=["weather", "episode", "t", "modality", "weight"])


def weather_weights(weights: pd.DataFrame) -> pd.DataFrame:
    """Mean weight of each modality over the episodes of a weather.

    :param weights: a row for each instant and modality: ``weather, modality, weight`` and, where there are several,
        ``seed`` and ``method``
    :return: a row for each method, weather and modality: ``mean``, ``lowest`` and ``highest`` of the ``seeds``
    """
    for name, value in (("method", ""), ("seed", 0)):
        if name not in weights:
            weights = pd.DataFrame({name: value}, index=weights.index).join(weights)
    keys = ["method", "weather", "modality"]
    of_seeds = weights.groupby([*keys, "seed"], sort=False)["weight"].mean()
    grouped = of_seeds.groupby(level=keys, sort=False)
    return grouped.agg(mean="mean", lowest="min", highest="max", seeds="count").reset_index()


def plot_weather_weights(
    weights: pd.DataFrame, weathers: Sequence[str] | None = None, methods: Sequence[str] | None = None
) -> Figure:
    """Mean weight of each modality by weather: a row for each method; whiskers from the lowest to the highest seed.

    :param weights: of :func:`weights_table`, or ``weights.csv`` of a benchmark; see :func:`weather_weights`
    :param weathers: to show, in this order; by default all, as they come
    :param methods: to show, in this order; by default all, as they come
    :raises ValueError: if there are no weights
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
        if "seed" in weights:
            seeds = sorted(set(weights.loc[weights["method"] == method, "seed"] if method else weights["seed"]))
            axis.set_title(", ".join(filter(None, [method, _seeds(seeds)])), fontsize=MEDIUM)
        else:
            axis.set_title(method, fontsize=MEDIUM)
    axes[-1].set_xticks(range(len(weathers)), [_broken(weather) for weather in weathers], fontsize=SMALL)
    # a method may have modalities that another one has not
    drawn = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    labels = [*(name for name in styles if name in drawn), EQUAL]
    legend_above(figure, [drawn[label] for label in labels], labels)
    return figure


def _draw_weather_weights(axis: Axes, table: pd.DataFrame, weathers: list[str], styles: dict[str, Style]) -> None:
    rows = table.set_index(["modality", "weather"])
    width = 0.8 / len(styles)
    for number, (modality, look) in enumerate(styles.items()):
        known = [weather for weather in weathers if (modality, weather) in rows.index]
        if not known:
            continue
        places = [weathers.index(weather) + (number - (len(styles) - 1) / 2) * width for weather in known]
        shown = rows.loc[[(modality, weather) for weather in known]]
        axis.bar(
            places,
            shown["mean"],
            0.92 * width,
            color=look.colour,
            hatch=look.hatch,
            edgecolor="white",
            linewidth=0,
            label=modality,
        )
        if shown["seeds"].max() > 1:
            draw_whiskers(axis, places, shown["lowest"], shown["highest"])
    axis.axhline(1 / max(1, table["modality"].nunique()), color="0.35", linestyle=":", linewidth=1, label=EQUAL)
    axis.set(ylabel="weight", ylim=(0, 1), axisbelow=True)
    axis.grid(axis="y", alpha=0.3)


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"mean of seeds {', '.join(map(str, seeds))}"


def _broken(weather: str) -> str:
    """``HardRainNight`` on two lines."""
    for end in ("Noon", "Night"):
        if weather.endswith(end):
            return f"{weather.removesuffix(end)}\n{end}"
    return weather
