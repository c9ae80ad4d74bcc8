"""The report of a benchmark: ``report.md``, its figures, and its tables as CSV files, from the results of the runs.

    python -m sb3_have.benchmark report benchmarks/results/core benchmarks/results/extended --out report

Several folders are joined, such as those of a grid and of its extension. A benchmark that is half done gives a report
of what there is, and says what is missing.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sb3_have.benchmark import breakdown, figures, tables
from sb3_have.benchmark.provenance import provenance
from sb3_have.benchmark.reading import DISTANCE, RETURN, Measure, Results, ResultsError, ordered, read_results
from sb3_have.plotting import weather_weights

DPI = 110
INTERVALS = (
    "Intervals are 95% percentile intervals of a bootstrap (2,000 resamples) that draws whole seeds, each with all its "
    "weathers: a seed that is good in one weather tends to be good in all. With few seeds they are narrower than they "
    "should be: with three, they hold the truth in some 75% of cases, with eight in 90%."
)


def write_report(
    results: Path | Sequence[Path],
    out: Path | None = None,
    reference: str = "have",
    grids: Sequence[Path] | None = None,
) -> Path:
    """Read results and write the report.

    :param results: folder or folders
    :param out: folder of the report, made if need be; default: ``report`` in the first folder
    :param reference: method that is compared with each of the others
    :param grids: which runs there are to be, see :func:`~sb3_have.benchmark.reading.read_results`
    :return: path of ``report.md``
    :raises ResultsError: if results are missing or broken
    """
    folders = [results] if isinstance(results, Path) else list(results)
    return Report(read_results(folders, grids), out or folders[0] / "report", reference).write()


class Report:
    """Writes the parts of a report.

    :param results: to report
    :param out: folder
    :param reference: method that is compared with each of the others
    """

    def __init__(self, results: Results, out: Path, reference: str = "have") -> None:
        self.results, self.out, self.reference = results, Path(out), reference
        self.methods = results.scored()

    def write(self) -> Path:
        """All parts, and the files beside them.

        :return: path of ``report.md``
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
        parts += [*self._curves(), *self._weights(), *self._failures(), *self._provenance()]
        path = self.out / "report.md"
        path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
        return path

    def _runs(self) -> list[str]:
        table = tables.run_table(self.results)
        parts = ["## Runs", tables.run_markdown(table)]
        if not self.methods:
            parts.append("No run is finished yet: there are no tables and statistics, only learning curves.")
        return [*parts, *missing(self.results, table)]

    def _summary(self) -> list[str]:
        lines = [] if self.reference in self.methods else [f"`{self.reference}` has no finished run."]
        for measure in reversed(self.results.measures):
            lines += _standing(self.weather_table, measure, self.reference, self.results.weathers)
            lines += _improvements(self.scores, measure, self.reference)
            lines += _improvements(self.areas, measure, self.reference, " while training")
        return ["## In short", "\n".join(f"- {line}" for line in lines)]

    def _weathers(self) -> list[str]:
        table = self.weather_table
        self._save_table("weathers", table)
        weathers = len(self.results.weathers)
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
            caption += f", but for {_listed(single)}, with a single seed, that of the episodes" if single else ""
        if len(self.results["drivers"]):
            names = list(dict.fromkeys(self.results["drivers"]["driver"]))
            caption += f"; {_listed(names)} did not learn, and ± is over episodes"
        caption += f'. "{tables.ALL}" is the mean over the {weathers} weathers. The best mean of the methods is bold, '
        caption += "which says nothing about chance: see the intervals below. Numbers: `table_weathers.csv`."
        return ["## Table 1: every method in every weather", tables.weather_markdown(self.results, table), caption]

    def _ablation(self) -> list[str]:
        table = tables.ablation_table(self.results)
        if len(table) < 2:
            return ["## Table 2: the parts of HAVE", f"Needs finished runs of two of {_listed(tables.ABLATION)}."]
        self._save_table("ablation", table)
        absent = [name for name in tables.ABLATION if name not in set(table["method"]) and name != "gve"]
        caption = (
            "Over all weathers; mean and ± as in Table 1. Parameters: all that is trained, target networks left out."
        )
        caption += f" Without a finished run: {_listed(absent)}." if absent else ""
        caption += " Numbers: `table_ablation.csv`."
        return ["## Table 2: the parts of HAVE", tables.ablation_markdown(self.results, table), caption]

    def _statistics(self) -> list[str]:
        self._save_table("statistics", self.scores)
        parts = ["## All weathers together"]
        for measure in reversed(self.results.measures):
            parts.append(tables.score_markdown(self.scores, measure, self.reference))
        few = [name for name in self.methods if len(self.results.finished_seeds(name)) < tables.MIN_SEEDS]
        caption = (
            "A score is the mean over the episodes of a seed in a weather. IQM: mean of the scores of all seeds and "
            "weathers without the lowest and the highest quarter. "
            f"P({self.reference} is better): how often a run of `{self.reference}` has the higher score than one of "
            f"the other method in the same weather, ties counting half. {INTERVALS}"
        )
        if few:
            caption += f" {_listed(few)}: fewer than {tables.MIN_SEEDS} seeds, hence no interval (hollow markers)."
        parts += [f"{caption} Numbers: `table_statistics.csv`."]
        parts.append(
            self._figure("iqm", figures.plot_scores(self.results, self.reference, self.scores), "IQM by method")
        )
        if self.reference in self.methods and len(self.methods) > 1:
            figure = figures.plot_improvement(self.results, self.reference, self.scores)
            parts.append(self._figure("improvement", figure, f"Probability that {self.reference} is better"))
        for measure in self.results.measures[-1:]:
            figure = figures.plot_profiles(self.results, measure, self.reference)
            parts.append(self._figure("profiles", figure, f"Performance profiles of {measure.name}"))
            parts.append(
                f"Performance profiles: share of scores above a threshold of {measure.name}. Drawn without intervals."
            )
        return parts

    def _areas(self) -> list[str]:
        steps = self.results.shared_steps()
        if not steps:
            return []
        self._save_table("areas", self.areas)
        parts = ["## While training"]
        for measure in reversed(self.results.measures):
            parts.append(tables.score_markdown(self.areas, measure, self.reference))
        parts.append(
            "Area under the learning curve: here a score is the mean over the evaluations of a seed in a weather while "
            f"training, at steps {_listed(f'{step:,}' for step in steps)}. It tells who learns sooner. Else as above. "
            "Numbers: `table_areas.csv`."
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
            "from its lowest to its highest seed. Number of seeds in brackets: of a method, only the seeds that "
            "have come as far as its furthest count. "
            f"Episodes in each weather: {_episodes_by_step(self.results['evaluations'])}. {_noise(self.results)}"
        )
        return ["## Learning curves", self._figure("learning_curves", figure, "Learning curves"), caption]

    def _weights(self) -> list[str]:
        weights = self.results["weights"]
        if weights.empty:
            return []
        self._save_table("weights", weather_weights(weights))
        parts = ["## Weights of the modalities"]
        figure = figures.plot_weather_weights(self.results)
        parts.append(self._figure("weights_by_weather", figure, "Weight of each modality by weather"))
        parts.append(
            "Mean weight over one episode in each weather. Bars: mean over seeds; whiskers: from the lowest to the "
            "highest seed. Dotted: equal weights. Numbers: `table_weights.csv`."
        )
        weighing = ordered(set(weights["method"]))
        method = self.reference if self.reference in weighing else weighing[0]
        seed = int(weights.loc[weights["method"] == method, "seed"].min())
        figure = figures.plot_episode_weights(self.results, method, seed)
        parts.append(self._figure("weights_in_episode", figure, "Weights over an episode"))
        parts.append(f"Weights over one episode of each weather: `{method}`, seed {seed}, deterministic policy.")
        return parts

    def _failures(self) -> list[str]:
        table = breakdown.failure_table(self.results)
        if (table["kind"] == "none").all():
            return []
        self._save_table("failures", table)
        parts = ["## When a sensor fails"]
        for measure in self.results.measures:
            name = "failures" if measure == RETURN else f"failures_{measure.name}"
            figure = figures.plot_failures(table, measure)
            parts += [f"Mean {measure.label}:", breakdown.failure_markdown(table, measure)]
            parts.append(self._figure(name, figure, f"{measure.name} under sensor failures"))
            if self.reference in set(table["method"]) and table["method"].nunique() > 1:
                parts.append(f"Lead of `{self.reference}` in {measure.label}:")
                parts.append(breakdown.lead_markdown(table, measure, self.reference))
        if DISTANCE in self.results.measures:
            parts += ["Share of the mean distance that is kept:", breakdown.kept_markdown(table, DISTANCE)]
        episodes = sorted(set(self.results["failures"]["episodes"]))
        severity = sorted(set(table.loc[table["kind"] != "none", "severity"]))
        caption = (
            f"A sensor fails for whole episodes, at severity {_listed(map(str, severity))} (episodes in each weather: "
            f"{_listed(map(str, episodes))}); none: the same episodes with sound sensors. Mean over weathers and seeds "
            "(number of seeds in brackets), ± standard deviation of the seeds' means (ddof 1); bars: the same means; "
            "whiskers: from the lowest to the highest seed. A share is the mean with the failure over that without: a "
            "poor driver easily keeps much. "
        )
        if breakdown.BOTH in set(table["kind"]):
            caption += "Black = frozen: frozen from the reset on, an event camera shows no events, as a black one. "
        return [*parts, f"{caption}Numbers: `table_failures.csv`."]

    def _provenance(self) -> list[str]:
        return ["## Provenance", *provenance(self.results, self.out)]

    def _save_table(self, name: str, table: pd.DataFrame) -> None:
        table.round(4).to_csv(self.out / f"table_{name}.csv", index=False)

    def _figure(self, name: str, figure: Figure, text: str) -> str:
        # no version of matplotlib in the file: the same results give the same bytes
        figure.savefig(self.out / f"{name}.png", dpi=DPI, metadata={"Software": None})
        return f"![{text}]({name}.png)"


