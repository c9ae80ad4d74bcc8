"""The same search of hyper-parameters for every method, on ReliabilityDrive-v0, and what each then makes of its best.

    python -m benchmarks.equal_search                   # 8 trials x 3 methods x 2 seeds, then 8 new seeds of each best
    python -m benchmarks.equal_search --trials 16 --methods gve gve-wide lve have
    python -m benchmarks.equal_search --report          # only the tables of the runs that are there

A trial is a set of hyper-parameters, the first the benchmark's own (``benchmarks.reliability_runs``), the others drawn
from ``SPACE`` by a seeded generator: all methods are tried with the same sets and the same seeds. A method's best is
the set with the largest mean ``area`` (of the learning curve) over the seeds of the search; it is then trained anew
with seeds that the search has not seen and evaluated in other episodes, so that what is reported has not been selected.

Rows of the runs lie in ``<out>/trial-<i>/<method>.csv`` and ``<out>/best-<i>/<method>.csv``, the sets in
``<out>/trials.csv``. Runs that are there are not repeated: the command can be stopped and given again.
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
SEARCH_EVALUATION_SEED = 2_000_000
"""Of the episodes that decide in the search; those that are reported are ``reliability_runs.EVALUATION_SEED``'s."""
N_SEEDS = 8
"""Of the runs with each method's best, from 0 on."""


def draw_trials(n_trials: int, seed: int = 0) -> list[dict[str, Any]]:
    """
    Sets of hyper-parameters: the benchmark's own, then learning rate log-uniform in 3e-4 to 3e-3, tau log-uniform in
    0.003 to 0.03, gamma of 0.95, 0.98, 0.99, the actor every update or every second one. More trials begin with the
    same ones.
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
    """Makes the runs that are missing: every trial of every method, then the best of each method with new seeds."""
    for i, trial in enumerate(trials):
        _make(methods, SEARCH_SEEDS, trial, n_updates, n_workers, out / f"trial-{i}", SEARCH_EVALUATION_SEED)
    best = best_trials(methods, len(trials), n_updates, out)
    for i in sorted(set(best.values())):
        chosen = [method for method in methods if best[method] == i]
        _make(chosen, range(N_SEEDS), trials[i], n_updates, n_workers, out / f"best-{i}", EVALUATION_SEED)


def record(trials: Sequence[Mapping[str, Any]], out: Path) -> None:
    """
    Writes the trials down, or compares them with those of the runs that are there.

    :raises ValueError: if they are others
    """
    file = out / "trials.csv"
    before = pd.read_csv(file, index_col="trial").to_dict("records") if file.exists() else []
    if any(dict(trial) != known for trial, known in zip(trials, before, strict=False)):
        raise ValueError(f"{file} has other trials than those that are drawn now: choose another --out.")
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
        told = {measure: value for _, _, _, measure, value in rows}
        print(f"{folder.name} {i}/{len(todo)} {rows[0][0]}-{rows[0][1]}: {summary(told)}", flush=True)


def areas(method: str, n_trials: int, n_updates: int, out: Path) -> list[float]:
    """Mean area under the learning curve over the seeds of the search, for each trial; NaN while a run is missing."""
    means = []
    for i in range(n_trials):
        rows = load(out / f"trial-{i}")
        scores = values(rows[rows["updates"] == n_updates], method, "area").reindex(SEARCH_SEEDS)
        means.append(float(scores.mean(skipna=False)))
    return means


def best_trials(methods: Sequence[str], n_trials: int, n_updates: int, out: Path) -> dict[str, int]:
    """
    The number of each method's best trial.

    :raises FileNotFoundError: if not all trials of a method have their runs, since the best would not be known
    """
    scores = {method: areas(method, n_trials, n_updates, out) for method in methods}
    for method, means in scores.items():
        if np.isnan(means).any():
            raise FileNotFoundError(
                f"{out}: {method} lacks runs of trial {int(np.isnan(means).argmax())}: make them without --report."
            )
    return {method: int(np.argmax(means)) for method, means in scores.items()}


def tables(methods: Sequence[str], trials: Sequence[Mapping[str, Any]], n_updates: int, out: Path) -> str:
    """The trials with every method's area, the best of each in bold, then the statistics of the best ones' new runs."""
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
    parser.add_argument("--report", action="store_true", help="make no runs, write <out>/report.md")
    args = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))  # as by Ctrl-C: the workers are to end too
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
