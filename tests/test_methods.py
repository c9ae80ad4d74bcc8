"""The methods of the comparison: every file of zoo_configs trains, and the files differ in the method alone."""

import json
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from torch import nn

from sb3_have import HAVESAC, ModalityReplayBuffer
from sb3_have.algorithms import ALGORITHMS, saved_algorithm
from sb3_have.benchmark.grid import read_grid
from sb3_have.checkpoint import newest_checkpoint
from sb3_have.common.encoders import MultiModalExtractor
from sb3_have.configuration import algorithm_of, config_names, config_path, load_config, model_kwargs
from sb3_have.evaluation.recording import record_episode
from sb3_have.train import Run, make_training_env

ENV_ID = "HighwayVision-v0"
SENSORS = ["rgb", "event", "depth"]
GLOBAL = [*SENSORS, "concat", "deepmdp", "gve", "gve-wide", "drq", "transfuser", "efnet"]
LOCAL = ["lve", "have", "lve-paper", "have-paper", "have-dropout"]
METHODS = [*GLOBAL, *LOCAL, "tqc", "crossq"]
# What defines a method; everything else is shared
ITS_OWN = {
    "value_estimation", "auxiliary", "target", "refusion", "local_coef", "modality_dropout", "random_shift",
    "n_augmentations", "policy", "policy_kwargs",
}  # fmt: skip


def small_config(method: str, **env_kwargs: Any) -> dict[str, Any]:
    """A method in the least time that still passes through all of its parts."""
    config = load_config(method, ENV_ID)
    small = {"image_size": 36, "vehicles_count": 2, "max_episode_steps": 25, **env_kwargs}
    config["env_kwargs"] = {**config["env_kwargs"], **small}
    return {**config, "buffer_size": 200, "learning_starts": 20, "batch_size": 8}


def make_run(method: str, out: Path) -> Run:
    return Run(small_config(method), ENV_ID, out, algo=algorithm_of(method), eval_freq=0, save_freq=0, device="cpu")


def build(method: str, without: Collection[str] = (), **env_kwargs: Any) -> HAVESAC:
    """An untrained model."""
    config = {key: value for key, value in small_config(method, **env_kwargs).items() if key not in without}
    env = make_training_env(ENV_ID, config)
    env.close()
    return HAVESAC(env=env, seed=0, device="cpu", **model_kwargs(config))


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@cache
def heads(method: str, modalities: tuple[str, ...] = ("rgb", "event"), **policy_kwargs: Any) -> int:
    """Parameters of a method's critic without its encoder."""
    model = build(method, modalities=modalities)
    return count(model.critic) - count(model.critic.encoder)


def test_every_file_is_a_method() -> None:
    assert set(config_names()) == {*METHODS, "have-50k"}
    assert all(load_config(name, ENV_ID)["policy"] for name in METHODS)


def test_committed_results_are_those_of_the_configurations() -> None:
    """So the runs of the core grid count as finished, under the names that they had."""
    benchmarks = Path(__file__).parents[1] / "benchmarks"
    runs = pd.read_csv(benchmarks / "results" / "core" / "runs.csv")
    jobs = {(job.method, job.seed): job for job in read_grid(benchmarks / "grids" / "core.yml").jobs()}
    assert len(runs) == len(jobs) == 21
    for row in runs.itertuples():
        recorded = json.loads(str(row.settings))
        settings = jobs[str(row.method), int(str(row.seed))].settings
        assert {key: recorded[key] for key in settings} == settings
        assert set(recorded) - set(settings) == {"final_episodes", "failures"}


@pytest.mark.parametrize("method", METHODS)
def test_hyperparameters_are_shared(method: str) -> None:
    config, reference = load_config(method, ENV_ID), load_config("have", ENV_ID)
    shared = {key: value for key, value in config.items() if key not in ITS_OWN}
    expected = {key: value for key, value in reference.items() if key not in ITS_OWN}
    if method == "crossq":  # has no target network
        del expected["tau"]
    if method in SENSORS:
        expected["env_kwargs"] = {**expected["env_kwargs"], "modalities": [method]}
    assert shared == expected


def test_what_the_methods_are() -> None:
    """Each differs from its neighbour in the comparison by what its name says."""
    own = {
        method: {key: value for key, value in load_config(method, ENV_ID).items() if key in ITS_OWN}
        for method in METHODS
    }
    policy = {"policy": "MultiInputPolicy"}
    assert own["deepmdp"] == own["gve"] == {"value_estimation": "gve", "auxiliary": "deepmdp", **policy}
    assert own["concat"] == {**own["deepmdp"], "auxiliary": None}
    assert all(own[sensor] == own["deepmdp"] for sensor in SENSORS)
    assert own["drq"] == {**own["concat"], "random_shift": 4, "n_augmentations": 2}
    for fusion in ("transfuser", "efnet"):
        assert own[fusion] == {**own["deepmdp"], "policy_kwargs": {"fusion": fusion}}
    assert own["have-dropout"] == {**own["have"], "modality_dropout": 0.2}
    assert set(own["tqc"]) == set(own["crossq"]) == {"policy"}
    default, written = build("have", without=ITS_OWN - {"policy"}), build("have")
    for name in ("target", "local_coef", "modality_dropout", "auxiliary_coefs", "policy_kwargs"):
        assert getattr(default, name) == getattr(written, name), name
    paper = build("have-paper")
    assert (paper.target, paper.local_coef, paper.critic.refusion.refusion) == ("paper", 0.0, "free")
    assert build("lve-paper").local_coef == 0.0 and build("lve").local_coef == 1.0


def test_wide_critic_is_as_large_as_that_of_have() -> None:
    assert (heads("gve-wide"), heads("have")) == (507_574, 508_304)
    assert heads("gve") < 0.4 * heads("have")


