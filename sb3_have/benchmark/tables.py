"""Tables of a benchmark: as data frames that go into CSV files, and as Markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from sb3_have.benchmark.reading import Measure, Results
from sb3_have.evaluation.evaluation import Interval, iqm, probability_of_improvement, stratified_bootstrap

ALL = "all"

MIN_SEEDS = 3
"""Of an interval: one of two seeds would hold the truth in half of all cases, and rule out chance where it is at work
in one of eight."""

ABLATION = {
    "deepmdp": "one critic of all features (GVE)",
    "gve": "one critic of all features (GVE)",
    "gve-wide": "the same, its critic as large as HAVE's",
    "lve": "a critic for each modality, weighted (LVE)",
    "have": "both, mixed by the re-fusion network",
    "lve-paper": "LVE, only the weighted sum supervised",
    "have-paper": "HAVE with Eq. 10 as printed",
    "have-dropout": "HAVE with modality dropout in training",
}
"""What the ablation compares."""


def weather_table(results: Results) -> pd.DataFrame:
    """Every method in every weather (the paper's Table 1), a row for each weather, measure and driver.

    :return: columns ``weather`` (the last is "all"), ``measure``, ``driver``, ``mean`` over seeds and episodes,
        ``std`` and ``spread``, what it is over: "seeds" (their means, ddof=1) where there are several, else "episodes"
        (ddof=0), ``seeds`` (0 for a driver that did not learn), ``episodes`` of all seeds together, ``best`` (whether
        no other method's mean is higher)
    """
    finished, drivers, rows = results.finished, results["drivers"], []
    for measure in results.measures:
        for method in results.scored():
            group = finished[finished["method"] == method]
            rows += [_cell(w, measure, method, _in(group, w), seeded=True) for w in [*results.weathers, ALL]]
        for driver in dict.fromkeys(drivers["driver"]):
            group = drivers[drivers["driver"] == driver]
            weathers = [w for w in results.weathers if w in set(group["weather"])]
            # "all" would mean something else than for the methods if weathers were missing
            weathers += [ALL] if weathers == results.weathers else []
            rows += [_cell(w, measure, driver, _in(group, w), seeded=False) for w in weathers]
    table = pd.DataFrame(rows, columns=["weather", "measure", "driver", "mean", "std", "spread", "seeds", "episodes"])
    of_methods = table["seeds"] > 0
    highest = table["mean"].where(of_methods).groupby([table["weather"], table["measure"]]).transform("max")
    return table.assign(best=of_methods & (table["mean"] == highest))


def _in(group: pd.DataFrame, weather: str) -> pd.DataFrame:
    return group if weather == ALL else group[group["weather"] == weather]


def _cell(weather: str, measure: Measure, driver: str, group: pd.DataFrame, seeded: bool) -> dict[str, Any]:
    mean, std = _pooled(group, measure)
    seeds = group["seed"].nunique() if seeded else 0
    if seeds > 1:
        # every seed counts alike, and so does every weather of a seed
        of_seeds = group.groupby("seed")[f"{measure.name}_mean"].mean()
        mean, std = float(of_seeds.mean()), float(of_seeds.std(ddof=1))
    spread = "seeds" if seeds > 1 else "episodes"
    told = {"weather": weather, "measure": measure.name, "driver": driver, "mean": mean, "std": std}
    return {**told, "spread": spread, "seeds": seeds, "episodes": int(group["episodes"].sum())}


def _pooled(group: pd.DataFrame, measure: Measure) -> tuple[float, float]:
    """Mean and standard deviation over all episodes."""
    counts = group["episodes"].to_numpy(float)
    means, stds = (group[f"{measure.name}_{what}"].to_numpy(float) for what in ("mean", "std"))
    mean = float(np.average(means, weights=counts))
    return mean, float(np.sqrt(np.average(stds**2 + (means - mean) ** 2, weights=counts)))


def weather_markdown(results: Results, table: pd.DataFrame) -> str:
    """:func:`weather_table` in the shape of the paper's: weathers down, drivers across, the best mean in bold."""
    drivers = list(dict.fromkeys(table["driver"]))
    seeds = table.groupby("driver")["seeds"].max()
    heads = [f"{name} ({seeds[name]})" if seeds[name] else name for name in drivers]
    cells = {(cell["weather"], cell["measure"], cell["driver"]): cell for cell in table.to_dict("records")}
    rows = []
    for weather in [*results.weathers, ALL]:
        for measure in results.measures:
            row = [weather, f"{measure.short} [{measure.unit}]" if measure.unit else measure.short]
            for driver in drivers:
                cell = cells.get((weather, measure.name, driver))
                if cell is None:
                    row.append("–")
                    continue
                text = f"{cell['mean']:.{measure.digits}f}"
                text = f"**{text}**" if cell["best"] else text
                row.append(f"{text} ± {cell['std']:.{measure.digits}f}")
            rows.append(row)
    return markdown(["weather", "", *heads], rows)


def ablation_table(results: Results) -> pd.DataFrame:
    """The parts of HAVE one by one (the paper's Table 2), over all weathers.

    :return: a row for each method of :data:`ABLATION` that has a finished run: ``method``, ``form``, ``parameters``,
        ``seeds``, and for each measure ``<name>_mean``, ``<name>_std``, ``<name>_spread`` as in :func:`weather_table`
    """
    cells = weather_table(results)
    cells = cells[cells["weather"] == ALL].set_index(["driver", "measure"])
    rows = []
    for method in results.scored():
        if method not in ABLATION:
            continue
        runs = results["runs"]
        counts = sorted(set(runs.loc[runs["method"] == method, "parameters"]))
        row: dict[str, Any] = {"method": method, "form": ABLATION[method]}
        row |= {"parameters": " / ".join(map(str, counts)), "seeds": len(results.finished_seeds(method))}
        for measure in results.measures:
            row |= {f"{measure.name}_{what}": cells.loc[(method, measure.name), what] for what in ("mean", "std")}
            row[f"{measure.name}_spread"] = cells.loc[(method, measure.name), "spread"]
        rows.append(row)
    return pd.DataFrame(rows)


def ablation_markdown(results: Results, table: pd.DataFrame) -> str:
    """:func:`ablation_table`, the best means in bold."""
    measures = results.measures
    rows = []
    for _, row in table.iterrows():
        cells = [row["method"], row["form"], row["parameters"] or "–", str(row["seeds"])]
        for m in measures:
            text = f"{row[f'{m.name}_mean']:.{m.digits}f}"
            best = row[f"{m.name}_mean"] == table[f"{m.name}_mean"].max()
            cells.append(f"{f'**{text}**' if best else text} ± {row[f'{m.name}_std']:.{m.digits}f}")
        rows.append(cells)
    heads = [f"{m.short} [{m.unit}]" if m.unit else m.short for m in measures]
    return markdown(["method", "values", "parameters", "seeds", *heads], rows)


def score_table(results: Results, reference: str = "have", areas: bool = False) -> pd.DataFrame:
    """Statistics over seeds and weathers with their 95% intervals, NaN below :data:`MIN_SEEDS` seeds of a method.

    :param reference: method whose probability of improvement over each of the others is asked for
    :param areas: of the areas under the learning curves instead of the final evaluations; no rows without evaluations
        that all runs share
    :return: a row for each measure and method: ``measure``, ``method``, ``seeds``, ``iqm``, ``iqm_lower``,
        ``iqm_upper``, ``improvement``, ``improvement_lower``, ``improvement_upper`` (NaN for the reference itself)
    """
    rows = []
    methods = results.scored() if not areas or results.shared_steps() else []
    of_method = results.areas if areas else results.scores
    for measure in results.measures:
        for method in methods:
            scores = of_method(method, measure)
            row: dict[str, Any] = {"measure": measure.name, "method": method, "seeds": len(scores)}
            row |= _named("iqm", interval(iqm, scores))
            improvement = Interval(np.nan, np.nan, np.nan)
            if reference in methods and method != reference:
                improvement = interval(probability_of_improvement, of_method(reference, measure), scores)
            rows.append(row | _named("improvement", improvement))
    columns = [f"{name}{end}" for name in ("iqm", "improvement") for end in ("", "_lower", "_upper")]
    return pd.DataFrame(rows, columns=["measure", "method", "seeds", *columns])


def interval(statistic: Callable[..., Any], *scores: ArrayLike) -> Interval:
    """A statistic with its bootstrap interval, which is NaN where a table has fewer runs than :data:`MIN_SEEDS`."""
    if min(len(np.asarray(table)) for table in scores) < MIN_SEEDS:
        return Interval(float(statistic(*scores)), np.nan, np.nan)
    return stratified_bootstrap(statistic, *scores, whole_runs=True)


def _named(name: str, values: Interval) -> dict[str, float]:
    return {name: values.estimate, f"{name}_lower": values.lower, f"{name}_upper": values.upper}


def score_markdown(table: pd.DataFrame, measure: Measure, reference: str) -> str:
    """The rows of :func:`score_table` for one measure."""
    rows = []
    for row in table[table["measure"] == measure.name].to_dict("records"):
        best = _with_interval(row, "iqm", measure.digits)
        versus = "" if np.isnan(row["improvement"]) else _with_interval(row, "improvement", 2)
        rows.append([row["method"], str(row["seeds"]), best, versus])
    return markdown(["method", "seeds", f"IQM of {measure.label}", f"P({reference} is better)"], rows)


def _with_interval(row: dict[Any, Any], name: str, digits: int) -> str:
    lower, upper = row[f"{name}_lower"], row[f"{name}_upper"]
    bounds = "" if np.isnan(lower) else f" [{lower:.{digits}f}, {upper:.{digits}f}]"
    return f"{row[name]:.{digits}f}{bounds}"


def run_table(results: Results) -> pd.DataFrame:
    """How far every method is: which seeds are finished, under way, or not begun.

    Expected are the runs of the grids; if those are not known, every seed of every method.

    :return: a row for each method: ``method``, ``parameters``, ``steps`` (of the finished runs), ``finished``,
        ``under_way`` (seeds and the step of their newest evaluation), ``not_begun``, ``minutes`` (median of the runs)
    """
    finished, runs, rows = results.finished, results["runs"], []
    every = pd.concat([results["evaluations"], results["final"]])
    for method in results.methods:
        done = results.finished_seeds(method)
        own = every[(every["method"] == method) & ~every["seed"].isin(done)]
        under_way = {
            seed: _newest(own[own["seed"] == seed], len(results.weathers)) for seed in sorted(set(own["seed"]))
        }
        of_runs, expected = runs[runs["method"] == method], results.expected_seeds(method)
        rows.append(
            {
                "method": method,
                "parameters": " / ".join(map(str, sorted(set(of_runs["parameters"])))),
                "steps": " / ".join(map(str, sorted(set(finished.loc[finished["method"] == method, "step"])))),
                "finished": ", ".join(map(str, done)),
                "under_way": ", ".join(f"{seed} ({state})" for seed, state in under_way.items()),
                "not_begun": ", ".join(str(s) for s in expected if s not in done and s not in under_way),
                "minutes": round(of_runs["minutes"].median(), 1) if len(of_runs) else np.nan,
            }
        )
    return pd.DataFrame(rows)


def _newest(rows: pd.DataFrame, weathers: int) -> str:
    """The step of a run's newest evaluation, and in how many weathers it is if not in all."""
    step = rows["step"].max()
    known = rows.loc[rows["step"] == step, "weather"].nunique()
    return f"at {step}" if known == weathers else f"at {step}, {known} of {weathers} weathers"


def run_markdown(table: pd.DataFrame) -> str:
    """:func:`run_table`."""
    shown = table.assign(minutes=table["minutes"].map(lambda value: "" if np.isnan(value) else f"{value:.0f}"))
    heads = ["method", "parameters", "steps", "finished seeds", "under way", "not begun", "minutes a run (median)"]
    return markdown(heads, [[cell or "–" for cell in row] for row in shown.astype(str).to_numpy().tolist()])


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table whose columns line up in plain text too."""
    table = [[str(cell).replace("|", "\\|") for cell in row] for row in [header, *rows]]
    widths = [max(3, *(len(row[column]) for row in table)) for column in range(len(header))]
    lines = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |" for row in table]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)


def end_table(results: Results) -> pd.DataFrame:
    """How the episodes of the finished runs ended.

    :return: a row for each method: ``method``, ``episodes``, ``crashed`` and ``offroad`` (shares), ``steps`` (mean)
    """
    episodes = results["episodes"].dropna(subset=["crashed", "offroad"])
    rows = []
    for method in results.scored():
        own = episodes[(episodes["method"] == method) & episodes["seed"].isin(results.finished_seeds(method))]
        if len(own):
            shares = {name: own[name].mean() for name in ("crashed", "offroad", "steps")}
            rows.append({"method": method, "episodes": len(own), **shares})
    return pd.DataFrame(rows, columns=["method", "episodes", "crashed", "offroad", "steps"])


def end_markdown(table: pd.DataFrame) -> str:
    """:func:`end_table`."""
    rows = [
        [row["method"], str(row["episodes"]), f"{row['crashed']:.2f}", f"{row['offroad']:.2f}", f"{row['steps']:.0f}"]
        for row in table.to_dict("records")
    ]
    return markdown(["method", "episodes", "crashed", "left the road", "mean steps"], rows)
