"""Tables of what methods still do when a sensor fails."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from sb3_have.benchmark.reading import Measure, Results, ordered
from sb3_have.benchmark.tables import markdown

CASE = ["modality", "kind", "severity"]


def failure_table(results: Results) -> pd.DataFrame:
    """Return and distance under each failure, and with sound sensors in the same episodes.

    Where a frozen sensor gave the same results as a black one, they are one case: events that are frozen from the
    reset on are no events.

    :return: a row for each method and case, the sound one ("none") first: ``method``, ``modality``, ``kind`` (such as
        "black = frozen"), ``severity``, ``seeds``, and for each measure ``<name>_mean`` over seeds and weathers,
        ``<name>_std`` (of the seeds' means, ddof=1, NaN for one seed), ``<name>_lowest`` and ``<name>_highest`` (of the
        seeds' means), ``<name>_kept`` (mean over that of the sound case, NaN where that is not positive)
    """
    failures = _each_once(results["failures"])
    names = [f"{measure.name}_mean" for measure in results.measures]
    of_seeds = failures.groupby(["method", *CASE, "seed"], sort=False)[names].mean()
    rows = []
    for key, group in of_seeds.groupby(level=["method", *CASE], sort=False):
        row: dict[str, Any] = {**dict(zip(["method", *CASE], key, strict=True)), "seeds": len(group)}
        for measure in results.measures:
            means = group[f"{measure.name}_mean"]
            row |= {f"{measure.name}_mean": means.mean(), f"{measure.name}_std": means.std(ddof=1)}
            row |= {f"{measure.name}_lowest": means.min(), f"{measure.name}_highest": means.max()}
        rows.append(row)
    columns = [f"{m.name}_{what}" for m in results.measures for what in ("mean", "std", "lowest", "highest")]
    table = pd.DataFrame(rows, columns=["method", *CASE, "seeds", *columns])
    for measure in results.measures:
        sound = table[table["kind"] == "none"].set_index("method")[f"{measure.name}_mean"]
        before = table["method"].map(sound)
        table[f"{measure.name}_kept"] = table[f"{measure.name}_mean"] / before.where(before > 0)
    rank = {method: place for place, method in enumerate(ordered(set(table["method"])))}
    return table.sort_values("method", key=lambda names: names.map(rank), kind="stable").reset_index(drop=True)


def _each_once(failures: pd.DataFrame) -> pd.DataFrame:
    """Black and frozen as one kind where they gave the same."""
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


BOTH = "black = frozen"


def cases_of(table: pd.DataFrame) -> dict[tuple[str, str, int], str]:
    """The cases of :func:`failure_table` in order, with their names; the severity is told where there are several."""
    cases = dict.fromkeys(zip(*(table[name] for name in CASE), strict=True))
    several = len({severity for _, kind, severity in cases if kind != "none"}) > 1
    return {
        (modality, kind, severity): kind
        if kind == "none"
        else f"{modality} {kind}" + (f" {severity}" if several else "")
        for modality, kind, severity in cases
    }


def failure_markdown(table: pd.DataFrame, measure: Measure) -> str:
    """The means of :func:`failure_table` for one measure: methods down, cases across."""

    def cell(row: dict[str, Any]) -> str:
        mean, std = row[f"{measure.name}_mean"], row[f"{measure.name}_std"]
        return f"{mean:.{measure.digits}f}" + ("" if np.isnan(std) else f" ± {std:.{measure.digits}f}")

    seeds = table.groupby("method")["seeds"].max()
    return _by_case(table, {method: f"{method} ({seeds[method]})" for method in table["method"]}, cell)


def kept_markdown(table: pd.DataFrame, measure: Measure) -> str:
    """The shares of :func:`failure_table` for one measure: methods down, failures across."""
    broken = table[table["kind"] != "none"]
    return _by_case(
        broken, {method: method for method in broken["method"]}, lambda row: f"{row[f'{measure.name}_kept']:.2f}"
    )


def lead_markdown(table: pd.DataFrame, measure: Measure, reference: str) -> str:
    """By how much the reference's mean is above that of each other method: methods down, cases across."""
    own = table[table["method"] == reference].set_index(CASE)[f"{measure.name}_mean"]
    others = table[table["method"] != reference]

    def cell(row: dict[str, Any]) -> str:
        lead = own.get(tuple(row[name] for name in CASE), np.nan) - row[f"{measure.name}_mean"]
        return f"{lead:+.{measure.digits}f}"

    return _by_case(others, {method: f"over {method}" for method in others["method"]}, cell)


def _by_case(table: pd.DataFrame, names: dict[Any, str], cell: Any) -> str:
    cases = cases_of(table)
    cells = {(row["method"], *(row[name] for name in CASE)): cell(row) for row in table.to_dict("records")}
    rows = []
    for method, name in names.items():
        told = [cells.get((method, *case), "nan") for case in cases]
        rows.append([name, *("–" if "nan" in text else text for text in told)])
    return markdown(["method", *cases.values()], rows)
