"""Measure how far a trained model drives when one of its sensors fails for whole episodes.

    python -m sb3_have.train --config have-50k --out runs/have-0         # trains a model
    python -m benchmarks.failures runs/have-0/model.zip --config have-50k

Each of rgb, event and depth fails in every way that it can, at one severity, outside the configuration's own
``env_wrapper``. All cases have the same episodes, in all weathers. Each row is appended to the CSV file when it is
complete, and the same command resumes. Columns: ``modality, kind, severity`` ("none" without a failure),
``distance_mean``, ``distance_std`` [m] and ``return_mean`` over the ``episodes``, ``kept`` (the distance divided by the
one without a failure), ``crash_share`` and ``offroad_share``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch as th
from gymnasium import spaces

from benchmarks.measure import RESULTS, machine
from sb3_have import HAVESAC
from sb3_have.configuration import Env, env_wrapper, evaluation_env_kwargs, load_config
from sb3_have.envs.weather import WEATHERS
from sb3_have.evaluation import evaluate_episodes
from sb3_have.sensors import SENSORS, SensorFailure, failures_for

NONE = ("none", "none", 0)
Case = tuple[str, str, int]


def cases(space: spaces.Space[Any], severity: int) -> Iterator[Case]:
    """No failure, then every modality called rgb, event or depth with every kind of failure that it has."""
    assert isinstance(space, spaces.Dict)
    yield NONE
    for modality in space.spaces:
        if modality in SENSORS:
            for kind in failures_for(modality):
                yield modality, kind, severity


def wrapped(env: Env, inner: Callable[[Env], Env] | None, case: Case) -> Env:
    """The environment of the training, with a failing sensor outside its wrappers."""
    env = env if inner is None else inner(env)
    modality, kind, severity = case
    return env if case == NONE else SensorFailure(env, modality, kind, severity)


def drive(
    model: Any,
    env_id: str,
    case: Case,
    n_episodes: int,
    seed: int,
    inner: Callable[[Env], Env] | None = None,
    **kwargs: Any,
) -> dict[str, Any]:
    """Drive one row of the table.

    :param model: The model
    :param env_id: Id of its environment
    :param case: Modality, kind and severity
    :param n_episodes: Episodes in each weather
    :param seed: Seed of the episodes
    :param inner: Wrapper of the training, see :func:`~sb3_have.configuration.env_wrapper`
    :param kwargs: Further keywords of :func:`~sb3_have.evaluation.evaluation.evaluate_episodes`
    """
    modality, kind, severity = case
    wrapper = partial(wrapped, inner=inner, case=case)
    episodes = evaluate_episodes(model, env_id, WEATHERS, n_episodes, seed, env_wrapper=wrapper, **kwargs)
    return {
        "modality": modality,
        "kind": kind,
        "severity": severity,
        "distance_mean": episodes["distance"].mean(),
        "distance_std": episodes["distance"].std(ddof=0),
        "return_mean": episodes["return"].mean(),
        "crash_share": episodes["crashed"].mean(),
        "offroad_share": episodes["offroad"].mean(),
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("model", type=Path, help="zip file of a HAVESAC model")
    parser.add_argument("--config", default="have-50k", help="configuration of its training")
    parser.add_argument("--env", default="HighwayVision-v0")
    parser.add_argument("--severity", type=int, default=3, choices=(1, 2, 3))
    parser.add_argument("--episodes", type=int, default=2, help="episodes in each weather")
    parser.add_argument("--seed", type=int, default=0, help="seed of the episodes")
    parser.add_argument("--envs", type=int, default=16, help="number of environments")
    parser.add_argument("--out", type=Path, default=RESULTS / "failures.csv")
    args = parser.parse_args(arguments)

    th.set_num_threads(1)
    model = HAVESAC.load(args.model, device="cpu")
    config = load_config(args.config, args.env)
    kwargs: dict[str, Any] = {"env_kwargs": evaluation_env_kwargs(config), "n_envs": args.envs}
    of_run = {"model": str(args.model), "training_seed": model.seed, "training_steps": model.num_timesteps}
    of_run |= {"config": args.config, "env": args.env, "seed": args.seed, "episodes": args.episodes * len(WEATHERS)}
    done = pd.DataFrame(columns=["modality", "kind", "severity", *of_run])
    if args.out.exists():
        done = pd.read_csv(args.out, keep_default_na=False)
        if (done[list(of_run)] != list(of_run.values())).any(axis=None):
            raise SystemExit(f"{args.out} has rows of another run than {of_run}: choose another --out, or remove it")
    finished = set(zip(done["modality"], done["kind"], done["severity"], strict=True))
    for case in cases(model.observation_space, args.severity):
        if case in finished:
            continue
        row = drive(model, args.env, case, args.episodes, args.seed, env_wrapper(config), **kwargs)
        healthy = row if case == NONE else done[done["kind"] == "none"].iloc[0]
        row["kept"] = row["distance_mean"] / healthy["distance_mean"]
        row |= of_run | machine()
        frame = pd.DataFrame([row]).round(3)
        frame.to_csv(args.out, mode="a", header=not args.out.exists(), index=False)
        done = pd.concat([done, frame]) if len(done) else frame
        print(
            f"{case[0]:6} {case[1]:16} {row['distance_mean']:6.0f} m, {row['kept']:.2f} of that without a failure",
            flush=True,
        )


if __name__ == "__main__":
    main()
