"""What of the user's command line reaches the Zoo's, and what wrong ones are told."""

import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
import zoo_fixtures
from zoo_fixtures import CARLA, DRIVING, SMALL, VECTORS, model_path, saved

from sb3_have import HAVESAC, ModalityReplayBuffer, configuration, zoo
from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.common.encoders import VectorEncoder
from sb3_have.configuration import config_path, load_config
from sb3_have.zoo import zoo_arguments

zoo_patches = zoo_fixtures.zoo_patches


def option(arguments: list[str], *names: str) -> list[str] | None:
    """Words of the last option of these names, as the Zoo heeds it; None without one."""
    places = [i for i, word in enumerate(arguments) if word in names]
    if not places:
        return None
    words = arguments[places[-1] + 1 :]
    return words[: next((i for i, word in enumerate(words) if word.startswith("-") and word != "-1"), None)]


def single(arguments: list[str], *names: str) -> str | None:
    words = option(arguments, *names)
    return None if words is None else " ".join(words)


def keeps(arguments: list[str], words: list[str]) -> bool:
    """Whether these are among them, in their order."""
    return any(arguments[i : i + len(words)] == words for i in range(len(arguments) + 1 - len(words)))


@pytest.mark.parametrize(
    ("given", "algo", "conf", "folder"),
    [
        ([], "havesac", "havesac", "logs"),
        (["--algo", "havesac", "--env", VECTORS], "havesac", "havesac", "logs"),
        (["--algo", "tqc"], "tqc", "tqc", "logs"),
        (["--algo", "crossq", "-f", "mine"], "crossq", "crossq", "mine"),
        (["--method", "lve"], "havesac", "lve", "logs/lve"),
        (["--method", "sac"], "havesac", "sac", "logs/sac"),
        (["--method", "tqc", "--log-folder", "mine"], "tqc", "tqc", "mine"),
        (["-conf", "lve"], "havesac", "lve", "logs"),
        (["-conf", "tqc"], "tqc", "tqc", "logs"),
        (["--algo", "havesac", "--conf-file", "gve-wide"], "havesac", "gve-wide", "logs"),
        (["--algo", "tqc", "--env", "Pendulum-v1"], "tqc", None, "logs"),
        (["--algo", "ppo", "--env", "CartPole-v1"], "ppo", None, "logs"),
    ],
)
def test_configuration_and_algorithm(given: list[str], algo: str, conf: str | None, folder: str) -> None:
    arguments = zoo_arguments("train", given)
    kept = given[2:] if given[:1] == ["--method"] else given
    assert keeps(arguments, kept)
    assert single(arguments, "--algo") == algo
    assert single(arguments, "--conf-file") == (None if conf is None else str(config_path(conf)))
    assert single(arguments, "-f", "--log-folder") == folder
    assert "--method" not in arguments


def test_own_files_and_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "mine.yml"
    own.write_text(yaml.safe_dump({VECTORS: {"n_timesteps": 5, "policy": "MultiInputPolicy"}}))
    (tmp_path / "my_hyperparams.py").write_text(f"hyperparams = {yaml.safe_load(own.read_text())!r}")
    monkeypatch.syspath_prepend(tmp_path)
    for conf in (str(own), str(tmp_path / "my_hyperparams.py"), "my_hyperparams"):
        arguments = zoo_arguments("train", ["-conf", conf, "--env", VECTORS])
        assert (single(arguments, "--conf-file"), single(arguments, "--algo")) == (conf, "havesac")


