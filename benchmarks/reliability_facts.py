"""Compute the lower and upper limits of the reliability benchmark, and the differences between its methods.

    python -m benchmarks.reliability_facts

This script does not train. In the evaluation episodes of the standard task it runs the action zero, 81 constant
actions, and a rule that knows the true state. While the rule drives, the script measures how well a simple feature
detects failures: the mean deviation of the second half of a modality's observation, the liveliness of its numbers, from
its usual value. From the results of ``python -m benchmarks.reliability`` it computes the differences between "have" and
every other method, with a 95% bootstrap interval over seeds, in the shares of the return kept under a failure, in the
returns under a failure, and in the AUC of the weights as detectors.

It prints and writes to benchmarks/results/reliability/facts.csv the columns ``fact``, ``than`` (the other method),
``value``, ``lower`` and ``upper``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.known_q import Floats
from benchmarks.reliability import N_UPDATES, OUT, STANDARD_TASK, load
from benchmarks.reliability_report import KEPT, REFERENCE, values
from benchmarks.reliability_runs import EVALUATION_SEED, N_EPISODES, N_MODALITIES, Drive
from benchmarks.reliability_vec_env import ReliabilityDriveVecEnv
from sb3_have.envs.reliability_drive import ACROSS, ALONG, CHANNELS, DRAG, DT, DriveBatch
from sb3_have.evaluation.statistics import mean, stratified_bootstrap

Row = dict[str, Any]
# A function from the drives, including their true state, to actions (N, 2)
Policy = Callable[[DriveBatch], Floats]
NOTHING = "return of doing nothing"
# Number of values of throttle and of steering, from -1 to 1, denser around 0
N_CONSTANTS = 9
# Lateral distance at which the rule passes the obstacle [m]
ROOM = 3.0
# Largest distance of the rule from the middle of the road [m]
WIDEST = 3.5
# Range of distances along the road where the rule considers the obstacle [m]
AHEAD = (-4.0, 14.0)


def constant(throttle: float, steering: float) -> Policy:
    """Create a policy that always takes the same action."""
    return lambda batch: np.tile([throttle, steering], (batch.num_envs, 1))


def rule(batch: DriveBatch) -> Floats:
    """Hold the target speed and the middle of the road, and pass the obstacle on the side with more room."""
    throttle = (batch.target_speed(batch.s + DT * batch.speed) - batch.speed) / (DT * ALONG)
    distance, offset, _ = batch.obstacle_position()
    obstacle = batch.y + offset
    is_near = (AHEAD[0] < distance) & (distance < AHEAD[1])
    aside = np.clip(obstacle - np.where(obstacle > 0, ROOM, -ROOM), -WIDEST, WIDEST)
    wanted = np.where(is_near & (np.abs(obstacle) < ROOM), aside, 0.0)
    outwards = batch.curvature(batch.s) * batch.speed**2
    push = (outwards + DRAG * batch.drift + 2.0 * (wanted - batch.y) - 2.5 * batch.drift) / ACROSS
    return np.clip(np.stack([throttle, push], axis=1), -1, 1)


def liveliness(batch: DriveBatch) -> Floats:
    """Score each modality (N, d): the higher, the more its liveliness is that of a working sensor."""
    scores: Floats = -np.abs(batch.frames[:, :, CHANNELS:].mean(axis=2))
    return scores


def drive(policy: Policy, n_episodes: int = N_EPISODES, **task: Any) -> Drive:
    """Run the episodes of the benchmark's evaluation, with :func:`liveliness` in place of the weights."""
    env = ReliabilityDriveVecEnv(n_episodes, n_modalities=N_MODALITIES, **task)
    env.seed(EVALUATION_SEED)
    env.reset()
    alive = np.ones(n_episodes, bool)
    rows = []
    while alive.any():
        scores, reliable = liveliness(env.batch), env.batch.reliable.copy()
        _, rewards, dones, _ = env.step(policy(env.batch))
        rows.append((rewards * alive, alive.copy(), reliable, scores))
        alive &= ~dones
    return Drive(*(np.stack(column) for column in zip(*rows, strict=True)))


def drivers() -> list[Row]:
    """Compute the returns of policies that were not trained, and the AUC of the liveliness."""

    def earned(policy: Policy) -> float:
        return float(drive(policy, **STANDARD_TASK).returns.mean())

    steps = np.linspace(-1, 1, N_CONSTANTS)
    actions = itertools.product(steps * np.abs(steps), repeat=2)
    ruled = drive(rule, **STANDARD_TASK)
    facts = {
        NOTHING: earned(constant(0, 0)),
        "return of the best constant action": max(earned(constant(*action)) for action in actions),
        "return of a rule that knows the state": float(ruled.returns.mean()),
        "AUC of liveliness by hand": ruled.weight_auc(),
        "AUC of liveliness by hand, in a step": ruled.weight_auc_in_step(),
    }
    return [{"fact": fact, "value": value} for fact, value in facts.items()]


def floors(rows: pd.DataFrame, floor: float) -> list[Row]:
    """Compute the return of doing nothing as a share of each method's return with working sensors."""
    returns = rows[rows["measure"] == "clean_return"].groupby("method", sort=False)["value"].mean()
    fact = "doing nothing: share of the clean return of"
    return [{"fact": fact, "than": method, "value": floor / clean} for method, clean in returns.items()]


def differences(rows: pd.DataFrame) -> list[Row]:
    """
    Compute the difference in each measure between "have" and every other method that has it, mean over seeds.

    :param rows: Rows with method, seed, updates, measure and value
    :return: Rows of the table
    """
    facts = []
    for method in rows["method"].unique():
        ours, other = measures(rows, REFERENCE), measures(rows, method)
        for name in ours:
            if method == REFERENCE or other[name].empty:
                continue
            scores = [series.to_numpy()[:, None] for series in (ours[name], other[name])]
            result = stratified_bootstrap(lambda x, y: mean(x) - mean(y), *scores)
            fact = {"fact": f"{name}: {REFERENCE} less", "than": method, "value": result.estimate}
            facts.append({**fact, "lower": result.lower, "upper": result.upper})
    return facts


def measures(rows: pd.DataFrame, method: str) -> dict[str, pd.Series[float]]:
    """Get the values per seed of each measure that is compared."""
    clean = values(rows, method, "clean_return")
    kept = {name: values(rows, method, name) for name in KEPT}
    returns = {f"return under {name.removeprefix('kept_')}": share * clean for name, share in kept.items()}
    return {**kept, **returns, "weight_auc": values(rows, method, "weight_auc")}


def main(path: Path = OUT / "facts.csv") -> None:
    rows = load(OUT)
    rows = rows[rows["updates"] == N_UPDATES]
    driven = drivers()
    facts = driven + floors(rows, driven[0]["value"]) + differences(rows)
    table = pd.DataFrame(facts, columns=["fact", "than", "value", "lower", "upper"]).round(4)
    print(table.to_string(index=False, na_rep=""))
    table.to_csv(path, index=False)


if __name__ == "__main__":
    main()
