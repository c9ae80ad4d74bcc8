"""Helpers of the speed benchmarks: timing of contenders in turn, and the CSV files of results."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd
import torch as th
from numpy.typing import NDArray

from sb3_have.benchmark.provenance import machine as machine

RESULTS = Path(__file__).parent / "results"
Name = TypeVar("Name")
Row = dict[str, Any]
Floats = NDArray[np.float64]


class Times(NamedTuple):
    """Wall-clock time and processor time (of all threads) of every round, in milliseconds."""

    wall: Floats
    cpu: Floats


def interleave(
    contenders: Mapping[Name, Callable[[], object]], rounds: int, repeats: int = 1, warm_up: int = 1
) -> dict[Name, Times]:
    """
    Time the contenders in turn, so that a change in the machine's speed affects all of them.

    Each round runs all contenders in a new random order, because a contender can slow down the next one (mainly by
    leaving a trimmed heap), which must not always be the same.

    :param contenders: Calls by name
    :param rounds: Number of rounds that count
    :param repeats: Calls per round and contender, whose mean time is recorded. A GPU is synchronised before and after.
    :param warm_up: Number of rounds before those that count
    :return: Times by name
    """
    wall, cpu = ({name: np.empty(warm_up + rounds) for name in contenders} for _ in range(2))
    rng = np.random.default_rng(0)
    names = list(contenders)
    for turn in range(warm_up + rounds):
        for index in rng.permutation(len(names)):
            name, call = names[index], contenders[names[index]]
            synchronize()
            start = time.perf_counter(), time.process_time()
            for _ in range(repeats):
                call()
            synchronize()
            wall[name][turn] = (time.perf_counter() - start[0]) * 1e3 / repeats
            cpu[name][turn] = (time.process_time() - start[1]) * 1e3 / repeats
    return {name: Times(wall[name][warm_up:], cpu[name][warm_up:]) for name in contenders}


def synchronize() -> None:
    if th.cuda.is_available():
        th.cuda.synchronize()


def quartiles(times: Floats, prefix: str = "", digits: int = 3) -> Row:
    """Compute median and quartiles in milliseconds, as columns of a row."""
    lower, median, upper = np.quantile(times, (0.25, 0.5, 0.75)).round(digits).tolist()
    return {f"{prefix}median_ms": median, f"{prefix}q25_ms": lower, f"{prefix}q75_ms": upper}


def median_ratio(numerator: Floats, denominator: Floats) -> float:
    """Compute the median over the rounds of the ratio of two contenders in the same round."""
    return float(np.median(numerator / denominator))


def save(rows: Sequence[Row], path: Path, group: Sequence[str]) -> None:
    """
    Write rows to a CSV file. Rows of the file stay, unless they belong to a group that was measured again.

    :param rows: The rows of this run
    :param path: CSV file
    :param group: Columns that identify a group of rows that are measured together
    """
    new = pd.DataFrame(rows)
    if path.exists():
        old = pd.read_csv(path)
        measured = set(map(tuple, new[list(group)].astype(str).to_numpy()))
        kept = [tuple(values) not in measured for values in old.reindex(columns=list(group)).astype(str).to_numpy()]
        if any(kept):
            new = pd.concat([old[kept], new])
    path.parent.mkdir(parents=True, exist_ok=True)
    new.to_csv(path, index=False)


def show(rows: Sequence[Row], columns: Sequence[str]) -> None:
    """Print some columns of the rows as a table."""
    print(pd.DataFrame(rows)[list(columns)].to_string(index=False, na_rep="", max_colwidth=None), flush=True)
