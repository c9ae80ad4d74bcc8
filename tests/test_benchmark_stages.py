"""A run of a benchmark: every stage once, and resumed where it was."""

import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from fake_drive import ENV_ID
from tiny_grid import FAILURES, TINY, make_grid, read

from sb3_have import HAVESAC
from sb3_have.benchmark import stages
from sb3_have.benchmark.grid import FINAL_SEED, Job
from sb3_have.benchmark.results import is_finished, merge
from sb3_have.benchmark.stages import collect, run_job
from sb3_have.checkpoint import newest_checkpoint
from sb3_have.evaluation import callback
from sb3_have.evaluation.callback import EVALUATION_SEED
from sb3_have.evaluation.episodes import Step, Task
from sb3_have.evaluation.evaluation import episode_tasks
from sb3_have.train import Run


def test_evaluation_seeds_are_not_those_of_training() -> None:
    assert FINAL_SEED != EVALUATION_SEED and min(FINAL_SEED, EVALUATION_SEED) > 100_000


def test_stages_resume_where_they_were(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each stage is driven as a whole, once; what another stage has is not driven again."""
    job = make_grid(tmp_path, failures=FAILURES).jobs()[1]
    driven: list[list[tuple[str, str | None]]] = []
    drive = stages._drive

    def counted(job: Job, model: Any, tasks: Sequence[Task], *args: Any) -> Any:
        if len(driven) == stop:
            raise KeyboardInterrupt
        failures = [task.env_wrapper.keywords.get("failure") or {} for task in tasks]  # type: ignore[union-attr]
        driven.append([(task.weather, case.get("kind")) for task, case in zip(tasks, failures, strict=True)])
        return drive(job, model, tasks, *args)

    monkeypatch.setattr(stages, "_drive", counted)
    for stop in (0, 1):  # noqa: B007 (the function above reads it)
        with pytest.raises(KeyboardInterrupt):
            run_job(job, tmp_path)
    stop = 99
    assert run_job(job, tmp_path)
    whole = [("slow", None)] * 3 + [("fast", None)] * 3
    broken = [(weather, kind) for weather in ("slow", "fast") for kind in ("black", "black", "overexposure")]
    assert driven == [whole, [case for case in broken for _ in range(2)]]
    assert run_job(job, tmp_path) and len(driven) == 2
    # Other questions are answered by the same model
    more = make_grid(tmp_path, failures={**FAILURES, "kinds": ["black"]}, final_episodes=4).jobs()[1]
    assert run_job(more, tmp_path) and [len(tasks) for tasks in driven[2:]] == [8, 8]


def test_stages_do_not_depend_on_the_number_of_environments(tmp_path: Path) -> None:
    """The returns depend on the actions, which differ under each failure."""
    files = {}
    for eval_envs in (1, 5):
        job = make_grid(tmp_path, failures=FAILURES, eval_envs=eval_envs).jobs()[1]
        assert run_job(job, tmp_path / str(eval_envs))
        final = tmp_path / str(eval_envs) / job.name / "final-30"
        tables = {name: pd.read_csv(final / f"{name}.csv") for name in ("episodes", "weights", "failures")}
        order = ["weather", "episode_seed", "t", "modality", "kind"]
        files[eval_envs] = {
            name: table.sort_values([c for c in order if c in table], ignore_index=True)
            for name, table in tables.items()
        }
    for name, table in files[1].items():
        pd.testing.assert_frame_equal(table, files[5][name], atol=2e-4)
    assert files[1]["failures"]["return_mean"].nunique() == 8


def test_weights_belong_to_their_episode() -> None:
    """The first environment drives another episode, the third none, and the fourth is between two rows."""

    class Model:
        def modality_weights(self, observations: np.ndarray) -> dict[str, np.ndarray]:
            return {"rgb": observations, "depth": 1 - observations}

    tasks = [Task("slow", 1), Task("slow", 2), Task("fast", 3), Task("fast", 4)]
    numbers, t, returns = [1, 2, None, 0], np.array([5, 5, 5, 6]), np.array([2.0, 1.5, 3.0, 4.0])
    nothing: Any = []
    step = Step(numbers, t, returns, np.array([0.5, 0.25, 0.5, 0.5]), *[nothing] * 5)
    rows: list[dict[str, Any]] = []
    stages._record_weights(Model(), tasks, range(0, 4, 2), rows, step)
    key = {"weather": "fast", "episode_seed": 3, "t": 5, "return_so_far": 1.5}
    assert rows == [{**key, "modality": "rgb", "weight": 0.25}, {**key, "modality": "depth", "weight": 0.75}]


def test_failures_may_be_added_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs, results = tmp_path / "runs", tmp_path / "results"
    job = make_grid(tmp_path).jobs()[0]
    assert run_job(job, runs)
    merge(results, job, collect(job, runs / job.name))
    assert is_finished(results, job) and not (results / "failures.csv").exists()

    later = make_grid(tmp_path, failures=FAILURES).jobs()[0]
    assert not is_finished(results, later)
    monkeypatch.setattr(Run, "train", lambda *args: pytest.fail("the model is trained already"))
    assert run_job(later, runs)
    merge(results, later, collect(later, runs / job.name))
    assert is_finished(results, later) and is_finished(results, job)
    assert len(read(results, "failures")) == 8


def test_run_begun_by_train_is_resumed(tmp_path: Path) -> None:
    job = make_grid(tmp_path, save_freq=0).jobs()[0]
    config = {**TINY, "value_estimation": "gve", "n_timesteps": 7}
    options: dict[str, Any] = {"eval_freq": 10, "eval_episodes": 1, "weathers": ("slow", "fast"), "save_freq": 0}
    plain = Run(config, ENV_ID, tmp_path / job.name, seed=0, **options)
    plain.train(12)
    assert run_job(job, tmp_path)
    minutes = float(collect(job, tmp_path / job.name)["runs"]["minutes"].iloc[0])
    assert [path.name for path in (tmp_path / job.name).glob("log-*")] != []
    assert sorted(path.name for path in (tmp_path / job.name).glob("log-*")) == ["log-0", "log-12"]
    assert minutes >= round(plain.seconds / 60, 2)


def test_checkpoint_stays_only_if_asked_for(tmp_path: Path) -> None:
    short, long = make_grid(tmp_path).jobs()[0], make_grid(tmp_path, steps=40).jobs()[0]
    folder = tmp_path / short.name
    assert run_job(short, tmp_path, keep_checkpoint=True)
    assert newest_checkpoint(folder) == folder / "checkpoint-30"
    assert run_job(long, tmp_path)
    assert newest_checkpoint(folder) is None
    assert {path.name for path in folder.glob("log-*")} == {"log-0", "log-30"}
    with pytest.raises(ValueError, match="was trained to step 40, beyond the 30"):
        run_job(short, tmp_path)
    with pytest.raises(ValueError, match="no checkpoint to resume from"):
        run_job(make_grid(tmp_path, steps=50).jobs()[0], tmp_path)


def test_training_past_the_grid_is_refused(tmp_path: Path) -> None:
    job = make_grid(tmp_path).jobs()[0]
    run = Run(job.config, ENV_ID, tmp_path / job.name, eval_freq=0)
    run.train(31)
    with pytest.raises(ValueError, match="trained to step 31, past the 30"):
        run_job(job, tmp_path)
    assert not (tmp_path / job.name / "final-30").exists()


def test_training_may_end_a_rollout_late(tmp_path: Path) -> None:
    """As after a stop at an odd step, with an update every second step."""
    job = make_grid(tmp_path, {"train_freq": 2}).jobs()[0]
    run = Run(job.config, ENV_ID, tmp_path / job.name, eval_freq=0)
    run.train(1)  # two steps, as rollouts are whole
    assert run_job(make_grid(tmp_path, {"train_freq": 2}, steps=31).jobs()[0], tmp_path)
    assert newest_checkpoint(tmp_path / job.name) is None
    assert (tmp_path / job.name / "final-31" / "episodes.csv").exists()


def test_stop_in_the_last_evaluation_is_a_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_grid(tmp_path, eval_freq=30).jobs()[0]
    with monkeypatch.context() as patch:
        patch.setattr(callback, "evaluate", lambda *args, **kwargs: os.kill(os.getpid(), signal.SIGINT))
        assert not run_job(job, tmp_path)
    assert newest_checkpoint(tmp_path / job.name) == tmp_path / job.name / "checkpoint-30"
    assert run_job(job, tmp_path)


def test_unfinished_checkpoint_is_removed(tmp_path: Path) -> None:
    job = make_grid(tmp_path).jobs()[0]
    assert run_job(job, tmp_path, keep_checkpoint=True)
    (tmp_path / job.name / "checkpoint-40.partial").touch()
    assert run_job(job, tmp_path)
    assert not [*(tmp_path / job.name).glob("checkpoint*")]


def test_parameters_are_those_that_are_trained() -> None:
    """DeepMDP's heads count only if that loss is on."""
    kwargs: dict[str, Any] = {"policy_kwargs": TINY["policy_kwargs"], "buffer_size": 10}
    sac, deepmdp = (HAVESAC("MultiInputPolicy", gym.make(ENV_ID), auxiliary=a, **kwargs) for a in (None, "deepmdp"))
    heads = sum(parameter.numel() for parameter in deepmdp.policy.auxiliary.parameters())
    assert heads > 0 and stages.n_parameters(sac) == stages.n_parameters(deepmdp) - heads
    trained = [*deepmdp.critic.parameters(), *deepmdp.actor.parameters(), *deepmdp.policy.auxiliary.parameters()]
    assert stages.n_parameters(deepmdp) == sum(parameter.numel() for parameter in trained)


def test_final_seed_of_a_grid(tmp_path: Path) -> None:
    """A search has other episodes than the tables, and its runs are not mistaken for theirs."""
    ours, theirs = make_grid(tmp_path, final_seed=7).jobs()[0], make_grid(tmp_path).jobs()[0]
    run_job(ours, tmp_path / "runs")
    episodes = pd.read_csv(tmp_path / "runs" / ours.name / "final-30" / "episodes.csv")
    assert set(episodes["episode_seed"]) == {task.seed for task in episode_tasks(["slow", "fast"], 3, seed=7)}
    with pytest.raises(ValueError, match="final_seed"):
        run_job(theirs, tmp_path / "runs")
