"""The Zoo's commands with HAVESAC: every configuration trains, and its model is found and driven."""

import sys
from pathlib import Path
from typing import Any

import pytest
import zoo_fixtures
from zoo_fixtures import CARLA, DRIVING, SMALL, SMALL_IMAGES, VECTORS, evaluations, in_python, model_path, saved

from sb3_have import ModalityReplayBuffer, zoo
from sb3_have.algorithms import ALGORITHMS
from sb3_have.common.encoders import MultiModalExtractor
from sb3_have.configuration import algorithm_of, config_names, config_path, load_config, read_config

zoo_patches = zoo_fixtures.zoo_patches
BLOCKS = [(name, env_id) for name in config_names() for env_id in read_config(name) if env_id.endswith("-v0")]


def train(folder: Path, *arguments: str) -> None:
    zoo.main(["train", *arguments, "-f", str(folder), "--num-threads", "1", "--device", "cpu"])


def load(name: str, folder: Path) -> Any:
    return ALGORITHMS[algorithm_of(name)].load(model_path(folder), device="cpu")


def test_blocks() -> None:
    """Vectors have no cameras, no images to shift and no feature maps to fuse."""
    images_only = {"rgb", "event", "depth", "drq", "transfuser", "efnet", "have-50k"}
    names = set(config_names())
    assert {name for name, env_id in BLOCKS if env_id == DRIVING} == names
    assert {name for name, env_id in BLOCKS if env_id == VECTORS} == names - images_only
    assert {name for name, env_id in BLOCKS if env_id == CARLA} == {"have"}


@pytest.mark.parametrize(("name", "env_id"), [block for block in BLOCKS if block[1] != CARLA])
def test_every_configuration_trains(name: str, env_id: str, tmp_path: Path) -> None:
    block = load_config(name, env_id)
    is_driving = env_id == DRIVING
    small = {"env_kwargs": {**block["env_kwargs"], **SMALL_IMAGES}} if is_driving else {}
    params = ["-params", *SMALL, *in_python(small)]
    train(tmp_path, "--method", name, "--env", env_id, "-n", "200", "--eval-freq", "-1", *params)

    model = load(name, tmp_path)
    assert model.num_timesteps == 200 and model._n_updates == 25 * block.get("gradient_steps", 1) * (
        2 // block["train_freq"]
    )
    reaches_model = set(block) & {
        "gamma", "tau", "ent_coef", "policy_delay", "target", "local_coef", "modality_dropout", "random_shift",
        "n_augmentations", "learning_rate",
    }  # fmt: skip
    values = {key: getattr(model, key) for key in reaches_model}
    values["learning_rate"] = model.lr_schedule(1.0)
    assert values == {key: block[key] for key in reaches_model}
    if algorithm_of(name) == "havesac":
        assert (model.critic.value_estimation, bool(model.auxiliary_coefs)) == (
            block.get("value_estimation", "have"),
            block.get("auxiliary", "deepmdp") is not None,
        )
    else:
        assert isinstance(model.critic.features_extractor, MultiModalExtractor)
    if is_driving:
        assert model.observation_space["rgb" if name not in ("event", "depth") else name].shape[1:] == (36, 36)
        assert model.replay_buffer_class is ModalityReplayBuffer

    args, config = saved(tmp_path, "args.yml"), saved(tmp_path, "config.yml")
    assert (args["algo"], args["env"], args["conf_file"]) == (algorithm_of(name), env_id, str(config_path(name)))
    assert config["gamma"] == block["gamma"] and config["learning_starts"] == 150
    assert config.get("env_kwargs") == small.get("env_kwargs")


