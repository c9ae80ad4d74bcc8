"""Compare methods on ReliabilityDrive-v0, a vector task whose sensors fail, in minutes.

    python -m benchmarks.reliability                          # 8 seeds of six methods, on two cores
    python -m benchmarks.reliability --methods have gve-wide --seeds 3 --updates 4000 --out runs/reliability
    python -m benchmarks.reliability --report                 # only the statistics of existing runs
    python -m benchmarks.reliability --n-blind 8 --corruption 0.3    # each modality only shows a third of the state

HAVESAC trains each run with the same hyperparameters (``benchmarks.reliability_runs``); ``gve-wide`` has a global
critic as large as all critics of HAVE. When a run ends, its measures are appended to ``<out>/<method>.csv``, with the
columns method, seed, number of updates, measure and value. Existing runs are not repeated, so the command can be
stopped and started again; an interrupted run starts from the beginning. At the end the script prints the statistics;
with ``--report`` it also writes them to ``<out>/report.md``.
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
from benchmarks.reliability_runs import DISTRIBUTIONAL, EVALUATION_SEED, METHODS, REMOVED, VARIANTS, run

DEFAULT_METHODS = ("gve", "gve-wide", "lve", "have", "have-dropout", "have-unsupervised")
N_UPDATES = 8000
OUT = RESULTS / "reliability"
STANDARD_TASK: Mapping[str, Any] = {"n_blind": 2, "corruption": 0.6}
COLUMNS = ["method", "seed", "updates", "measure", "value"]


def run_small(seeds: Sequence[int] = (0, 1), n_updates: int = 2000, n_workers: int = 2) -> pd.DataFrame:
    """
    Make a few short runs of "have" to check the formulas, in about a minute on two free cores.

    :param seeds: Seeds of the runs
    :param n_updates: Number of updates of each run
    :param n_workers: Number of processes; with 1 the runs are in this process, where patches are in effect
    :return: One row per seed and one column per measure of :func:`benchmarks.reliability_runs.run`, and ``seconds``
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
    Make runs and yield the rows of each as it ends.

    :param runs: Pairs of method and seed
    :param n_updates: Number of updates of each run
    :param n_workers: Number of processes
    :param task: Options of the environment
    :param hyperparameters: Changes of the hyperparameters
    :param evaluation_seed: Seed of the evaluation episodes
    :return: Iterator over lists of rows
    """
    if n_workers == 1:
        for method, seed in runs:
            yield _run(method, seed, n_updates, task, hyperparameters, evaluation_seed)
        return
    # Spawn processes, because torch's threads do not survive a fork
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
            for worker in context.active_children():  # in the middle of a run if the script was stopped
                worker.terminate()


def _run(method: str, seed: int, n_updates: int, *given: Any) -> list[tuple[str, int, int, str, float]]:
    start = time.perf_counter()
    measures = run(method, seed, n_updates, *given)
    measures["seconds"] = time.perf_counter() - start
    return [(method, seed, n_updates, measure, value) for measure, value in measures.items()]


def load(folder: Path) -> pd.DataFrame:
    """Load the rows of all runs in a folder, which may also contain other tables."""
    files = [folder / f"{method}.csv" for method in (*METHODS, *VARIANTS, *DISTRIBUTIONAL, *REMOVED)]
    tables = [pd.read_csv(file) for file in files if file.exists()]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=COLUMNS)


def save(rows: Sequence[tuple[str, int, int, str, float]], folder: Path) -> None:
    """Append the rows of a run to the file of its method, all or none of them."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{rows[0][0]}.csv"
    table = pd.DataFrame(rows, columns=COLUMNS).round({"value": 5})
    if file.exists():
        table = pd.concat([pd.read_csv(file), table])
    table.to_csv(written := file.with_suffix(".part"), index=False)
    written.replace(file)


def missing(rows: pd.DataFrame, methods: Sequence[str], seeds: Sequence[int], n_updates: int) -> list[tuple[str, int]]:
    """List the missing runs (method, seed) seed by seed, so that an interrupted benchmark compares all methods."""
    done = set(rows.loc[rows["updates"] == n_updates, ["method", "seed"]].itertuples(index=False, name=None))
    return [(method, seed) for seed, method in itertools.product(seeds, methods) if (method, seed) not in done]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--methods",
        nargs="+",
        choices=[*METHODS, *VARIANTS, *DISTRIBUTIONAL],
        default=list(DEFAULT_METHODS),
        help="in this order",
    )
    parser.add_argument("--seeds", type=int, default=8, help="number of seeds, starting from 0")
    parser.add_argument("--updates", type=int, default=N_UPDATES)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--n-blind", type=int, default=2, help="state directions that a modality does not see")
    parser.add_argument("--corruption", type=float, default=0.6, help="probability that a modality fails")
    parser.add_argument("--out", type=Path, help="folder of the runs; by default one per task")
    parser.add_argument("--report", action="store_true", help="only write <out>/report.md")
    args = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))  # end the workers, too
    task = {"n_blind": args.n_blind, "corruption": args.corruption}
    if args.out is None:
        name = f"n_blind-{args.n_blind}-corruption-{args.corruption:g}"
        args.out = OUT if task == STANDARD_TASK else OUT / name
    todo = [] if args.report else missing(load(args.out), args.methods, range(args.seeds), args.updates)
    for i, rows in enumerate(run_all(todo, args.updates, args.workers, task), 1):
        save(rows, args.out)
        measures = {measure: value for _, _, _, measure, value in rows}
        print(f"{i}/{len(todo)} {rows[0][0]}-{rows[0][1]}: {summary(measures)}", flush=True)
    table = load(args.out)
    chosen = table["updates"].eq(args.updates) & table["seed"].lt(args.seeds)
    text = report(table[chosen], args.methods)
    print(text)
    if args.report:
        (args.out / "report.md").write_text(text)


def summary(measures: Mapping[str, float]) -> str:
    """Format the most important measures of a run in a line."""
    names = ("final_return", "area", "weight_auc", "value_bias", "kept_black", "kept_frozen", "kept_noise", "seconds")
    return ", ".join(f"{name} {measures[name]:.4g}" for name in names)


if __name__ == "__main__":
    main()
