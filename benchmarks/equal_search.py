"""Give every method the same hyperparameter search on ReliabilityDrive-v0, and evaluate each with its best settings.

    python -m benchmarks.equal_search                   # 8 trials x 3 methods x 2 seeds, then 8 new seeds of each best
    python -m benchmarks.equal_search --trials 16 --methods gve gve-wide lve have
    python -m benchmarks.equal_search --report          # only the tables of existing runs

A trial is a set of hyperparameters. The first one is the benchmark's own (``benchmarks.reliability_runs``), the others
are drawn from ``SPACE`` by a seeded generator, so all methods are tried with the same sets and the same seeds. The best
trial of a method has the largest mean area under the learning curve over the seeds of the search. It is then trained
with new seeds and evaluated in other episodes, so that the reported results are free of selection bias.

The results are in ``<out>/trial-<i>/<method>.csv`` and ``<out>/best-<i>/<method>.csv``, the trials in
``<out>/trials.csv``. Existing runs are not repeated, so the command can be stopped and started again.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.reliability import N_UPDATES, OUT, load, missing, run_all, save, summary
from benchmarks.reliability_report import markdown, report, values
from benchmarks.reliability_runs import EVALUATION_SEED, HYPERPARAMETERS, METHODS

DEFAULT_METHODS = ("gve-wide", "lve", "have")
SPACE = ("learning_rate", "tau", "gamma", "policy_delay")
SEARCH_SEEDS = (100, 200)
# Seed of the evaluation episodes of the search; the reported ones use reliability_runs.EVALUATION_SEED
SEARCH_EVALUATION_SEED = 2_000_000
# Number of seeds for the best trial of each method, starting from 0
N_SEEDS = 8


def draw_trials(n_trials: int, seed: int = 0) -> list[dict[str, Any]]:
    """
    Draw the trials: the benchmark's own hyperparameters first, then log-uniform learning rates in 3e-4..3e-3,
    log-uniform tau in 0.003..0.03, gamma from 0.95, 0.98 and 0.99, and a policy delay of 1 or 2.

    A larger number of trials starts with the same ones.
    """
    rng = np.random.default_rng(seed)
    drawn = [
        {
            "learning_rate": float(f"{np.exp(rng.uniform(np.log(3e-4), np.log(3e-3))):.2g}"),
            "tau": float(f"{np.exp(rng.uniform(np.log(3e-3), np.log(3e-2))):.2g}"),
            "gamma": float(rng.choice([0.95, 0.98, 0.99])),
            "policy_delay": int(rng.choice([1, 2])),
        }
        for _ in range(n_trials - 1)
    ]
    return [{name: HYPERPARAMETERS[name] for name in SPACE}, *drawn]


def search(
    methods: Sequence[str], trials: Sequence[Mapping[str, Any]], n_updates: int, n_workers: int, out: Path
) -> None:
    """Run what is missing: every trial of every method, then the best trial of each method with new seeds."""
    for i, trial in enumerate(trials):
        _make(methods, SEARCH_SEEDS, trial, n_updates, n_workers, out / f"trial-{i}", SEARCH_EVALUATION_SEED)
    best = best_trials(methods, len(trials), n_updates, out)
    for i in sorted(set(best.values())):
        chosen = [method for method in methods if best[method] == i]
        _make(chosen, range(N_SEEDS), trials[i], n_updates, n_workers, out / f"best-{i}", EVALUATION_SEED)


def record(trials: Sequence[Mapping[str, Any]], out: Path) -> None:
    """
    Save the trials, and check that they match those of existing runs.

    :raises ValueError: If they do not
    """
    file = out / "trials.csv"
    before = pd.read_csv(file, index_col="trial").to_dict("records") if file.exists() else []
    if any(dict(trial) != known for trial, known in zip(trials, before, strict=False)):
        raise ValueError(f"{file} has other trials than this search; choose another --out")
    if len(trials) > len(before):
        out.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(trials).rename_axis("trial").to_csv(file)


def _make(
    methods: Sequence[str],
    seeds: Sequence[int],
    trial: Mapping[str, Any],
    n_updates: int,
    n_workers: int,
    folder: Path,
    evaluation_seed: int,
) -> None:
    todo = missing(load(folder), methods, seeds, n_updates)
    made = run_all(todo, n_updates, n_workers, hyperparameters=trial, evaluation_seed=evaluation_seed)
    for i, rows in enumerate(made, 1):
        save(rows, folder)
        measures = {measure: value for _, _, _, measure, value in rows}
        print(f"{folder.name} {i}/{len(todo)} {rows[0][0]}-{rows[0][1]}: {summary(measures)}", flush=True)


def areas(method: str, n_trials: int, n_updates: int, out: Path) -> list[float]:
    """Compute the mean area under the learning curve of each trial; NaN if a run is missing."""
    means = []
    for i in range(n_trials):
        rows = load(out / f"trial-{i}")
        scores = values(rows[rows["updates"] == n_updates], method, "area").reindex(SEARCH_SEEDS)
        means.append(float(scores.mean(skipna=False)))
    return means


def best_trials(methods: Sequence[str], n_trials: int, n_updates: int, out: Path) -> dict[str, int]:
    """
    Find the best trial of each method.

    :raises FileNotFoundError: If a run is missing
    """
    scores = {method: areas(method, n_trials, n_updates, out) for method in methods}
    for method, means in scores.items():
        if np.isnan(means).any():
            raise FileNotFoundError(
                f"{out}: {method} lacks runs of trial {int(np.isnan(means).argmax())}; run without --report"
            )
    return {method: int(np.argmax(means)) for method, means in scores.items()}


def tables(methods: Sequence[str], trials: Sequence[Mapping[str, Any]], n_updates: int, out: Path) -> str:
    """Format the areas of all trials, and the statistics of the best trials with new seeds."""
    by_method = {method: areas(method, len(trials), n_updates, out) for method in methods}
    best = best_trials(methods, len(trials), n_updates, out)
    lines = [
        f"## Mean area under the learning curve, {len(SEARCH_SEEDS)} seeds of {n_updates} updates; the best in bold",
        "",
    ]
    cells = []
    for i, trial in enumerate(trials):
        scores = [f"**{a[i]:.1f}**" if best[method] == i else f"{a[i]:.1f}" for method, a in by_method.items()]
        cells.append([str(i), *(f"{trial[name]:g}" for name in SPACE), *scores])
    lines += markdown(["trial", *SPACE, *methods], cells)
    rows = []
    for method in methods:
        final = load(out / f"best-{best[method]}")
        rows.append(final[(final["method"] == method) & (final["updates"] == n_updates)])
    return "\n".join([*lines, "", "# Each method with its best, new seeds", "", report(pd.concat(rows), methods)])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", choices=[*METHODS], default=list(DEFAULT_METHODS))
    parser.add_argument("--trials", type=int, default=8)
    parser.add_argument("--updates", type=int, default=N_UPDATES)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=OUT / "search")
    parser.add_argument("--report", action="store_true", help="only write <out>/report.md")
    args = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))  # end the workers, too
    trials = draw_trials(args.trials)
    record(trials, args.out)
    if not args.report:
        search(args.methods, trials, args.updates, args.workers, args.out)
    text = tables(args.methods, trials, args.updates, args.out)
    print(text)
    if args.report:
        (args.out / "report.md").write_text(text)


if __name__ == "__main__":
    main()
