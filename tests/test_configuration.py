"""Configurations: files are found, merged with their base, and read as the Zoo reads them."""

import argparse
import pickle
import shutil
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from fake_drive import CONFIG, ENV_ID
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecExtractDictObs, VecFrameStack, VecNormalize

from sb3_have import ModalityReplayBuffer, MultiModalPolicy, configuration, train
from sb3_have.common.encoders import ImageEncoder
from sb3_have.configuration import (
    algorithm_of,
    config_names,
    config_path,
    env_wrapper,
    hyperparameter,
    load_config,
    model_kwargs,
    normalize_kwargs,
)
from sb3_have.envs.drivers import RandomDriver
from sb3_have.evaluation import callback
from sb3_have.evaluation.evaluation import evaluate_episodes
from sb3_have.have.auxiliary import DeepMDP
from sb3_have.train import Run

STOP = "stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes"
# Ends every episode after two steps
SHORT = {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 2}}


def write(folder: Path, content: dict[str, Any], name: str = "mine") -> str:
    path = folder / f"{name}.yml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


def test_configurations_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_config(write(tmp_path, {"A-v0": {"gamma": 0.5}}), "A-v0") == {"gamma": 0.5}
    with pytest.raises(FileNotFoundError, match=r"'heve'; did you mean 'have'.*Available: concat, crossq"):
        config_path("heve")
    with pytest.raises(KeyError, match=r"Pendulum-v1.*only for HighwayVision-v0, CarlaVision-v0, Reliab"):
        load_config("have", "Pendulum-v1")
    with pytest.raises(ValueError, match="expected environment ids"):
        load_config(write(tmp_path, 3), "A-v0")  # type: ignore[arg-type]
    # The wheel has them inside the package
    installed = tmp_path / "sb3_have" / "zoo_configs"
    shutil.copytree(config_path("have").parent, installed)
    monkeypatch.setattr(configuration, "__file__", str(tmp_path / "sb3_have" / "configuration.py"))
    assert config_path("have") == installed / "have.yml" and "shared" not in config_names()


def test_ids_with_a_module_find_the_block_of_the_plain_id(tmp_path: Path) -> None:
    assert load_config("have", "sb3_have:HighwayVision-v0") == load_config("have", "HighwayVision-v0")
    path = write(tmp_path, {"A-v0": {"gamma": 0.5}, "pkg:A-v0": {"gamma": 0.7}})
    assert [load_config(path, env_id)["gamma"] for env_id in ("A-v0", "other:A-v0", "pkg:A-v0")] == [0.5, 0.5, 0.7]


def test_block_is_merged_into_that_of_the_base(tmp_path: Path) -> None:
    block = {"tau": 0.1, "env_kwargs": {"size": 8, "weather": "sun"}, "policy_kwargs": {"net_arch": [8]}}
    write(tmp_path, {"algo": "sac", "A-v0": block, "B-v0": {}}, "first")
    own = {"gamma": 0.5, "env_kwargs": {"size": 9}, "policy_kwargs": {"n_critics": 1}}
    path = write(tmp_path, {"base": "first.yml", "A-v0": own}, "second")
    merged = {**own, "tau": 0.1, "env_kwargs": {"size": 9, "weather": "sun"}}
    assert load_config(path, "A-v0") == merged and algorithm_of(path) == "sac"
    with pytest.raises(KeyError, match="no block for 'B-v0', only for A-v0"):
        load_config(path, "B-v0")
    # CrossQ has no target network
    third = write(tmp_path, {"algo": "crossq", "base": "second.yml", "A-v0": {}}, "third")
    assert load_config(third, "A-v0") == {key: value for key, value in merged.items() if key != "tau"}
    assert load_config(write(tmp_path, {"base": "lve", "HighwayVision-v0": {}}), "HighwayVision-v0") == load_config(
        "lve", "HighwayVision-v0"
    )


def test_file_names_its_algorithm(tmp_path: Path) -> None:
    """The name of the file does not decide."""
    assert algorithm_of(write(tmp_path, {"A-v0": {}}, "tqc")) == "havesac"
    assert algorithm_of(write(tmp_path, {"algo": "tqc", "A-v0": {}}, "my_tqc")) == "tqc"
    assert {name: algorithm_of(name) for name in config_names() if algorithm_of(name) != "havesac"} == {
        "tqc": "tqc",
        "crossq": "crossq",
    }
    with pytest.raises(ValueError, match=r"mine\.yml: there is no algo 'tcq'.*vailable: crossq, havesac"):
        algorithm_of(write(tmp_path, {"algo": "tcq"}))


def test_merged_file_is_printed_for_the_zoo(capsys: pytest.CaptureFixture[str]) -> None:
    configuration.main(["drq"])
    printed = yaml.safe_load(capsys.readouterr().out)
    assert printed == {"algo": "havesac", "HighwayVision-v0": load_config("drq", "HighwayVision-v0")}


def test_unknown_keys_are_refused_before_anything_starts(tmp_path: Path) -> None:
    path = write(tmp_path, {ENV_ID: {**CONFIG, "bufer_size": 3}})
    arguments = ["--config", path, "--env", ENV_ID, "--out", str(tmp_path / "run")]
    with pytest.raises(ValueError, match="havesac has no hyper-parameter 'bufer_size'; did you mean 'buffer_size'"):
        train.main(arguments)
    arguments += ["--hyperparams", "refusion:free"]
    with pytest.raises(ValueError, match="sac has no hyper-parameter 'refusion'"):
        train.main([*arguments, "--config", write(tmp_path, {ENV_ID: CONFIG}), "--algo", "sac"])
    assert not (tmp_path / "run").exists()


