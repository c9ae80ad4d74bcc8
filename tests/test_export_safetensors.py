"""Weights as safetensors: a policy comes back bit by bit."""

import warnings
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import TINY, RandomSensors, fill_buffer, sensors_space, tiny_model, vector, vectors_space
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_have import MultiModalPolicy
from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.common.encoders import MultiModalExtractor, VectorEncoder
from sb3_have.export import export_safetensors, load_policy, read_config


class Normed(th.nn.Sequential):
    """An encoder with running statistics."""

    def __init__(self, space: spaces.Box, features_dim: int):
        super().__init__(th.nn.Linear(space.shape[0], features_dim), th.nn.BatchNorm1d(features_dim))


class OwnPolicy(MultiModalPolicy):
    """A subclass with an argument that SB3 does not know."""

    def __init__(self, *args: Any, wide: int = 4, **kwargs: Any):
        self.wide = wide
        super().__init__(*args, **kwargs)
        self.extra = th.nn.Linear(wide, wide)


def trained(space: Any = None, **kwargs: Any) -> Any:
    model = tiny_model(vectors_space() if space is None else space, learning_rate=1e-2, **kwargs)
    fill_buffer(model, 40)
    model.train(3, batch_size=8)
    return model


def loaded(path: Path, **kwargs: Any) -> MultiModalPolicy:
    policy = load_policy(path, device="cpu", **kwargs)
    assert isinstance(policy, MultiModalPolicy)
    return policy


def assert_same_policy(model: Any, policy: Any) -> None:
    """Compare the bits of every tensor, the actions, and the modality weights and parts of the value, if any."""
    own, other = model.policy.state_dict(), policy.state_dict()
    assert list(own) == list(other)
    for name in own:
        assert own[name].dtype == other[name].dtype and th.equal(own[name], other[name]), name
    assert type(policy) is type(model.policy)
    assert policy.observation_space == model.observation_space and policy.action_space == model.action_space
    observation = model.observation_space.sample()
    for deterministic in (True, False):
        actions = []
        for one in (model.policy, policy):
            th.manual_seed(3)
            if model.use_sde:
                one.reset_noise()
            actions.append(one.predict(observation, deterministic=deterministic)[0])
        assert np.array_equal(actions[0], actions[1])
    if isinstance(policy, MultiModalPolicy):
        obs, _ = policy.obs_to_tensor(observation)
        action = th.full((1, 2), 0.3)
        parts, others = (one.critic.decompose(obs, action) for one in (model.policy, policy))
        assert parts.keys() == others.keys() and all(th.equal(parts[name], others[name]) for name in parts)
        if policy.critic.value_estimation != "gve":
            weights, expected = policy.modality_weights(observation), model.modality_weights(observation)
            assert list(weights) == list(expected)
            assert all(np.array_equal(weights[name], expected[name]) for name in weights)


VARIANTS: dict[str, dict[str, Any]] = {
    "images": {"space": sensors_space()},
    "single": {"space": vector(3)},
    "groups": {
        "refusion": "monotone",
        "policy_kwargs": {
            "modalities": {"second": ["b"], "first": ["a"]},
            "encoder_kwargs": {"first": {"net_arch": (7, 5)}},
            "attention_dim": 3,
            "n_critics": 3,
            "activation_fn": th.nn.Tanh,
            "net_arch": {"pi": [8], "qf": [9]},
            "optimizer_kwargs": {"betas": (0.5, 0.9)},
        },
    },
    "gve-sde": {"value_estimation": "gve", "use_sde": True},
    "lve-class": {"value_estimation": "lve", "policy_kwargs": {"encoder_classes": {"a": VectorEncoder}}},
    "bounds": {
        "space": spaces.Dict(
            OrderedDict(
                z=spaces.Box(-np.inf, np.inf, (2,)),
                a=spaces.Box(np.array([-1.5, 0.1], np.float32), np.array([np.inf, 9.0], np.float32)),
            )
        )
    },
}


@pytest.mark.parametrize("name", VARIANTS)
def test_a_policy_comes_back_bit_by_bit(tmp_path: Path, name: str) -> None:
    model = trained(**VARIANTS[name])
    export_safetensors(model, tmp_path / "policy")
    assert {file.name for file in (tmp_path / "policy").iterdir()} == {"config.json", "model.safetensors"}
    policy = loaded(tmp_path / "policy")
    assert_same_policy(model, policy)
    before, after = (one._get_constructor_parameters() for one in (model.policy, policy))
    assert before.keys() == after.keys()
    assert list(policy.critic.encoder.modalities) == list(model.critic.encoder.modalities)


@pytest.mark.parametrize(
    ("algorithm", "space", "shared"),
    [
        (SAC, sensors_space(), True),
        (TQC, vectors_space(), False),
        (TQC, vectors_space(), True),
        (MultiInputCrossQ, vectors_space(), False),
    ],
)
def test_other_algorithms_on_these_encoders(tmp_path: Path, algorithm: Any, space: spaces.Dict, shared: bool) -> None:
    policy_kwargs = {
        "features_extractor_class": MultiModalExtractor,
        "features_extractor_kwargs": {"features_dim": 8, "precision": "float32"},
        "normalize_images": False,
        "net_arch": [16],
        "share_features_extractor": shared,
    }
    env = RandomSensors(space)
    model = algorithm("MultiInputPolicy", env, buffer_size=50, learning_starts=8, policy_kwargs=policy_kwargs, seed=0)
    model.learn(12)
    export_safetensors(model, tmp_path)
    policy: Any = load_policy(tmp_path, "cpu")
    assert_same_policy(model, policy)
    assert policy.share_features_extractor is shared


