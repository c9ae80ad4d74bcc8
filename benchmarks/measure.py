"""Shared by the speed benchmarks: contenders timed in turn, the machine and versions, and the CSV file of results."""

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
    """Milliseconds of every round, by wall clock and by processor time (of all threads)."""

    wall: Floats
    cpu: Floats


def interleave(
    contenders: Mapping[Name, Callable[[], object]], rounds: int, repeats: int = 1, warm_up: int = 1
) -> dict[Name, Times]:
    """
    Time the contenders in turn, so that a change in the machine's speed hits all of them alike.

    Each round visits all of them, in an order drawn anew: what one leaves behind (a trimmed heap, above all) slows
    its successor down, which must not always be the same.

    :param contenders: calls by name
    :param rounds: visits to each contender that count
    :param repeats: calls a visit; their mean time counts. A GPU is waited for at the start and at the end of a visit.
    :param warm_up: rounds before those that count
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
    """Median and quartiles in milliseconds, as columns of a row."""
    lower, median, upper = np.quantile(times, (0.25, 0.5, 0.75)).round(digits).tolist()
    return {f"{prefix}median_ms": median, f"{prefix}q25_ms": lower, f"{prefix}q75_ms": upper}


def median_ratio(numerator: Floats, denominator: Floats) -> float:
    """Median over the rounds of the ratio of two contenders in the same round."""
    return float(np.median(numerator / denominator))


def save(rows: Sequence[Row], path: Path, group: Sequence[str]) -> None:
    """
    Write the rows; those that the file has already stay, except where they belong to a group measured anew.

    :param rows: the rows of this run
    :param path: CSV file
    :param group: columns that name what is measured together
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