def test_evaluation_has_keywords_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in CARLA, where each environment needs a server of its own."""
    evaluated: list[dict[str, Any]] = []

    class Enough(Exception):
        pass

    def record(env_id: str, weather: str, env_kwargs: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        evaluated.append(env_kwargs)
        raise Enough

    monkeypatch.setattr(callback, "check_environment", record)
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


@pytest.mark.parametrize("path", ["sb3_have.Nothing", "no_such_module.Buffer"])
def test_wrong_dotted_paths_are_explained(path: str) -> None:
    with pytest.raises(ValueError, match=f"replay_buffer_class: cannot import '{path}'"):
        model_kwargs({"replay_buffer_class": path})


def test_values_of_the_zoo_are_read() -> None:
    config = {
        "policy_kwargs": "dict(net_arch=[8], activation_fn=nn.Tanh)",
        "replay_buffer_class": "HerReplayBuffer",
        "replay_buffer_kwargs": "{'n_sampled_goal': 4.0}",
        "train_freq": [1, "episode"],
        "buffer_size": 1e6,
        "gradient_steps": -1,
    }
    assert model_kwargs(config) == {
        "policy_kwargs": {"net_arch": [8], "activation_fn": th.nn.Tanh},
        "replay_buffer_class": HerReplayBuffer,
        "replay_buffer_kwargs": {"n_sampled_goal": 4.0},
        "train_freq": (1, "episode"),
        "buffer_size": 1_000_000,
        "gradient_steps": -1,
    }
    assert isinstance(model_kwargs(config)["buffer_size"], int)
    with pytest.raises(ValueError, match=r"policy_kwargs: 'dict.net_arch=nothing.' is not Python: NameError"):
        model_kwargs({"policy_kwargs": "dict(net_arch=nothing)"})


@pytest.mark.parametrize(
    ("normalize", "expected"),
    [
        (False, None),
        (True, {"gamma": 0.9}),
        ({"norm_obs": False}, {"norm_obs": False, "gamma": 0.9}),
        ("dict(norm_obs=False)", {"norm_obs": False, "gamma": 0.9}),
    ],
)
def test_normalize(normalize: Any, expected: dict[str, Any] | None) -> None:
    """VecNormalize discounts rewards as the algorithm does."""
    assert normalize_kwargs({"normalize": normalize, "gamma": 0.9}) == expected


def test_training_env_is_wrapped_as_in_the_zoo(tmp_path: Path) -> None:
    config = {
        "env_kwargs": {"max_episode_steps": 3},
        "monitor_kwargs": "dict(info_keywords=('speed',))",
        "vec_env_wrapper": {"stable_baselines3.common.vec_env.VecExtractDictObs": {"key": "m1"}},
        "normalize": {"norm_reward": False},
        "gamma": 0.9,
        "frame_stack": 2,
    }
    env: Any = train.make_training_env("ReliabilityDrive-v0", config, tmp_path)
    layers = []
    while hasattr(env, "venv"):
        layers.append(env)
        env = env.venv
    assert [type(layer) for layer in layers] == [VecNormalize, VecFrameStack, VecExtractDictObs]
    assert (layers[0].norm_reward, layers[0].gamma) == (False, 0.9)
    env.reset()
    for _ in range(3):
        env.step(np.array([env.action_space.sample()]))
    assert (tmp_path / "monitor.csv").read_text().splitlines()[1] == "r,l,t,distance,speed"
    env.close()


@pytest.mark.parametrize(
    ("name", "noise"), [("normal", NormalActionNoise), ("ornstein-uhlenbeck", OrnsteinUhlenbeckActionNoise)]
)
def test_action_noise(name: str, noise: type[ActionNoise]) -> None:
    env = train.make_training_env("ReliabilityDrive-v0", {})
    made = model_kwargs({"noise_type": name, "noise_std": 0.5}, env)["action_noise"]
    assert type(made) is noise and repr(made).endswith("(mu=[0. 0.], sigma=[0.5 0.5])")
    with pytest.raises(ValueError, match="noise_type='white': expected"):
        model_kwargs({"noise_type": "white", "noise_std": 0.5}, env)
    env.close()


def test_noise_and_callbacks_reach_the_training(tmp_path: Path) -> None:
    config = {
        **CONFIG,
        "noise_type": "normal",
        "noise_std": 0.1,
        "callback": [{STOP: {"max_episodes": 2}}, f"{STOP}: {{max_episodes: 2}}"],
    }
    run = Run(config, ENV_ID, tmp_path, algo="sac", eval_freq=0, device="cpu")
    with pytest.warns(UserWarning, match="no checkpoint was saved"):
        model = run.train(100)
    assert isinstance(model.action_noise, NormalActionNoise)
    assert len((tmp_path / "monitor.csv").read_text().splitlines()) == 4, "training stops after two episodes"


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
    # rl_zoo3 may have replaced Gymnasium's TimeLimit by its own
    assert [kind.__name__.removeprefix("Patched") for kind in found] == [kind.__name__ for kind in outermost_first]
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
        ("gymnasium.wrappers.Nothing", "env_wrapper: cannot import 'gymnasium.wrappers.Nothing'.*Nothing"),
        ("no_such_module.Wrapper", "no_such_module"),
        ("Wrapper", "env_wrapper: cannot import 'Wrapper'"),
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
