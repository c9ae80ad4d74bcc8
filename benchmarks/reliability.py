"""Who is believed when sensors fail: methods side by side on ReliabilityDrive-v0, from vectors, in minutes.

    python -m benchmarks.reliability                          # 8 seeds of six methods, on two cores
    python -m benchmarks.reliability --methods have gve-wide --seeds 3 --updates 4000 --out runs/reliability
    python -m benchmarks.reliability --report                 # only the statistics of the runs that are there
    python -m benchmarks.reliability --n-blind 8 --corruption 0.3    # each modality shows a third of the state only

Each run is trained by HAVESAC with the same hyper-parameters (``benchmarks.reliability_runs``); ``gve-wide`` has a
global critic as large as all of HAVE's. When a run ends, its measures become rows of ``<out>/<method>.csv``: method,
seed, number of updates, measure, value. Runs that are there are not repeated, so that the command can be stopped and
given again; a run that was under way begins anew. Then it prints the statistics; ``--report`` writes them to
``<out>/report.md`` too.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.measure import RESULTS
from benchmarks.reliability_report import report
from benchmarks.reliability_runs import EVALUATION_SEED, METHODS, REMOVED, VARIANTS, run

DEFAULT_METHODS = ("gve", "gve-wide", "lve", "have", "have-dropout", "have-unsupervised")
N_UPDATES = 8000
OUT = RESULTS / "reliability"
STANDARD_TASK: Mapping[str, Any] = {"n_blind": 2, "corruption": 0.6}
COLUMNS = ["method", "seed", "updates", "measure", "value"]


def run_small(seeds: Sequence[int] = (0, 1), n_updates: int = 2000, n_workers: int = 2) -> pd.DataFrame:
    """
    A few short runs of "have", to see whether a formula is broken: about a minute on two free cores.

    :param seeds: of the runs
    :param n_updates: of each run
    :param n_workers: processes; with 1 it runs in this one, so that what a caller has patched is in effect
    :return: a row per seed, a column for each measure of :func:`benchmarks.reliability_runs.run`, among them
        ``final_return``, ``weight_auc``, ``value_bias``, ``value_correlation`` and ``negative_gradient``, and
        ``seconds``
    """
    rows = [row for rows in run_all([("have", seed) for seed in seeds], n_updates, n_workers) for row in rows]
    return pd.DataFrame(rows, columns=COLUMNS).pivot(index="seed", columns="measure", values="value").sort_index()


def run_all(
    runs: Sequence[tuple[str, int]],
    n_updates: int,
    n_workers: int,
    task: Mapping[str, Any] | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    evaluation_seed: int = EVALUATION_SEED,
) -> Iterator[list[tuple[str, int, int, str, float]]]:
    """
    Rows of each run (method, seed) on a task as it ends, in the order in which they end; what else is given is for
    :func:`benchmarks.reliability_runs.run`, the same for all.
    """
    if n_workers == 1:
        for method, seed in runs:
            yield _run(method, seed, n_updates, task, hyperparameters, evaluation_seed)
        return
    # Fresh processes: torch's threads do not survive a fork
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(n_workers, mp_context=context) as pool:
        futures = [
            pool.submit(_run, method, seed, n_updates, task, hyperparameters, evaluation_seed) for method, seed in runs
        ]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in context.active_children():  # in the middle of a run, if this was stopped
                worker.terminate()


def _run(method: str, seed: int, n_updates: int, *given: Any) -> list[tuple[str, int, int, str, float]]:
    start = time.perf_counter()
    measures = run(method, seed, n_updates, *given)
    measures["seconds"] = time.perf_counter() - start
    return [(method, seed, n_updates, measure, value) for measure, value in measures.items()]


def load(folder: Path) -> pd.DataFrame:
    """The rows of all runs in a folder; other tables may lie there too."""
    files = [folder / f"{method}.csv" for method in (*METHODS, *VARIANTS, *REMOVED)]
    tables = [pd.read_csv(file) for file in files if file.exists()]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=COLUMNS)


def save(rows: Sequence[tuple[str, int, int, str, float]], folder: Path) -> None:
    """Adds the rows of a run to the file of its method, all or none of them."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{rows[0][0]}.csv"
    table = pd.DataFrame(rows, columns=COLUMNS).round({"value": 5})
    if file.exists():
        table = pd.concat([pd.read_csv(file), table])
    table.to_csv(written := file.with_suffix(".part"), index=False)
    written.replace(file)


def missing(rows: pd.DataFrame, methods: Sequence[str], seeds: Sequence[int], n_updates: int) -> list[tuple[str, int]]:
    """Runs (method, seed) that are still to be made, seed by seed, so that whatever is there compares all methods."""
    done = set(rows.loc[rows["updates"] == n_updates, ["method", "seed"]].itertuples(index=False, name=None))
    return [(method, seed) for seed, method in itertools.product(seeds, methods) if (method, seed) not in done]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--methods", nargs="+", choices=[*METHODS, *VARIANTS], default=list(DEFAULT_METHODS), help="in this order"
    )
    parser.add_argument("--seeds", type=int, default=8, help="how many, from 0 on")
    parser.add_argument("--updates", type=int, default=N_UPDATES)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--n-blind", type=int, default=2, help="directions of the state a modality does not see")
    parser.add_argument("--corruption", type=float, default=0.6, help="probability with which a modality fails")
    parser.add_argument("--out", type=Path, help="folder of runs on one task; by default one for each")
    parser.add_argument("--report", action="store_true", help="make no runs, write <out>/report.md")
    args = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))  # as by Ctrl-C: the workers are to end too
    task = {"n_blind": args.n_blind, "corruption": args.corruption}
    if args.out is None:
        name = f"n_blind-{args.n_blind}-corruption-{args.corruption:g}"
        args.out = OUT if task == STANDARD_TASK else OUT / name
    todo = [] if args.report else missing(load(args.out), args.methods, range(args.seeds), args.updates)
    for i, rows in enumerate(run_all(todo, args.updates, args.workers, task), 1):
        save(rows, args.out)
        told = {measure: value for _, _, _, measure, value in rows}
        print(f"{i}/{len(todo)} {rows[0][0]}-{rows[0][1]}: {summary(told)}", flush=True)
    table = load(args.out)
    chosen = table["updates"].eq(args.updates) & table["seed"].lt(args.seeds)
    text = report(table[chosen], args.methods)
    print(text)
    if args.report:
        (args.out / "report.md").write_text(text)


def summary(measures: Mapping[str, float]) -> str:
    """The measures that tell most of a run, in a line."""
    names = ("final_return", "area", "weight_auc", "value_bias", "kept_black", "kept_frozen", "kept_noise", "seconds")
    return ", ".join(f"{name} {measures[name]:.4g}" for name in names)


if __name__ == "__main__":
    main()
