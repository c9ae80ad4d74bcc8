"""Saving, loading and copying: everything that trains comes back, and training goes on to the same bits."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import RandomSensors, batched, fill_buffer, quiet_logger, sensors_space, tiny_model, vectors_space
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_have import HAVESAC, MultiModalPolicy


class Normed(th.nn.Sequential):
    """An encoder with running statistics."""

    def __init__(self, space: spaces.Box, features_dim: int):
        super().__init__(th.nn.Linear(space.shape[0], features_dim), th.nn.BatchNorm1d(features_dim))


VARIANTS: list[dict[str, Any]] = [
    {},
    {"refusion": "monotone", "target": "paper", "ent_coef": 0.1},
    {"value_estimation": "lve", "auxiliary": None, "use_sde": True},
    {"policy_kwargs": {"encoder_classes": {"state": Normed}}},
    {"value_estimation": "gve", "local_coef": 0.0, "modality_dropout": 0.3, "ent_coef": "auto_0.01"},
]


def trained(space: Any = None, **kwargs: Any) -> HAVESAC:
    model = tiny_model(sensors_space() if space is None else space, learning_rate=1e-3, **kwargs)
    fill_buffer(model, 40)
    model.train(3, batch_size=8)
    return model


def tensors(value: Any, prefix: str = "") -> dict[str, th.Tensor]:
    """Every tensor in nested dicts and lists, by its path; numbers as tensors too."""
    if isinstance(value, th.Tensor):
        return {prefix: value.detach().clone()}
    if isinstance(value, bool | int | float):
        return {prefix: th.tensor(value)}
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list | tuple) else ()
    return {path: leaf for key, item in items for path, leaf in tensors(item, f"{prefix}/{key}").items()}


def state(model: HAVESAC) -> dict[str, th.Tensor]:
    """All that trains: parameters, buffers, optimizers, temperature, counters, coefficients."""
    found = tensors(model.get_parameters())
    found.update(tensors(dict(model.policy.named_buffers()), "buffers"))
    if model.log_ent_coef is not None:
        found["log_ent_coef"] = model.log_ent_coef.detach().clone()
    found.update(tensors({"n_updates": model._n_updates, "coefficients": model.auxiliary_coefs}))
    return found


def assert_same(first: dict[str, th.Tensor], second: dict[str, th.Tensor]) -> None:
    assert first.keys() == second.keys()
    for path, tensor in first.items():
        assert th.equal(tensor, second[path]), path


def assert_same_actions(first: Any, second: Any, observation: Any) -> None:
    actions = [one.predict(observation, deterministic=True)[0] for one in (first, second)]
    assert np.array_equal(actions[0], actions[1])


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: "-".join(map(str, variant.values())) or "default")
def test_a_loaded_model_goes_on_to_the_same_bits(tmp_path: Path, variant: dict[str, Any]) -> None:
    model = trained(**variant)
    model.auxiliary_coefs = dict.fromkeys(model.auxiliary_coefs, 0.5)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = HAVESAC.load(tmp_path / "model", device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_logger(quiet_logger())
    assert_same(state(model), state(loaded))
    settings = ("target", "local_coef", "modality_dropout", "auxiliary_coefs", "gamma", "tau", "use_sde")
    for name in settings:
        assert getattr(loaded, name) == getattr(model, name), name
    for name in ("value_estimation", "encoder"):
        assert str(getattr(loaded.critic, name)) == str(getattr(model.critic, name)), name

    before = state(model)
    for one in (model, loaded):
        np.random.seed(5)  # the replay buffer's choice
        th.manual_seed(5)
        one.train(3, batch_size=8)
    after = state(model)
    assert_same(after, state(loaded))
    assert any(not th.equal(before[path], after[path]) for path in before)


def test_aliases_point_at_the_loaded_policy(tmp_path: Path) -> None:
    """After ``load`` the model trains what it acts with, and not a copy."""
    model = trained(vectors_space())
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", env=RandomSensors(vectors_space()), device="cpu")
    assert loaded.actor is loaded.policy.actor and loaded.critic is loaded.policy.critic
    assert loaded.critic_target is loaded.policy.critic_target
    inside = {id(p) for group in loaded.critic.optimizer.param_groups for p in group["params"]}
    assert inside == {id(p) for module in (loaded.critic, loaded.policy.auxiliary) for p in module.parameters()}
    assert not any(p.requires_grad for p in loaded.critic_target.parameters())
    observation = loaded.get_env().reset()  # type: ignore[union-attr]
    before, _ = loaded.predict(observation, deterministic=True)  # type: ignore[arg-type]
    loaded.learn(60)
    after, _ = loaded.predict(observation, deterministic=True)  # type: ignore[arg-type]
    assert not np.array_equal(before, after)


def test_loaded_models_predict_alike(tmp_path: Path) -> None:
    model = trained()
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", device="cpu")
    observation = model.observation_space.sample()
    assert_same_actions(model, loaded, observation)
    first, second = model.modality_weights(observation), loaded.modality_weights(observation)
    assert first.keys() == second.keys() and all(np.array_equal(first[key], second[key]) for key in first)


def test_load_keeps_what_its_keywords_change(tmp_path: Path) -> None:
    model = trained(vectors_space())
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", device="cpu", local_coef=0.25, target="paper", gamma=0.5)
    assert (loaded.local_coef, loaded.target, loaded.gamma) == (0.25, "paper", 0.5)


def test_parameters_exact_and_inexact() -> None:
    model, other = trained(), trained(ent_coef="auto")
    fill_buffer(other, 40, seed=9)
    other.train(3, batch_size=8)
    parameters: dict[str, Any] = model.get_parameters()
    assert set(parameters) == {"policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer"}
    assert any(name.startswith("auxiliary.deepmdp") for name in parameters["policy"])
    other.set_parameters(parameters)
    assert_same(tensors(model.get_parameters()), tensors(other.get_parameters()))

    third = tiny_model(sensors_space(), seed=3)
    with pytest.raises(ValueError, match="policy"):
        third.set_parameters({"actor.optimizer": parameters["actor.optimizer"]})
    third.set_parameters({"policy": parameters["policy"]}, exact_match=False)
    assert_same(tensors(third.policy.state_dict()), tensors(parameters["policy"]))
    assert not third.critic.optimizer.state_dict()["state"]


def test_policy_alone(tmp_path: Path) -> None:
    """``policy.save`` and ``policy.load`` keep every option of the constructor."""
    space = sensors_space()
    model = trained(
        space,
        refusion="monotone",
        policy_kwargs={
            "modalities": {"vision": ["rgb", "event"], "state": ["state"]},
            "attention_dim": 7,
            "n_critics": 3,
        },
    )
    model.policy.save(str(tmp_path / "policy"))
    policy = MultiModalPolicy.load(str(tmp_path / "policy"), device="cpu")
    assert_same(tensors(dict(model.policy.named_parameters())), tensors(dict(policy.named_parameters())))
    assert policy._get_constructor_parameters().keys() == model.policy._get_constructor_parameters().keys()
    observation = model.observation_space.sample()
    assert_same_actions(model.policy, policy, observation)
    assert list(policy.critic.encoder.modalities) == ["vision", "state"]


def test_policy_can_be_pickled() -> None:
    policy = trained(vectors_space()).policy
    observation = policy.observation_space.sample()
    copy = pickle.loads(pickle.dumps(policy))
    assert_same_actions(policy, copy, observation)


def test_training_goes_on_with_more_environments(tmp_path: Path) -> None:
    space = vectors_space()
    model = trained(space)
    model.save(tmp_path / "model")
    env = DummyVecEnv([lambda: RandomSensors(space)] * 3)
    loaded = HAVESAC.load(tmp_path / "model", env=env, device="cpu", force_reset=True)
    updates = loaded._n_updates
    loaded.learn(30)
    assert loaded._n_updates > updates
    action, _ = loaded.predict(batched(space.sample()))
    assert action.shape == (1, 2)
