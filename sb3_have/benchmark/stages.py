"""
One run of a benchmark: train, drive the final episodes in each weather, and drive them again with failing sensors.

Each stage leaves complete files in the run's folder, so that a run that dies resumes where it was:

    monitor.csv, evaluation.csv, checkpoint-<step>, model.zip    from :class:`sb3_have.train.Run`
    final-<steps>/training.json                                  the training is over, and what it took
    final-<steps>/weights.csv, episodes.csv                      the final episodes
    final-<steps>/failures.csv                                   the episodes with failing sensors
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from stable_baselines3.common.monitor import LoadMonitorResultsError, load_results
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_have.algorithms import ALGORITHMS
from sb3_have.benchmark.grid import Failures, Job
from sb3_have.benchmark.provenance import machine
from sb3_have.benchmark.reading import FILES
from sb3_have.benchmark.results import difference, read_text_table, settings_column
from sb3_have.checkpoint.files import locked, write_atomically
from sb3_have.configuration import env_wrapper, evaluation_env_kwargs
from sb3_have.evaluation.episodes import Env, Step, Task
from sb3_have.evaluation.evaluation import drive_tasks, episode_tasks, summarize
from sb3_have.evaluation.recording import weighing
from sb3_have.sensors import SENSORS, SensorFailure, failures_for
from sb3_have.train import Run

# Decimals in the results
DIGITS = 4
# Steps between the rows of weights.csv
WEIGHTS_FREQ = 5
# How long to wait for a process that is about to die [s]
LOCK_SECONDS = 60.0

HEALTHY = {"modality": "none", "kind": "none", "severity": 0}


def run_job(job: Job, runs: Path, device: str = "cpu", keep_checkpoint: bool = False) -> bool:
    """
    Do what remains of a run.

    :param job: The run
    :param runs: Folder of the runs' folders
    :param device: Device of the model
    :param keep_checkpoint: Whether to keep the checkpoints, so that a grid of more steps can continue the training
    :return: Whether the run is finished; False if its training was stopped
    """
    folder = runs / job.name
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder, LOCK_SECONDS):
        model = trained(job, folder, device)
        if model is None:
            return False
        if not keep_checkpoint:
            for path in folder.glob("checkpoint*"):
                path.unlink()
        drive_finally(job, model, folder)
        if job.grid.failures is not None:
            break_sensors(job, model, folder, job.grid.failures)
    return True


def final_folder(job: Job, folder: Path) -> Path:
    """Return the folder of what follows the training."""
    return folder / f"final-{job.grid.steps}"


def trained(job: Job, folder: Path, device: str) -> OffPolicyAlgorithm | None:
    """
    Train the model, or resume or load it; None if the training was stopped.

    :raises ValueError: If the folder is of a run with other settings, or was trained past the grid's steps
    """
    record, grid = final_folder(job, folder) / "training.json", job.grid
    if record.exists():
        return _load(job, folder, json.loads(record.read_text()), device)
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
    # A training ends with a whole rollout, at most one after the last step
    if model.num_timesteps - grid.steps >= job.config.get("n_envs", 1) * _rollout_length(job.config):
        raise ValueError(
            f"{folder} has been trained to step {model.num_timesteps}, past the {grid.steps} steps of the grid; "
            "choose another --runs"
        )
    record.parent.mkdir(exist_ok=True)
    row = {"settings": job.settings, "steps": model.num_timesteps, "minutes": round(run.seconds / 60, 2)}
    row |= {"parameters": n_parameters(model), **machine(device)}
    write_atomically(record, partial(Path.write_text, data=json.dumps(row, indent=1)))
    return model


def _rollout_length(config: dict[str, Any]) -> float:
    """Return the steps of each environment between two updates."""
    train_freq = config.get("train_freq", 1)
    frequency, unit = (train_freq, "step") if isinstance(train_freq, int) else train_freq
    return frequency if unit == "step" else math.inf


def _load(job: Job, folder: Path, record: dict[str, Any], device: str) -> OffPolicyAlgorithm:
    if differences := difference(record["settings"], job.settings):
        raise ValueError(f"{folder} is a run with other settings ({differences}); choose another --runs, or remove it")
    model = ALGORITHMS[job.algo].load(folder / "model.zip", device=device)
    if model.num_timesteps != record["steps"]:
        raise ValueError(
            f"{folder / 'model.zip'} was trained to step {model.num_timesteps}, beyond the {record['steps']} steps of "
            "the grid; choose another --runs"
        )
    return model


def n_parameters(model: OffPolicyAlgorithm) -> int:
    """
    Count the trained parameters, without those of target networks.

    :param model: The model
    """
    return sum(
        parameter.numel()
        for name, parameter in model.policy.named_parameters()
        if parameter.requires_grad and not name.startswith("critic_target.")
    )


def drive_finally(job: Job, model: OffPolicyAlgorithm, folder: Path) -> None:
    """Drive the final episodes (``episodes.csv``), with the weights in the first of each weather (``weights.csv``)."""
    grid, path = job.grid, final_folder(job, folder) / "episodes.csv"
    tasks = episode_tasks(grid.weathers, grid.final_episodes, grid.final_seed, partial(_wrapped, config=job.config))
    tasks.sort(key=lambda task: grid.weathers.index(task.weather))
    driven = read_text_table(path) if path.exists() else pd.DataFrame(columns=["weather", "episode_seed"])
    if [*zip(driven["weather"], driven["episode_seed"], strict=True)] == [(t.weather, str(t.seed)) for t in tasks]:
        return
    weights: list[dict[str, Any]] = []
    recorded = range(0, len(tasks), grid.final_episodes)
    on_step = None if weighing(model) is None else partial(_record_weights, model, tasks, recorded, weights)
    episodes = _drive(job, model, tasks, on_step)
    # Write the weights first: episodes.csv implies that they are there
    if weights:
        rows = pd.DataFrame(weights).sort_values(
            "weather", key=lambda names: names.map(grid.weathers.index), kind="stable"
        )
        write_atomically(path.with_name("weights.csv"), partial(rows.round(DIGITS).to_csv, index=False))
    write_atomically(path, partial(episodes.to_csv, index=False))


def _record_weights(model: Any, tasks: Sequence[Task], recorded: range, rows: list[dict[str, Any]], step: Step) -> None:
    """Add a row for each modality before every fifth action of the recorded tasks."""
    due = [
        (i, number)
        for i, number in enumerate(step.numbers)
        if number is not None and number in recorded and step.t[i] % WEIGHTS_FREQ == 0
    ]
    weights = model.modality_weights(step.observations) if due else {}
    for (i, number), (modality, weight) in product(due, weights.items()):
        row = {"weather": tasks[number].weather, "episode_seed": tasks[number].seed, "t": int(step.t[i])}
        rows.append({**row, "modality": modality, "weight": float(weight[i]), "return_so_far": step.returns[i]})


def _drive(
    job: Job, model: OffPolicyAlgorithm, tasks: Sequence[Task], on_step: Callable[[Step], None] | None = None
) -> pd.DataFrame:
    """Drive episodes, as rows of ``episodes.csv`` in the order of the tasks."""
    env_kwargs, n_envs = evaluation_env_kwargs(job.config), job.grid.eval_envs
    episodes = drive_tasks(model, job.grid.env, tasks, env_kwargs, n_envs, on_step=on_step)
    for column in ("crashed", "offroad"):
        # NaN stays
        episodes[column] = episodes[column].map({0.0: False, 1.0: True})
    return episodes.rename(columns={"seed": "episode_seed"}).round({"return": DIGITS, "distance": DIGITS})


def _wrapped(env: Env, config: dict[str, Any], failure: dict[str, Any] | None = None) -> Env:
    """Wrap an environment as in training, with a failing sensor outside."""
    inner = env_wrapper(config)
    env = env if inner is None else inner(env)
    return env if failure is None else SensorFailure(env, **failure)


def break_sensors(job: Job, model: OffPolicyAlgorithm, folder: Path, failures: Failures) -> None:
    """Drive the first final episodes with each modality failing in each way, and compare (``failures.csv``)."""
    path, n_episodes = final_folder(job, folder) / "failures.csv", failures.episodes
    cases = [(weather, case) for weather in job.grid.weathers for case in failure_cases(model, failures)]
    asked = [{"weather": weather, **case, "episodes": n_episodes} for weather, case in cases]
    if path.exists():
        done = read_text_table(path)[[*asked[0]]].to_dict("records")
        if done == [{key: str(value) for key, value in row.items()} for row in asked]:
            return
    tasks = [
        task
        for weather, case in cases
        if case != HEALTHY
        for task in episode_tasks(
            [weather], n_episodes, job.grid.final_seed, partial(_wrapped, config=job.config, failure=case)
        )
    ]
    driven = _drive(job, model, tasks) if tasks else pd.DataFrame()
    healthy, rows = _read_episodes(path.with_name("episodes.csv")), []
    for weather, case in cases:
        if case == HEALTHY:
            episodes = healthy[healthy["weather"] == weather].head(n_episodes)
        else:
            episodes, driven = driven.head(n_episodes), driven.iloc[n_episodes:]
        rows.append({**case, **_summary(episodes).iloc[0]})
    write_atomically(path, partial(pd.DataFrame(rows).to_csv, index=False))


def failure_cases(model: OffPolicyAlgorithm, failures: Failures) -> list[dict[str, Any]]:
    """List the cases: no failure, then every modality with every kind of failure that it has."""
    modalities = [name for name in getattr(model.observation_space, "spaces", {}) if name in SENSORS]
    return [HEALTHY] + [
        {"modality": modality, "kind": kind, "severity": failures.severity}
        for modality, kind in product(modalities, failures.kinds)
        if kind in failures_for(modality)
    ]


def _summary(episodes: pd.DataFrame) -> pd.DataFrame:
    columns = ["weather", "return_mean", "return_std", "distance_mean", "distance_std", "episodes"]
    return summarize(episodes)[columns].round(DIGITS)


def _read_episodes(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, dtype={"weather": str})


def collect(job: Job, folder: Path) -> dict[str, pd.DataFrame]:
    """
    Collect the rows of a finished run.

    :param job: The run
    :param folder: Its folder
    :return: Data frames by the names and with the columns of the results
    """
    final, grid = final_folder(job, folder), job.grid
    record = json.loads((final / "training.json").read_text())
    last = _summary(_read_episodes(final / "episodes.csv")).assign(step=grid.steps)
    evaluations = [last]
    if (path := folder / "evaluation.csv").exists():
        # The final evaluation replaces the last point of the learning curve
        curve = pd.read_csv(path)
        curve = curve[(curve["step"] < grid.steps) & curve["weather"].isin(grid.weathers)]
        evaluations = [frame.round(DIGITS) for frame in (curve, last) if len(frame)]
    tables = {
        "evaluations": pd.concat(evaluations),
        "final": last,
        "runs": pd.DataFrame([{**record, "steps": grid.steps, "settings": settings_column(job)}]),
    }
    for name in ("episodes", "weights", "failures"):
        if (path := final / f"{name}.csv").exists() and (name != "failures" or grid.failures is not None):
            tables[name] = read_text_table(path)
    return {
        name: frame.assign(method=job.method, seed=job.seed)[[*FILES[name].columns]] for name, frame in tables.items()
    }


def steps_done(folder: Path) -> int:
    """Count the training steps of a run in finished episodes."""
    # Another process may be writing the file
    with suppress(OSError, ValueError, KeyError, IndexError, AssertionError, LoadMonitorResultsError):
        return int(load_results(str(folder))["l"].sum())
    return 0
