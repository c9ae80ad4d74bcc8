"""The tables of the results page: a section for each results folder of a grid, made when the site is built."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sb3_have.benchmark.reading import Results, read_results
from sb3_have.benchmark.tables import interval, score_table
from sb3_have.evaluation.evaluation import markdown_table
from sb3_have.evaluation.statistics import Interval, iqm

ROOT = Path(__file__).parents[2]
RESULTS, GRIDS = Path("benchmarks") / "results", Path("benchmarks") / "grids"
REFERENCE = "have"
SPACE = "\u00a0"  # no line break here


def results_markdown(root: Path = ROOT) -> str:
    """
    Format the results of every folder in ``benchmarks/results`` that has a ``final.csv``.

    :param root: Top of the checkout
    :return: Markdown with a heading and a table for each folder
    """
    folders = sorted(file.parent for file in (root / RESULTS).rglob("final.csv"))
    return "\n\n".join(_section(root, folder) for folder in folders)


def _section(root: Path, folder: Path) -> str:
    name = folder.relative_to(root / RESULTS).as_posix()
    grid = GRIDS / f"{name}.yml"
    results = read_results([folder], [root / grid] if (root / grid).exists() else [])
    run = f"python -m sb3_have.benchmark run {grid}"
    if grid.parent != GRIDS:  # the default is the name of the grid, without its folder
        run += f" --results {RESULTS / name}"

    # A row for each method, then the drivers that did not learn
    measures, scores = results.measures[::-1], score_table(results, REFERENCE)
    rows = []
    for method in results.scored():
        own = scores[scores["method"] == method].set_index("measure")
        means = results.scores(method, measures[0]).mean(axis=1)
        seeds = zip(results.finished_seeds(method), means, strict=True)
        cells = [_cell(Interval(*own.loc[m.name, ["iqm", "iqm_lower", "iqm_upper"]]), m.digits) for m in measures]
        better = ["improvement", "improvement_lower", "improvement_upper"]
        cells += [_cell(Interval(*own.loc[measure.name, better]), 2) for measure in measures[:1]]
        of_seeds = ", ".join(f"{mean:,.{measures[0].digits}f}{SPACE}({seed})" for seed, mean in seeds)
        rows.append([f"`{method}`", *cells, of_seeds, f"`{run} --only {method}`"])
    for driver, of_driver in results["drivers"].groupby("driver", sort=False):
        cells = [_cell(interval(iqm, [of_driver[f"{m.name}_mean"]]), m.digits) for m in measures]
        rows.append([str(driver), *cells, "", "", f"`python -m benchmarks.drivers {grid}`"])
    heads = [measure.label for measure in measures]
    heads += [f"P({REFERENCE} is better)", f"mean {measures[0].name} (seed)"]
    table = markdown_table(["method", *heads, "command"], rows)
    return "\n\n".join([f"## {name}", _conditions(results), table])


def _conditions(results: Results) -> str:
    """Describe what the rows of a table have in common."""
    final = results.finished
    if final.empty:
        return "No run is finished."
    steps = " or ".join(f"{step:,}" for step in sorted(set(final["step"])))
    episodes = " or ".join(map(str, sorted(set(final["episodes"]))))
    return (
        f"{steps} training steps; {episodes} final episodes for each seed in each of {len(results.weathers)} weathers."
    )


def _cell(statistic: Interval, digits: int) -> str:
    """Format a statistic with its interval if there is one, or an empty cell."""
    if np.isnan(statistic.estimate):
        return ""
    value, *bounds = (f"{number:,.{digits}f}" for number in statistic)
    return value if np.isnan(statistic.lower) else f"{value} [{f',{SPACE}'.join(bounds)}]"


def insert_results(app: Any, page: str, source: list[str]) -> None:
    """Replace the placeholder of the page, and rebuild it when a result changes."""
    if page == "results":
        source[0] = source[0].replace("{results}", results_markdown())
        for file in (ROOT / RESULTS).rglob("*.csv"):
            app.env.note_dependency(str(file))


def setup(app: Any) -> dict[str, bool]:
    app.connect("source-read", insert_results)
    return {"parallel_read_safe": True}