def _episodes_by_step(evaluations: pd.DataFrame) -> str:
    """How many episodes the points of the learning curves stand for."""
    steps = {
        int(count): sorted(set(evaluations.loc[evaluations["episodes"] == count, "step"]))
        for count in sorted(set(evaluations["episodes"]))
    }
    told = [f"{n} at step {s[0]:,}" if len(s) == 1 else f"{n} at steps {s[0]:,} to {s[-1]:,}" for n, s in steps.items()]
    return _listed(told)


def _noise(results: Results) -> str:
    """How much of the curves is chance of the episodes, in a sentence.

    The standard error of a seed's mean over the weathers, from the standard deviations of the final episodes.
    """
    episodes = int(results["evaluations"]["episodes"].min())
    final, weathers = results.finished, len(results.weathers)
    final = final[final["episodes"] > 1]
    if final.empty:
        return "A point of few episodes is noisy: differences between neighbouring points may be chance."
    told = []
    for measure in reversed(results.measures):
        variance = final[f"{measure.name}_std"] ** 2 * final["episodes"] / (final["episodes"] - 1)
        errors = np.sqrt(variance.groupby([final["method"], final["seed"]]).mean() / (weathers * episodes))
        told.append(
            f"±{errors.median():.{measure.digits}f}{f' {measure.unit}' if measure.unit else ''} in {measure.name}"
        )
    return (
        f"A seed's point of {weathers * episodes} episodes has a standard error of {_listed(told)} from the choice of "
        "the episodes alone (median of the runs, by the spread of their final episodes): differences between points "
        "that are not well above it say nothing."
    )


