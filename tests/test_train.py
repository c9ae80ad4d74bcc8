"""Training runs: resumed where they stopped, evaluations neither lost nor doubled, ended in good order."""

import fcntl
import multiprocessing
import os
import random
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from fake_drive import CONFIG, ENV_ID
from gymnasium import spaces
from resuming import assert_same, everything, leaves

import sb3_have
from sb3_have import train
from sb3_have.checkpoint import StopTrainingOnSignal, checkpoints, newest_checkpoint, save_checkpoint
from sb3_have.checkpoint.files import locked
from sb3_have.configuration import load_config, model_kwargs
from sb3_have.evaluation import callback, saved_normalizer
from sb3_have.train import Run, make_training_env


def make_run(out: Path, **kwargs: Any) -> Run:
    options = {"algo": "sac", "eval_freq": 10, "eval_episodes": 1, "weathers": ("slow", "fast"), "save_freq": 0}
    return Run(CONFIG, ENV_ID, out, **{**options, "device": "cpu", **kwargs})


@contextmanager
def acting_at(step: int, act: Callable[[], None]) -> Iterator[None]:
    """Call a function in a training step of all runs of a ``with`` block."""

    class Acting(StopTrainingOnSignal):
        def _on_step(self) -> bool:
            if self.num_timesteps == step:
                act()
            return super()._on_step()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "StopTrainingOnSignal", Acting)
        yield


def press_ctrl_c(times: int = 1) -> None:
    for _ in range(times):
        os.kill(os.getpid(), signal.SIGINT)


def die() -> None:
    raise MemoryError


def test_resumed_run_goes_on(tmp_path: Path) -> None:
    first = make_run(tmp_path).train(25)
    second_run = make_run(tmp_path)
    second = second_run.train(40)
    assert (first.num_timesteps, second.num_timesteps) == (25, 40)
    assert first.replay_buffer is not None and second.replay_buffer is not None
    assert second.replay_buffer.pos == 40
    assert (second.replay_buffer.actions[:25] == first.replay_buffer.actions[:25]).all()
    assert second._n_updates > first._n_updates > 0
    frame = pd.read_csv(tmp_path / "evaluation.csv")
    assert list(frame["step"]) == [10, 10, 20, 20, 30, 30, 40, 40]
    assert list(frame["weather"]) == ["slow", "fast"] * 4
    assert frame["wall_time"].is_monotonic_increasing
    assert {path.name for path in tmp_path.glob("checkpoint*")} == {"checkpoint-25", "checkpoint-40"}
    assert second_run.seconds > 0


def test_finished_run_is_not_touched(tmp_path: Path) -> None:
    before = make_run(tmp_path).train(12).policy.state_dict()
    after = make_run(tmp_path).train(12).policy.state_dict()
    assert all(th.equal(before[key], after[key]) for key in before)
    assert len(pd.read_csv(tmp_path / "evaluation.csv")) == 2


def test_records_after_the_checkpoint_are_dropped(tmp_path: Path) -> None:
    """As after a run was killed between two checkpoints."""
    with acting_at(35, die), pytest.raises(MemoryError):
        make_run(tmp_path, save_freq=20).train(40)
    assert list(pd.read_csv(tmp_path / "evaluation.csv")["step"]) == [10, 10, 20, 20, 30, 30]
    assert newest_checkpoint(tmp_path) == tmp_path / "checkpoint-20"
    make_run(tmp_path).train(40)
    assert list(pd.read_csv(tmp_path / "evaluation.csv")["step"]) == [10, 10, 20, 20, 30, 30, 40, 40]
    assert pd.read_csv(tmp_path / "monitor.csv", skiprows=1)["l"].sum() <= 40


def test_folder_of_another_run_is_refused(tmp_path: Path) -> None:
    make_run(tmp_path, eval_freq=0).train(8)
    with pytest.raises(ValueError, match="choose another folder"):
        make_run(tmp_path, seed=1).train(12)


def test_records_of_others_are_not_removed(tmp_path: Path) -> None:
    """Those of a run that was killed before its first checkpoint are."""
    for name in ("monitor.csv", "3.monitor.csv", "evaluation.csv"):
        others = tmp_path / name.removesuffix(".csv") / name
        others.parent.mkdir()
        others.write_text("of another program")
        with pytest.raises(ValueError, match=f"{name} was not written by this program; remove it, or choose another"):
            make_run(others.parent).train(8)
        assert others.read_text() == "of another program" and not (others.parent / "model.zip").exists()
    with acting_at(12, die), pytest.raises(MemoryError):
        make_run(tmp_path / "mine").train(12)
    make_run(tmp_path / "mine").train(12)
    assert len(pd.read_csv(tmp_path / "mine" / "evaluation.csv")) == 2


