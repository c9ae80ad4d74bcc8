"""
Statistics over training runs.

They follow Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (NeurIPS 2021).

A table of scores has a row for each run (seed) and a column for each task (weather). Every statistic also takes a stack
of tables, (..., n_runs, n_tasks), and returns one value for each, so that the bootstrap needs no loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Interval(NamedTuple):
    """A statistic with its confidence interval: floats, or arrays for a statistic that returns arrays."""

    estimate: Any
    lower: Any
    upper: Any


def mean(scores: ArrayLike) -> Any:
    """
    Compute the mean over runs and tasks.

    :param scores: (n_runs, n_tasks), or a stack of such tables (..., n_runs, n_tasks)
    :return: A float, or (...) for a stack
    :raises ValueError: If scores are not such a table, or not finite
    """
    return _table(scores).mean(axis=(-2, -1))


def median(scores: ArrayLike) -> Any:
    """Compute the median over tasks of the mean over runs; parameters as for :func:`mean`."""
    return np.median(_table(scores).mean(axis=-2), axis=-1)


def iqm(scores: ArrayLike) -> Any:
    """
    Compute the interquartile mean: the mean of all scores together, without the lowest and the highest quarter.

    A quarter of n scores is ``n // 4``, so fewer than four scores are all kept. Parameters as for :func:`mean`.
    """
    table = _table(scores)
    pooled = np.sort(table.reshape(*table.shape[:-2], -1), axis=-1)
    cut = pooled.shape[-1] // 4
    return pooled[..., cut : pooled.shape[-1] - cut].mean(axis=-1)


def optimality_gap(scores: ArrayLike, target: float = 1.0) -> Any:
    """
    Compute the mean shortfall of the scores from a target; scores above it do not make up for others below.

    :param scores: As for :func:`mean`
    :param target: In the scores' unit
    :return: At least 0, a float, or (...) for a stack
    """
    return np.maximum(target - _table(scores), 0.0).mean(axis=(-2, -1))


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> Any:
    """
    Compute how often a run of ``x`` beats one of ``y`` on the same task.

    This is the mean over tasks of Mann-Whitney's U / (N M).

    :param x: (N, n_tasks) scores, or a stack (..., N, n_tasks)
    :param y: (M, n_tasks) scores on the same tasks, in a stack of the same shape
    :return: 0..1, where ties count half; a float, or (...) for stacks
    :raises ValueError: If the numbers of tasks differ, or scores are not tables or not finite
    """
    left, right = _table(x), _table(y)
    if left.shape[:-2] != right.shape[:-2] or left.shape[-1] != right.shape[-1]:
        raise ValueError(f"x and y need the same tasks (columns), got shapes {left.shape} and {right.shape}")
    left, right = left[..., :, None, :], right[..., None, :, :]
    wins = np.mean(left > right, axis=(-3, -2, -1))
    return wins + 0.5 * np.mean(left == right, axis=(-3, -2, -1))


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> np.ndarray:
    """
    Compute the share of runs, over all tasks, that score above each threshold.

    For a band, bootstrap ``partial(performance_profile, thresholds=...)``.

    :param scores: As for :func:`mean`
    :param thresholds: (n_thresholds,), in the scores' unit
    :return: (n_thresholds,), or (..., n_thresholds) for a stack, 0..1
    """
    table = _table(scores)
    return np.stack([np.mean(table > level, axis=(-2, -1)) for level in np.asarray(thresholds)], axis=-1)


def stratified_bootstrap(
    statistic: Callable[..., Any],
    *scores: ArrayLike,
    n_resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
    whole_runs: bool = False,
) -> Interval:
    """
    Bootstrap percentile intervals by resampling runs within each task, independently for each task and table.

    Use it as ``stratified_bootstrap(iqm, scores)`` or ``stratified_bootstrap(probability_of_improvement, x, y)``.

    With few runs the interval is too narrow, as nothing lies beyond the best and the worst of them: for normal scores
    of one task, a 95% interval of the mean contains the true mean in about 75% of cases with three runs, and in 90%
    with eight. It is also too narrow where the scores of one agent on several tasks rise and fall together, as it
    treats them as independent (which they are if an agent is trained on each task); ``whole_runs`` keeps them together.

    :param statistic: A function of tables that reduces their last two axes: one of this module, or for example
        ``partial(optimality_gap, target=500.0)``
    :param scores: Its tables (n_runs, n_tasks), with at least two runs each
    :param n_resamples: Number of resamples
    :param confidence: Between 0 and 1
    :param seed: Seed of the resampling
    :param whole_runs: Whether to resample rows (the same runs for every task) instead of single scores
    :raises ValueError: If a table has only one run (nothing would vary) or is not a finite table, or
        ``n_resamples`` or ``confidence`` are out of range
    """
    # Not scipy.stats.bootstrap: it resamples whole rows only, and the base package does not depend on SciPy
    if n_resamples < 1 or not 0 < confidence < 1:
        raise ValueError(f"need n_resamples >= 1 and 0 < confidence < 1, got {n_resamples} and {confidence}")
    tables = [_table(table) for table in scores]
    for table in tables:
        if table.ndim != 2:
            raise ValueError(f"the bootstrap takes single tables (n_runs, n_tasks), got shape {table.shape}")
        if len(table) < 2:
            raise ValueError(
                f"a confidence interval needs at least 2 runs, got scores of shape {table.shape}; "
                "add seeds, or report the estimate alone"
            )

    # Resample each table
    rng = np.random.default_rng(seed)
    resampled = []
    for table in tables:
        n_runs, n_tasks = table.shape
        runs = rng.integers(n_runs, size=(n_resamples, n_runs, 1 if whole_runs else n_tasks))
        resampled.append(table[runs, np.arange(n_tasks)])

    # Compute the statistic of the tables and of all resamples at once
    estimate, values = np.asarray(statistic(*tables)), np.asarray(statistic(*resampled))
    if values.shape != (n_resamples, *estimate.shape):
        raise ValueError(f"the statistic must reduce the last two axes, (..., n_runs, n_tasks); got {statistic}")
    tail = (1.0 - confidence) / 2
    lower, upper = np.quantile(values, [tail, 1.0 - tail], axis=0)
    return Interval(estimate[()], lower, upper)


def _table(scores: ArrayLike) -> np.ndarray:
    """Convert scores to float64 (..., n_runs, n_tasks)."""
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim < 2 or 0 in table.shape:
        raise ValueError(
            f"scores must be a table (n_runs, n_tasks) with at least one of each, got shape {table.shape}; "
            "for a single task, pass scores[:, None]"
        )
    if not np.isfinite(table).all():
        raise ValueError(f"scores must be finite, got {np.count_nonzero(~np.isfinite(table))} NaN or infinite values")
    return table
