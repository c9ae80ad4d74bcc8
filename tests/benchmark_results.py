"""Made-up results of a benchmark, small enough to compute by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_have.benchmark.reading import Results, read_results

Rows = list[dict[str, Any]]
Runs = Mapping[str, Mapping[int, tuple[float, ...]]]

NOON, NIGHT = "ClearNoon", "ClearNight"
# distance of each seed at noon and at night; the return is distance / 10 - 5
DISTANCES: Runs = {"sac": {0: (100, 200), 1: (140, 160)}, "have": {0: (150, 190), 1: (300, 250)}}
STEPS, STD, EPISODES = 2000, 30.0, 2


def moments(distance: float, episodes: int = EPISODES) -> dict[str, Any]:
    values = {"return_mean": distance / 10 - 5, "return_std": STD / 10, "distance_mean": distance, "distance_std": STD}
    return {**values, "episodes": episodes}


def each(runs: Runs) -> list[tuple[dict[str, Any], float]]:
    """Every score with its method, seed and weather."""
    return [
        ({"method": method, "seed": seed, "weather": weather}, distance)
        for method, seeds in runs.items()
        for seed, distances in seeds.items()
        for weather, distance in zip((NOON, NIGHT), distances, strict=False)
    ]


def final(runs: Runs = DISTANCES, step: int = STEPS) -> Rows:
    return [{**key, "step": step, **moments(distance)} for key, distance in each(runs)]


def evaluations(runs: Runs = DISTANCES, shares: Mapping[int, float] = {1000: 0.5, 2000: 1.0}) -> Rows:
    return [row for step, share in shares.items() for row in final(scaled(runs, share), step)]


def scaled(runs: Runs, share: float) -> Runs:
    return {name: {seed: tuple(share * d for d in ds) for seed, ds in seeds.items()} for name, seeds in runs.items()}


def run_rows(runs: Runs = DISTANCES, **settings: Any) -> Rows:
    common = {"steps": STEPS, "parameters": 1234, "minutes": 10.0, "machine": "a machine", "versions": "torch 2"}
    return [
        {"method": method, "seed": seed, **common, "settings": json.dumps({"gamma": 0.9, "name": method, **settings})}
        for method, seeds in runs.items()
        for seed in seeds
    ]


def weight_rows(weights: Mapping[int, Sequence[float]], method: str = "have", weather: str = NIGHT) -> Rows:
    """Rows for the weights of rgb by seed, one number per step."""
    key = {"method": method, "weather": weather, "episode_seed": 7}
    return [
        {**key, "seed": seed, "t": t, "modality": modality, "weight": weight, "return_so_far": float(t)}
        for seed, values in weights.items()
        for t, rgb in enumerate(values)
        for modality, weight in (("rgb", rgb), ("event", 1 - rgb))
    ]


def failure_rows(kept: Mapping[str, Mapping[int, tuple[float, float]]], modality: str = "rgb") -> Rows:
    """Rows for distances without and with a black image, by method and seed; the return is distance / 10 - 5."""
    rows = []
    for method, seeds in kept.items():
        for seed, (healthy, black) in seeds.items():
            key = {"method": method, "seed": seed, "weather": NIGHT}
            rows.append({**key, "modality": "none", "kind": "none", "severity": 0, **moments(healthy, 1)})
            rows.append({**key, "modality": modality, "kind": "black", "severity": 3, **moments(black, 1)})
    return rows


def write(folder: Path, **files: Rows) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in files.items():
        pd.DataFrame(rows).to_csv(folder / f"{name}.csv", index=False)
    return folder


def read(folder: Path, **files: Rows) -> Results:
    return read_results([write(folder, **files)])
