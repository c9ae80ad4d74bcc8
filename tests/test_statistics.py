"""Statistics over runs: known answers, brute force, rliable's figures, and the coverage of the intervals."""

import json
import math
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sb3_have.evaluation import statistics
from sb3_have.evaluation.statistics import (
    iqm,
    mean,
    median,
    optimality_gap,
    performance_profile,
    probability_of_improvement,
    stratified_bootstrap,
)

RLIABLE = json.loads((Path(__file__).parent / "rliable_figures.json").read_text())
SINGLE = [iqm, mean, median, optimality_gap]

# Whole numbers tie often, and sums of them are exact.
SCORES = st.integers(-20, 20).map(float)
untimed = settings(deadline=None)


def tables(min_runs: int = 1, tasks: int | None = None) -> Any:
    shapes = st.tuples(st.integers(min_runs, 9), st.integers(tasks or 1, tasks or 4))
    return shapes.flatmap(lambda shape: hnp.arrays(np.float64, shape, elements=SCORES))


@st.composite
def pairs(draw: Any) -> tuple[np.ndarray, np.ndarray]:
    x = draw(tables())
    return x, draw(tables(tasks=x.shape[1]))


# Estimates


def test_known_answers() -> None:
    scores = np.array([[0.0, 10.0], [1.0, 20.0], [2.0, 30.0], [9.0, 100.0]])
    assert mean(scores) == 172 / 8
    assert median(scores) == (3 + 40) / 2
    assert iqm(scores) == (2 + 9 + 10 + 20) / 4  # without 0, 1 and 30, 100: a quarter of all eight scores
    assert optimality_gap(scores, target=10.0) == (10 + 9 + 8 + 1) / 8
    assert iqm([[1.0], [2.0], [6.0]]) == 3  # a quarter of three scores is none
    assert iqm([[0.0], [1.0], [2.0], [3.0], [100.0]]) == 2  # and of five, one
    assert list(performance_profile(scores, [-1.0, 1.0, 100.0])) == [1.0, 6 / 8, 0.0]  # strictly above
    x, y = [[1.0, 5.0], [3.0, 5.0]], [[2.0, 5.0], [0.0, 6.0], [1.0, 4.0]]
    # first task: 1 beats 0, ties 1, loses to 2; 3 beats all. Second: 5 beats 4, ties 5, loses to 6, twice.
    assert probability_of_improvement(x, y) == ((1.5 + 3) / 6 + 3 / 6) / 2


