"""Compute rliable's figures for a few tables of scores, as the reference of our statistics.

rliable (https://github.com/google-research/rliable) is the reference implementation of Agarwal et al. 2021. It has many
dependencies that nothing else here needs, so its figures are committed, and `tests/test_statistics.py` compares with
them. To compute them again (which takes minutes), use a separate environment, which does not need ``sb3_have``::

    python -m venv rliable-venv
    rliable-venv/bin/pip install "rliable==1.2.0" "pandas<3"
    rliable-venv/bin/python benchmarks/rliable_check.py
    git diff tests/rliable_figures.json            # empty, unless versions changed the figures
    python -m pytest tests/test_statistics.py
"""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

OUT = Path(__file__).parents[1] / "tests" / "rliable_figures.json"

# Runs of x, runs of y, tasks, and decimals: with none or one, there are many ties
SHAPES = [(3, 3, 1, 1), (8, 8, 1, 0), (5, 3, 2, 4), (10, 7, 3, 1), (16, 16, 8, 0), (4, 16, 8, 4), (3, 5, 8, 1)]
AGGREGATES = ("iqm", "mean", "median", "optimality_gap")
THRESHOLDS = (-1.0, 0.0, 0.5, 1.0, 2.5)
CONFIDENCE = 0.95
RESAMPLES = 10_000
RESAMPLES_OF_PAIRS = 2_000  # slow: rliable calls SciPy for each task of each resample


def tables(case: int) -> tuple[np.ndarray, np.ndarray]:
    """Scores of two methods on tasks that differ in level and spread."""
    runs_x, runs_y, tasks, decimals = SHAPES[case]
    rng = np.random.default_rng(case)
    level, spread = rng.normal(0.5, 0.5, tasks), rng.uniform(0.5, 1.5, tasks)
    x, y = rng.normal(level + 0.4, spread, (runs_x, tasks)), rng.normal(level, spread, (runs_y, tasks))
    return x.round(decimals) + 0.0, y.round(decimals) + 0.0  # + 0.0: no -0.0


def figures(case: int) -> dict[str, Any]:
    """rliable's estimates and bounds, by statistic."""
    from rliable import library, metrics  # type: ignore[import-not-found, import-untyped, unused-ignore]

    def interval(name: str, statistic: Any, scores: Any, resamples: int) -> dict[str, Any]:
        np.random.seed(case)  # rliable draws from NumPy's global generator, whatever its random_state
        estimates, bounds = library.get_interval_estimates(
            {name: scores}, statistic, reps=resamples, confidence_interval_size=CONFIDENCE
        )
        lower, upper = bounds[name].tolist()
        return {"estimate": estimates[name].tolist(), "lower": lower, "upper": upper, "resamples": resamples}

    x, y = tables(case)
    result: dict[str, Any] = {"x": x.tolist(), "y": y.tolist()}
    aggregates = [getattr(metrics, f"aggregate_{name}") for name in AGGREGATES]
    result["aggregates"] = interval("x", lambda s: np.array([f(s) for f in aggregates]), x, RESAMPLES)
    # rliable treats a name with a comma as a pair of methods, whose runs it resamples independently
    better = metrics.probability_of_improvement
    result["improvement"] = interval("x,y", lambda s, t: np.array([better(s, t)]), (x, y), RESAMPLES_OF_PAIRS)
    above = library.run_score_deviation
    result["profile"] = interval("x", lambda s: np.array([above(s, t) for t in THRESHOLDS]), x, RESAMPLES)
    return result


def main() -> None:
    """Write the figures, with one table or statistic per line."""
    made_with = {name: version(name) for name in ("rliable", "arch", "scipy", "numpy")}
    head = {"made_with": made_with, "confidence": CONFIDENCE, "aggregates": AGGREGATES, "thresholds": THRESHOLDS}
    cases = [figures(case) for case in range(len(SHAPES))]
    bodies = [",\n".join(f"   {json.dumps(key)}: {json.dumps(value)}" for key, value in case.items()) for case in cases]
    lines = [f" {json.dumps(key)}: {json.dumps(value)},\n" for key, value in head.items()]
    OUT.write_text("{\n" + "".join(lines) + ' "cases": [\n  {\n' + "\n  },\n  {\n".join(bodies) + "\n  }\n ]\n}\n")
    print(f"wrote {OUT.name}: {len(cases)} cases, {made_with}")


if __name__ == "__main__":
    main()
