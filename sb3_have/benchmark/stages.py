"""What is done with one run: trained, driven in every weather, asked for its weights, and with sensors that fail.

All of it goes into the run's folder, step by step and each step whole, so that a run which dies goes on where it was:

    monitor.csv, evaluation.csv, checkpoint-<step>, model.zip    of :class:`sb3_have.train.Run`
    final-<steps>/training.json                                   the training is over; what it took
    final-<steps>/episodes.csv, weights.csv, failures.csv         each in one go
"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
from collections import deque
from collections.abc import Sequence
from functools import partial
from itertools import count, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_have import HAVESAC
from sb3_have.algorithms import ALGORITHMS
from sb3_have.benchmark.grid import Failures, Job
from sb3_have.benchmark.machine import machine
from sb3_have.benchmark.reading import FILES
from sb3_have.benchmark.results import difference, read_text_table, settings_column
from sb3_have.checkpoint.checkpoint import checkpoint_step, checkpoints
from sb3_have.checkpoint.files import locked, write_atomically
from sb3_have.configuration import Env, env_wrapper, evaluation_env_kwargs
from sb3_have.evaluation.episodes import EpisodeQueue, Task, match_observations
from sb3_have.evaluation.evaluation import drive_tasks, episode_tasks, summarize
from sb3_have.sensors import SENSORS, SensorFailure, failures_for
from sb3_have.train import Run

DIGITS = 4
LOCK_SECONDS = 60.0
"""How long to wait for a process that is just dying."""

KEY = ["method", "seed"]
HEALTHY = {"modality": "none", "kind": "none", "severity": 0}


def run_job(job: Job, runs: Path, device: str = "cpu", keep_checkpoint: bool = False) -> bool:
    """Do what is still to be done of a run.

    :param job: the run
    :param runs: folder of the runs' folders
    :param device: of the model
    :param keep_checkpoint: whether the replay buffer stays, so that a grid of more steps can go on from here
    :return: whether it is finished; False if it was asked to stop while it trained
    """
    folder = runs / job.name
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder, LOCK_SECONDS):
        model = trained(job, folder, device)
        if model is None:
            return False
        if not keep_checkpoint:
            _drop_checkpoints(folder)
        drive_finally(job, model, folder)
        if has_weights(model):
            watch_weights(job, model, folder)
        if job.grid.failures is not None:
            break_sensors(job, model, folder, job.grid.failures)
    return True


def final_folder(job: Job, folder: Path) -> Path:
    """Where a run keeps what it did after its training."""
    return folder / f"final-{job.grid.steps}"


def trained(job: Job, folder: Path, device: str) -> OffPolicyAlgorithm | None:
    """The trained model, from where the training was; None if it was stopped."""
    record = final_folder(job, folder) / "training.json"
    if record.exists():
        return _reload(job, folder, json.loads(record.read_text()), device)
    grid = job.grid
    run = Run(
        job.config,
        grid.env,
        folder,
        seed=job.seed,
        algo=job.algo,
        eval_freq=grid.eval_freq,
        eval_episodes=grid.eval_episodes,
        eval_envs=grid.eval_envs,
        weathers=grid.weathers,
        save_freq=grid.save_freq,
        device=device,
    )
    model = run.train(grid.steps)
    if run.interrupted or model.num_timesteps < grid.steps:
        return None
    if model.num_timesteps - grid.steps >= job.config.get("n_envs", 1) * _rollout(job.config):
        raise ValueError(
            f"{folder} has been trained to step {model.num_timesteps}, past the {grid.steps} at which it should be "
            "driven; choose another --runs"
        )
    record.parent.mkdir(exist_ok=True)
    told = {"settings": job.settings, "steps": model.num_timesteps, "minutes": round(run.seconds / 60, 2)}
    told |= {"parameters": n_parameters(model), **machine(device)}
    write_atomically(record, partial(Path.write_text, data=json.dumps(told, indent=1)))
    return model


def _rollout(config: dict[str, Any]) -> float:
    """Steps of each environment from one update to the next: a stopped training goes on with whole rollouts."""
    train_freq = config.get("train_freq", 1)
    frequency, unit = (train_freq, "step") if isinstance(train_freq, int) else train_freq
    return frequency if unit == "step" else math.inf


def _reload(job: Job, folder: Path, record: dict[str, Any], device: str) -> OffPolicyAlgorithm:
    if told := difference(record["settings"], job.settings):
        raise ValueError(f"{folder} is of a run with other settings ({told}); choose another --runs, or remove it")
    model = ALGORITHMS[job.algo].load(folder / "model.zip", device=device)
    if model.num_timesteps != record["steps"]:
        raise ValueError(
            f"{folder / 'model.zip'} has gone on to step {model.num_timesteps} from step {record['steps']}, "
            "at which it should be driven; choose another --runs"
        )
    return model


def _drop_checkpoints(folder: Path) -> None:
    for remains in folder.glob("checkpoint*"):
        if remains.is_dir():  # of an older form
            shutil.rmtree(remains)
        else:
            remains.unlink()


def n_parameters(model: OffPolicyAlgorithm) -> int:
    """Numbers that the training changes by gradients, in actor, critic and all that belongs to them.

    Target networks are left out, and heads of auxiliary losses that are off: a policy has DeepMDP's in any case.
    """
    left_out = ["critic_target."]
    if isinstance(model, HAVESAC):
        heads: dict[str, Any] = dict(model.policy.auxiliary.items())
        trained = model.auxiliary_coefs.keys()
        left_out += [f"auxiliary.{name}." for name, head in heads.items() if trained.isdisjoint(head.terms)]
    return sum(
        parameter.numel()
        for name, parameter in model.policy.named_parameters()
        if parameter.requires_grad and not name.startswith(tuple(left_out))
    )


def has_weights(model: OffPolicyAlgorithm) -> bool:
    """Whether a model weighs its modalities."""
    return isinstance(model, HAVESAC) and model.critic.value_estimation != "gve"


def drive_finally(job: Job, model: OffPolicyAlgorithm, folder: Path) -> None:
    """Deterministic episodes in each weather: ``episodes.csv``."""
    grid, path = job.grid, final_folder(job, folder) / "episodes.csv"
    missing = [w for w in grid.weathers if len(_rows_of(path, weather=w)) != grid.final_episodes]
    if missing:
        tasks = episode_tasks(missing, grid.final_episodes, grid.final_seed, partial(_wrapped, config=job.config))
        tasks.sort(key=lambda task: missing.index(task.weather))
        _replace(path, _drive(job, model, tasks), [{"weather": weather} for weather in missing])


def _drive(job: Job, model: OffPolicyAlgorithm, tasks: Sequence[Task]) -> pd.DataFrame:
    """Episodes as rows of ``episodes.csv``, in the order of the tasks."""
    grid = job.grid
    episodes = drive_tasks(model, grid.env, tasks, evaluation_env_kwargs(job.config), grid.eval_envs)
    for column in ("crashed", "offroad"):
        episodes[column] = episodes[column].map({0.0: False, 1.0: True})  # NaN stays
    return episodes.rename(columns={"seed": "episode_seed"}).round({"return": DIGITS, "distance": DIGITS})


def _wrapped(env: Env, config: dict[str, Any], failure: dict[str, Any] | None = None) -> Env:
    """As in training, a failing sensor outermost."""
    inner = env_wrapper(config)
    env = env if inner is None else inner(env)
    return env if failure is None else SensorFailure(env, **failure)


def watch_weights(job: Job, model: OffPolicyAlgorithm, folder: Path) -> None:
    """The modalities' weights at each step of the first final episode in each weather: ``weights.csv``."""
    path = final_folder(job, folder) / "weights.csv"
    missing = [weather for weather in job.grid.weathers if not len(_rows_of(path, weather=weather))]
    wrapper, tasks = partial(_wrapped, config=job.config), []
    for weather in missing:
        seed = int(_rows_of(path.with_name("episodes.csv"), weather=weather)["episode_seed"].iloc[0])
        tasks.append(Task(weather, seed, wrapper))
    for start in range(0, len(tasks), job.grid.eval_envs):
        rows = weights_of_episodes(job, model, tasks[start : start + job.grid.eval_envs])
        _replace(path, rows, [{"weather": weather} for weather in missing[start : start + job.grid.eval_envs]])