def test_incomplete_checkpoint_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "checkpoint-30.partial").touch()
    assert newest_checkpoint(tmp_path) is None
    make_run(tmp_path, eval_freq=0).train(8)
    assert [path.name for path in tmp_path.glob("checkpoint*")] == ["checkpoint-8"]


def outcome(run: Run, model: Any) -> dict[str, Any]:
    """Return everything that a run leaves, except for times."""
    evaluations = pd.read_csv(run.out / "evaluation.csv").drop(columns="wall_time")
    episodes = pd.read_csv(run.out / "monitor.csv", skiprows=1).drop(columns="t")
    return everything(model) | leaves({"evaluations": evaluations.to_numpy(), "episodes": episodes.to_numpy()})


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    run = make_run(tmp_path_factory.mktemp("uninterrupted"))
    return outcome(run, run.train(40))


@pytest.mark.parametrize("how", ["killed", "stopped", "stopped at once"])
def test_resumed_run_is_the_same(tmp_path: Path, uninterrupted: dict[str, Any], how: str) -> None:
    """Bit for bit, including evaluations."""
    run = make_run(tmp_path, save_freq=10)
    if how == "stopped":
        with acting_at(25, press_ctrl_c):
            run.train(40)
    else:
        act = die if how == "killed" else partial(press_ctrl_c, times=2)
        with acting_at(25, act), pytest.raises((MemoryError, KeyboardInterrupt)):
            run.train(40)
    assert run.interrupted == (how == "stopped")
    assert newest_checkpoint(tmp_path) == tmp_path / ("checkpoint-25" if how == "stopped" else "checkpoint-20")
    assert (tmp_path / "model.zip").exists() == (how == "stopped")
    again = make_run(tmp_path)
    assert_same(outcome(again, again.train(40)), uninterrupted)


def test_resumed_schedule_continues(tmp_path: Path) -> None:
    """The learning rate is that of the whole run, and so are the weights, bit for bit."""

    def run(name: str) -> Run:
        made = make_run(tmp_path / name)
        made.config["learning_rate"] = "lin_1e-3"
        return made

    uninterrupted = run("whole")
    expected = outcome(uninterrupted, uninterrupted.train(40))
    with acting_at(25, press_ctrl_c):
        stopped: Any = run("stopped").train(40)
    assert stopped.num_timesteps == 25
    assert stopped.critic.optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 * 15 / 40)
    resumed = run("stopped")
    assert_same(outcome(resumed, resumed.train(40)), expected)


def test_evaluations_do_not_disturb(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uninterrupted: dict[str, Any]
) -> None:
    def evaluate(*args: Any, **kwargs: Any) -> pd.DataFrame:
        random.random(), np.random.rand(3), th.rand(3)
        return sb3_have.evaluate(*args, **kwargs)

    monkeypatch.setattr(callback, "evaluate", evaluate)
    run = make_run(tmp_path, eval_freq=3)
    model = run.train(40)
    assert len(pd.read_csv(tmp_path / "evaluation.csv")) == 2 * 13
    states = outcome(run, model), uninterrupted
    assert_same(*({name: leaf for name, leaf in state.items() if name != "/evaluations"} for state in states))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_training_and_saves(tmp_path: Path, number: signal.Signals) -> None:
    """The step in which the signal arrives is finished; the handlers are restored."""
    before = signal.getsignal(number)
    run = make_run(tmp_path, eval_freq=0)
    with acting_at(15, lambda: os.kill(os.getpid(), number)):
        assert run.train(1000).num_timesteps == 15
    assert run.interrupted and newest_checkpoint(tmp_path) == tmp_path / "checkpoint-15"
    assert (tmp_path / "model.zip").is_file()
    assert signal.getsignal(number) == before