def test_width_for_three_sensors() -> None:
    """The one that the file names: 454 would be a fifth too small."""
    have = heads("have", ("rgb", "event", "depth"))
    assert have == 694_838
    config = small_config("gve-wide", modalities=["rgb", "event", "depth"])
    config["policy_kwargs"]["net_arch"]["qf"] = [517, 517]
    env = make_training_env(ENV_ID, config)
    model = HAVESAC(env=env, device="cpu", **model_kwargs(config))
    env.close()
    wide = count(model.critic) - count(model.critic.encoder)
    assert wide == 694_850 and heads("gve-wide", ("rgb", "event", "depth")) < 0.8 * have
    text = config_path("gve-wide").read_text()
    assert all(f"{number:,}" in text for number in (507_574, 508_304, have, wide))


@pytest.mark.parametrize("method", METHODS)
def test_method_trains_and_comes_back(method: str, tmp_path: Path) -> None:
    """Finite losses, another actor than at the start, actions in the action space, and the same ones after loading."""
    model = make_run(method, tmp_path).train(60, keep_checkpoint=False)
    losses = {name: value for name, value in model.logger.name_to_value.items() if name.startswith("train/")}
    expected = {"critic_loss", "actor_loss"}
    if load_config(method, ENV_ID).get("auxiliary"):
        expected |= {"aux_transition_loss", "aux_reward_loss"}
    else:
        assert not [name for name in losses if "aux" in name]
    assert {f"train/{name}" for name in expected} <= set(losses)
    assert np.isfinite(list(losses.values())).all(), losses
    assert model._n_updates == 20
    assert isinstance(model.replay_buffer, ModalityReplayBuffer) and model.replay_buffer.n_stack == 3
    batch = model.replay_buffer.sample(16).observations
    assert isinstance(batch, dict)
    observations = {key: value.numpy() for key, value in batch.items()}
    actions, _ = model.predict(observations, deterministic=True)
    assert actions.shape == (16, 2) and np.isfinite(actions).all()
    assert (np.abs(actions) <= 1).all() and actions.std(axis=0).min() > 0
    assert saved_algorithm(tmp_path / "model.zip", method) == algorithm_of(method)
    loaded = ALGORITHMS[algorithm_of(method)].load(tmp_path / "model.zip", device="cpu")
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], actions)


@pytest.mark.parametrize("method", ["tqc", "crossq"])
def test_off_the_shelf_algorithms_resume(method: str, tmp_path: Path) -> None:
    first = make_run(method, tmp_path).train(30)
    before = {name: value.clone() for name, value in first.policy.state_dict().items()}
    untouched = make_run(method, tmp_path).train(30)
    assert all(th.equal(before[name], value) for name, value in untouched.policy.state_dict().items())
    second = make_run(method, tmp_path).train(40)
    assert (first._n_updates, second._n_updates, second.num_timesteps) == (5, 10, 40)
    assert isinstance(second.replay_buffer, ModalityReplayBuffer) and second.replay_buffer.pos == 40
    optimizer: th.optim.Optimizer = second.critic.optimizer  # type: ignore[attr-defined]
    steps = [state["step"].item() for state in optimizer.state_dict()["state"].values()]
    assert set(steps) == {10}
    changed = [name for name, value in second.policy.state_dict().items() if not th.equal(before[name], value)]
    assert {name.split(".")[0] for name in changed} >= {"actor", "critic"}
    assert newest_checkpoint(tmp_path) == tmp_path / "checkpoint-40"


@pytest.mark.parametrize("method", ["tqc", "crossq"])
def test_off_the_shelf_algorithms_see_what_have_sees(method: str, tmp_path: Path) -> None:
    """The same stack of frames, the same decoding, the same encoder."""
    theirs = make_run(method, tmp_path).train(1, keep_checkpoint=False)
    ours = build("have")
    assert theirs.observation_space == ours.observation_space
    critic: ContinuousCritic = theirs.critic  # type: ignore[attr-defined]
    extractor = critic.features_extractor
    assert isinstance(extractor, MultiModalExtractor)
    assert str(extractor.encoder) == str(ours.critic.encoder)
    extractor.encoder.load_state_dict(ours.critic.encoder.state_dict())
    observation, _ = ours.policy.obs_to_tensor(ours.observation_space.sample())
    with th.no_grad():
        extracted = critic.extract_features(observation, extractor)
        th.testing.assert_close(extracted, ours.policy.encode(observation).flatten(start_dim=1))


def test_gve_is_deepmdp_bit_for_bit(tmp_path: Path) -> None:
    """Two names of one method."""
    models = [make_run(method, tmp_path / method).train(60, keep_checkpoint=False) for method in ("gve", "deepmdp")]
    assert all(model._n_updates == 20 for model in models)
    gve, deepmdp = (model.policy.state_dict() for model in models)
    assert all(th.equal(gve[name], deepmdp[name]) for name in gve)
    untrained = build("gve").policy.state_dict()
    assert not any(th.equal(gve[name], untrained[name]) for name in gve if name.endswith("weight"))


@pytest.mark.parametrize(("method", "keys"), [("gve", set()), ("lve", {"rgb", "event"})])
def test_recorded_episode_of_a_method(method: str, keys: set[str]) -> None:
    """The global critic alone has no weights to record."""
    env_kwargs = {key: value for key, value in small_config(method)["env_kwargs"].items() if key != "weather"}
    recording = record_episode(build(method), ENV_ID, "ClearNoon", env_kwargs=env_kwargs, max_steps=2)
    assert len(recording.infos) == 2 and set(recording.weights) == keys
