"""Test whether the driving task of HighwayVision-v0 can be learned, and with which settings, from a state vector.

    python -m benchmarks.state_learnability drivers                                # drivers that do not learn
    python -m benchmarks.state_learnability drivers --scenarios merge curves       # the same on other roads
    python -m benchmarks.state_learnability train --settings default --seeds 0 1   # stock SAC, two seeds at a time

Every evaluation is appended to ``benchmarks/results/state_learnability.csv`` at once. The name of a setting starts with
the scenario, unless it is the highway.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from highway_env.envs.common.observation import ObservationType
from stable_baselines3 import SAC

from sb3_have.envs.highway_vision import HighwayVisionEnv
from sb3_have.envs.road import LANE_WIDTH
from sb3_have.envs.road_shape import SCENARIOS
from sb3_have.envs.rule_driven import RuleDrivenEnv

RESULTS = Path(__file__).parent / "results" / "state_learnability.csv"
COLUMNS = ["setting", "seed", "step", "episodes", "distance_mean", "distance_std", "distance_max"]
COLUMNS += ["return_mean", "crash_share", "offroad_share", "seconds"]
# Range within which the state vector reports other vehicles [m]
SEEN = 150.0

SAC_DEFAULTS: dict[str, Any] = {
    "gamma": 0.98,
    "learning_rate": 3e-4,
    "ent_coef": "auto_0.1",
    "batch_size": 256,
    "learning_starts": 1000,
    "policy_kwargs": {"net_arch": [128, 128]},
}
SETTINGS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "default": ({}, {}),
    "gamma_0.95": ({}, {"gamma": 0.95}),
    "gamma_0.97": ({}, {"gamma": 0.97}),
    "gamma_0.99": ({}, {"gamma": 0.99}),
    "crash_5": ({"crash_penalty": 5.0}, {}),
    "crash_10": ({"crash_penalty": 10.0}, {}),
    "crash_50": ({"crash_penalty": 50.0}, {}),
    "steer_0.01": ({"steering_range": 0.01}, {}),
    "steer_0.05": ({"steering_range": 0.05}, {}),
    "10_hz": ({"policy_frequency": 10, "max_episode_steps": 1000}, {}),
    "start_20": ({"initial_speed": 20.0}, {}),
    "free_brake": ({"brake_cost": 0.0}, {}),
    "wide_traffic": ({"traffic_speed": (12.0, 24.0)}, {}),
    "no_costs": ({"brake_cost": 0.0, "steer_cost": 0.0}, {}),
}


class StateObservation(ObservationType):  # type: ignore[misc]  # highway-env is untyped
    """
    State vector of 19 values relative to the road.

    These are lateral position, offset from the centre of the lane, heading and speed of the ego vehicle, and for the
    left lane, the own lane and the right lane: whether it exists, and the gap and speed difference to the next vehicle
    ahead and behind. Only lanes in the ego vehicle's direction count.
    """

    def space(self) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, shape=(19,), dtype=np.float32)

    def observe(self) -> np.ndarray:
        ego, road = self.env.vehicle, self.env.road
        width = self.env.lanes_count * LANE_WIDTH
        y = ego.position[1] - self.env.shape.bend(ego.position[0])
        along, lateral = ego.lane.local_coordinates(ego.position)
        *direction, own = ego.lane_index
        state = [2 * y / width, lateral / LANE_WIDTH, 10 * ego.lane.local_angle(ego.heading, along)]
        state.append(ego.speed / 15 - 1)
        for lane in (own - 1, own, own + 1):
            exists = 0 <= lane < len(road.network.all_side_lanes(ego.lane_index))
            state.append(float(exists))
            front, rear = road.neighbour_vehicles(ego, (*direction, lane)) if exists else (None, None)
            for other in (front, rear):
                gap = SEEN if other is None else min(abs(other.position[0] - ego.position[0]), SEEN)
                closing = 0.0 if other is None or gap == SEEN else ego.speed - other.speed
                state += [gap / SEEN if exists else 0.0, closing / 10]
        return np.array(state, dtype=np.float32)


class StateEnv(HighwayVisionEnv):
    """HighwayVision-v0 with a state vector as its observation; nothing is rendered."""

    def define_spaces(self) -> None:
        super().define_spaces()
        self.observation_type = StateObservation(self)
        self.observation_space = self.observation_type.space()


class RuleBasedEnv(RuleDrivenEnv, StateEnv):
    """The same environment with an IDM/MOBIL driver."""


Driver = Callable[[np.ndarray], np.ndarray]


def keep_straight(speed: float) -> Driver:
    """Create a driver that goes straight at a speed [m/s], with a proportional controller on the throttle."""
    return lambda state: np.array([np.clip((speed - 15 * (state[3] + 1)) / 3, -1, 1), 0.0])


def evaluate(env: HighwayVisionEnv, driver: Driver, seeds: Iterable[int]) -> dict[str, Any]:
    """Drive one episode per seed."""
    distances, returns, reasons = [], [], []
    for seed in seeds:
        state: Any  # a vector here, a Dict in the base class
        state, info = env.reset(seed=seed)
        done, total = False, 0.0
        while not done:
            state, reward, terminated, truncated, info = env.step(driver(state))
            total += reward
            done = terminated or truncated
        distances.append(info["distance"])
        returns.append(total)
        reasons.append(info["end_reason"])
    return {
        "episodes": len(distances),
        "distance_mean": round(float(np.mean(distances)), 1),
        "distance_std": round(float(np.std(distances)), 1),
        "distance_max": round(float(np.max(distances)), 1),
        "return_mean": round(float(np.mean(returns)), 2),
        "crash_share": reasons.count("crash") / len(reasons),
        "offroad_share": reasons.count("offroad") / len(reasons),
    }


def record(row: dict[str, Any], path: Path) -> None:
    """Append a row to the CSV file and print it."""
    path.parent.mkdir(exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if new:
            writer.writeheader()
        writer.writerow(row)
    print(" ".join(f"{key}={value}" for key, value in row.items()), flush=True)


def run_drivers(scenario: str, path: Path, episodes: int) -> None:
    """Evaluate drivers that do not learn."""
    rng = np.random.default_rng(0)
    drivers: dict[str, tuple[type[StateEnv], Driver]] = {
        "random": (StateEnv, lambda state: rng.uniform(-1, 1, 2)),
        **{f"keep_straight_{v}": (StateEnv, keep_straight(v)) for v in (10, 15, 20, 25)},
        "idm_mobil": (RuleBasedEnv, lambda state: np.zeros(2)),
    }
    for name, (env_class, driver) in drivers.items():
        start = time.perf_counter()
        result = evaluate(env_class(scenario=scenario), driver, range(10_000, 10_000 + episodes))
        setting = name if scenario == "highway" else f"{scenario}_{name}"
        seconds = round(time.perf_counter() - start)
        record({"setting": setting, "seed": "", "step": 0, **result, "seconds": seconds}, path)


def train(setting: str, seed: int, steps: int, every: int, episodes: int, path: Path) -> None:
    """Train SB3's SAC on the state vector and evaluate it every ``every`` steps."""
    th.set_num_threads(1)
    env_kwargs, sac_kwargs = SETTINGS[setting]
    model = SAC("MlpPolicy", StateEnv(**env_kwargs), seed=seed, device="cpu", **{**SAC_DEFAULTS, **sac_kwargs})
    test_env = StateEnv(**env_kwargs)
    start = time.perf_counter()
    while model.num_timesteps < steps:
        model.learn(every, reset_num_timesteps=False)
        result = evaluate(
            test_env,
            lambda state: model.predict(state, deterministic=True)[0],
            range(10_000, 10_000 + episodes),
        )
        row = {"setting": setting, "seed": seed, "step": model.num_timesteps, **result}
        record({**row, "seconds": round(time.perf_counter() - start)}, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["drivers", "train"])
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=["highway"], help="scenarios for drivers")
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=["default"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--every", type=int, default=2_500)
    parser.add_argument("--episodes", type=int, default=None, help="default: 20 for drivers, 10 in training")
    parser.add_argument("--jobs", type=int, default=2, help="number of parallel runs")
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    if args.what == "drivers":
        for scenario in args.scenarios:
            run_drivers(scenario, args.out, args.episodes or 20)
        return
    with ProcessPoolExecutor(args.jobs) as pool:
        runs = [
            pool.submit(train, setting, seed, args.steps, args.every, args.episodes or 10, args.out)
            for setting in args.settings
            for seed in args.seeds
        ]
        for run in runs:
            run.result()


if __name__ == "__main__":
    main()
