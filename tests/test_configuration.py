"""Configurations: found, read as the Zoo reads them, and handed to whom they concern."""

import argparse
import pickle
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml
from fake_drive import CONFIG, ENV_ID
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit
from stable_baselines3.common.monitor import Monitor

from sb3_have import ModalityReplayBuffer, MultiModalPolicy, train
from sb3_have.common.encoders import ImageEncoder
from sb3_have.configuration import (
    config_path,
    env_wrapper,
    hyperparameter,
    load_config,
    model_kwargs,
)
from sb3_have.envs.drivers import RandomDriver
from sb3_have.evaluation.evaluation import evaluate_episodes
from sb3_have.have.auxiliary import DeepMDP
from sb3_have.train import Run

#: Ends every episode after two steps.
SHORT = {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 2}}


def test_unknown_configuration_is_explained(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nothing.*zoo_configs"):
        config_path("nothing")
    with pytest.raises(KeyError, match=r"Pendulum-v1.*only for HighwayVision-v0, CarlaVision-v0"):
        load_config("havesac", "Pendulum-v1")
    (tmp_path / "mine.yml").write_text("A-v0: {gamma: 0.5}")
    assert load_config(str(tmp_path / "mine.yml"), "A-v0") == {"gamma": 0.5}
    (tmp_path / "mine.yml").write_text("A-v0: 3")
    with pytest.raises(ValueError, match=r"mine\.yml: expected ids of environments"):
        load_config(str(tmp_path / "mine.yml"), "A-v0")


def test_one_block_for_both_simulators() -> None:
    ours, theirs = load_config("havesac", "CarlaVision-v0"), load_config("havesac", "HighwayVision-v0")
    assert ours == {**theirs, "env_kwargs": {**theirs["env_kwargs"], "reward": "highway"}}


def test_evaluation_has_keywords_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in CARLA, where each environment needs a server of its own."""
    evaluated: list[dict[str, Any]] = []

    class Enough(Exception):
        pass

    def record(*args: Any, **kwargs: Any) -> None:
        evaluated.append(args[5])
        raise Enough

    monkeypatch.setattr(train, "evaluate", record)
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({ENV_ID: {**CONFIG, "env_kwargs": {"weather": "fast"}}}))
    run = ["--config", str(tmp_path / "mine.yml"), "--env", ENV_ID, "--algo", "sac", "--steps", "1", "--eval-freq", "1"]
    for number, more in enumerate(([], ["--eval-env-kwargs", "image_size:40", "port:2010", "weather:slow"])):
        with pytest.raises(Enough):
            train.main([*run, "--out", str(tmp_path / str(number)), *more])
    assert evaluated == [{}, {"image_size": 40, "port": 2010}]


def test_constructor_gets_a_copy_of_what_concerns_it() -> None:
    kwargs = model_kwargs({**CONFIG, "n_envs": 2, "env_wrapper": SHORT})
    assert set(CONFIG) - set(kwargs) == {"n_timesteps", "frame_stack", "env_kwargs"}
    assert set(kwargs) < set(CONFIG)
    kwargs["policy_kwargs"]["net_arch"].append(1)
    assert CONFIG["policy_kwargs"]["net_arch"] == [8]


def test_dotted_paths_become_classes() -> None:
    config = {
        "policy": "MultiInputPolicy",
        "replay_buffer_class": "sb3_have.ModalityReplayBuffer",
        "auxiliary": {"mine": "sb3_have.have.auxiliary.DeepMDP"},
        "policy_kwargs": {
            "fusion": "transfuser",
            "activation_fn": "torch.nn.Tanh",
            "encoder_classes": {"rgb": "sb3_have.common.encoders.ImageEncoder"},
            "precision": "a.word",
        },
    }
    untouched = deepcopy(config)
    assert model_kwargs(config) == {
        "policy": "MultiInputPolicy",
        "replay_buffer_class": ModalityReplayBuffer,
        "auxiliary": {"mine": DeepMDP},
        "policy_kwargs": {
            "fusion": "transfuser",
            "activation_fn": th.nn.Tanh,
            "encoder_classes": {"rgb": ImageEncoder},
            "precision": "a.word",
        },
    }
    assert config == untouched
    assert model_kwargs({"policy": "sb3_have.MultiModalPolicy"}) == {"policy": MultiModalPolicy}
    assert model_kwargs({"auxiliary": None, "replay_buffer_class": None}) == {
        "auxiliary": None,
        "replay_buffer_class": None,
    }


@pytest.mark.parametrize("path", ["sb3_have.Nothing", "no_such_module.Buffer", "ModalityReplayBuffer"])
def test_wrong_dotted_paths_are_explained(path: str) -> None:
    with pytest.raises(ValueError, match=f"no replay_buffer_class '{path}'"):
        model_kwargs({"replay_buffer_class": path})


@pytest.mark.parametrize(
    ("spec", "outermost_first"),
    [
        (SHORT, [TimeLimit]),
        ("gymnasium.wrappers.RecordEpisodeStatistics", [RecordEpisodeStatistics]),
        ([SHORT, "gymnasium.wrappers.RecordEpisodeStatistics"], [RecordEpisodeStatistics, TimeLimit]),
    ],
)
def test_env_wrappers(spec: Any, outermost_first: list[type]) -> None:
    wrap = env_wrapper({"env_wrapper": spec})
    assert wrap is not None
    inner: Any = gym.make(ENV_ID, weather="fast")
    env: Any = pickle.loads(pickle.dumps(wrap))(inner)
    found = []
    while env is not inner:
        found.append(type(env))
        env = env.env
    assert found == outermost_first
    if spec == SHORT:
        wrapped = wrap(inner)
        wrapped.reset()
        ends = [wrapped.step(inner.action_space.sample())[3] for _ in range(2)]
        assert ends == [False, True]


def test_no_env_wrapper() -> None:
    assert env_wrapper({}) is None


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("gymnasium.wrappers.Nothing", "no env_wrapper 'gymnasium.wrappers.Nothing'.*Nothing"),
        ("no_such_module.Wrapper", "no_such_module"),
        ("Wrapper", "no env_wrapper 'Wrapper'"),
        ({"a.B": {}, "c.D": {}}, "module.Class"),
        ({"gymnasium.wrappers.TimeLimit": 3}, "module.Class"),
        ([3], "got 3"),
    ],
)
def test_wrong_env_wrappers_are_explained(spec: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        env_wrapper({"env_wrapper": spec})


@pytest.mark.parametrize("n_envs", [1, 2])
def test_evaluation_wraps_every_episode(n_envs: int) -> None:
    kwargs: dict[str, Any] = {"weathers": ["slow", "fast"], "n_episodes": 2, "n_envs": n_envs}
    bare = evaluate_episodes(RandomDriver(), ENV_ID, **kwargs)
    short = evaluate_episodes(RandomDriver(), ENV_ID, **kwargs, env_wrapper=env_wrapper({"env_wrapper": SHORT}))
    assert (short["steps"] == 2).all() and (bare["steps"] > 2).all()


def test_training_and_its_evaluations_are_wrapped(tmp_path: Path) -> None:
    config = {**CONFIG, "env_wrapper": SHORT}
    options: dict[str, Any] = {"algo": "sac", "eval_episodes": 1, "weathers": ["slow"], "device": "cpu"}
    Run(config, ENV_ID, tmp_path, eval_freq=10, **options).train(12)
    monitored = (tmp_path / "monitor.csv").read_text().splitlines()[2:]
    assert len(monitored) == 6 and all(row.split(",")[1] == "2" for row in monitored)
    assert ",2.0," in (tmp_path / "evaluation.csv").read_text()
    env = train.make_training_env(ENV_ID, config)
    monitor: Any = env.unwrapped.envs[0]  # type: ignore[attr-defined]
    while not isinstance(monitor, Monitor):
        monitor = monitor.env
    assert isinstance(monitor.env, TimeLimit)
    env.close()


def test_learning_rate_decays_as_in_the_zoo() -> None:
    schedule = model_kwargs({"learning_rate": "lin_1e-3"})["learning_rate"]
    assert [schedule(remaining) for remaining in (1.0, 0.5, 0.0)] == pytest.approx([1e-3, 5e-4, 0.0])
    for word in ("log_1e-3", "lin_fast", "fast"):
        with pytest.raises(ValueError, match=f"learning_rate='{word}': expected a number.*lin_1e-3"):
            model_kwargs({"learning_rate": word})


def test_hyperparameters_of_the_command_line() -> None:
    assert hyperparameter("learning_rate:3e-4") == ("learning_rate", 3e-4)
    for text, value in (("32", 32), ("1e5", 100_000), ("1.0", 1.0), ("0.5", 0.5)):
        assert hyperparameter(f"x:{text}") == ("x", value) and type(hyperparameter(f"x:{text}")[1]) is type(value)
    assert hyperparameter("ent_coef:auto_0.1") == ("ent_coef", "auto_0.1")
    assert hyperparameter("policy_kwargs:{precision: float32}") == ("policy_kwargs", {"precision": "float32"})
    for text, message in (("gamma", "NAME:VALUE"), ("net_arch:[64", "not YAML")):
        with pytest.raises(argparse.ArgumentTypeError, match=message):
            hyperparameter(text)
