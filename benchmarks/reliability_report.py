"""Format the statistics of the reliability benchmark as a Markdown page."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from sb3_have.evaluation.statistics import Interval, iqm, mean, probability_of_improvement, stratified_bootstrap

REFERENCE = "have"
SCORES = {"final_return": "final return", "area": "area under the curve"}
MEASURES = {
    "weight_auc": "weight AUC",
    "weight_auc_in_step": "weight AUC in a step",
    "value_bias": "bias of Q",
    "value_correlation": "correlation of Q",
    "negative_gradient": "dH/dq < 0",
    "clean_return": "clean return",
    "kept_black": "kept: black",
    "kept_frozen": "kept: frozen",
    "kept_noise": "kept: noise",
}
KEPT = ("kept_black", "kept_frozen", "kept_noise")


def report(rows: pd.DataFrame, methods: Sequence[str]) -> str:
    """
    Format tables of the scores (interquartile mean over seeds), of the probability that a run of "have" is better than
    one of another method, and of the other measures (mean over seeds), with 95% bootstrap intervals.

    :param rows: Rows with method, seed, updates, measure and value
    :param methods: Methods in the order of the tables; those without rows are skipped
    :return: The Markdown text
    """
    there = set(rows["method"])
    methods = [method for method in dict.fromkeys(methods) if method in there]
    n_seeds = rows.groupby("method")["seed"].nunique()
    lines = ["## Scores: interquartile mean over seeds [95% interval], and mean ± standard deviation", ""]
    header = ["method", "seeds", *(f"{title} {kind}" for title in SCORES.values() for kind in ("IQM", "mean"))]
    table = []
    for method in methods:
        cells = [method, str(n_seeds[method])]
        for measure in SCORES:
            scores = values(rows, method, measure)
            cells += [interval(scores, iqm, digits=1), f"{scores.mean():.1f} ± {scores.std(ddof=0):.1f}"]
        table.append(cells)
    lines += markdown(header, table)
    if REFERENCE in methods:
        lines += ["", f"## Probability that a run of {REFERENCE} is better [95% interval]", ""]
        others = [method for method in methods if method != REFERENCE]
        lines += markdown(
            ["than", *SCORES.values()],
            [[method, *(_improvement(rows, method, m) for m in SCORES)] for method in others],
        )
        if all(not values(rows, method, measure).empty for method in methods for measure in (*KEPT, "clean_return")):
            lines += ["", f"## Return with one sensor failed: that of {REFERENCE} less the other's [95% interval]", ""]
            table = [[method, *(_lead(rows, method, m) for m in KEPT)] for method in others]
            lines += markdown(["than", *(MEASURES[m].removeprefix("kept: ") for m in KEPT)], table)
    lines += ["", "## What the weights and the values are worth: mean over seeds [95% interval]", ""]
    table = [[method, *(interval(values(rows, method, m), mean) for m in MEASURES)] for method in methods]
    return "\n".join([*lines, *markdown(["method", *MEASURES.values()], table), ""])


def values(rows: pd.DataFrame, method: str, measure: str) -> pd.Series[float]:
    """Get the values of a measure per seed, without seeds where it is missing."""
    chosen = rows[(rows["method"] == method) & (rows["measure"] == measure)]
    return chosen.set_index("seed")["value"].astype(float).dropna().sort_index()


def interval(scores: pd.Series[float], statistic: object, digits: int = 3) -> str:
    if scores.empty:
        return "-"
    if len(scores) == 1:
        return f"{scores.iloc[0]:.{digits}f}"
    return _format(stratified_bootstrap(statistic, scores.to_numpy()[:, None]), digits)  # type: ignore[arg-type]


def _improvement(rows: pd.DataFrame, method: str, measure: str) -> str:
    better, other = (values(rows, name, measure).to_numpy()[:, None] for name in (REFERENCE, method))
    if min(len(better), len(other)) < 2:
        return "-"
    return _format(stratified_bootstrap(probability_of_improvement, better, other), 2)


def _lead(rows: pd.DataFrame, method: str, measure: str) -> str:
    """Compute the lead of the reference over a method in the return under a failure, mean over seeds."""
    ours, other = (
        (values(rows, name, measure) * values(rows, name, "clean_return")).to_numpy()[:, None]
        for name in (REFERENCE, method)
    )
    if min(len(ours), len(other)) < 2:
        return "-"
    return _format(stratified_bootstrap(lambda x, y: mean(x) - mean(y), ours, other), 1)


def _format(result: Interval, digits: int) -> str:
    return f"{result.estimate:.{digits}f} [{result.lower:.{digits}f}, {result.upper:.{digits}f}]"


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Format the lines of a Markdown table."""
    return ["| " + " | ".join(cells) + " |" for cells in [header, ["---"] * len(header), *rows]]
