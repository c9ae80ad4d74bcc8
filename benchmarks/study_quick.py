"""Whether the formulas of HAVE still hold, in minutes: bounds on what small trainings measure.

    OMP_NUM_THREADS=1 python -m benchmarks.study_quick                                # exit code 1 if out of bounds
    OMP_NUM_THREADS=1 python -m benchmarks.study_quick --fault swapped_modalities     # a planted fault: has to fail
    OMP_NUM_THREADS=1 python -m benchmarks.study_quick --record                       # sound code, and every fault

The default form of HAVE learns a known Q (``benchmarks.known_q``) and, if that is within bounds, to drive on
ReliabilityDrive-v0 (``benchmarks.reliability``), in two processes. The worst seed of each measure counts. ``--record``
does so for several sets of seeds of the sound code and for every fault of ``benchmarks.planted_faults``, and writes
``benchmarks/results/study_quick/faults.csv`` and ``faults.md``, with what was printed.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context
from typing import NamedTuple

import pandas as pd
import torch as th

from benchmarks import known_q, reliability
from benchmarks.measure import RESULTS
from benchmarks.planted_faults import FAULTS
from sb3_have.common.machine import machine

SEEDS = (0, 1, 2)
SOUND_SEEDS = (SEEDS, (3, 4, 5), (6, 7, 8))
N_DRIVES = 2
"""Of the seeds, how many also learn to drive."""
DRIVE_UPDATES = 2000
N_PROCESSES = 2


class Bound(NamedTuple):
    """What a measure has to be in every seed, and where to look if it is not."""

    measure: str
    lower: float
    upper: float
    suspects: str

    def excess(self, value: float) -> float:
        """How far a value is out of bounds; within them, a negative distance to the nearer one."""
        return math.inf if math.isnan(value) else max(self.lower - value, value - self.upper)


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
    Bound("weight_auc", 0.8, 1, "as above"),
    Bound("negative_gradient", 0, 0, "as above"),
)


class Verdict(NamedTuple):
    """A measure against its bounds."""

    suite: str
    bound: Bound
    worst: float
    """The value of the seed that is furthest out."""
    ok: bool


def judge(suite: str, bounds: Sequence[Bound], measured: Sequence[Mapping[str, float]]) -> list[Verdict]:
    """
    :param suite: its name
    :param bounds: what the measures have to be
    :param measured: measures by name, of each seed
    :return: one verdict for each bound; a NaN is out of any bounds
    """
    worst = [max((row[bound.measure] for row in measured), key=bound.excess) for bound in bounds]
    return [Verdict(suite, bound, value, bound.excess(value) <= 0) for bound, value in zip(bounds, worst, strict=True)]


def describe(verdicts: Sequence[Verdict]) -> str:
    """The verdicts as a table, and a line for each that is out of bounds."""
    lines = [f"{'suite':10}{'measure':20}{'worst seed':>12}   {'bounds':16}ok"]
    failures = []
    for suite, bound, worst, ok in verdicts:
        limits = f"[{bound.lower:g}, {bound.upper:g}]"
        lines.append(f"{suite:10}{bound.measure:20}{worst:12.3f}   {limits:16}{'yes' if ok else 'NO'}")
        if not ok:
            failures.append(f"OUT OF BOUNDS: {suite}, {bound.measure} {worst:.3f}; look at: {bound.suspects}")
    return "\n".join(lines + failures)


def learn_known_q(seed: int, fault: str | None = None) -> dict[str, float]:
    """
    Measures of one seed; runs in a process of its own.

    :param seed: of everything
    :param fault: one of ``FAULTS`` to plant, or None
    """
    th.set_num_threads(1)
    with nullcontext() if fault is None else FAULTS[fault]():
        return vars(known_q.run(seed))


def learn_to_drive(seed: int, fault: str | None = None) -> dict[str, float]:
    """As :func:`learn_known_q`, on ReliabilityDrive-v0."""
    th.set_num_threads(1)
    with nullcontext() if fault is None else FAULTS[fault]():
        row = reliability.run_small([seed], DRIVE_UPDATES, n_workers=1).iloc[0]
    return {str(measure): float(value) for measure, value in row.items()}


def study(seeds: Sequence[int] = SEEDS, fault: str | None = None) -> list[Verdict]:
    """
    :param seeds: of the trainings
    :param fault: one of ``FAULTS`` to plant, or None
    """
    with ProcessPoolExecutor(N_PROCESSES, mp_context=get_context("spawn")) as pool:
        measured = list(pool.map(learn_known_q, seeds, [fault] * len(seeds)))
        verdicts = judge("known Q", KNOWN_Q, measured)
        if all(verdict.ok for verdict in verdicts):  # else the longer runs would add nothing
            driven = list(pool.map(learn_to_drive, seeds[:N_DRIVES], [fault] * N_DRIVES))
            verdicts += judge("driving", DRIVING, driven)
    return verdicts


def record() -> bool:
    """
    Sound code and every fault, written to ``faults.csv`` and ``faults.md``.

    :return: whether all sound studies passed and all faults were found
    """
    folder = RESULTS / "study_quick"
    folder.mkdir(parents=True, exist_ok=True)
    cases: list[tuple[str | None, Sequence[int]]] = [(fault, SEEDS) for fault in FAULTS]
    cases += [(None, seeds) for seeds in SOUND_SEEDS]
    rows, as_expected = [], True
    text = "# What the quick study prints\n\n"
    text += "`python -m benchmarks.study_quick --record`: one planted fault at a time, then the sound code.\n"
    for fault, seeds in cases:
        start = time.perf_counter()
        verdicts = study(seeds, fault)
        passed = all(verdict.ok for verdict in verdicts)
        as_expected &= passed == (fault is None)
        case = {
            "fault": fault or "none",
            "seeds": " ".join(map(str, seeds)),
            "exit_code": int(not passed),
            "seconds": round(time.perf_counter() - start),
        }
        rows += [
            {**case, "suite": suite, "measure": bound.measure, "worst": round(worst, 5)}
            | {"lower": bound.lower, "upper": bound.upper, "ok": ok, **machine()}
            for suite, bound, worst, ok in verdicts
        ]
        said = FAULTS[fault].__doc__ if fault else "The sound code."
        section = f"\n## {', '.join(f'{name} {value}' for name, value in case.items())}\n\n{said}\n\n"
        section += f"```\n{describe(verdicts)}\n```\n"
        print(section, flush=True)
        text += section
        pd.DataFrame(rows).to_csv(folder / "faults.csv", index=False)
        (folder / "faults.md").write_text(text)
    return as_expected


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fault", choices=list(FAULTS), help="plant this fault")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--record", action="store_true", help="run the sound code and every fault, and write it down")
    args = parser.parse_args()
    if args.record:
        sys.exit(None if record() else "A sound study failed, or a fault was not found: see above.")
    start = time.perf_counter()
    verdicts = study(args.seeds, args.fault)
    print(describe(verdicts))
    failed = [f"{verdict.suite} {verdict.bound.measure}" for verdict in verdicts if not verdict.ok]
    outcome = f"FAILED: {', '.join(failed)}" if failed else "Passed"
    print(f"{outcome} ({time.perf_counter() - start:.0f} s, seeds {args.seeds})")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