def test_algorithms_of_other_policies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"HAVESAC, SAC, TQC or CrossQ, got ActorCriticPolicy"):
        export_safetensors(PPO("MlpPolicy", RandomSensors(vector(3)), device="cpu"), tmp_path)


def test_a_loaded_policy_is_exported_again(tmp_path: Path) -> None:
    model = trained()
    export_safetensors(model, tmp_path / "first")
    export_safetensors(loaded(tmp_path / "first"), tmp_path / "second")
    assert_same_policy(model, loaded(tmp_path / "second"))


def test_configuration(tmp_path: Path) -> None:
    env = VecFrameStack(DummyVecEnv([lambda: RandomSensors(sensors_space())]), 3)
    export_safetensors(tiny_model(sensors_space(), env=env), tmp_path)
    config = read_config(tmp_path)
    assert config["algorithm"] == "HAVESAC" and config["n_stack"] == 3 and config["format_version"] == 1
    assert {"sb3_have", "torch", "stable-baselines3", "gymnasium"} <= config["versions"].keys()
    keys = dict(config["observation_space"]["spaces"])
    assert keys["rgb"] == {"type": "Box", "shape": [9, 36, 36], "dtype": "uint8", "low": 0, "high": 255}


def test_policies_of_vec_normalize_are_exported_with_a_warning(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: RandomSensors(vectors_space())]))
    model = tiny_model(vectors_space(), env=env)
    with pytest.warns(UserWarning, match="expects normalized observations") as caught:
        export_safetensors(model, tmp_path)
    assert caught[0].filename == __file__
    env.norm_obs = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        export_safetensors(model, tmp_path)


def test_classes_of_ones_own_are_given(tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {"encoder_classes": {"a": Normed, "b": VectorEncoder}, "activation_fn": th.nn.Hardtanh}
    model = trained(policy_kwargs=kwargs)
    export_safetensors(model, tmp_path)
    with pytest.raises(
        ValueError, match=r"config\.json: .*activation_fn'\] is {'\$class': 'Hardtanh'}.*load_policy\(\)"
    ):
        load_policy(tmp_path, "cpu")
    own = {"encoder_classes": {"a": Normed}, "activation_fn": th.nn.Hardtanh}
    policy = loaded(tmp_path, policy_kwargs=own)
    assert_same_policy(model, policy)
    assert isinstance(policy.critic.encoder.encoders[1], VectorEncoder)
    with pytest.raises(ValueError, match=r"(?s)Missing key.*critic\.encoder\.encoders\.0\.net.*Unexpected key"):
        # another encoder than in training
        load_policy(tmp_path, "cpu", policy_kwargs={**own, "encoder_classes": {"a": VectorEncoder}})


class Lazy(th.nn.Module):
    """An encoder that finds its sizes by a dry run."""

    def __init__(self, space: spaces.Box, features_dim: int, **kwargs: Any):
        super().__init__()
        self.net = th.nn.Sequential(th.nn.LazyLinear(features_dim), th.nn.Tanh())
        with th.no_grad():
            self.net(th.zeros(1, *space.shape))

    def forward(self, values: th.Tensor) -> th.Tensor:
        return self.net(values)  # type: ignore[no-any-return]


def test_lazy_modules_of_ones_own(tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {"encoder_classes": {"a": Lazy}}
    model = trained(policy_kwargs=kwargs)
    export_safetensors(model, tmp_path)
    assert_same_policy(model, loaded(tmp_path, policy_kwargs=kwargs))


def test_policies_of_ones_own_are_given(tmp_path: Path) -> None:
    model = trained()
    model.policy = OwnPolicy(
        model.observation_space, model.action_space, lambda _: 0.0, **{**TINY, "net_arch": [16], "wide": 3}
    )
    export_safetensors(model, tmp_path)
    with pytest.raises(ValueError, match=r"policy_class is {'\$class': 'OwnPolicy'}.*`policy_class`"):
        load_policy(tmp_path, "cpu")
    policy = load_policy(tmp_path, "cpu", OwnPolicy, {"wide": 3})
    assert isinstance(policy, OwnPolicy) and policy.wide == 3
    assert th.equal(policy.extra.weight, model.policy.extra.weight)
    with pytest.raises(ValueError, match=r"size mismatch for extra\.weight"):
        load_policy(tmp_path, "cpu", OwnPolicy)


def test_loading_leaves_random_numbers_and_training_alone(tmp_path: Path) -> None:
    model = trained(use_sde=True)
    export_safetensors(model, tmp_path)
    th.manual_seed(0)
    expected = th.rand(3)
    th.manual_seed(0)
    policy = loaded(tmp_path)
    assert th.equal(th.rand(3), expected)
    assert not policy.training and not policy.critic.encoder.training


def test_exploration_is_that_of_the_loaded_deviations(tmp_path: Path) -> None:
    model = tiny_model(vectors_space(), use_sde=True)
    log_std: Any = model.actor.log_std
    log_std.data.fill_(5.0)  # 0.05 at first
    export_safetensors(model, tmp_path)
    actor: Any = loaded(tmp_path).actor
    assert actor.action_dist.exploration_mat.std() > 10
