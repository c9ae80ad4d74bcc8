"""Check the formulas of HAVE in minutes, with bounds on the measures of short training runs.

    OMP_NUM_THREADS=1 python -m benchmarks.study_quick                                # exit code 1 if out of bounds
    OMP_NUM_THREADS=1 python -m benchmarks.study_quick --fault swapped_modalities     # has to fail
    OMP_NUM_THREADS=1 python -m benchmarks.study_quick --record                       # correct code, and every fault

The default form of HAVE learns a known Q-function (``benchmarks.known_q``) and, if that is within bounds, to drive on
ReliabilityDrive-v0 (``benchmarks.reliability``), in two processes. The worst seed of each measure counts, except for
the return, which varies most: its mean over the seeds counts, and doing nothing (59.4) is out of bounds. ``--record``
repeats the check for several sets of seeds with correct code and for every fault of ``benchmarks.planted_faults``, and
writes the output to ``benchmarks/results/study_quick/faults.csv`` and ``faults.md``.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context
from typing import Any, NamedTuple

import pandas as pd
import torch as th

from benchmarks import known_q, reliability
from benchmarks.measure import RESULTS, save
from benchmarks.planted_faults import FAULTS
from sb3_have.benchmark.provenance import machine

SEEDS = (0, 1, 2, 3)
# Number of seeds that learn to drive
N_DRIVES = 2
# Seeds of the record: all of them for correct code, the first pair for the faults
RECORD_SEEDS = ((0, 1), (2, 3), (4, 5))
DRIVE_UPDATES = 2000
RECORD = RESULTS / "study_quick"
SOUND = "sound"
N_PROCESSES = 2


class Bound(NamedTuple):
    """
    Bounds of a measure.

    :param measure: Name of the measure
    :param lower: Lower bound
    :param upper: Upper bound
    :param suspects: Where to look if the measure is out of bounds
    :param of_mean: Whether the bounds are for the mean over the seeds, not for every seed
    """

    measure: str
    lower: float
    upper: float
    suspects: str
    of_mean: bool = False

    def excess(self, value: float) -> float:
        """Compute by how much a value is out of bounds; negative within the bounds."""
        return max(self.lower - value, value - self.upper) if math.isfinite(value) else math.inf


KNOWN_Q = (
    Bound("error", 0, 0.28, "some part of the target, see the other measures"),
    Bound("bias", -0.2, 0.2, "the target's entropy (-alpha log pi), (1 - done), discount; target networks that stay"),
    Bound("std_ratio", 0.82, 1.12, "the target's weights of the modalities: of another step, or in another order"),
    Bound("correlation", 0.96, 1, "the critic's inputs: features, actions, modalities"),
    Bound("local_error", 0, 0.35, "the loss of the local critics (local_coef), or what they regress on"),
    Bound("negative_gradient", 0, 0, "the re-fusion's constraint: dH/dq_g and dH/dq_l are positive (Remark 1)"),
    Bound("weight_auc", 0.99, 1, "the assignment: supervision of the local critics, gradient of the weights"),
    Bound("refusion_optimized", 1, 1, "the critic's optimizer: it lacks parameters of the re-fusion"),
    Bound("refusion_moved", 1, 1, "the gradient of the re-fusion: its parameters stayed what they were"),
)
DRIVING = (
    Bound("final_return", 62, math.inf, "actor or entropy temperature, if the known Q is within bounds", of_mean=True),
    Bound("weight_auc", 0.8, 1, "as above, where actions follow from the values"),
    Bound("negative_gradient", 0, 0, "as above, at other values"),
)
SUITES = {"known Q": KNOWN_Q, "driving": DRIVING}


class Verdict(NamedTuple):
    """
    Result of the comparison of a measure with its bounds.

    :param suite: One of ``SUITES``
    :param bound: The bounds
    :param worst: Value of the worst seed, or the mean over the seeds if the bounds are for the mean
    :param ok: Whether the value is within the bounds
    """

    suite: str
    bound: Bound
    worst: float
    ok: bool


def judge(suite: str, measured: Sequence[Mapping[str, float]]) -> list[Verdict]:
    """
    Compare measures with their bounds.

    :param suite: One of ``SUITES``
    :param measured: Measures by name, for each seed
    :return: One verdict per bound; NaN and infinity are always out of bounds
    """
    bounds = SUITES[suite]
    verdicts = []
    for bound in bounds:
        values = [row[bound.measure] for row in measured]
        value = math.fsum(values) / len(values) if bound.of_mean else max(values, key=bound.excess)
        verdicts.append(Verdict(suite, bound, value, bound.excess(value) <= 0))
    return verdicts


def describe(verdicts: Sequence[Verdict]) -> str:
    """Format the verdicts as a table, with a line for each one that is out of bounds."""
    lines = [f"{'suite':10}{'measure':20}{'worst seed':>12}   {'bounds':16}ok"]
    failures = []
    for suite, bound, worst, ok in verdicts:
        limits = f"[{bound.lower:g}, {bound.upper:g}]"
        name = f"{bound.measure} (mean)" if bound.of_mean else bound.measure
        lines.append(f"{suite:10}{name:20}{worst:12.3f}   {limits:16}{'yes' if ok else 'NO'}")
        if not ok:
            failures.append(f"OUT OF BOUNDS: {suite}, {bound.measure} {worst:.3f}; look at: {bound.suspects}")
    return "\n".join(lines + failures)


def learn_known_q(seed: int, fault: str | None = None) -> dict[str, float]:
    """
    Measure one seed of the known Q-function, in a process of its own.

    :param seed: Seed of everything
    :param fault: One of ``FAULTS`` to plant, or None
    :return: Measures by name
    """
    th.set_num_threads(1)
    with nullcontext() if fault is None else FAULTS[fault]():
        return vars(known_q.run(seed))


def learn_to_drive(seed: int, fault: str | None = None) -> dict[str, float]:
    """Measure one seed on ReliabilityDrive-v0, see :func:`learn_known_q`."""
    th.set_num_threads(1)
    with nullcontext() if fault is None else FAULTS[fault]():
        row = reliability.run_small([seed], DRIVE_UPDATES, n_workers=1).iloc[0]
    return {str(measure): float(value) for measure, value in row.items()}


def study(pool: Executor, seeds: Sequence[int] = SEEDS, fault: str | None = None) -> list[Verdict]:
    """
    Run the study.

    :param pool: Pool of processes
    :param seeds: Seeds of the training runs
    :param fault: One of ``FAULTS`` to plant, or None
    :return: The verdicts
    """
    verdicts = judge("known Q", list(pool.map(learn_known_q, seeds, [fault] * len(seeds))))
    if all(verdict.ok for verdict in verdicts):  # otherwise the longer runs would add nothing
        drivers = seeds[:N_DRIVES]
        verdicts += judge("driving", list(pool.map(learn_to_drive, drivers, [fault] * len(drivers))))
    return verdicts


def record(pool: Executor, names: Sequence[str]) -> bool:
    """
    Run studies of two seeds each and update their rows in ``faults.csv`` and ``faults.md``.

    :param pool: Pool of processes
    :param names: "sound" for correct code with each of ``RECORD_SEEDS``, and faults with the first pair
    :return: Whether all studies of correct code passed and all faults were found
    """
    as_expected = True
    for name in names:
        fault = None if name == SOUND else name
        for seeds in RECORD_SEEDS if fault is None else RECORD_SEEDS[:1]:
            verdicts = study(pool, seeds, fault)
            passed = all(verdict.ok for verdict in verdicts)
            as_expected &= passed == (fault is None)
            case = {
                "study": name,
                "seeds": " ".join(map(str, seeds)),
                "exit_code": int(not passed),
            }
            rows = [
                {**case, "suite": suite, "measure": bound.measure, "worst": round(worst, 5)}
                | {"lower": bound.lower, "upper": bound.upper, "ok": ok, **machine()}
                for suite, bound, worst, ok in verdicts
            ]
            save(rows, RECORD / "faults.csv", group=["study", "seeds"])
            print(case, describe(verdicts), sep="\n", flush=True)
    (RECORD / "faults.md").write_text(summary(pd.read_csv(RECORD / "faults.csv")))
    return as_expected


def summary(table: pd.DataFrame) -> str:
    """
    Format the output of each study as Markdown.

    :param table: The rows of ``faults.csv``
    :return: The Markdown text
    """
    bounds = {(suite, bound.measure): bound for suite, bounds in SUITES.items() for bound in bounds}
    studies: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in table.to_dict("records"):
        studies.setdefault((row["study"], row["seeds"]), []).append({str(name): value for name, value in row.items()})
    text = "# What the quick study prints\n\nBy `python -m benchmarks.study_quick --record`: "
    text += "the sound code, then one planted fault at a time.\n"
    order = [SOUND, *FAULTS]
    for name, seeds in sorted(studies, key=lambda study: (order.index(study[0]), study[1])):
        rows = studies[name, seeds]
        verdicts = [
            Verdict(row["suite"], bounds[row["suite"], row["measure"]], row["worst"], row["ok"]) for row in rows
        ]
        text += f"\n## {name}, seeds {seeds}: exit code {rows[0]['exit_code']}\n\n"
        text += f"{FAULTS[name].__doc__}\n\n" if name in FAULTS else ""
        text += f"```\n{describe(verdicts)}\n```\n"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fault", choices=list(FAULTS), help="plant this fault")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument(
        "--record",
        nargs="*",
        choices=[SOUND, *FAULTS],
        help="record these studies; by default correct code and all faults",
    )
    args = parser.parse_args()
    # Spawn processes, because torch's threads do not survive a fork
    with ProcessPoolExecutor(N_PROCESSES, mp_context=get_context("spawn")) as pool:
        if args.record is not None:
            as_expected = record(pool, args.record or [SOUND, *FAULTS])
            sys.exit(None if as_expected else "A study of correct code failed, or a fault was not found; see above")
        verdicts = study(pool, args.seeds, args.fault)
    print(describe(verdicts))
    failed = [f"{verdict.suite} {verdict.bound.measure}" for verdict in verdicts if not verdict.ok]
    print(f"FAILED: {', '.join(failed)}" if failed else f"Passed, seeds {args.seeds}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
