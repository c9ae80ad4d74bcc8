"""Measure an evaluation by the number of environments that run at a time, all in one process.

    python -m benchmarks.evaluation_speed

An untrained HAVESAC drives the task of the driving benchmark (two cameras of 64 pixels, three stacked frames, "curves")
in eight weathers, with episodes of at most 40 steps. ``predict`` is one forward pass for as many observations. The
contenders take turns in one process. The script prints and writes to benchmarks/results/evaluation_speed.csv the median
and quartiles of the wall-clock time, and ``vs_one``, the median over the rounds of the ratio to the time with one
environment (for ``predict``, to the same number of passes for one observation).
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

import sb3_have
from benchmarks.measure import RESULTS, Row, interleave, machine, median_ratio, quartiles, save, show
from sb3_have import HAVESAC, evaluate
from sb3_have.envs.weather import WEATHERS

ENV_ID = "HighwayVision-v0"
ENV_KWARGS: dict[str, Any] = {"scenario": "curves", "image_size": 64, "modalities": ["rgb", "event"]}
N_ENVS = (1, 8, 16, 32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=4, help="episodes in each weather")
    parser.add_argument("--steps", type=int, default=40, help="maximum length of an episode")
    args = parser.parse_args()
    assert sb3_have.__version__  # importing the package registers the environment
    th.set_num_threads(1)
    env = VecFrameStack(DummyVecEnv([lambda: gym.make(ENV_ID, **ENV_KWARGS)]), 3)
    model = HAVESAC("MultiInputPolicy", env, buffer_size=10, seed=0, device="cpu")
    observation = env.reset()
    assert isinstance(observation, dict)
    batches = {n: {key: value.repeat(n, axis=0) for key, value in observation.items()} for n in N_ENVS}
    evaluation = partial(
        evaluate, model, ENV_ID, WEATHERS, args.episodes, env_kwargs={**ENV_KWARGS, "max_episode_steps": args.steps}
    )
    rows: list[Row] = []
    passes = interleave({n: partial(model.predict, batch, deterministic=True) for n, batch in batches.items()}, 20)
    evaluations = interleave({n: partial(evaluation, n_envs=n) for n in N_ENVS}, args.rounds, warm_up=0)
    for what, times in (("predict", passes), ("evaluate", evaluations)):
        for n, (wall, _) in times.items():
            one = times[1].wall * (n if what == "predict" else 1)
            rows.append(
                {"what": what, "n_envs": n, **quartiles(wall), "vs_one": round(median_ratio(wall, one), 3), **machine()}
            )
    save(rows, RESULTS / "evaluation_speed.csv", ("machine",))
    show(rows, ("what", "n_envs", "median_ms", "q25_ms", "q75_ms", "vs_one"))


if __name__ == "__main__":
    main()
