"""
Write the report of a benchmark: ``report.md``, its figures, and its tables as CSV files.

    python -m sb3_have.benchmark report benchmarks/results/core benchmarks/results/extended --out report

Several folders are joined, such as those of a grid and of its extension. An unfinished benchmark gives a report of what
there is, with a list of what is missing.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sb3_have.benchmark import figures, tables
from sb3_have.benchmark.provenance import provenance
from sb3_have.benchmark.reading import DISTANCE, RETURN, Measure, Results, ResultsError, ordered, read_results
from sb3_have.plotting import weather_weights

DPI = 110
INTERVALS = (
    "Intervals are 95% percentile intervals of a bootstrap (2,000 resamples) that draws whole seeds, each with all its "
    "weathers: a seed that is good in one weather tends to be good in all. With few seeds they are narrower than they "
    "should be: with three, they contain the true value in about 75% of cases, with eight in 90%."
)


def write_report(
    results: Path | Sequence[Path],
    out: Path | None = None,
    reference: str = "have",
    grids: Sequence[Path] | None = None,
) -> Path:
    """
    Read results and write the report.

    :param results: Folder or folders
    :param out: Folder of the report; default: ``report`` in the first folder
    :param reference: Method to compare with each of the others
    :param grids: Grid files, see :func:`~sb3_have.benchmark.reading.read_results`
    :return: Path of ``report.md``
    :raises ResultsError: If results are missing or broken
    """
    folders = [results] if isinstance(results, Path) else list(results)
    return Report(read_results(folders, grids), out or folders[0] / "report", reference).write()


class Report:
    """
    The sections of a report.

    :param results: The results
    :param out: Folder of the report
    :param reference: Method to compare with each of the others
    """

    def __init__(self, results: Results, out: Path, reference: str = "have") -> None:
        self.results, self.out, self.reference = results, Path(out), reference
        self.methods = results.scored()
        # Distance first, in all sections but the tables of failures
        self.measures = results.measures[::-1]

    def write(self) -> Path:
        """
        Write all sections, and the files that belong to them.

        :return: Path of ``report.md``
        """
        self.out.mkdir(parents=True, exist_ok=True)
        names = ", ".join(folder.resolve().name for folder in self.results.folders)
        parts = [f"# Benchmark: {names}", *self._runs()]
        if self.methods:
            self.weather_table = tables.weather_table(self.results)
            self.scores = tables.score_table(self.results, self.reference)
            self.areas = tables.score_table(self.results, self.reference, areas=True)
            parts += [*self._summary(), *self._weathers(), *self._ablation(), *self._statistics(), *self._areas()]
            parts += self._ends()
        parts += [*self._curves(), *self._weights(), *self._failures()]
        parts += ["## Provenance", *provenance(self.results, self.out)]
        path = self.out / "report.md"
        path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
        return path

    def _runs(self) -> list[str]:
        table = tables.run_table(self.results)
        parts = ["## Runs", tables.run_markdown(table)]
        if not self.methods:
            parts.append("No run is finished yet: there are no tables and statistics, only learning curves.")
        lines = []
        for row in table.to_dict("records"):
            labels = {"under_way": "under way:", "not_begun": "not begun:"}
            absent = [f"{label} {row[name]}" for name, label in labels.items() if row[name]]
            lines += [f"- `{row['method']}`: seed {'; seed '.join(absent)}"] if absent else []
        if lines:
            of_what = "of the grid" if self.results.planned else "if every method is to have every seed"
            parts.append(f"Missing, {of_what}:\n\n" + "\n".join(lines))
        else:
            parts.append("The grid is finished." if self.results.planned else "Every method has every seed.")
        lengths = sorted(set(self.results.finished["step"]))
        if len(lengths) > 1:
            steps = _listed(f"{step:,}" for step in lengths)
            parts.append(f"**Runs of different lengths are side by side**: {steps} steps.")
        return parts

    def _summary(self) -> list[str]:
        lines = [] if self.reference in self.methods else [f"`{self.reference}` has no finished run."]
        for measure in self.measures:
            lines += _standing(self.weather_table, measure, self.reference, self.results.weathers)
            lines += _improvements(self.scores, measure, self.reference)
            lines += _improvements(self.areas, measure, self.reference, " while training")
        return ["## In short", "\n".join(f"- {line}" for line in lines)]

    def _weathers(self) -> list[str]:
        table = self.weather_table
        self._save_table("weathers", table)
        caption = (
            "ER is the return of an episode (episode reward), D the distance driven in it. Mean over seeds and "
            "episodes of the final evaluation with the deterministic policy; number of seeds in brackets. ± is the "
            "standard deviation of the "
        )
        single = [name for name in self.methods if len(self.results.finished_seeds(name)) == 1]
        if single == self.methods:
            caption += "episodes: there is a single seed"
        else:
            caption += "seeds' means (ddof 1)"
            caption += f", of the episodes for {_listed(single)} with a single seed" if single else ""
        drivers = list(dict.fromkeys(table.loc[table["seeds"] == 0, "driver"]))
        if drivers:
            caption += f"; {_listed(drivers)} are untrained, and ± is over episodes"
        caption += (
            f'. "all" is the mean over the {len(self.results.weathers)} weathers. The best mean of the methods is '
        )
        caption += "bold, which is no evidence by itself: see the intervals below. Numbers: `table_weathers.csv`."
        return ["## Table 1: every method in every weather", tables.weather_markdown(self.results, table), caption]

    def _ablation(self) -> list[str]:
        table, title = tables.ablation_table(self.results), "## Table 2: the parts of HAVE"
        if len(table) < 2:
            return [title, f"Needs finished runs of two of {_listed(tables.ABLATION)}."]
        self._save_table("ablation", table)
        absent = [name for name in tables.ABLATION if name not in set(table["method"]) and name != "gve"]
        caption = (
            "Over all weathers; mean and ± as in Table 1. Parameters: all that are trained, without target networks."
        )
        caption += f" Without a finished run: {_listed(absent)}." if absent else ""
        return [title, tables.ablation_markdown(self.results, table), f"{caption} Numbers: `table_ablation.csv`."]

    def _statistics(self) -> list[str]:
        self._save_table("statistics", self.scores)
        parts = ["## All weathers together"]
        parts += [tables.score_markdown(self.scores, measure, self.reference) for measure in self.measures]
        caption = (
            "A score is the mean over the episodes of a seed in a weather. IQM: mean of the scores of all seeds and "
            "weathers without the lowest and the highest quarter. "
            f"P({self.reference} is better): how often a run of `{self.reference}` has a higher score than one of "
            f"the other method in the same weather, where ties count half. {INTERVALS}"
        )
        few = [name for name in self.methods if len(self.results.finished_seeds(name)) < tables.MIN_SEEDS]
        if few:
            caption += f" {_listed(few)}: fewer than {tables.MIN_SEEDS} seeds, hence no interval (hollow markers)."
        parts.append(f"{caption} Numbers: `table_statistics.csv`.")
        figure = figures.plot_scores(self.results, self.reference, self.scores)
        parts.append(self._figure("iqm", figure, "IQM by method"))
        if self.reference in self.methods and len(self.methods) > 1:
            figure = figures.plot_improvement(self.results, self.reference, self.scores)
            parts.append(self._figure("improvement", figure, f"Probability that {self.reference} is better"))
        measure = self.measures[0]
        figure = figures.plot_profiles(self.results, measure, self.reference)
        parts.append(self._figure("profiles", figure, f"Performance profiles of {measure.name}"))
        parts.append(f"Performance profiles: share of scores above a threshold of {measure.name}, without intervals.")
        return parts

    def _areas(self) -> list[str]:
        steps = self.results.shared_steps()
        if not steps:
            return []
        self._save_table("areas", self.areas)
        parts = ["## While training"]
        parts += [tables.score_markdown(self.areas, measure, self.reference) for measure in self.measures]
        parts.append(
            "Area under the learning curve: here a score is the mean over the evaluations of a seed in a weather while "
            f"training, at steps {_listed(f'{step:,}' for step in steps)}. It shows which method learns sooner. "
            "Everything else is as above. Numbers: `table_areas.csv`."
        )
        return parts

    def _ends(self) -> list[str]:
        table = tables.end_table(self.results)
        if table.empty:
            return []
        return ["## How episodes end", tables.end_markdown(table), "Shares of the final evaluation's episodes."]

    def _curves(self) -> list[str]:
        if self.results["evaluations"].empty:
            return []
        figure = figures.plot_progress(self.results, self.reference)
        caption = (
            f"Mean over weathers of the evaluations while training. Line: mean over seeds; band: `{self.reference}` "
            "from its lowest to its highest seed. Number of seeds in brackets: only the seeds of a method that are as "
            "far as its furthest one. "
            f"Episodes in each weather: {_episodes_by_step(self.results['evaluations'])}. {_noise(self.results)}"
        )
        return ["## Learning curves", self._figure("learning_curves", figure, "Learning curves"), caption]

    def _weights(self) -> list[str]:
        weights = self.results["weights"]
        if weights.empty:
            return []
        self._save_table("weights", weather_weights(weights))
        weighing = ordered(set(weights["method"]))
        method = self.reference if self.reference in weighing else weighing[0]
        seed = int(weights.loc[weights["method"] == method, "seed"].min())
        by_weather = figures.plot_weather_weights(self.results)
        in_episode = figures.plot_episode_weights(self.results, method, seed)
        return [
            "## Weights of the modalities",
            self._figure("weights_by_weather", by_weather, "Weight of each modality by weather"),
            "Mean weight over one episode in each weather. Bars: mean over seeds; whiskers: from the lowest to the "
            "highest seed. Dotted: equal weights. Numbers: `table_weights.csv`.",
            self._figure("weights_in_episode", in_episode, "Weights over an episode"),
            f"Weights over one episode of each weather: `{method}`, seed {seed}, deterministic policy.",
        ]

    def _failures(self) -> list[str]:
        table = tables.failure_table(self.results)
        if (table["kind"] == "none").all():
            return []
        self._save_table("failures", table)
        parts = ["## When a sensor fails"]
        for measure in self.results.measures:
            name = "failures" if measure == RETURN else f"failures_{measure.name}"
            parts += [f"Mean {measure.label}:", tables.failure_markdown(table, measure)]
            parts.append(
                self._figure(name, figures.plot_failures(table, measure), f"{measure.name} under sensor failures")
            )
            if self.reference in set(table["method"]) and table["method"].nunique() > 1:
                parts.append(f"Lead of `{self.reference}` in {measure.label}:")
                parts.append(tables.lead_markdown(table, measure, self.reference))
        if DISTANCE in self.results.measures:
            parts += ["Share of the mean distance that is kept:", tables.kept_markdown(table, DISTANCE)]
        episodes = _listed(map(str, sorted(set(self.results["failures"]["episodes"]))))
        severity = _listed(map(str, sorted(set(table.loc[table["kind"] != "none", "severity"]))))
        caption = (
            f"A sensor fails for whole episodes, at severity {severity} (episodes in each weather: {episodes}); none: "
            "the same episodes without a failure. Mean over weathers and seeds (number of seeds in brackets), "
            "± standard deviation of the seeds' means (ddof 1); bars: the same means; whiskers: from the lowest to the "
            "highest seed. A share is the mean with the failure divided by the mean without: it is easy for a poor "
            "driver to keep much. "
        )
        if tables.BOTH in set(table["kind"]):
            caption += "Black = frozen: frozen from the reset on, an event camera shows no events, as a black one. "
        return [*parts, f"{caption}Numbers: `table_failures.csv`."]

    def _save_table(self, name: str, table: pd.DataFrame) -> None:
        table.round(4).to_csv(self.out / f"table_{name}.csv", index=False)

    def _figure(self, name: str, figure: Figure, text: str) -> str:
        # Leave matplotlib's version out of the file, so that the same results give the same bytes
        figure.savefig(self.out / f"{name}.png", dpi=DPI, metadata={"Software": None})
        return f"![{text}]({name}.png)"


def _episodes_by_step(evaluations: pd.DataFrame) -> str:
    """Describe how many episodes the points of the learning curves stand for."""
    parts = []
    for count, steps in evaluations.groupby("episodes")["step"]:
        first, last = steps.min(), steps.max()
        parts.append(f"{count} at step {first:,}" if first == last else f"{count} at steps {first:,} to {last:,}")
    return _listed(parts)


def _noise(results: Results) -> str:
    """
    Describe how much of the learning curves is due to the choice of the episodes.

    This is the standard error of a seed's mean over the weathers, from the standard deviations of the final episodes.
    """
    episodes = int(results["evaluations"]["episodes"].min())
    final, weathers = results.finished, len(results.weathers)
    final = final[final["episodes"] > 1]
    if final.empty:
        return "A point of few episodes is noisy: differences between neighbouring points may be chance."
    parts = []
    for measure in reversed(results.measures):
        variance = final[f"{measure.name}_std"] ** 2 * final["episodes"] / (final["episodes"] - 1)
        errors = np.sqrt(variance.groupby([final["method"], final["seed"]]).mean() / (weathers * episodes))
        parts.append(f"±{measure.format(errors.median())} in {measure.name}")
    return (
        f"A seed's point of {weathers * episodes} episodes has a standard error of {_listed(parts)} from the choice of "
        "the episodes alone (median of the runs, estimated from their final episodes): differences between points "
        "that are not much larger mean nothing."
    )


def _standing(table: pd.DataFrame, measure: Measure, reference: str, weathers: Sequence[str]) -> list[str]:
    """Describe how the methods and drivers rank."""
    table = table[table["measure"] == measure.name]
    overall = table[table["weather"] == tables.ALL]

    def levels(rows: pd.DataFrame) -> str:
        return ", ".join(f"`{row['driver']}` {measure.format(row['mean'])}" for row in rows.to_dict("records"))

    methods = overall[overall["seeds"] > 0].sort_values("mean", ascending=False)
    lines = [f"Mean {measure.name} over the weathers, best first: {levels(methods)}."]
    if len(drivers := overall[overall["seeds"] == 0]):
        lines.append(f"Untrained drivers: {levels(drivers)}.")
    if reference in set(table["driver"]):
        best = table[table["best"] & (table["weather"] != tables.ALL)]
        won = best.loc[best["driver"] == reference, "weather"]
        level = " or level" if best["weather"].isin(won).sum() > len(won) else ""
        text = f"`{reference}` is first{level} in {measure.name} in {len(won)} of {len(weathers)} weathers"
        others = best[~best["weather"].isin(won)].groupby("driver", sort=False)["weather"]
        losses = [f"{', '.join(lost)} (`{driver}`)" for driver, lost in others]
        lines.append(f"{text}; not in {_listed(losses)}." if losses else f"{text}.")
    return lines


def _improvements(scores: pd.DataFrame, measure: Measure, reference: str, when: str = "") -> list[str]:
    """Describe which methods the reference beats by more than chance."""
    own = scores[scores["measure"] == measure.name]
    rows = own[own["improvement"].notna()]
    if rows.empty:
        return []
    unknown = rows["improvement_lower"].isna()
    groups = {
        "above 0.5": rows["improvement_lower"] > 0.5,
        "including 0.5": (rows["improvement_lower"] <= 0.5) & (rows["improvement_upper"] >= 0.5),
        "below 0.5": rows["improvement_upper"] < 0.5,
        "unknown for lack of seeds": unknown,
    }
    parts = [
        f"{label} for {_listed(f'`{name}`' for name in rows.loc[chosen, 'method'])}"
        for label, chosen in groups.items()
        if chosen.any()
    ]
    text = f"Probability that `{reference}` is better in {measure.name}{when}, its 95% interval"
    if not unknown.all():
        seeds = [*own.loc[own["method"] == reference, "seeds"], *rows.loc[~unknown, "seeds"]]
        counts = str(min(seeds)) if min(seeds) == max(seeds) else f"{min(seeds)} to {max(seeds)}"
        text += f" (from {counts} seeds; with three, such intervals contain the true value in about 75% of cases, with"
        text += " eight in 90%)"
    return [f"{text}: {'; '.join(parts)}."]


def _listed(names: Iterable[str]) -> str:
    """Join names as ``a``, ``a and b`` or ``a, b and c``."""
    *most, last = list(names)
    return f"{', '.join(most)} and {last}" if most else last


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.benchmark report``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_have.benchmark report", description=(__doc__ or "").strip().splitlines()[0]
    )
    parser.add_argument("results", nargs="+", type=Path, help="folders with the CSV files of a benchmark, to be joined")
    parser.add_argument("--out", type=Path, help="folder of the report; default: report in the first folder")
    parser.add_argument("--grids", nargs="+", type=Path, help="grid files, to list missing runs; default: by name")
    parser.add_argument("--reference", default="have", help="method to compare with each of the others")
    args = parser.parse_args(arguments)
    try:
        print(write_report(args.results, args.out, args.reference, args.grids))
    except ResultsError as error:
        raise SystemExit(str(error)) from None
