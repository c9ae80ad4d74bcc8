"""The command line of ``sb3_have.zoo``: its defaults, the user's options, and what reaches the model."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
import zoo_fixtures
from zoo_fixtures import CARLA, DRIVING, SMALL, VECTORS, model_path, saved

from sb3_have import HAVESAC, ModalityReplayBuffer, zoo
from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.common.encoders import VectorEncoder
from sb3_have.configuration import config_path, load_config
from sb3_have.zoo import zoo_arguments

zoo_patches = zoo_fixtures.zoo_patches


def option(arguments: list[str], *names: str) -> str | None:
    """Return the first word of the last option of these names, which is the one that the Zoo takes."""
    places = [i for i, word in enumerate(arguments) if word in names]
    return arguments[places[-1] + 1] if places else None


@pytest.mark.parametrize(
    ("given", "algo", "conf", "folder"),
    [
        ([], "havesac", "have", "logs"),
        (["--algo", "havesac", "--env", VECTORS], "havesac", "have", "logs"),
        (["--algo", "tqc"], "tqc", "tqc", "logs"),
        (["--algo", "crossq", "-f", "mine"], "crossq", "crossq", "mine"),
        (["--method", "lve"], "havesac", "lve", "logs/lve"),
        (["--method", "tqc", "--log-folder", "mine"], "tqc", "tqc", "mine"),
        (["-conf", "concat"], "havesac", "concat", "logs"),
        (["-conf", "tqc"], "tqc", "tqc", "logs"),
        (["--algo", "tqc", "--env", "Pendulum-v1"], "tqc", None, "logs"),
        (["--algo", "sac"], "sac", None, "logs"),
        (["--algo", "ppo", "--env", "CartPole-v1"], "ppo", None, "logs"),
    ],
)
def test_configuration_and_algorithm(given: list[str], algo: str, conf: str | None, folder: str) -> None:
    arguments = zoo_arguments("train", given)
    assert option(arguments, "--algo") == algo
    assert option(arguments, "--conf-file") == (None if conf is None else str(config_path(conf)))
    assert option(arguments, "-f", "--log-folder") == folder
    assert "--method" not in arguments


def test_own_files_and_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "mine.yml"
    own.write_text(yaml.safe_dump({VECTORS: {"n_timesteps": 5, "policy": "MultiInputPolicy"}}))
    (tmp_path / "my_hyperparams.py").write_text(f"hyperparams = {yaml.safe_load(own.read_text())!r}")
    monkeypatch.syspath_prepend(tmp_path)
    for conf in (str(own), str(tmp_path / "my_hyperparams.py"), "my_hyperparams"):
        arguments = zoo_arguments("train", ["-conf", conf, "--env", VECTORS])
        assert (option(arguments, "--conf-file"), option(arguments, "--algo")) == (conf, "havesac")


def test_options_of_the_user_stay() -> None:
    given = ["-params", "gamma:0.5", "policy_kwargs:dict(net_arch=[8])", "-n", "7", "--track", "-P", "--eval-freq", "3"]
    arguments = zoo_arguments("train", ["--method", "tqc", *given])
    start = arguments.index("-params")
    assert arguments[start : start + len(given)] == given


def test_carla_has_one_server() -> None:
    assert option(zoo_arguments("train", ["--env", CARLA]), "--eval-freq") == "-1"
    assert option(zoo_arguments("train", ["--env", CARLA, "--eval-freq", "9"]), "--eval-freq") == "9"
    second_server = ["--eval-env-kwargs", "port:2010"]
    assert option(zoo_arguments("train", ["--env", CARLA, *second_server]), "--eval-freq") is None
    assert option(zoo_arguments("train", ["--env", DRIVING]), "--eval-freq") is None


def test_what_is_registered() -> None:
    from rl_zoo3 import ALGOS
    from stable_baselines3 import SAC

    zoo.register()
    assert ALGOS["havesac"] is HAVESAC and ALGOS["crossq"] is MultiInputCrossQ and ALGOS["sac"] is SAC


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"encoder_classes": {"m0": "sb3_have.common.encoders.VectorEncoder"}, "activation_fn": "torch.nn.Tanh"},
        "dict(encoder_classes={'m0': __import__('sb3_have.common.encoders', fromlist=['VectorEncoder']).VectorEncoder},"
        " activation_fn=nn.Tanh)",
    ],
)
def test_classes_in_own_configurations(policy_kwargs: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Classes are given by their dotted path or as the Zoo has them, in Python."""
    block = {"policy_kwargs": policy_kwargs}
    if isinstance(policy_kwargs, dict):
        block |= {"replay_buffer_class": "sb3_have.ModalityReplayBuffer", "policy": "sb3_have.MultiModalPolicy"}
        block |= {"env_wrapper": [{"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 5}}]}
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({"base": "have", VECTORS: block}))
    options = ["--env", VECTORS, "-n", "20", "-f", str(tmp_path), "-params", "learning_starts:15", *SMALL[1:]]
    zoo.main(["train", "-conf", str(tmp_path / "mine.yml"), *options])
    model = HAVESAC.load(model_path(tmp_path))
    assert model.policy_kwargs["encoder_classes"] == {"m0": VectorEncoder}
    assert type(model.actor.latent_pi[1]).__name__ == "Tanh"
    if isinstance(policy_kwargs, dict):
        assert model.replay_buffer_class is ModalityReplayBuffer
        assert re.search(r"episodes +\| 4 ", capsys.readouterr().out)
    zoo.main(["enjoy", "--env", VECTORS, "-n", "3", "-f", str(tmp_path)])
    assert saved(tmp_path, "config.yml")["gamma"] == load_config("have", VECTORS)["gamma"]


@pytest.mark.parametrize("given", [["--method", "lvee"], ["-conf", "lvee"]])
def test_right_names_are_listed(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises((SystemExit, FileNotFoundError)) as error:
        zoo.main(["train", *given])
    assert re.search("crossq.*deepmdp.*lve-paper", f"{error.value} {capsys.readouterr().err}")


def test_unknown_commands_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="no command 'trian'; there are train, tune and enjoy"):
        zoo.main(["trian"])
    zoo.main(["--help"])
    assert "python -m sb3_have.zoo tune" in capsys.readouterr().out