@pytest.mark.parametrize(("moment", "steps"), [("before", 20), ("within", 20), ("within", 10)])
def test_interrupted_evaluation_is_made_up_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str, steps: int
) -> None:
    run = make_run(tmp_path)
    with monkeypatch.context() as patch:
        if moment == "within":
            patch.setattr(callback, "evaluate", lambda *args, **kwargs: press_ctrl_c())
        with acting_at(10, press_ctrl_c if moment == "before" else lambda: None):
            assert run.train(steps).num_timesteps == 10
    assert run.interrupted and not (tmp_path / "evaluation.csv").exists()
    again = make_run(tmp_path)
    again.train(steps)
    frame = pd.read_csv(tmp_path / "evaluation.csv")
    assert list(frame["step"]) == [10, 10, 20, 20][: 2 * steps // 10]
    assert not again.interrupted


def test_ctrl_c_in_an_evaluation_without_handler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not swallowed."""
    monkeypatch.setattr(callback, "evaluate", lambda *args, **kwargs: press_ctrl_c())
    model = make_run(tmp_path, eval_freq=0).train(8)
    model.set_env(make_training_env(ENV_ID, CONFIG))
    with pytest.raises(KeyboardInterrupt):
        model.learn(8, callback.WeatherEvalCallback(ENV_ID, ["slow"], tmp_path / "rows.csv", eval_freq=5))


def test_a_folder_for_evaluations_is_made(tmp_path: Path) -> None:
    rows = tmp_path / "new" / "folder" / "rows.csv"
    model = make_run(tmp_path / "run", eval_freq=0).train(8)
    model.set_env(make_training_env(ENV_ID, CONFIG))
    model.learn(8, callback.WeatherEvalCallback(ENV_ID, ["slow"], rows, eval_freq=5, n_eval_episodes=1))
    assert len(pd.read_csv(rows)) == 1


def test_evaluations_of_another_training_are_kept(tmp_path: Path) -> None:
    model = make_run(tmp_path).train(12)
    model.set_env(make_training_env(ENV_ID, CONFIG))
    before = (tmp_path / "evaluation.csv").read_text()
    with pytest.raises(ValueError, match="has the evaluations of another training"):
        model.learn(12, callback.WeatherEvalCallback(ENV_ID, ["slow"], tmp_path / "evaluation.csv"))
    assert (tmp_path / "evaluation.csv").read_text() == before


def test_folder_is_for_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / ".lock").open("w") as other, monkeypatch.context() as patch:
        patch.setattr(train, "locked", lambda folder: locked(folder, patience=0.0))
        fcntl.flock(other, fcntl.LOCK_EX)  # as another process does
        with pytest.raises(BlockingIOError, match="another process is using"):
            make_run(tmp_path).train(8)
    assert not (tmp_path / "model.zip").exists()
    with locked(tmp_path), locked(tmp_path):  # a process may lock a folder twice
        assert make_run(tmp_path, eval_freq=0).train(8).num_timesteps == 8
        with (tmp_path / ".lock").open("w") as other, pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with (tmp_path / ".lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_model_without_checkpoint_is_not_trained_over(tmp_path: Path) -> None:
    make_run(tmp_path).train(12, keep_checkpoint=False)
    with pytest.raises(ValueError, match=r"no checkpoint to resume from"):
        make_run(tmp_path).train(12)
    assert len(pd.read_csv(tmp_path / "evaluation.csv")) == 2


def test_damaged_checkpoints(tmp_path: Path) -> None:
    """The newest is written again when the run gets there; if no other is left, nothing is overwritten."""
    make_run(tmp_path, save_freq=6).train(12)
    (tmp_path / "checkpoint-12").write_bytes(b"")
    with pytest.warns(UserWarning, match="checkpoint-12 is damaged"):
        make_run(tmp_path, save_freq=6).train(12)
    assert newest_checkpoint(tmp_path) == tmp_path / "checkpoint-12"
    records = (tmp_path / "monitor.csv").read_text()
    for path in tmp_path.glob("checkpoint-*"):
        path.write_bytes(b"")
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(ValueError, match="checkpoint-12 and before"):
        make_run(tmp_path).train(12)
    assert (tmp_path / "monitor.csv").read_text() == records


def test_checkpoint_of_another_program_is_refused(tmp_path: Path) -> None:
    model = make_run(tmp_path / "run").train(8)
    model.set_env(make_training_env(ENV_ID, CONFIG))
    save_checkpoint(model, tmp_path / "checkpoint-8")
    with pytest.raises(ValueError, match="belongs to a run with None, not"):
        make_run(tmp_path).train(12)


def test_two_checkpoints_stay(tmp_path: Path) -> None:
    make_run(tmp_path, eval_freq=0, save_freq=5).train(22)
    assert {path.name for path in tmp_path.glob("checkpoint*")} == {"checkpoint-20", "checkpoint-22"}


def test_without_checkpoints(tmp_path: Path) -> None:
    make_run(tmp_path, save_freq=5).train(12, keep_checkpoint=False)
    assert not checkpoints(tmp_path) and (tmp_path / "model.zip").exists()


def test_time_limit(tmp_path: Path) -> None:
    """At least one rollout is made, so that there is a checkpoint."""
    run = make_run(tmp_path, eval_freq=0, time_limit=0.0)
    assert run.train(1000).num_timesteps == 1
    assert not run.interrupted


def test_several_environments(tmp_path: Path) -> None:
    multiprocessing.get_context("forkserver").set_forkserver_preload(["sb3_have.train"])
    kwargs: dict[str, Any] = {"algo": "sac", "eval_freq": 15, "eval_episodes": 1, "weathers": ["slow"]}
    for steps in (20, 30):
        assert Run({**CONFIG, "n_envs": 2}, ENV_ID, tmp_path, **kwargs).train(steps).num_timesteps == steps
    # a step counts two, so 15 is passed at 16
    assert list(pd.read_csv(tmp_path / "evaluation.csv")["step"]) == [16, 30]
    for file in tmp_path.glob("*.monitor.csv"):
        assert 15 - 8 < pd.read_csv(file, skiprows=1)["l"].sum() <= 15, "episodes go on where they were"
    assert len(list(tmp_path.glob("*.monitor.csv"))) == 2


@pytest.mark.parametrize(
    ("content", "more", "algo"),
    [({}, [], "havesac"), ({"algo": "tqc"}, [], "tqc"), ({"algo": "tqc"}, ["--algo", "sac"], "sac")],
)
def test_algorithm_of_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: dict[str, Any], more: list[str], algo: str
) -> None:
    class Enough(Exception):
        pass

    def trained(run: Run, *args: Any, **kwargs: Any) -> None:
        assert run.algo == algo
        raise Enough

    monkeypatch.setattr(Run, "train", trained)
    config = {key: value for key, value in CONFIG.items() if key != "policy_kwargs"}
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({**content, ENV_ID: config}))
    with pytest.raises(Enough):
        train.main(["--config", str(tmp_path / "mine.yml"), "--env", ENV_ID, "--out", str(tmp_path), *more])


def test_shipped_configuration_fits_havesac() -> None:
    config = load_config("have-50k", "HighwayVision-v0")
    env = train.make_training_env("HighwayVision-v0", config)
    model = sb3_have.HAVESAC(env=env, **{**model_kwargs(config), "buffer_size": 2})
    assert model.gamma == config["gamma"] == 0.98
    shapes = {key: space.shape for key, space in model.observation_space.spaces.items()}  # type: ignore[attr-defined]
    assert shapes == {"rgb": (9, 64, 64), "event": (15, 64, 64), "depth": (3, 64, 64)}
    env.close()


@pytest.mark.parametrize("progress_bar", [True, False])
def test_evaluations_have_a_progress_bar(tmp_path: Path, progress_bar: bool, capfd: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path).train(12, progress_bar=progress_bar)
    output = "".join(capfd.readouterr())
    assert ("2/2" in output and "episode" in output) == progress_bar


def test_normalization_with_stacked_frames(tmp_path: Path) -> None:
    """VecNormalize is the outermost wrapper, and its statistics are saved with the model."""
    config: dict[str, Any] = {
        "policy": "MultiInputPolicy",
        "policy_kwargs": {"net_arch": [4], "features_dim": 4},
        "learning_starts": 10,
        "batch_size": 4,
        "buffer_size": 100,
        "normalize": True,
        "frame_stack": 2,
    }
    model = Run(config, "ReliabilityDrive-v0", tmp_path, eval_freq=0, device="cpu").train(30)
    normalizer = saved_normalizer(tmp_path / "vecnormalize.pkl")
    assert normalizer is not None and isinstance(model.observation_space, spaces.Dict)
    assert isinstance(normalizer.obs_rms, dict)
    for key, space in model.observation_space.spaces.items():
        assert normalizer.obs_rms[key].mean.shape == space.shape
    resumed = Run(config, "ReliabilityDrive-v0", tmp_path, eval_freq=0, device="cpu").train(40)
    assert resumed.num_timesteps == 40


def test_wrong_keywords_of_the_evaluation_are_refused_before_the_training(tmp_path: Path) -> None:
    run = Run(CONFIG, ENV_ID, tmp_path / "run", eval_freq=10, eval_env_kwargs={"image_sze": 48}, device="cpu")
    with pytest.raises(ValueError, match=r"cannot be evaluated in the weather .*image_sze"):
        run.train(20)
    assert not (tmp_path / "run").exists()
