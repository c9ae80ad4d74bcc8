"""Auxiliary losses: DeepMDP's coefficients and schedule, an own loss plugged in, switching on and off."""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch as th
from envs import RandomSensors, changed, clone_parameters, fill_buffer, tiny_model, vector, vectors_space
from stable_baselines3 import SAC

from sb3_have import HAVESAC, DeepMDPCallback
from sb3_have.have import AuxiliaryLoss, AuxiliaryLossCallback, DeepMDP
from sb3_have.have.auxiliary import LatentTransitions


class InverseDynamics(AuxiliaryLoss):
    """A toy: the action from the features before and after it; and a count of the samples, which trains nothing."""

    terms: ClassVar[tuple[str, ...]] = ("inverse", "samples")

    def __init__(self, n_modalities: int, features_dim: int, action_dim: int):
        super().__init__(n_modalities, features_dim, action_dim)
        self.net = th.nn.Linear(2 * n_modalities * features_dim, action_dim)

    def forward(self, batch: LatentTransitions) -> dict[str, th.Tensor]:
        both = th.cat([batch.features.flatten(start_dim=1), batch.next_features.flatten(start_dim=1)], dim=1)
        loss = th.nn.functional.mse_loss(self.net(both), batch.actions)
        return {"inverse": loss, "samples": th.tensor(float(len(batch.actions)))}


def model_with(auxiliary: Any, **kwargs: Any) -> HAVESAC:
    model = tiny_model(vectors_space(), auxiliary=auxiliary, learning_rate=1e-3, **kwargs)
    fill_buffer(model, 50)
    return model


def logged_terms(model: HAVESAC) -> set[str]:
    return {name for name in model.logger.name_to_value if name.startswith("train/aux_")}


DEEPMDP_TERMS = {"train/aux_transition_loss", "train/aux_reward_loss"}


def test_an_own_loss_is_trained_and_logged() -> None:
    model = model_with({"inverse": InverseDynamics})
    assert model.auxiliary_coefs == {"inverse": 1.0, "samples": 1.0}
    heads = model.policy.auxiliary["inverse"]
    assert list(model.policy.auxiliary) == ["inverse"]
    before = clone_parameters(heads)
    losses = []
    for _ in range(2):
        model.train(100, batch_size=32)
        losses.append(model.logger.name_to_value["train/aux_inverse_loss"])
    assert losses[1] < 0.9 * losses[0]
    assert changed(before, heads) == {"net.weight", "net.bias"}
    assert logged_terms(model) == {"train/aux_inverse_loss", "train/aux_samples_loss"}
    assert model.logger.name_to_value["train/aux_samples_loss"] == 32


def test_an_own_loss_beside_deepmdp() -> None:
    model = model_with({"deepmdp": DeepMDP, "inverse": InverseDynamics})
    before = clone_parameters(model.policy.auxiliary)
    model.train(1, batch_size=32)
    assert changed(before, model.policy.auxiliary) == set(before)
    assert logged_terms(model) == DEEPMDP_TERMS | {"train/aux_inverse_loss", "train/aux_samples_loss"}


def test_an_own_loss_survives_saving(tmp_path: Path) -> None:
    model = model_with({"inverse": InverseDynamics})
    model.auxiliary_coefs["inverse"] = 0.25
    model.train(3, batch_size=32)
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", device="cpu")
    assert loaded.auxiliary_coefs == {"inverse": 0.25, "samples": 1.0}
    heads = dict(model.policy.auxiliary.named_parameters())
    for name, parameter in loaded.policy.auxiliary.named_parameters():
        assert th.equal(parameter, heads[name]), name
    before = clone_parameters(loaded.policy.auxiliary["inverse"])
    fill_buffer(loaded, 50)
    loaded.train(1, batch_size=32)
    assert changed(before, loaded.policy.auxiliary["inverse"]) == set(before)


def test_a_coefficient_scales_the_gradient() -> None:
    """The encoder's gradient is linear in the coefficients: critic + 3 transition - the same without."""
    gradients = {}
    for coefficient in (0.0, 1.0, 3.0):
        model = model_with("deepmdp")
        model.auxiliary_coefs.update(transition=coefficient, reward=0.0)
        th.manual_seed(0)
        model.replay_buffer.sample = lambda *args, model=model, **kwargs: fixed_batch(model)  # type: ignore[union-attr, method-assign]
        model.train(1, batch_size=32)
        parameters = model.critic.encoder.parameters()
        gradients[coefficient] = th.cat([p.grad.flatten() for p in parameters if p.grad is not None])
    single, triple = gradients[1.0] - gradients[0.0], gradients[3.0] - gradients[0.0]
    assert single.norm() > 1e-3
    assert th.allclose(triple, 3 * single, rtol=1e-2, atol=1e-4)


def fixed_batch(model: HAVESAC) -> Any:
    assert model.replay_buffer is not None
    return model.replay_buffer._get_samples(np.arange(32))