def test_configurations_of_an_installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There they lie inside the package."""
    installed = tmp_path / "sb3_have"
    shutil.copytree(config_path("havesac").parent, installed / "zoo_configs")
    monkeypatch.setattr(configuration, "__file__", str(installed / "configuration.py"))
    monkeypatch.chdir(tmp_path)
    assert single(zoo_arguments("train", []), "--conf-file") == str(installed / "zoo_configs" / "havesac.yml")
    assert single(zoo_arguments("train", ["--method", "lve"]), "--conf-file") == str(
        installed / "zoo_configs" / "lve.yml"
    )


def test_evaluation_has_the_env_kwargs_of_the_configuration() -> None:
    """Under those of the command line."""

    def evaluated(*given: str) -> dict[str, str] | None:
        words = option(zoo_arguments("train", ["--method", "rgb", *given]), "--eval-env-kwargs")
        return None if words is None else dict(word.split(":", 1) for word in words)

    configured = {key: repr(value) for key, value in load_config("rgb", DRIVING)["env_kwargs"].items()}
    assert evaluated() == configured
    assert evaluated("--eval-env-kwargs", "weather:'WetNoon'") == {**configured, "weather": "'WetNoon'"}
    # the Zoo puts these in the configuration's place
    assert evaluated("--env-kwargs", "image_size:40") == {"image_size": "40"}
    assert evaluated("-params", "env_kwargs:dict(image_size=40)") == {"image_size": "40"}
    assert option(zoo_arguments("train", ["--env", VECTORS]), "--eval-env-kwargs") is None


def test_options_of_the_user_stay() -> None:
    given = ["-params", "gamma:0.5", "policy_kwargs:dict(net_arch=[8])", "-n", "7", "--track", "-P", "--eval-freq", "3"]
    arguments = zoo_arguments("train", ["--method", "tqc", *given])
    assert keeps(arguments, given)
    assert option(arguments, "--eval-freq") == ["3"]
    params = option(arguments, "-params", "--hyperparams")
    assert params is not None and params[:2] == ["gamma:0.5", "policy_kwargs:dict(net_arch=[8])"]
    assert [word.split(":")[0] for word in params[2:]] == ["replay_buffer_class", "replay_buffer_kwargs"]


def test_carla_has_one_server() -> None:
    assert option(zoo_arguments("train", ["--env", CARLA]), "--eval-freq") == ["-1"]
    for more in (["--eval-env-kwargs", "port:2010"], ["--eval-freq", "9"]):
        assert option(zoo_arguments("train", ["--env", CARLA, *more]), "--eval-freq") in (None, ["9"])
    assert option(zoo_arguments("train", ["--env", DRIVING]), "--eval-freq") is None


def test_what_is_registered() -> None:
    from rl_zoo3 import ALGOS
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
    from stable_baselines3 import SAC

    zoo.register()
    assert ALGOS["havesac"] is HAVESAC and ALGOS["crossq"] is MultiInputCrossQ and ALGOS["sac"] is SAC
    assert "havesac" in HYPERPARAMS_SAMPLER and "havesac" in HYPERPARAMS_CONVERTER


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"encoder_classes": {"m0": "sb3_have.common.encoders.VectorEncoder"}, "activation_fn": "torch.nn.Tanh"},
        "dict(encoder_classes={'m0': __import__('sb3_have.common.encoders', fromlist=['VectorEncoder']).VectorEncoder},"
        " activation_fn=nn.Tanh)",
    ],
)
def test_classes_in_own_configurations(policy_kwargs: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By their path, or in the Zoo's way."""
    block = {**load_config("have", VECTORS), "policy_kwargs": policy_kwargs}
    if isinstance(policy_kwargs, dict):
        block |= {"replay_buffer_class": "sb3_have.ModalityReplayBuffer", "policy": "sb3_have.MultiModalPolicy"}
        block |= {"env_wrapper": [{"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 5}}]}
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({VECTORS: block}))
    options = ["--env", VECTORS, "-n", "20", "-f", str(tmp_path), "-params", "learning_starts:15", *SMALL[1:]]
    zoo.main(["train", "-conf", str(tmp_path / "mine.yml"), *options])
    model = HAVESAC.load(model_path(tmp_path))
    assert model.policy_kwargs["encoder_classes"] == {"m0": VectorEncoder}
    assert type(model.actor.latent_pi[1]).__name__ == "Tanh"
    if isinstance(policy_kwargs, dict):
        assert model.replay_buffer_class is ModalityReplayBuffer
        assert re.search(r"episodes +\| 4 ", capsys.readouterr().out)
    zoo.main(["enjoy", "--env", VECTORS, "-n", "3", "-f", str(tmp_path)])
    assert saved(tmp_path, "config.yml")["gamma"] == 0.98


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["train", "--algo", "havsac"], "no algorithm 'havsac'; did you mean 'havesac'?"),
        (["train", "--algo", "lve"], "'lve'; it is a method of HAVESAC: --method lve"),
        (["train", "--method", "lvee"], "no method 'lvee'; did you mean 'lve'?; there are crossq, deepmdp,"),
        (["train", "--method", "lve", "--algo", "tqc"], "--method lve is of havesac, not of tqc"),
        (["train", "--method", "lve", "-conf", "lve"], "give one of them"),
        (["train", "-conf", "heve"], "no configuration 'heve'; did you mean 'have'?"),
        (["train", "-conf", "nowhere/lve.yml"], "no configuration 'nowhere/lve.yml'"),
        (["train", "--env", "MyDrive-v0"], "no environment 'MyDrive-v0'; --gym-packages imports packages"),
        (["train", "--env", "HighwayVison-v0"], "no environment 'HighwayVison-v0'; did you mean 'HighwayVision-v0'?"),
        (["enjoy", "--env", "HighwayVison-v0"], "zoo enjoy: there is no environment"),
        (["train", "--env", "Pendulum-v1"], "no block for 'Pendulum-v1', only for HighwayVision-v0, Carla"),
        (["train", "--method", "rgb", "--env", VECTORS], "Hyperparameters not found for havesac-ReliabilityDrive-v0"),
        (["train", "-params", "replay_buffer_class:'sb3_have.Nothing'"], "no replay_buffer_class 'sb3_have.Nothing'"),
        (["tune", "--method", "crossq"], "no search for 'crossq'"),
        (["train", "--gym-packages", "nopkg"], "--gym-packages nopkg cannot be imported"),
        (["train", "-params", "gamma"], "-params gamma: expected NAME:VALUE with a value in Python"),
        (
            ["train", "-params", "tau:0.1", "ent_coef:auto"],
            "-params ent_coef:auto: .*ent_coef:'auto_0.1'.*NameError",
        ),
        (["train", "--eval-env-kwargs", "port:"], "--eval-env-kwargs port:: expected NAME:VALUE"),
        (["enjoy", "--env-kwargs", "weather:WetNoon"], "--env-kwargs weather:WetNoon: expected NAME:VALUE"),
        (
            ["enjoy", "-f", "nowhere"],
            "The nowhere/havesac folder was not found; `train` with the same options saves one",
        ),
        (
            ["enjoy", "--method", "lve", "-f", "nowhere", "--exp-id", "3"],
            "nowhere/havesac/HighwayVision-v0_3 folder was",
        ),
        (["train", "--env", VECTORS, "--trial-id", "7", "-f", "nowhere"], "no nowhere/optuna.log; `tune` writes it"),
        (["plots"], "sb3_have.benchmark report"),
        (["push_to_hub", "--algo", "havesac"], "upload"),
        (["trian"], "there is no such command; there are train, tune, enjoy"),
    ],
)
def test_mistakes_are_explained(given: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        zoo.main(given)
    printed = capsys.readouterr().err
    assert end.value.code == 2 and printed.count("\n") == 1
    assert re.search(message.replace("?", r"\?"), printed), printed


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "expected ids of environments"),
        (f"{VECTORS}:", "expected ids of environments"),
        ("gamma: 0.5", "expected ids of environments"),
        (f"{VECTORS}: {{gamma: [1}}", "is not YAML: while parsing"),
        ("\ta: b", "is not YAML: while scanning"),
    ],
)
def test_configurations_that_are_none(
    content: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.yml").write_text(content)
    with pytest.raises(SystemExit) as end:
        zoo.main(["train", "-conf", str(tmp_path / "mine.yml"), "--env", VECTORS])
    printed = capsys.readouterr().err
    assert end.value.code == 2 and printed.count("\n") == 1
    assert f"{tmp_path / 'mine.yml'}" in printed and message in printed


def test_model_of_the_newest_training_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A search and a training that was killed leave folders without one."""
    given = ["--env", VECTORS, "-f", str(tmp_path)]
    for number, files in {1: [f"{VECTORS}.zip"], 2: [f"{VECTORS}.zip", "best_model.zip"], 10: []}.items():
        folder = tmp_path / "havesac" / f"{VECTORS}_{number}"
        folder.mkdir(parents=True)
        for name in files:
            (folder / name).touch()
    assert option(zoo_arguments("enjoy", given), "--exp-id") == ["2"]
    assert option(zoo_arguments("enjoy", [*given, "--exp-id", "1"]), "--exp-id") == ["1"]
    assert option(zoo_arguments("enjoy", [*given, "--load-best"]), "--exp-id") == ["2"]
    with pytest.raises(ValueError, match=rf"No model found .*{VECTORS}_1.best_model.zip"):
        zoo_arguments("enjoy", [*given, "--load-best", "--exp-id", "1"])
    with pytest.raises(ValueError, match=rf"No model found .*{VECTORS}_10.rl_model_5_steps.zip"):
        zoo_arguments("enjoy", [*given, "--load-checkpoint", "5"])


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    zoo.main(["--help"])
    assert "python -m sb3_have.zoo tune" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        zoo.main(["train", "--help"])
    printed = capsys.readouterr().out
    assert "--method NAME" in printed and "lve-paper" in printed and "--n-eval-envs" in printed


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """As on a clean install of rl_zoo3, whose ``enjoy`` needs requests without saying so."""
    for module in ("rl_zoo3.enjoy", "rl_zoo3.load_from_hub"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    for module in ("requests", "requests.exceptions"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SystemExit):
        zoo.main(["enjoy"])
    assert re.search(r"requests.*pip install \"sb3_have\[zoo\]\"", capsys.readouterr().err)


def test_command_line_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    before = sys.argv
    with pytest.raises(SystemExit):
        zoo.main(["train", "--no-such-option"])
    assert sys.argv is before