@untimed
@given(tables())
def test_against_brute_force(scores: np.ndarray) -> None:
    ordered = sorted(scores.ravel().tolist())
    kept = [s for i, s in enumerate(ordered) if i >= len(ordered) // 4 and len(ordered) - 1 - i >= len(ordered) // 4]
    assert iqm(scores) == pytest.approx(sum(kept) / len(kept))
    by_task = sorted(sum(column) / len(column) for column in scores.T.tolist())
    middle = (by_task[(len(by_task) - 1) // 2] + by_task[len(by_task) // 2]) / 2
    assert median(scores) == pytest.approx(middle)
    assert mean(scores) == pytest.approx(sum(ordered) / len(ordered))
    assert optimality_gap(scores, 3.0) == pytest.approx(sum(max(3.0 - s, 0) for s in ordered) / len(ordered))
    profile = performance_profile(scores, [-5.0, 0.0, 7.0])
    assert profile.tolist() == [sum(s > level for s in ordered) / len(ordered) for level in (-5, 0, 7)]


@untimed
@given(pairs())
def test_probability_of_improvement_against_brute_force(pair: tuple[np.ndarray, np.ndarray]) -> None:
    x, y = pair
    tasks = [
        sum(1.0 if a > b else 0.5 if a == b else 0.0 for a, b in product(left, right)) / (len(left) * len(right))
        for left, right in zip(x.T.tolist(), y.T.tolist(), strict=True)
    ]
    assert probability_of_improvement(x, y) == pytest.approx(sum(tasks) / len(tasks))
    assert probability_of_improvement(x, y) + probability_of_improvement(y, x) == pytest.approx(1.0)
    assert probability_of_improvement(x, x) == pytest.approx(0.5)
    # only the order within a task counts
    assert probability_of_improvement(x**3, y**3) == probability_of_improvement(x, y)


@pytest.mark.parametrize("statistic", [*SINGLE, partial(performance_profile, thresholds=[0.0, 0.5])])
def test_a_stack_gives_what_its_tables_give(statistic: Callable[..., Any]) -> None:
    stack = np.random.default_rng(0).normal(size=(2, 3, 6, 4))
    each = np.array([[statistic(table) for table in row] for row in stack])
    np.testing.assert_allclose(statistic(stack), each, rtol=0, atol=1e-15)


def test_a_stack_of_pairs() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 3, 5, 4)).round(), rng.normal(size=(2, 3, 6, 4)).round()
    each = [[probability_of_improvement(*pair) for pair in zip(*row, strict=True)] for row in zip(x, y, strict=True)]
    np.testing.assert_allclose(probability_of_improvement(x, y), each, rtol=0, atol=1e-15)


# The bootstrap


def test_two_runs_have_three_resamples() -> None:
    """Means of two draws from 0 and 1: 0, 1/2, 1 with 1/4, 1/2, 1/4."""
    scores = [[0.0], [1.0]]
    assert stratified_bootstrap(mean, scores) == (0.5, 0.0, 1.0)
    assert stratified_bootstrap(mean, scores, confidence=0.4) == (0.5, 0.5, 0.5)
    assert stratified_bootstrap(mean, scores, confidence=0.6, n_resamples=4000) == (0.5, 0.0, 1.0)


def test_tasks_are_resampled_on_their_own() -> None:
    """Four independent draws, whose mean is k/4 with binomial probability; whole rows would give the three above."""
    assert stratified_bootstrap(mean, [[0.0, 0.0], [1.0, 1.0]], confidence=0.6) == (0.5, 0.25, 0.75)


def test_whole_runs_are_resampled_for_all_tasks_at_once() -> None:
    """The same table by rows: 0, 1/2, 1 again."""
    scores = [[0.0, 0.0], [1.0, 1.0]]
    assert stratified_bootstrap(mean, scores, confidence=0.6, n_resamples=4000, whole_runs=True) == (0.5, 0.0, 1.0)


def test_scores_stay_within_their_task() -> None:
    """Nothing varies within either task."""
    assert stratified_bootstrap(mean, [[0.0, 100.0]] * 5) == (50.0, 50.0, 50.0)


@pytest.mark.parametrize("swap", [False, True])
def test_both_sides_are_resampled(swap: bool) -> None:
    varied, constant = [[0.0], [2.0]], [[1.0], [1.0]]
    x, y = (constant, varied) if swap else (varied, constant)
    assert stratified_bootstrap(probability_of_improvement, x, y) == (0.5, 0.0, 1.0)


def test_sides_are_resampled_independently() -> None:
    """The difference of two means of two draws is -1, -1/2, 0 ... with 1/16, 4/16, 6/16 ...; in step it would be 0."""
    scores = [[0.0], [1.0]]
    interval = stratified_bootstrap(lambda x, y: mean(x) - mean(y), scores, scores, confidence=0.8)
    assert interval == (0.0, -0.5, 0.5)


@settings(max_examples=30, deadline=None)
@given(tables(min_runs=2), st.sampled_from(SINGLE))
def test_interval_lies_within_the_scores(scores: np.ndarray, statistic: Callable[..., Any]) -> None:
    estimate, lower, upper = stratified_bootstrap(statistic, scores, n_resamples=200)
    assert estimate == statistic(scores)
    assert lower <= upper
    if statistic is not optimality_gap:
        assert scores.min() - 1e-12 <= lower and upper <= scores.max() + 1e-12
    narrow = stratified_bootstrap(statistic, scores, n_resamples=200, confidence=0.5)
    assert lower <= narrow.lower and narrow.upper <= upper


def test_determined_by_the_seed() -> None:
    scores = np.random.default_rng(0).normal(size=(5, 2))
    first = stratified_bootstrap(iqm, scores, seed=3)
    assert first == stratified_bootstrap(iqm, scores, seed=3)
    assert first.lower != stratified_bootstrap(iqm, scores, seed=4).lower


def test_band_is_each_threshold_s_interval() -> None:
    scores, levels = np.random.default_rng(1).normal(size=(6, 3)), [-1.0, 0.0, 0.5]
    band = stratified_bootstrap(partial(performance_profile, thresholds=levels), scores, seed=2)
    for i, level in enumerate(levels):
        alone = stratified_bootstrap(lambda s, level=level: np.mean(s > level, axis=(-2, -1)), scores, seed=2)
        assert (band.estimate[i], band.lower[i], band.upper[i]) == alone
    assert (np.diff(band.estimate) < 0).all() and (band.upper - band.lower > 0.05).all()


def held(statistic: Callable[..., Any], truth: float, draw: Callable[[], list[np.ndarray]], **options: Any) -> float:
    """Share of 300 experiments whose 95% interval holds the truth; three standard deviations are 3.8%."""
    intervals = [stratified_bootstrap(statistic, *draw(), n_resamples=400, seed=i, **options) for i in range(300)]
    return float(np.mean([interval.lower <= truth <= interval.upper for interval in intervals]))


@pytest.mark.parametrize("statistic, better", [(mean, False), (iqm, False), (probability_of_improvement, True)])
def test_coverage(statistic: Callable[..., Any], better: bool) -> None:
    """With 16 runs on two very different tasks a little below the nominal 95%, as the percentile bootstrap is."""
    rng = np.random.default_rng(0)
    centres = np.array([-5.0, 5.0])  # symmetric, so that the true mean and interquartile mean are 0

    def draw() -> list[np.ndarray]:
        x, y = rng.normal(centres, 1.0, (16, 2)), rng.normal(centres - 0.5, 1.0, (16, 2))
        return [x, y] if better else [x]

    truth = (1 + math.erf(0.25)) / 2 if better else 0.0  # x - y has mean 0.5 and variance 2
    assert 0.89 <= held(statistic, truth, draw) <= 0.975


@pytest.mark.parametrize("runs, share", [(3, 0.75), (8, 0.9)])
def test_few_runs_cover_as_documented(runs: int, share: float) -> None:
    rng = np.random.default_rng(0)
    assert held(mean, 0.0, lambda: [rng.normal(size=(runs, 1))]) == pytest.approx(share, abs=0.06)


def test_runs_scored_on_every_task_are_kept_whole() -> None:
    """An agent that is good in one weather is good in all, so its scores are not independent."""
    rng = np.random.default_rng(0)

    def draw() -> list[np.ndarray]:
        return [rng.normal(0, 1, (16, 1)) + rng.normal(0, 0.3, (16, 6))]

    assert held(mean, 0.0, draw) < 0.7
    assert 0.89 <= held(mean, 0.0, draw, whole_runs=True) <= 0.975


# rliable's figures


@pytest.mark.parametrize("case", RLIABLE["cases"], ids=lambda case: "{}x{}".format(*np.shape(case["x"])))
def test_estimates_are_rliable_s(case: dict[str, Any]) -> None:
    x, y = case["x"], case["y"]
    ours = [getattr(statistics, name)(x) for name in RLIABLE["aggregates"]]
    np.testing.assert_allclose(ours, case["aggregates"]["estimate"], rtol=0, atol=1e-12)
    profile = performance_profile(x, RLIABLE["thresholds"])
    np.testing.assert_allclose(profile, case["profile"]["estimate"], rtol=0, atol=1e-12)
    better = probability_of_improvement(x, y)
    np.testing.assert_allclose([better], case["improvement"]["estimate"], rtol=0, atol=1e-12)


@pytest.mark.parametrize("case", RLIABLE["cases"], ids=lambda case: "{}x{}".format(*np.shape(case["x"])))
def test_intervals_are_rliable_s(case: dict[str, Any]) -> None:
    """Up to Monte-Carlo error, in terms of probability, as a bound of few runs may jump.

    The share of n resamples below the 2.5% quantile has variance q (1 - q) / n. So rliable's bound must lie between
    ours at q - d and q + d, with d four standard deviations of the difference of two such shares.
    """
    x, y, ours = np.array(case["x"]), np.array(case["y"]), 10_000

    def check(statistic: Callable[..., Any], theirs: dict[str, Any], *scores: np.ndarray) -> None:
        tail = (1 - RLIABLE["confidence"]) / 2
        margin = 4 * np.sqrt(tail * (1 - tail) * (1 / ours + 1 / theirs["resamples"]))
        outer, inner = (
            stratified_bootstrap(statistic, *scores, n_resamples=ours, confidence=1 - 2 * level, seed=1)
            for level in (tail - margin, tail + margin)
        )
        for lowest, highest, bound in ((outer[1], inner[1], "lower"), (inner[2], outer[2], "upper")):
            assert np.all(lowest - 1e-12 <= theirs[bound]) and np.all(theirs[bound] <= highest + 1e-12), bound

    check(
        lambda s: np.stack([getattr(statistics, name)(s) for name in RLIABLE["aggregates"]], -1), case["aggregates"], x
    )
    check(partial(performance_profile, thresholds=RLIABLE["thresholds"]), case["profile"], x)
    check(lambda s, t: probability_of_improvement(s, t)[..., None], case["improvement"], x, y)


def test_rliable_s_figures_have_ties_and_few_runs() -> None:
    runs = {len(case[side]) for case in RLIABLE["cases"] for side in "xy"}
    assert min(runs) == 3 and max(runs) == 16
    tied = [np.isin(case["x"], case["y"]).any() for case in RLIABLE["cases"]]
    assert sum(tied) >= 3 and RLIABLE["made_with"]["rliable"] == "1.2.0"


# Errors


@pytest.mark.parametrize(
    "scores, message",
    [
        ([1.0, 2.0], r"table \(n_runs, n_tasks\).*shape \(2,\).*scores\[:, None\]"),
        (3.0, r"shape \(\)"),
        (np.zeros((0, 2)), r"shape \(0, 2\)"),
        (np.zeros((2, 0)), r"shape \(2, 0\)"),
        ([[1.0], [np.nan]], "finite, got 1 NaN"),
        ([[np.inf], [1.0]], "finite, got 1 NaN"),
    ],
)
def test_wrong_tables_of_scores(scores: Any, message: str) -> None:
    for statistic in SINGLE:
        with pytest.raises(ValueError, match=message):
            statistic(scores)
    with pytest.raises(ValueError, match=message):
        performance_profile(scores, [0.0])
    with pytest.raises(ValueError, match=message):
        probability_of_improvement([[1.0], [2.0]], scores)
    with pytest.raises(ValueError, match=message):
        stratified_bootstrap(mean, scores)


def test_an_interval_of_one_run_is_refused() -> None:
    with pytest.raises(ValueError, match=r"at least 2 runs, got scores of shape \(1, 8\)"):
        stratified_bootstrap(iqm, np.zeros((1, 8)))
    with pytest.raises(ValueError, match=r"at least 2 runs, got scores of shape \(1, 3\)"):
        stratified_bootstrap(probability_of_improvement, np.zeros((4, 3)), np.zeros((1, 3)))


def test_bad_arguments_of_the_bootstrap() -> None:
    scores = np.zeros((3, 2))
    with pytest.raises(ValueError, match="n_resamples >= 1"):
        stratified_bootstrap(mean, scores, n_resamples=0)
    for confidence in (0.0, 1.0, 95.0):
        with pytest.raises(ValueError, match="0 < confidence < 1"):
            stratified_bootstrap(mean, scores, confidence=confidence)
    with pytest.raises(ValueError, match=r"single tables .* got shape \(4, 3, 2\)"):
        stratified_bootstrap(mean, np.zeros((4, 3, 2)))
    with pytest.raises(ValueError, match="last two axes"):
        stratified_bootstrap(np.mean, scores)


def test_pairs_of_other_shapes() -> None:
    with pytest.raises(ValueError, match=r"same tasks .* \(3, 2\) and \(3, 1\)"):
        probability_of_improvement(np.zeros((3, 2)), np.zeros((3, 1)))
    with pytest.raises(ValueError, match="same tasks"):
        probability_of_improvement(np.zeros((5, 3, 2)), np.zeros((3, 2)))