def missing(results: Results, table: pd.DataFrame) -> list[str]:
    """What a report has to say about runs that are not there.

    :param table: from :func:`~sb3_have.benchmark.tables.run_table`
    """
    lines = []
    for row in table.to_dict("records"):
        absent = [f"{label} {row[name]}" for name, label in _ABSENCE.items() if row[name]]
        lines += [f"`{row['method']}`: seed " + "; seed ".join(absent)] if absent else []
    parts = []
    if lines:
        of_what = "of the grid" if results.planned else "if every method is to have every seed"
        parts.append(f"Missing, {of_what}:\n\n" + "\n".join(f"- {line}" for line in lines))
    elif len(table):
        parts.append("The grid is finished." if results.planned else "Every method has every seed.")
    lengths = sorted(set(results.finished["step"]))
    if len(lengths) > 1:
        parts.append(
            f"**Runs of different length are side by side**: {_listed(f'{step:,}' for step in lengths)} steps."
        )
    return parts


_ABSENCE = {"under_way": "under way:", "not_begun": "not begun:"}


def _standing(table: pd.DataFrame, measure: Measure, reference: str, weathers: Sequence[str]) -> list[str]:
    """Where the reference stands, in sentences."""
    table = table[table["measure"] == measure.name]
    overall = table[(table["weather"] == tables.ALL) & (table["seeds"] > 0)].sort_values("mean", ascending=False)
    unit = f" {measure.unit}" if measure.unit else ""
    levels = [f"`{row['driver']}` {row['mean']:.{measure.digits}f}{unit}" for row in overall.to_dict("records")]
    lines = [f"Mean {measure.name} over the weathers, best first: {', '.join(levels)}."]
    told = table[(table["weather"] == tables.ALL) & (table["seeds"] == 0)].to_dict("records")
    if told:
        levels = [f"`{row['driver']}` {row['mean']:.{measure.digits}f}{unit}" for row in told]
        lines.append(f"Drivers that did not learn: {', '.join(levels)}.")
    best = table[table["best"] & (table["weather"] != tables.ALL)]
    won = best.loc[best["driver"] == reference, "weather"]
    others = best[~best["weather"].isin(won)]
    if reference in set(table["driver"]):
        level = sum(best["weather"].isin(won)) > len(won)
        text = f"`{reference}` is first{' or level' if level else ''} in {measure.name}"
        text += f" in {len(won)} of {len(weathers)} weathers"
        firsts = {driver: list(others.loc[others["driver"] == driver, "weather"]) for driver in others["driver"]}
        losses = [f"{', '.join(lost)} (`{driver}`)" for driver, lost in firsts.items()]
        lines.append(f"{text}; not in {_listed(losses)}." if losses else f"{text}.")
    return lines