def test_run_is_found_and_driven(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the environment that it was trained and evaluated in."""
    options = ["--algo", "havesac", "--env", VECTORS]
    short = ["--env-kwargs", "corruption:0.0", "max_episode_steps:7"]
    evaluated = ["--eval-freq", "100", "--eval-episodes", "2", "-P"]
    train(tmp_path, *options, "-n", "200", *evaluated, *short, "-params", *SMALL)
    assert (evaluations(tmp_path)["ep_lengths"] == 7).all() and list(evaluations(tmp_path)["timesteps"]) == [100, 200]
    assert "200/200" in capsys.readouterr().out
    zoo.main(["enjoy", *options, "-f", str(tmp_path), "-n", "15"])  # and asks for no pictures, there are none
    assert capsys.readouterr().out.count("Episode Length 7") == 2


@pytest.mark.filterwarnings("ignore:.*You are trying to use 'human' rendering:UserWarning")
def test_driving_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The evaluation and the replay have image size, sensors and frame stack of the configuration."""
    from gymnasium.wrappers import HumanRendering

    shown: list[Any] = []
    show: Any = HumanRendering._render_frame
    monkeypatch.setattr(HumanRendering, "_render_frame", lambda self: shown.append(show(self)))
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env_kwargs = {**load_config("gve", DRIVING)["env_kwargs"], **SMALL_IMAGES, "max_episode_steps": 6}
    params = ["-params", *SMALL, *in_python({"env_kwargs": env_kwargs})]
    rest = ["--eval-env-kwargs", "max_episode_steps:5", "--eval-freq", "20", "--eval-episodes", "1"]
    monkeypatch.chdir(tmp_path)
    zoo.main(["train", "--method", "gve", "-n", "20", *params, *rest])
    assert evaluations(tmp_path / "logs" / "gve")["ep_lengths"].tolist() == [[5]]
    capsys.readouterr()
    zoo.main(["enjoy", "--method", "gve", "-n", "7"])
    printed = capsys.readouterr().out
    assert "Stacking 3 frames" in printed and printed.count("Episode Length 6") == 1 and len(shown) >= 7
    shown.clear()
    zoo.main(["enjoy", "--method", "gve", "-n", "7", "--no-render", "--load-best"])
    assert not shown


def test_carla_is_not_evaluated_on_the_server_it_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")
    from fake_carla_fixtures import fresh

    server = fresh(monkeypatch)
    block = load_config("have", CARLA)
    small = {**block["env_kwargs"], "image_size": 36, "vehicles_count": 2, "timeout": 0.5}
    params = ["-params", *SMALL, *in_python({"env_kwargs": small})]
    train(tmp_path, "--algo", "havesac", "--env", CARLA, "-n", "200", *params)
    model = load("have", tmp_path)
    assert (model.num_timesteps, model._n_updates, model.gamma) == (200, 50, block["gamma"])
    assert model.observation_space["event"].shape == (15, 36, 36)
    assert saved(tmp_path, "args.yml")["eval_freq"] == -1
    assert server.left_behind() == []


def test_training_goes_on_from_a_model(tmp_path: Path) -> None:
    options = ["--method", "lve", "--env", VECTORS, "-n", "160", "--eval-freq", "-1", "-params", *SMALL]
    train(tmp_path / "first", *options, "--save-replay-buffer")
    train(tmp_path / "second", *options, "-i", str(model_path(tmp_path / "first")))
    first, second = load("lve", tmp_path / "first"), load("lve", tmp_path / "second")
    assert second._n_updates > first._n_updates > 0
    assert second.critic.value_estimation == "lve"


def test_workers_know_the_environments(tmp_path: Path) -> None:
    options = ["--algo", "havesac", "--env", VECTORS, "-n", "10", "--eval-freq", "-1"]
    train(tmp_path, *options, "--vec-env", "subproc", "-params", *SMALL)
    assert load("have", tmp_path).num_timesteps == 10


def test_zoo_alone_reads_the_merged_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A launcher that knows nothing of this package trains TQC with the printed file."""
    from rl_zoo3 import train as zoo_train
    from rl_zoo3.exp_manager import ExperimentManager

    from sb3_have import configuration

    configuration.main(["tqc"])
    (tmp_path / "tqc.yml").write_text(capsys.readouterr().out)
    monkeypatch.setattr(zoo_train, "ExperimentManager", ExperimentManager)
    options = [
        "--algo",
        "tqc",
        "--env",
        VECTORS,
        "-n",
        "160",
        "--eval-freq",
        "-1",
        "--device",
        "cpu",
        "-params",
        *SMALL,
    ]
    command = ["train", "-conf", str(tmp_path / "tqc.yml"), "-f", str(tmp_path), *options]
    monkeypatch.setattr(sys, "argv", command)
    zoo_train.train()
    model = load("tqc", tmp_path)
    assert isinstance(model.critic.features_extractor, MultiModalExtractor) and model.gamma == 0.98
