"""What users of Stable-Baselines3 do, done with HAVESAC."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs import (
    TINY,
    RandomSensors,
    batched,
    changed,
    clone_parameters,
    fill_buffer,
    image,
    sensors_space,
    tiny_model,
    vector,
    vectors_space,
)
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_have import HAVESAC, MultiModalPolicy
from sb3_have.have import policies
from sb3_have.have.critic import drop_modalities

STEPS = 40


def vec_env(space: spaces.Space[Any], n_envs: int = 1, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(RandomSensors(space, **kwargs))] * n_envs)


def learns(model: HAVESAC, steps: int = STEPS) -> None:
    """Training runs, updates, changes the actor and leaves finite numbers behind."""
    before = clone_parameters(model.actor)
    updates = model._n_updates
    model.learn(steps)
    assert model._n_updates > updates
    assert changed(before, model.actor)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


# -- Policies and observations


@pytest.mark.parametrize("policy", ["MultiInputPolicy", MultiModalPolicy, policies.MultiInputPolicy])
def test_policy_by_name_and_by_class(policy: Any) -> None:
    env = RandomSensors(sensors_space())
    model = HAVESAC(
        policy, env, policy_kwargs=TINY, buffer_size=50, learning_starts=8, batch_size=8, device="cpu", seed=0
    )
    assert isinstance(model.policy, MultiModalPolicy)
    learns(model)


@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_names_of_policies_for_a_box(policy: str) -> None:
    space = vector(5) if policy == "MlpPolicy" else image(3)
    model = HAVESAC(policy, RandomSensors(space), policy_kwargs=TINY, learning_starts=8, batch_size=8, buffer_size=50)
    learns(model, 20)


@pytest.mark.parametrize("value_estimation", ["have", "lve", "gve"])
@pytest.mark.parametrize("n_modalities", [1, 2, 3, 4])
def test_any_number_of_modalities(n_modalities: int, value_estimation: str) -> None:
    space = vectors_space(n_modalities)
    model = tiny_model(space, value_estimation=value_estimation)
    learns(model, 20)
    if value_estimation != "gve":
        weights = model.modality_weights(
            {key: np.zeros((5, *(box.shape or ())), np.float32) for key, box in space.items()}
        )
        assert list(weights) == list(space.spaces)
        assert all(weight.shape == (5,) for weight in weights.values())
        np.testing.assert_allclose(sum(weights.values()), 1, rtol=1e-5)


def test_groups_of_keys() -> None:
    groups = {"vision": ["rgb", "event"], "body": ["state"]}
    model = tiny_model(sensors_space(), {"modalities": groups})
    learns(model)
    assert list(model.modality_weights(model.observation_space.sample())) == ["vision", "body"]


def test_frame_stacking_with_images_and_vectors() -> None:
    env = VecFrameStack(vec_env(sensors_space(), 2), n_stack=3)
    model = tiny_model(sensors_space(), env=env)
    assert isinstance(model.observation_space, spaces.Dict)
    shapes = {key: box.shape for key, box in model.observation_space.items()}
    assert shapes == {"event": (15, 36, 36), "rgb": (9, 36, 36), "state": (12,)}
    learns(model)
    action, _ = model.predict(env.reset())
    assert action.shape == (2, 2)


def test_normalised_vectors_beside_images() -> None:
    # VecTransposeImage inside: SB3 stores VecNormalize's originals, which it would otherwise not transpose
    env = VecNormalize(VecTransposeImage(vec_env(sensors_space(), 2)), norm_obs_keys=["state"])
    model = tiny_model(sensors_space(), env=env)
    encoded: list[dict[str, th.Tensor]] = []

    def keep(module: th.nn.Module, inputs: tuple[dict[str, th.Tensor]]) -> None:
        if model.policy.training:
            encoded.append(inputs[0])

    model.critic.encoder.register_forward_pre_hook(keep)
    learns(model)
    assert all(batch["rgb"].dtype == th.uint8 for batch in encoded)
    assert th.cat([batch["state"] for batch in encoded[-8:]]).std() > 0.7  # uniform in [-1, 1] has 0.58


def test_an_environment_of_sb3() -> None:
    env = SimpleMultiObsEnv(discrete_actions=False, channel_last=True)
    model = tiny_model(env.observation_space, env=env)
    learns(model)


# -- Schedules of training


@pytest.mark.parametrize(
    "train_freq,gradient_steps,n_envs,updates",
    [
        (1, 1, 1, 32),
        (4, 2, 1, 16),
        (4, -1, 1, 32),
        (2, -1, 2, 32),
        ((1, "episode"), 3, 1, 12),
        ((1, "episode"), -1, 1, 40),
    ],
)
def test_train_freq_and_gradient_steps(train_freq: Any, gradient_steps: int, n_envs: int, updates: int) -> None:
    space = vectors_space()
    model = tiny_model(space, env=vec_env(space, n_envs), train_freq=train_freq, gradient_steps=gradient_steps)
    learns(model, 40)
    assert model._n_updates == updates


@pytest.mark.parametrize("ent_coef", [0.1, "auto", "auto_0.01"])
def test_entropy_temperatures(ent_coef: Any) -> None:
    model = tiny_model(vectors_space(), ent_coef=ent_coef)
    learns(model)
    logged = model.logger.name_to_value
    model.train(1, 8)
    if ent_coef == 0.1:
        assert logged["train/ent_coef"] == pytest.approx(0.1) and "train/ent_coef_loss" not in logged
    else:
        assert logged["train/ent_coef"] == pytest.approx(1.0 if ent_coef == "auto" else 0.01, rel=0.05)
        assert logged["train/ent_coef"] not in (1.0, 0.01) and "train/ent_coef_loss" in logged


@pytest.mark.parametrize("sde_sample_freq", [-1, 4])
def test_state_dependent_exploration(sde_sample_freq: int) -> None:
    model = tiny_model(sensors_space(), use_sde=True, sde_sample_freq=sde_sample_freq, use_sde_at_warmup=True)
    learns(model)


def test_action_noise_and_learning_rate_schedule() -> None:
    noise = NormalActionNoise(np.zeros(2), 0.1 * np.ones(2))
    model = tiny_model(vectors_space(), action_noise=noise, learning_rate=lambda progress: 1e-3 * progress)
    learns(model)
    assert model.critic.optimizer.param_groups[0]["lr"] < 1e-4


@pytest.mark.parametrize("optimizer_class", [th.optim.AdamW, th.optim.SGD])
def test_other_optimizers(optimizer_class: type[th.optim.Optimizer]) -> None:
    kwargs = {"optimizer_class": optimizer_class, "optimizer_kwargs": {"weight_decay": 1e-4}}
    model = tiny_model(vectors_space(), kwargs)
    assert type(model.critic.optimizer) is optimizer_class and type(model.actor.optimizer) is optimizer_class
    learns(model)


def test_learn_twice() -> None:
    model = tiny_model(vectors_space())
    learns(model)
    learns(model, 20)
    assert model.num_timesteps == 20
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == 40


def test_logged_values() -> None:
    model = tiny_model(vectors_space())
    model.learn(STEPS, log_interval=10_000)
    expected = {"actor_loss", "critic_loss", "ent_coef", "ent_coef_loss", "n_updates", "learning_rate"}
    expected |= {"aux_transition_loss", "aux_reward_loss"}
    logged = {name.removeprefix("train/") for name in model.logger.name_to_value if name.startswith("train/")}
    assert logged == expected
    assert all(isinstance(value, int | float) for value in model.logger.name_to_value.values())


def test_callbacks(tmp_path: Any) -> None:
    class Counter(BaseCallback):
        calls = 0

        def _on_step(self) -> bool:
            self.calls += 1
            return self.calls < 30

    space, counter = vectors_space(), Counter()
    callbacks: list[BaseCallback] = [
        counter,
        CheckpointCallback(20, str(tmp_path)),
        EvalCallback(vec_env(space), n_eval_episodes=1, eval_freq=20, verbose=0, best_model_save_path=str(tmp_path)),
    ]
    tiny_model(space, env=vec_env(space)).learn(50, callback=callbacks)
    assert counter.calls == 30
    assert {path.name for path in tmp_path.iterdir()} >= {"rl_model_20_steps.zip", "best_model.zip"}
    HAVESAC.load(tmp_path / "best_model", device="cpu")


# -- Acting


def test_predict_single_and_batched() -> None:
    space = sensors_space()
    model = tiny_model(space)
    space.seed(0)
    rows = [space.sample() for _ in range(3)]
    batch = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    actions, _ = model.predict(batch, deterministic=True)
    assert actions.shape == (3, 2)
    weights = model.modality_weights(batch)
    for i, row in enumerate(rows):
        single, _ = model.predict(row, deterministic=True)
        assert single.shape == (2,)
        np.testing.assert_allclose(single, actions[i], atol=1e-5)
        np.testing.assert_allclose(model.modality_weights(row)["rgb"], weights["rgb"][i : i + 1], atol=1e-5)
    assert not np.allclose(actions[0], actions[1])
    sampled = [model.predict(rows[0])[0] for _ in range(2)]
    assert not np.allclose(sampled[0], sampled[1])


def test_predict_takes_images_either_way_up() -> None:
    space = sensors_space()
    model = tiny_model(space)
    observation = space.sample()
    transposed = {key: value.transpose(2, 0, 1) if value.ndim == 3 else value for key, value in observation.items()}
    actions = [model.predict(one, deterministic=True)[0] for one in (observation, transposed)]
    assert np.array_equal(actions[0], actions[1])


def test_actions_are_scaled_to_the_space() -> None:
    env = RandomSensors(vectors_space())
    env.action_space = spaces.Box(np.array([10.0, -3.0], np.float32), np.array([20.0, 0.0], np.float32))
    model = tiny_model(env.observation_space, env=env)
    observation = env.observation_space.sample()
    actions = np.array([model.predict(observation)[0] for _ in range(30)])
    assert all(env.action_space.contains(action) for action in actions) and actions[:, 0].std() > 0.5
    learns(model)


def test_the_critic_as_sb3_calls_it() -> None:
    model = tiny_model(vectors_space(3), {"n_critics": 3})
    obs, _ = model.policy.obs_to_tensor(batched(model.observation_space.sample()))
    q_values = model.critic(obs, th.zeros(1, 2))
    assert len(q_values) == 3 and all(q.shape == (1, 1) for q in q_values)
    parts = {name: tuple(part.shape) for name, part in model.critic.decompose(obs, th.zeros(1, 2)).items()}
    assert parts == {"q": (3, 1), "q_global": (3, 1), "q_lve": (3, 1), "q_local": (3, 3, 1), "weights": (1, 3)}


@pytest.mark.parametrize(
    "value_estimation,parts", [("lve", {"q", "q_local", "q_lve", "weights"}), ("gve", {"q", "q_global"})]
)
def test_ablations_give_their_parts(value_estimation: str, parts: set[str]) -> None:
    model = tiny_model(vectors_space(), value_estimation=value_estimation)
    obs, _ = model.policy.obs_to_tensor(batched(model.observation_space.sample()))
    found = model.critic.decompose(obs, th.zeros(1, 2))
    assert set(found) == parts
    assert th.equal(found["q"], found["q_lve" if value_estimation == "lve" else "q_global"])


# -- Determinism, and modes


def run_bits(seed: int, **kwargs: Any) -> dict[str, th.Tensor]:
    model = tiny_model(sensors_space(), seed=seed, **kwargs)
    model.learn(25)
    return clone_parameters(model.policy)


@pytest.mark.parametrize("kwargs", [{}, {"modality_dropout": 0.3}, {"use_sde": True}], ids=["plain", "dropout", "sde"])
def test_same_seed_same_bits(kwargs: dict[str, Any]) -> None:
    first, second, third = run_bits(1, **kwargs), run_bits(1, **kwargs), run_bits(2, **kwargs)
    assert all(th.equal(first[name], second[name]) for name in first)
    assert not all(th.equal(first[name], third[name]) for name in first)


class ModeDependent(th.nn.Module):
    """An encoder with batch norm and dropout, which behave differently in training."""

    def __init__(self, space: spaces.Box, features_dim: int):
        super().__init__()
        self.net = th.nn.Sequential(
            th.nn.Linear(space.shape[0], features_dim), th.nn.BatchNorm1d(features_dim), th.nn.Dropout(0.5)
        )

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features: th.Tensor = self.net(observations)
        return features


def test_training_and_evaluation_mode() -> None:
    model = tiny_model(vectors_space(), {"encoder_classes": {"a": ModeDependent}})
    fill_buffer(model, 40)

    def statistics(critic: th.nn.Module) -> list[th.Tensor]:
        return [buffer.clone() for name, buffer in critic.named_buffers() if "running" in name]

    def same(first: list[th.Tensor], second: list[th.Tensor]) -> bool:
        return all(th.equal(a, b) for a, b in zip(first, second, strict=True))

    start = statistics(model.critic)
    observation = {key: np.ones((4, *(box.shape or ())), np.float32) for key, box in vectors_space().items()}
    actions = [model.predict(observation, deterministic=True)[0] for _ in range(2)]
    model.modality_weights(observation)
    assert np.array_equal(actions[0], actions[1]) and same(start, statistics(model.critic))
    assert not model.critic.training and not model.actor.training
    model.train(1, 16)
    assert model.critic.training and model.actor.training and model.policy.auxiliary.training
    assert not any(module.training for module in model.critic_target.modules())
    assert not same(start, statistics(model.critic))
    assert same(statistics(model.critic), statistics(model.critic_target))
    trained = [model.predict(observation, deterministic=True)[0] for _ in range(2)]
    assert np.array_equal(trained[0], trained[1]) and not np.array_equal(trained[0], actions[0])


# -- Modality dropout


def dropped(probability: float, n_modalities: int = 3) -> th.Tensor:
    """(B, d): which modalities of ones are still there."""
    th.manual_seed(0)
    features = th.ones(20_000, n_modalities, 8)
    kept = drop_modalities(features, probability)
    assert th.equal(features, th.ones_like(features))
    assert th.equal(kept, kept[:, :, :1].expand_as(kept)) and ((kept == 0) | (kept == 1)).all()
    return kept[:, :, 0]


@pytest.mark.parametrize("probability", [0.2, 0.5, 0.9])
def test_modality_dropout_blanks_as_often_as_asked_but_never_all(probability: float) -> None:
    kept = dropped(probability)
    assert kept.any(dim=1).all()
    # of 3, all are blank with probability p^3, and then one of them, drawn evenly, is spared
    expected = 1 - probability + probability**3 / 3
    np.testing.assert_allclose(kept.mean(dim=0), expected, atol=0.02)


def test_no_modality_dropout_by_default_nor_of_a_single_modality() -> None:
    assert dropped(0.0).all()
    assert dropped(0.9, n_modalities=1).all()


def test_modality_dropout_reaches_critic_and_actor_alike() -> None:
    """And neither the auxiliary losses nor the acting: those see all modalities."""
    model = tiny_model(vectors_space(3), modality_dropout=0.5)
    fill_buffer(model, 40)
    inputs: dict[str, list[th.Tensor]] = {"critic": [], "actor": [], "auxiliary": []}
    critic_values, actor_log_prob = model.critic.values, model.actor.action_log_prob

    def values(features: th.Tensor, actions: th.Tensor) -> Any:
        inputs["critic"].append(features.detach())
        return critic_values(features, actions)

    def log_prob(features: th.Tensor) -> Any:
        inputs["actor"].append(features.detach().unflatten(1, (3, -1)))  # type: ignore[no-untyped-call]
        return actor_log_prob(features)

    model.critic.values = values  # type: ignore[method-assign]
    model.actor.action_log_prob = log_prob  # type: ignore[method-assign, assignment]
    hook = model.policy.auxiliary["deepmdp"].register_forward_pre_hook(
        lambda module, args: inputs["auxiliary"].append(args[0].features.detach())
    )
    model.train(1, 32)
    hook.remove()
    for_next, for_actor = inputs["actor"]
    for_loss, for_policy = inputs["critic"]
    assert th.equal(for_loss, for_policy) and th.equal(for_loss, for_actor)
    blank = (for_loss == 0).all(dim=2)
    assert blank.any() and not blank.all(dim=1).any()
    assert not (for_next == 0).all(dim=2).any()
    (for_auxiliary,) = inputs["auxiliary"]
    assert not (for_auxiliary == 0).all(dim=2).any()
    observation = model.observation_space.sample()
    actions = [model.predict(observation, deterministic=True)[0] for _ in range(5)]
    assert all(np.array_equal(action, actions[0]) for action in actions)


def test_it_learns_something() -> None:
    """The reward is minus the squared action: the deterministic policy goes to zero."""
    space = vectors_space()
    model = tiny_model(space, env=vec_env(space), learning_rate=3e-3, gamma=0.5, ent_coef=0.01, batch_size=32)
    with th.no_grad():
        model.actor.mu.bias.fill_(1.0)  # type: ignore[operator]
    before, _ = evaluate_policy(model, vec_env(space), n_eval_episodes=3)
    model.learn(400)
    after, _ = evaluate_policy(model, vec_env(space), n_eval_episodes=3)
    assert isinstance(before, float) and isinstance(after, float)
    assert before < -5 and after > before / 10
