"""The tables of a benchmark, as data frames for CSV files and as Markdown."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from sb3_have.benchmark.reading import Measure, Results, ordered
from sb3_have.evaluation.evaluation import markdown_table, pooled
from sb3_have.evaluation.statistics import Interval, iqm, probability_of_improvement, stratified_bootstrap

ALL = "all"

# Fewest seeds for an interval: with two, it would contain the true value in half of all cases, and exclude chance in
# one of eight cases where there is nothing else
MIN_SEEDS = 3

# The methods of the ablation and what they are
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

CASE = ["modality", "kind", "severity"]
BOTH = "black = frozen"


def weather_table(results: Results) -> pd.DataFrame:
    """
    Compare every method in every weather (the paper's Table 1): a row for each weather, measure and driver.

    :param results: The results
    :return: Columns ``weather`` (the last is "all"), ``measure``, ``driver``, ``mean`` over seeds and episodes,
        ``std``, ``spread`` (what ``std`` is over: "seeds" (their means, ddof=1) if there are several, else "episodes"
        (ddof=0)), ``seeds`` (0 for an untrained driver), ``episodes`` of all seeds together, and ``best``
        (whether no other method has a higher mean)
    """
    groups = [(method, results.finished[results.finished["method"] == method]) for method in results.scored()]
    drivers = results["drivers"]
    groups += [(name, drivers[drivers["driver"] == name]) for name in dict.fromkeys(drivers["driver"])]
    rows = []
    for measure in results.measures:
        for name, group in groups:
            weathers = [weather for weather in results.weathers if weather in set(group["weather"])]
            # "all" would not be comparable if weathers were missing
            weathers += [ALL] if weathers == results.weathers else []
            for weather in weathers:
                part = group if weather == ALL else group[group["weather"] == weather]
                rows.append({"weather": weather, "measure": measure.name, "driver": name, **_cell(part, measure)})
    table = pd.DataFrame(rows, columns=["weather", "measure", "driver", "mean", "std", "spread", "seeds", "episodes"])
    of_methods = table["seeds"] > 0
    highest = table["mean"].where(of_methods).groupby([table["weather"], table["measure"]]).transform("max")
    return table.assign(best=of_methods & (table["mean"] == highest))


def _cell(group: pd.DataFrame, measure: Measure) -> dict[str, Any]:
    mean, std = pooled(group, measure.name)
    seeds = group["seed"].nunique() if "seed" in group else 0
    if seeds > 1:
        # Every seed has the same weight, and so has every weather of a seed
        of_seeds = group.groupby("seed")[f"{measure.name}_mean"].mean()
        mean, std = float(of_seeds.mean()), float(of_seeds.std(ddof=1))
    spread = "seeds" if seeds > 1 else "episodes"
    return {"mean": mean, "std": std, "spread": spread, "seeds": seeds, "episodes": int(group["episodes"].sum())}


def weather_markdown(results: Results, table: pd.DataFrame) -> str:
    """Format :func:`weather_table` as in the paper: weathers down, drivers across, the best mean in bold."""
    drivers, seeds = list(dict.fromkeys(table["driver"])), table.groupby("driver")["seeds"].max()
    cells = {(cell["weather"], cell["measure"], cell["driver"]): cell for cell in table.to_dict("records")}
    rows = []
    for weather in [*results.weathers, ALL]:
        for measure in results.measures:
            row = [weather, measure.short_label]
            for driver in drivers:
                cell = cells.get((weather, measure.name, driver))
                row.append("–" if cell is None else _mean_and_std(cell["mean"], cell["std"], measure, cell["best"]))
            rows.append(row)
    return markdown_table(["weather", "", *(f"{n} ({seeds[n]})" if seeds[n] else n for n in drivers)], rows)


def _mean_and_std(mean: float, std: float, measure: Measure, bold: bool = False) -> str:
    text = f"{mean:.{measure.digits}f}"
    text = f"**{text}**" if bold else text
    return text if np.isnan(std) else f"{text} ± {std:.{measure.digits}f}"


def ablation_table(results: Results) -> pd.DataFrame:
    """
    Compare the parts of HAVE one by one (the paper's Table 2), over all weathers.

    :param results: The results
    :return: A row for each method of :data:`ABLATION` that has a finished run: ``method``, ``form``, ``parameters``,
        ``seeds``, and for each measure ``<name>_mean``, ``<name>_std``, ``<name>_spread`` as in :func:`weather_table`
    """
    cells = weather_table(results)
    cells = cells[cells["weather"] == ALL].set_index(["driver", "measure"])
    rows = []
    for method in results.scored():
        if method in ABLATION:
            row: dict[str, Any] = {"method": method, "form": ABLATION[method]}
            row |= {"parameters": _parameters(results, method), "seeds": len(results.finished_seeds(method))}
            for measure in results.measures:
                cell = (method, measure.name)
                row |= {f"{measure.name}_{what}": cells.loc[cell, what] for what in ("mean", "std", "spread")}
            rows.append(row)
    return pd.DataFrame(rows)


def _parameters(results: Results, method: str) -> str:
    runs = results["runs"]
    return " / ".join(map(str, sorted(set(runs.loc[runs["method"] == method, "parameters"]))))


def ablation_markdown(results: Results, table: pd.DataFrame) -> str:
    """Format :func:`ablation_table`, the best means in bold."""
    rows = []
    for row in table.to_dict("records"):
        cells = [row["method"], row["form"], row["parameters"] or "–", str(row["seeds"])]
        for measure in results.measures:
            mean, std = row[f"{measure.name}_mean"], row[f"{measure.name}_std"]
            cells.append(_mean_and_std(mean, std, measure, mean == table[f"{measure.name}_mean"].max()))
        rows.append(cells)
    heads = [measure.short_label for measure in results.measures]
    return markdown_table(["method", "values", "parameters", "seeds", *heads], rows)


def score_table(results: Results, reference: str = "have", areas: bool = False) -> pd.DataFrame:
    """
    Compute statistics over seeds and weathers with 95% intervals, which are NaN below :data:`MIN_SEEDS` seeds.

    :param results: The results
    :param reference: Method to compare with each of the others
    :param areas: Whether to use the areas under the learning curves instead of the final evaluations; there are no rows
        if the runs share no evaluations
    :return: A row for each measure and method: ``measure``, ``method``, ``seeds``, ``iqm``, ``iqm_lower``,
        ``iqm_upper``, ``improvement``, ``improvement_lower``, ``improvement_upper`` (NaN for the reference itself)
    """
    rows = []
    methods = results.scored() if not areas or results.shared_steps() else []
    of_method = results.areas if areas else results.scores
    for measure in results.measures:
        for method in methods:
            scores = of_method(method, measure)
            improvement = Interval(np.nan, np.nan, np.nan)
            if reference in methods and method != reference:
                improvement = interval(probability_of_improvement, of_method(reference, measure), scores)
            statistics = (*interval(iqm, scores), *improvement)
            rows.append([measure.name, method, len(scores), *map(float, statistics)])
    columns = [f"{name}{end}" for name in ("iqm", "improvement") for end in ("", "_lower", "_upper")]
    return pd.DataFrame(rows, columns=["measure", "method", "seeds", *columns])


def interval(statistic: Callable[..., Any], *scores: ArrayLike) -> Interval:
    """Compute a statistic with its bootstrap interval, which is NaN below :data:`MIN_SEEDS` runs in a table."""
    if min(len(np.asarray(table)) for table in scores) < MIN_SEEDS:
        return Interval(statistic(*scores), np.nan, np.nan)
    return stratified_bootstrap(statistic, *scores, whole_runs=True)


def score_markdown(table: pd.DataFrame, measure: Measure, reference: str) -> str:
    """Format the rows of :func:`score_table` for one measure."""

    def cell(row: dict[Any, Any], name: str, digits: int) -> str:
        value, lower, upper = (row[f"{name}{end}"] for end in ("", "_lower", "_upper"))
        bounds = "" if np.isnan(lower) else f" [{lower:.{digits}f}, {upper:.{digits}f}]"
        return "" if np.isnan(value) else f"{value:.{digits}f}{bounds}"

    rows = [
        [row["method"], str(row["seeds"]), cell(row, "iqm", measure.digits), cell(row, "improvement", 2)]
        for row in table[table["measure"] == measure.name].to_dict("records")
    ]
    return markdown_table(["method", "seeds", f"IQM of {measure.label}", f"P({reference} is better)"], rows)


def run_table(results: Results) -> pd.DataFrame:
    """
    List the progress of every method: which seeds are finished, under way, or not begun.

    Expected are the runs of the grids; if those are not known, every seed of every method.

    :param results: The results
    :return: A row for each method: ``method``, ``parameters``, ``steps`` (of the finished runs), ``finished``,
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
        not_begun = [seed for seed in results.expected_seeds(method) if seed not in done and seed not in under_way]
        minutes = runs.loc[runs["method"] == method, "minutes"]
        rows.append(
            {
                "method": method,
                "parameters": _parameters(results, method),
                "steps": " / ".join(map(str, sorted(set(finished.loc[finished["method"] == method, "step"])))),
                "finished": ", ".join(map(str, done)),
                "under_way": ", ".join(f"{seed} ({state})" for seed, state in under_way.items()),
                "not_begun": ", ".join(map(str, not_begun)),
                "minutes": round(minutes.median(), 1) if len(minutes) else np.nan,
            }
        )
    return pd.DataFrame(rows)


def _newest(rows: pd.DataFrame, weathers: int) -> str:
    """Describe a run's newest evaluation by its step, and the number of weathers if some are missing."""
    step = rows["step"].max()
    known = rows.loc[rows["step"] == step, "weather"].nunique()
    return f"at {step}" if known == weathers else f"at {step}, {known} of {weathers} weathers"


def run_markdown(table: pd.DataFrame) -> str:
    """Format :func:`run_table`."""
    shown = table.assign(minutes=table["minutes"].map(lambda value: "" if np.isnan(value) else f"{value:.0f}"))
    heads = ["method", "parameters", "steps", "finished seeds", "under way", "not begun", "minutes a run (median)"]
    return markdown_table(heads, [[cell or "–" for cell in row] for row in shown.astype(str).to_numpy().tolist()])


def end_table(results: Results) -> pd.DataFrame:
    """
    Count how the episodes of the finished runs ended.

    :param results: The results
    :return: A row for each method: ``method``, ``episodes``, ``crashed`` and ``offroad`` (shares), ``steps`` (mean)
    """
    episodes = results["episodes"].dropna(subset=["crashed", "offroad"])
    rows = []
    for method in results.scored():
        own = episodes[(episodes["method"] == method) & episodes["seed"].isin(results.finished_seeds(method))]
        if len(own):
            rows.append([method, len(own), *own[["crashed", "offroad", "steps"]].mean()])
    return pd.DataFrame(rows, columns=["method", "episodes", "crashed", "offroad", "steps"])


def end_markdown(table: pd.DataFrame) -> str:
    """Format :func:`end_table`."""
    rows = [
        [row["method"], str(row["episodes"]), f"{row['crashed']:.2f}", f"{row['offroad']:.2f}", f"{row['steps']:.0f}"]
        for row in table.to_dict("records")
    ]
    return markdown_table(["method", "episodes", "crashed", "left the road", "mean steps"], rows)


def failure_table(results: Results) -> pd.DataFrame:
    """
    Compare return and distance under each sensor failure, and in the same episodes without a failure.

    Where a frozen sensor gave the same results as a black one, they are one case: an event camera that is frozen from
    the reset on shows no events.

    :param results: The results
    :return: A row for each method and case, the one without a failure ("none") first: ``method``, ``modality``,
        ``kind`` (such as "black = frozen"), ``severity``, ``seeds``, and for each measure ``<name>_mean`` over seeds
        and weathers, ``<name>_std`` (of the seeds' means, ddof=1, NaN for one seed), ``<name>_lowest`` and
        ``<name>_highest`` (of the seeds' means), ``<name>_kept`` (mean divided by that of "none", NaN if that is not
        positive)
    """
    failures = _join_black_and_frozen(results["failures"])
    names = [f"{measure.name}_mean" for measure in results.measures]
    of_seeds = failures.groupby(["method", *CASE, "seed"], sort=False)[names].mean()
    cases = of_seeds.groupby(level=["method", *CASE], sort=False)
    columns: dict[str, Any] = {"seeds": cases.size()}
    for name, means in zip(names, (cases[name] for name in names), strict=True):
        stem = name.removesuffix("_mean")
        columns |= {f"{stem}_mean": means.mean(), f"{stem}_std": means.std(ddof=1)}
        columns |= {f"{stem}_lowest": means.min(), f"{stem}_highest": means.max()}
    table = pd.DataFrame(columns).reset_index()
    for name in names:
        before = table["method"].map(table[table["kind"] == "none"].set_index("method")[name])
        table[f"{name.removesuffix('_mean')}_kept"] = table[name] / before.where(before > 0)
    rank = {method: place for place, method in enumerate(ordered(set(table["method"])))}
    return table.sort_values("method", key=lambda names: names.map(rank), kind="stable", ignore_index=True)


def _join_black_and_frozen(failures: pd.DataFrame) -> pd.DataFrame:
    """Merge black and frozen where they gave the same results."""
    for (modality, severity), rows in failures.groupby(["modality", "severity"], sort=False):
        black, frozen = (
            rows[rows["kind"] == kind].set_index(["method", "seed", "weather"])["return_mean"].sort_index()
            for kind in ("black", "frozen")
        )
        if len(black) and black.equals(frozen):
            own = (failures["modality"] == modality) & (failures["severity"] == severity)
            failures = failures[~own | (failures["kind"] != "frozen")]
            failures = failures.assign(kind=failures["kind"].mask(own & (failures["kind"] == "black"), BOTH))
    return failures


def cases_of(table: pd.DataFrame) -> dict[tuple[str, str, int], str]:
    """Return the cases of :func:`failure_table` in order, with their names (and severities if there are several)."""
    cases = dict.fromkeys(zip(*(table[name] for name in CASE), strict=True))
    several = len({severity for _, kind, severity in cases if kind != "none"}) > 1
    return {
        (modality, kind, severity): kind
        if kind == "none"
        else f"{modality} {kind}" + (f" {severity}" if several else "")
        for modality, kind, severity in cases
    }


def failure_markdown(table: pd.DataFrame, measure: Measure) -> str:
    """Format the means of :func:`failure_table` for one measure: methods down, cases across."""
    seeds = table.groupby("method")["seeds"].max()
    names = {method: f"{method} ({seeds[method]})" for method in table["method"]}
    return _by_case(
        table, names, lambda row: _mean_and_std(row[f"{measure.name}_mean"], row[f"{measure.name}_std"], measure)
    )


def kept_markdown(table: pd.DataFrame, measure: Measure) -> str:
    """Format the shares of :func:`failure_table` for one measure: methods down, failures across."""
    broken = table[table["kind"] != "none"]
    names = {method: method for method in broken["method"]}
    return _by_case(broken, names, lambda row: f"{row[f'{measure.name}_kept']:.2f}")


def lead_markdown(table: pd.DataFrame, measure: Measure, reference: str) -> str:
    """Format the reference's mean minus that of each other method: methods down, cases across."""
    own = table[table["method"] == reference].set_index(CASE)[f"{measure.name}_mean"]
    others = table[table["method"] != reference]

    def cell(row: dict[Any, Any]) -> str:
        lead = own.get(tuple(row[name] for name in CASE), np.nan) - row[f"{measure.name}_mean"]
        return f"{lead:+.{measure.digits}f}"

    return _by_case(others, {method: f"over {method}" for method in others["method"]}, cell)


def _by_case(table: pd.DataFrame, names: dict[str, str], cell: Callable[[dict[Any, Any]], str]) -> str:
    cases = cases_of(table)
    cells = {(row["method"], *(row[name] for name in CASE)): cell(row) for row in table.to_dict("records")}
    rows = []
    for method, name in names.items():
        texts = [cells.get((method, *case), "nan") for case in cases]
        rows.append([name, *("–" if "nan" in text else text for text in texts)])
    return markdown_table(["method", *cases.values()], rows)