def weights_of_episodes(job: Job, model: Any, tasks: Sequence[Task]) -> pd.DataFrame:
    """A row per episode, step and modality: its weight before the action, and the return up to there."""
    env_kwargs = evaluation_env_kwargs(job.config)
    makers: list[Any] = [partial(EpisodeQueue, job.grid.env, deque([(0, task)]), env_kwargs) for task in tasks]
    env = match_observations(DummyVecEnv(makers), model)
    rows, so_far, driving = [], np.zeros(len(tasks)), np.ones(len(tasks), bool)
    try:
        observations = env.reset()
        for t in count():
            weights = model.modality_weights(observations)
            for i, (modality, weight) in product(np.flatnonzero(driving).tolist(), weights.items()):
                told = {"weight": float(weight[i]), "return_so_far": so_far[i]}
                named = {"weather": tasks[i].weather, "episode_seed": tasks[i].seed}
                rows.append({**named, "t": t, "modality": modality, **told})
            actions, _ = model.predict(observations, deterministic=True)
            observations, rewards, dones, _ = env.step(actions)
            so_far += rewards
            driving &= ~dones
            if not driving.any():
                break
    finally:
        env.close()
    return pd.DataFrame(rows).round(DIGITS)


def break_sensors(job: Job, model: OffPolicyAlgorithm, folder: Path, failures: Failures) -> None:
    """Each modality failing in each way for whole episodes, beside the healthy ones: ``failures.csv``."""
    path, n_episodes = final_folder(job, folder) / "failures.csv", failures.episodes
    missing = []
    for weather, case in product(job.grid.weathers, failure_cases(model, failures)):
        done = _rows_of(path, weather=weather, **case)
        if not len(done) or int(done["episodes"].iloc[0]) != n_episodes:
            missing.append((weather, case))
    tasks: list[Task] = []
    for weather, case in missing:
        if case != HEALTHY:
            wrapper = partial(_wrapped, config=job.config, failure=case)
            tasks += episode_tasks([weather], n_episodes, job.grid.final_seed, wrapper)
    driven, rows = _drive(job, model, tasks) if tasks else pd.DataFrame(), []
    for weather, case in missing:
        if case == HEALTHY:
            episodes = _typed(_rows_of(path.with_name("episodes.csv"), weather=weather)).head(n_episodes)
        else:
            episodes, driven = driven.head(n_episodes), driven.iloc[n_episodes:]
        rows.append({**case, **_summary(episodes).iloc[0]})
    if missing:
        _replace(path, pd.DataFrame(rows), [{"weather": weather, **case} for weather, case in missing])


