"""
Measure how well the sensors of HighwayVision-v0 see other vehicles in each of the eight weathers.

    python -m benchmarks.weather_contrast

The traffic is the same in every weather. Vehicles farther away than 35 m, beyond the headlights, are compared with the
road around them. Prints a table and writes benchmarks/results/weather_contrast.csv with the columns

- ``rgb_contrast``: |mean brightness of a vehicle's pixels - mean of a ring of 2 pixels around it|, 8-bit steps;
- ``rgb_vs_noon``: its ratio to the noon with the same sky;
- ``events_per_pixel``: sum of |count| over the bins in a vehicle's pixels, per pixel and control step, minus the noise;
- ``events_vs_noon``: its ratio to the noon with the same sky;
- ``event_noise``: the same quantity over all pixels while nothing moves;
- ``rgb_noise``: standard deviation over time of the colour image while nothing moves, 8-bit steps;
- ``saturated``: share of colour pixels with a channel at 255;
- ``recognised``: share of frames whose weather a nearest-centroid classifier recognises from simple image statistics
  (means and deviations of colours and events above and below the horizon), learned from other episodes;
- ``recognised_rgb``: the same from the colour image alone.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sb3_have.envs.vision import VisionSensors
from sb3_have.envs.weather import WEATHERS
from sb3_have.sensors import decode_events

BEYOND_HEADLIGHTS = 35.0
FARTHEST = 90.0
DURATION = 0.2
LANE_SPEEDS = np.array([20.0, 23.0, 26.0, 29.0])

Array = NDArray[Any]


def traffic(rng: np.random.Generator, vehicles: int = 20) -> tuple[Array, Array]:
    """Poses (1 + vehicles, 3) and speeds (1 + vehicles,): steady traffic on four lanes ahead of the ego."""
    lane = rng.integers(4, size=vehicles)
    slot = rng.permutation(vehicles)
    poses = np.zeros((1 + vehicles, 3))
    poses[0, :2] = rng.uniform(0, 240), 4.0
    poses[1:, 0] = poses[0, 0] + 35 + 6.5 * slot
    poses[1:, 1] = 4.0 * lane
    return poses, np.concatenate(([25.0], LANE_SPEEDS[lane]))


def drive(poses: Array, speeds: Array, instants: int = 5) -> Array:
    """Poses at equally spaced instants of one control step, (instants, 1 + vehicles, 3)."""
    times = np.linspace(0, DURATION, instants)
    moved = np.repeat(poses[None], instants, axis=0)
    moved[..., 0] += times[:, None] * speeds
    return moved


def brightness(image: Array) -> Array:
    return np.asarray(image.astype(np.float64) @ (0.299, 0.587, 0.114))


def activity(image: Array) -> Array:
    return np.asarray(np.abs(decode_events(image)).sum(axis=-1))


def far_vehicles(truth: dict[str, Array], poses: Array) -> list[tuple[Array, Array]]:
    """Masks of the vehicles beyond the headlights that cover at least 3 pixels, and of the rings around them."""
    vehicle = truth["vehicle"]
    rings = []
    for number in np.unique(vehicle[vehicle >= 0]):
        distance = poses[1 + number, 0] - poses[0, 0]
        mask = vehicle == number
        if BEYOND_HEADLIGHTS < distance < FARTHEST and mask.sum() >= 3:
            grown = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            ring = grown & (vehicle < 0)
            if ring.any():
                rings.append((mask, ring))
    return rings


def statistics(observation: dict[str, Array]) -> tuple[list[float], list[float]]:
    """Simple statistics of the colour image and of the event image."""
    colour, events = observation["rgb"].astype(np.float64), activity(observation["event"])
    half = len(colour) // 2
    of_rgb = [*colour[:half].mean((0, 1)), *colour[half:].mean((0, 1)), *colour[:half].std((0, 1)), colour[half:].std()]
    return of_rgb, [events[:half].mean(), events[half:].mean()]


def measure(weather: str, episodes: int, steps: int, image_size: int) -> tuple[dict[str, float], Array, Array]:
    """Figures of one weather, and the image statistics of every frame with its episode."""
    sensors = VisionSensors(image_size, ("rgb", "event"))
    contrast, events, saturated, features, episode_of = [], [], [], [], []
    event_noise, rgb_noise = [], []
    for episode in range(episodes):
        rng = np.random.default_rng(episode)
        poses, speeds = traffic(rng)
        sensors.reset(weather, poses, np.tile((5.0, 2.0), (len(poses), 1)), rng)
        still = [sensors.observe(drive(poses, 0 * speeds), DURATION, rng) for _ in range(5)]
        event_noise += [activity(frame["event"]).mean() for frame in still]
        rgb_noise.append(np.std([frame["rgb"] for frame in still], axis=0, ddof=1).mean())
        for _ in range(steps):
            instants = drive(poses, speeds)
            poses = instants[-1]
            observation = sensors.observe(instants, DURATION, rng)
            light, active = brightness(observation["rgb"]), activity(observation["event"])
            for mask, ring in far_vehicles(sensors.last_truth, poses):
                contrast.append(abs(light[mask].mean() - light[ring].mean()))
                events.append(active[mask].mean())
            saturated.append((observation["rgb"] == 255).any(axis=-1).mean())
            of_rgb, of_events = statistics(observation)
            features.append([*of_rgb, *of_events])
            episode_of.append(episode)
    noise = float(np.mean(event_noise))
    figures = {
        "rgb_contrast": float(np.mean(contrast)),
        "events_per_pixel": float(np.mean(events)) - noise,
        "event_noise": noise,
        "rgb_noise": float(np.mean(rgb_noise)),
        "saturated": float(np.mean(saturated)),
    }
    return figures, np.array(features), np.array(episode_of)


def recognition(features: dict[str, Array], episode_of: Array) -> dict[str, float]:
    """Share of frames of odd episodes that lie nearest to the centroid of their own weather in even episodes."""
    train = episode_of % 2 == 0
    spread = np.sqrt(np.mean([values[train].var(axis=0) for values in features.values()], axis=0)) + 1e-3
    centroids = np.array([values[train].mean(axis=0) for values in features.values()]) / spread
    recognised = {}
    for number, (weather, values) in enumerate(features.items()):
        distance = np.linalg.norm(values[~train][:, None] / spread - centroids, axis=-1)
        recognised[weather] = float((distance.argmin(axis=1) == number).mean())
    return recognised


def run(episodes: int, steps: int, image_size: int) -> list[dict[str, Any]]:
    """One row per weather."""
    measured = {weather: measure(weather, episodes, steps, image_size) for weather in WEATHERS}
    episode_of = next(iter(measured.values()))[2]
    by_all = recognition({weather: features for weather, (_, features, _) in measured.items()}, episode_of)
    by_rgb = recognition({weather: features[:, :-2] for weather, (_, features, _) in measured.items()}, episode_of)
    rows = []
    for weather, (figures, _, _) in measured.items():
        noon = measured[weather.replace("Night", "Noon")][0]
        rows.append(
            {
                "weather": weather,
                "rgb_contrast": figures["rgb_contrast"],
                "rgb_vs_noon": figures["rgb_contrast"] / noon["rgb_contrast"],
                "events_per_pixel": figures["events_per_pixel"],
                "events_vs_noon": figures["events_per_pixel"] / noon["events_per_pixel"],
                "event_noise": figures["event_noise"],
                "rgb_noise": figures["rgb_noise"],
                "saturated": figures["saturated"],
                "recognised": by_all[weather],
                "recognised_rgb": by_rgb[weather],
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="Car-pixel contrast and events per car pixel in each weather.")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "weather_contrast.csv")
    arguments = parser.parse_args()
    rows = run(arguments.episodes, arguments.steps, arguments.image_size)
    print(" ".join(f"{name:>16}" for name in rows[0]))
    for row in rows:
        print(" ".join(f"{value:>16}" if isinstance(value, str) else f"{value:16.3f}" for value in row.values()))
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    with arguments.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: v if isinstance(v, str) else round(v, 4) for k, v in row.items()} for row in rows)


if __name__ == "__main__":
    main()