def _improvements(scores: pd.DataFrame, measure: Measure, reference: str, when: str = "") -> list[str]:
    """Over which methods the reference is better by more than chance, in sentences."""
    own = scores[scores["measure"] == measure.name]
    rows = own[own["improvement"].notna()]
    if rows.empty:
        return []
    unknown = rows["improvement_lower"].isna()
    groups = {
        "above 0.5": rows["improvement_lower"] > 0.5,
        "including 0.5": (rows["improvement_lower"] <= 0.5) & (rows["improvement_upper"] >= 0.5),
        "below 0.5": rows["improvement_upper"] < 0.5,
        "not known for want of seeds": unknown,
    }
    told = [
        f"{label} for {_listed(f'`{name}`' for name in rows.loc[chosen, 'method'])}"
        for label, chosen in groups.items()
        if chosen.any()
    ]
    text = f"Probability that `{reference}` is better in {measure.name}{when}, its 95% interval"
    if not unknown.all():
        seeds = [*own.loc[own["method"] == reference, "seeds"], *rows.loc[~unknown, "seeds"]]
        counts = str(min(seeds)) if min(seeds) == max(seeds) else f"{min(seeds)} to {max(seeds)}"
        text += (
            f" (from {counts} seeds; of three, such intervals hold the truth in about 75% of cases, of eight in 90%)"
        )
    return [f"{text}: {'; '.join(told)}."]


def _listed(names: Iterable[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    *most, last = list(names)
    return f"{', '.join(most)} and {last}" if most else last


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.benchmark report``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_have.benchmark report", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("results", nargs="+", type=Path, help="folders with the CSV files of a benchmark; joined")
    parser.add_argument("--out", type=Path, help="folder of the report; default: report in the first of them")
    parser.add_argument("--grids", nargs="+", type=Path, help="which runs there are to be; default: found by name")
    parser.add_argument("--reference", default="have", help="method to compare with each of the others")
    args = parser.parse_args(arguments)
    try:
        print(write_report(args.results, args.out, args.reference, args.grids))
    except ResultsError as error:
        raise SystemExit(str(error)) from None
