"""Measure the import of the package and of the algorithm, compared with Stable-Baselines3 and its SAC.

    python -m benchmarks.import_time

Each import runs in a new interpreter, and the contenders take turns; an interpreter that imports nothing is the
baseline. The script prints and writes to benchmarks/results/import_time.csv the median and quartiles of the wall-clock
time, and ``vs_sb3``, the median over the rounds of the ratio to ``import stable_baselines3``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from functools import partial

from benchmarks.measure import RESULTS, Row, interleave, machine, median_ratio, quartiles, save, show

STATEMENTS = (
    "pass",
    "import stable_baselines3",
    "import sb3_have",
    "from stable_baselines3 import SAC",
    "from sb3_have import HAVESAC",
)


def run(statement: str) -> None:
    subprocess.run([sys.executable, "-c", statement], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    times = interleave({statement: partial(run, statement) for statement in STATEMENTS}, args.rounds)
    sb3 = times["import stable_baselines3"].wall
    rows: list[Row] = [
        {"statement": name, **quartiles(wall), "vs_sb3": round(median_ratio(wall, sb3), 3), **machine()}
        for name, (wall, _) in times.items()
    ]
    save(rows, RESULTS / "import_time.csv", ("machine",))
    show(rows, ("statement", "median_ms", "q25_ms", "q75_ms", "vs_sb3"))


if __name__ == "__main__":
    main()
