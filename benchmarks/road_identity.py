"""
Compare the traffic of HighwayVision-v0 with that of highway-env: is it the same to the last bit, and how much faster?

    OMP_NUM_THREADS=1 python -m benchmarks.road_identity

Both environments get the same seeds and random actions and render nothing. One has the road, lanes and drivers of this
package, the other ``Road``, ``RoadNetwork`` and ``IDMVehicle``. The complete state of all vehicles is compared after
every control step, and the script fails at the first difference. There are two kinds of traffic:

- ``episodes``: as for an agent; a crash or leaving the road ends the episode;
- ``breakdowns``: 100 steps without end; every second a random car breaks down right in front of another.

Writes benchmarks/results/road_identity.csv with a row per kind and seed: ``recycled`` cars, ``lane_changes``,
``crashed`` cars, the number of ``values`` compared, and the processor time per control step of both with their ratio.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from gymnasium import spaces
from highway_env.envs.common.observation import ObservationType
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from sb3_have.envs import HighwayVisionEnv, highway_vision, traffic
from sb3_have.envs.road import ROAD_LENGTH

RESULTS = Path(__file__).parent / "results" / "road_identity.csv"
KINDS = ("episodes", "breakdowns")


class NoObservation(ObservationType):  # type: ignore[misc]  # highway-env is untyped
    """No observation."""

    def space(self) -> spaces.Box:
        return spaces.Box(0, 1, (1,), np.float32)

    def observe(self) -> np.ndarray:
        return np.zeros(1, np.float32)


class BlindEnv(HighwayVisionEnv):
    """
    HighwayVision-v0 without sensors.

    :param endless: Whether to continue after a crash and off the road.
    """

    def __init__(self, endless: bool = False, **kwargs: Any) -> None:
        self.endless = endless
        super().__init__(**kwargs)

    def define_spaces(self) -> None:
        super().define_spaces()
        self.observation_type = NoObservation(self)
        self.observation_space = self.observation_type.space()

    def _is_terminated(self) -> bool:
        return not self.endless and super()._is_terminated()


class StockEnv(BlindEnv):
    """The same with highway-env's own road and drivers."""

    def _reset(self) -> None:
        def network(lanes_count: int) -> RoadNetwork:
            return RoadNetwork.straight_road_network(lanes_count, length=ROAD_LENGTH)

        with (
            patch.multiple(highway_vision, HighwayRoad=Road, HighwayNetwork=network),
            patch.object(traffic, "Driver", IDMVehicle),
        ):
            super()._reset()

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        with patch.object(traffic, "Driver", IDMVehicle):
            return super().step(action)


def state(env: HighwayVisionEnv) -> list[Any]:
    """Return the complete state of all vehicles."""
    values: list[Any] = []
    for v in env.road.vehicles:
        values += [*v.position.tolist(), float(v.heading), float(v.speed), v.crashed, v.lane_index]
        values += [float(v.action["steering"]), float(v.action["acceleration"]), np.array(v.impact).tobytes()]
        values += [getattr(v, "target_lane_index", None), getattr(v, "timer", None), getattr(v, "DELTA", None)]
    return values


def break_down(vehicle: Vehicle, other: Vehicle) -> None:
    """Stop a vehicle three metres in front of another."""
    vehicle.position = other.position + np.array([3.0 + vehicle.LENGTH, 0.0])
    vehicle.speed, vehicle.crashed = 0.0, True


def timed_step(env: HighwayVisionEnv, action: np.ndarray) -> tuple[float, list[Any]]:
    """Take a control step and return its processor time in seconds and its results."""
    start = time.process_time()
    _, *returned = env.step(action)
    return time.process_time() - start, returned


def compare(kind: str, seed: int, steps: int, **kwargs: Any) -> dict[str, Any]:
    """
    Drive both environments at random with one seed.

    :param kind: One of :data:`KINDS`.
    :param seed: Seed of the environments and actions.
    :param steps: Number of control steps.
    :param kwargs: Options of both environments.
    :return: Row of the table.
    :raises AssertionError: If they differ.
    """
    endless = kind == "breakdowns"
    kwargs = {"endless": endless, "max_episode_steps": 100 if endless else None, "initial_speed": 20.0, **kwargs}
    envs = BlindEnv(**kwargs), StockEnv(**kwargs)
    rng = np.random.default_rng(seed)
    episodes = 1
    recycled = lane_changes = crashed = values = 0
    seconds = np.zeros(2)
    for env in envs:
        env.reset(seed=seed)
    for step in range(steps):
        cars, lanes = list(envs[0].road.vehicles), [v.lane_index for v in envs[0].road.vehicles]
        if endless and step % round(envs[0].config["policy_frequency"]) == 0:
            broken, other = rng.choice(len(cars) - 1, 2, replace=False) + 1
            for env in envs:
                break_down(env.road.vehicles[broken], env.road.vehicles[other])
        before = sum(v.crashed for v in cars)
        action = rng.uniform(-1, 1, 2)
        order = (0, 1) if step % 2 else (1, 0)
        results: dict[int, list[Any]] = {}
        for i in order:
            taken, results[i] = timed_step(envs[i], action)
            seconds[i] += taken
        states = state(envs[0]), state(envs[1])
        values += len(states[0])
        if states[0] != states[1] or results[0] != results[1]:
            raise AssertionError(f"{kind}, seed {seed}, step {step}: the roads differ")
        stayed = [old is new for old, new in zip(cars, envs[0].road.vehicles, strict=True)]
        recycled += stayed.count(False)
        lane_changes += sum(
            same and v.lane_index != lane for same, v, lane in zip(stayed, envs[0].road.vehicles, lanes, strict=True)
        )
        crashed += max(0, sum(v.crashed for v in envs[0].road.vehicles) - before)
        if results[0][1] or results[0][2]:
            episodes += 1
            for env in envs:
                env.reset()
    fast, stock = seconds / steps * 1000
    return {
        "traffic": kind,
        "seed": seed,
        "steps": steps,
        "episodes": episodes,
        "recycled": recycled,
        "lane_changes": lane_changes,
        "crashed": crashed,
        "values": values,
        "cpu_ms": round(fast, 3),
        "stock_cpu_ms": round(stock, 3),
        "ratio": round(stock / fast, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=1000, help="control steps at 5 Hz over 20 Hz")
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    rows = []
    for kind in KINDS:
        for seed in range(args.seeds):
            rows.append(compare(kind, seed, args.steps, vehicles_count=args.vehicles))
            print(" ".join(f"{key}={value}" for key, value in rows[-1].items()), flush=True)
    total = {key: sum(row[key] for row in rows) for key in ("steps", "recycled", "lane_changes", "crashed", "values")}
    print(f"no difference: {total}")
    for kind in KINDS:
        ratio = np.median([row["ratio"] for row in rows if row["traffic"] == kind])
        print(f"{kind}: {ratio:.2f} times as fast as highway-env (median of {args.seeds} seeds)")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
