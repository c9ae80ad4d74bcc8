"""Drive HighwayVision-v0 for many episodes in every weather and check every step.

    python -W error -m benchmarks.env_soak --episodes 100
    python -W error -m benchmarks.env_soak --episodes 10 --scenarios merge curves --driver idm

Fails on an exception, a warning (-W error), a number that is not finite or an observation outside of its space.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np

from benchmarks.rule_driven import RuleDrivenEnv
from sb3_have.envs import HighwayVisionEnv
from sb3_have.envs.road_shape import SCENARIOS
from sb3_have.envs.weather import WEATHERS


def soak(weather: str, episodes: int, image_size: int, seed: int, scenario: str = "highway", idm: bool = False) -> str:
    """Drive at random, or with highway-env's driver; returns what was seen in one line."""
    env = (RuleDrivenEnv if idm else HighwayVisionEnv)(weather=weather, image_size=image_size, scenario=scenario)
    env.action_space.seed(seed)
    distances, ends, steps = [], Counter[str](), 0
    start = time.perf_counter()
    for episode in range(episodes):
        observation, info = env.reset(seed=seed + episode)
        while info["end_reason"] is None:
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            steps += 1
            if not env.observation_space.contains(observation):
                raise AssertionError(f"{weather}, episode {episode}, step {steps}: observation outside of its space")
            if not np.isfinite([reward, info["distance"], info["speed"]]).all():
                raise AssertionError(f"{weather}, episode {episode}, step {steps}: {reward=} {info=}")
            if (info["end_reason"] is not None) != (terminated or truncated):
                raise AssertionError(f"{weather}, episode {episode}, step {steps}: {terminated=} {truncated=} {info=}")
        distances.append(info["distance"])
        ends[info["end_reason"]] += 1
    return (
        f"{scenario} {weather:13} {episodes} episodes, {steps} steps, "
        f"distance {np.mean(distances):.0f} +- {np.std(distances):.0f} m, "
        f"{dict(ends)}, {steps / (time.perf_counter() - start):.0f} steps/s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--weathers", nargs="+", choices=WEATHERS, default=list(WEATHERS))
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=["highway"])
    parser.add_argument("--driver", choices=["random", "idm"], default="random")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for scenario in args.scenarios:
        for weather in args.weathers:
            line = soak(weather, args.episodes, args.image_size, args.seed, scenario, args.driver == "idm")
            print(line, flush=True)


if __name__ == "__main__":
    main()