def failure_cases(model: OffPolicyAlgorithm, failures: Failures) -> list[dict[str, Any]]:
    """The healthy car, then every modality with every kind of failure it knows."""
    modalities = [name for name in getattr(model.observation_space, "spaces", {}) if name in SENSORS]
    return [HEALTHY] + [
        {"modality": modality, "kind": kind, "severity": failures.severity}
        for modality in modalities
        for kind in failures.kinds
        if kind in failures_for(modality)
    ]


def _summary(episodes: pd.DataFrame) -> pd.DataFrame:
    columns = ["weather", "return_mean", "return_std", "distance_mean", "distance_std", "episodes"]
    return summarize(episodes)[columns].round(DIGITS)


def collect(job: Job, folder: Path) -> dict[str, pd.DataFrame]:
    """All rows of a finished run, by the names and in the columns of the results.

    :param job: the run
    :param folder: of it
    """
    final, steps = final_folder(job, folder), job.grid.steps
    record = json.loads((final / "training.json").read_text())
    episodes = _in_order(read_text_table(final / "episodes.csv"), job)
    last = _summary(_typed(episodes)).assign(step=steps)
    curve = folder / "evaluation.csv"
    rows = [_earlier(pd.read_csv(curve), steps, job.grid.weathers)] if curve.exists() else []
    tables = {
        "evaluations": pd.concat([*rows, last]) if rows and len(rows[0]) else last,
        "final": last,
        "episodes": episodes,
        "runs": pd.DataFrame([{**record, "steps": steps, "settings": settings_column(job)}]),
    }
    if (path := final / "weights.csv").exists():
        tables["weights"] = _in_order(read_text_table(path), job)
    if job.grid.failures is not None:
        broken, failures = _in_order(read_text_table(final / "failures.csv"), job), job.grid.failures
        asked = broken["kind"].isin(failures.kinds) & (broken["severity"] == str(failures.severity))
        tables["failures"] = broken[asked | (broken["kind"] == HEALTHY["kind"])]
    return {
        name: frame.assign(method=job.method, seed=job.seed)[[*FILES[name].columns]] for name, frame in tables.items()
    }


def _earlier(curve: pd.DataFrame, steps: int, weathers: Sequence[str]) -> pd.DataFrame:
    """The learning curve but for its last point, of which the final evaluation knows more."""
    numbers = dict.fromkeys(("return_mean", "return_std", "distance_mean", "distance_std"), DIGITS)
    return curve[(curve["step"] < steps) & curve["weather"].isin(weathers)].round(numbers)


def _in_order(rows: pd.DataFrame, job: Job) -> pd.DataFrame:
    """Rows of the grid's weathers, in its order."""
    parts = [rows[rows["weather"] == weather] for weather in job.grid.weathers]
    return pd.concat(parts)


def _typed(episodes: pd.DataFrame) -> pd.DataFrame:
    """Text of ``episodes.csv`` as numbers."""
    numbers = episodes.replace({"True": "1", "False": "0", "": "nan"})
    columns = ["return", "distance", "steps", "crashed", "offroad"]
    return numbers.astype(dict.fromkeys(columns, float))


def _rows_of(path: Path, **key: Any) -> pd.DataFrame:
    """Rows of a stage's file with the given values, as text."""
    if not path.exists():
        return pd.DataFrame()
    rows = read_text_table(path)
    return rows[_matches(rows, key)]


def _matches(rows: pd.DataFrame, key: dict[str, Any]) -> pd.Series[bool]:
    matches = pd.Series(True, index=rows.index)
    for column, value in key.items():
        matches &= rows[column] == str(value)
    return matches


def _replace(path: Path, rows: pd.DataFrame, keys: Sequence[dict[str, Any]]) -> None:
    """Put rows in place of those with the values of one of the keys."""
    if path.exists():
        old = read_text_table(path)
        for key in keys:
            old = old[~_matches(old, key)]
        rows = pd.concat([old, rows])
    write_atomically(path, partial(rows.to_csv, index=False))


def steps_done(folder: Path) -> int:
    """Training steps of a run so far, as its folder tells: those of finished episodes and of the newest checkpoint."""
    done = max(map(checkpoint_step, checkpoints(folder)), default=0)
    lived = 0
    for path in folder.glob("*monitor.csv"):
        with contextlib.suppress(OSError, ValueError, KeyError):  # just being written
            lived += int(pd.read_csv(path, skiprows=1)["l"].sum())
    return max(done, lived)