def test_callback_sets_the_coefficients() -> None:
    model = model_with("deepmdp")
    model.learn(20, callback=DeepMDPCallback(transition_coef=0.5, reward_coef=2.0))
    assert model.auxiliary_coefs == {"transition": 0.5, "reward": 2.0}


def test_callback_schedules_the_coefficients() -> None:
    seen = []

    class Spy(DeepMDPCallback):
        def _on_step(self) -> bool:
            go_on = super()._on_step()
            seen.append(self.model.auxiliary_coefs["reward"])
            return go_on

    model = model_with("deepmdp")
    model.learn(40, callback=Spy(reward_coef=2.0, schedule=lambda progress: progress))
    assert seen[0] == pytest.approx(2.0, rel=0.05) and seen[-1] == pytest.approx(0.0, abs=0.1)
    assert seen == sorted(seen, reverse=True) and len(set(seen)) > 30


def test_the_initial_actor_does_not_depend_on_the_auxiliary_losses() -> None:
    with_heads, without = model_with("deepmdp"), model_with(None)
    assert not without.policy.auxiliary
    weights = with_heads.policy.state_dict()
    for name, value in without.policy.state_dict().items():
        assert th.equal(value, weights[name]), name


def test_callback_needs_a_model_with_its_losses() -> None:
    with pytest.raises(ValueError, match="it has none; build it with"):
        model_with(None).learn(20, callback=DeepMDPCallback())


def test_coefficient_of_zero_trains_nothing_but_logs() -> None:
    model = model_with("deepmdp")
    before = clone_parameters(model.policy.auxiliary)
    model.learn(20, callback=DeepMDPCallback(transition_coef=0.0, reward_coef=0.0), log_interval=100)
    assert not changed(before, model.policy.auxiliary)
    assert model.logger.name_to_value["train/aux_reward_loss"] > 0


def test_callback_refuses_unknown_terms() -> None:
    model = model_with("deepmdp")
    with pytest.raises(ValueError, match=r"no auxiliary loss 'inverse', it has 'transition', 'reward'.*auxiliary="):
        model.learn(10, callback=AuxiliaryLossCallback({"inverse": 1.0}))


def test_callback_refuses_other_algorithms() -> None:
    model = SAC("MlpPolicy", RandomSensors(vector(3)), policy_kwargs={"net_arch": [4]}, buffer_size=10, device="cpu")
    with pytest.raises(ValueError, match="HAVESAC"):
        model.learn(10, callback=DeepMDPCallback())


def test_deepmdp_learns_the_reward_and_the_next_features() -> None:
    """Rewards are a function of the action here: the head finds it."""
    model = model_with("deepmdp", learning_starts=50, batch_size=32)
    model.learn(60)
    early = model.logger.name_to_value["train/aux_reward_loss"]
    model.learn(250)
    assert model.logger.name_to_value["train/aux_reward_loss"] < 0.5 * early


def test_two_losses_of_one_name_are_refused() -> None:
    """A term names one coefficient and one curve."""

    class OwnReward(InverseDynamics):
        terms: ClassVar[tuple[str, ...]] = ("reward", "samples")

    with pytest.raises(ValueError, match="reward"):
        model_with({"deepmdp": DeepMDP, "own": OwnReward})


class OwnDeepMDP(DeepMDP):
    """Takes DeepMDP's place."""


def test_an_own_class_in_the_place_of_deepmdp() -> None:
    model = model_with({"deepmdp": OwnDeepMDP})
    assert type(model.policy.auxiliary["deepmdp"]) is OwnDeepMDP
    model.train(1, batch_size=8)
    assert logged_terms(model) == DEEPMDP_TERMS


def test_losses_must_be_those_announced() -> None:
    class Silent(InverseDynamics):
        terms: ClassVar[tuple[str, ...]] = ("inverse", "samples", "silence")

    model = model_with({"silent": Silent})
    with pytest.raises(ValueError, match="silence"):
        model.train(1, batch_size=8)


@pytest.mark.parametrize("auxiliary", [{"x": 3}, DeepMDP, {"": DeepMDP}])
def test_what_is_no_auxiliary_loss(auxiliary: Any) -> None:
    with pytest.raises(ValueError, match="AuxiliaryLoss class"):
        model_with(auxiliary)


def test_a_schedule_starts_again_with_every_run() -> None:
    model = tiny_model(vectors_space())
    callback = DeepMDPCallback(schedule=lambda progress_remaining: progress_remaining)
    model.learn(20, callback)
    assert model.auxiliary_coefs["reward"] == 0.0
    seen: list[float] = []

    class Watch(DeepMDPCallback):
        def _on_step(self) -> bool:
            super()._on_step()
            seen.append(self.model.auxiliary_coefs["reward"])
            return True

    model.learn(20, Watch(schedule=lambda progress_remaining: progress_remaining))
    np.testing.assert_allclose(seen, 1 - np.arange(1, 21) / 20)
