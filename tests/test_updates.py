"""Who learns from what: optimizers, gradients, target networks."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch as th
from envs import changed, clone_parameters, fill_buffer, sensors_space, tiny_model, vectors_space

from sb3_have import HAVESAC

TAU = 0.01


def ready_model(mixed: bool = True, **kwargs: Any) -> HAVESAC:
    model = tiny_model(sensors_space() if mixed else vectors_space(3), tau=TAU, learning_rate=1e-3, **kwargs)
    fill_buffer(model, 40)
    return model


def optimized(optimizer: th.optim.Optimizer) -> set[int]:
    return {id(parameter) for group in optimizer.param_groups for parameter in group["params"]}


def value_names(model: HAVESAC) -> set[str]:
    return {name for name, _ in model.policy.named_parameters() if name.startswith(("critic.", "auxiliary."))}


PARTS = {
    "have": {"encoder", "local_critics", "global_critic", "assignment", "refusion"},
    "lve": {"encoder", "local_critics", "assignment"},
    "gve": {"encoder", "global_critic"},
}


@pytest.mark.parametrize("refusion", ["convex", "monotone", "free"])
@pytest.mark.parametrize("value_estimation", PARTS)
def test_every_parameter_learns(value_estimation: str, refusion: str) -> None:
    model = ready_model(value_estimation=value_estimation, refusion=refusion)
    assert {name for name, _ in model.critic.named_children()} == PARTS[value_estimation]
    before = clone_parameters(model.policy)
    model.train(1, batch_size=32)
    learnt = {name for name in before if not name.startswith("critic_target.")}
    assert changed(before, model.policy) >= learnt, learnt - changed(before, model.policy)


def test_every_twin_and_modality_learns() -> None:
    """The parallel networks are single tensors: look at each network inside."""
    model = ready_model()
    heads = {
        name: parameter.detach().clone()
        for name, parameter in model.policy.named_parameters()
        if name.startswith(("critic.local_critics", "critic.global_critic", "auxiliary"))
    }
    model.train(1, batch_size=32)
    for name, parameter in model.policy.named_parameters():
        if name in heads:
            for net in range(len(parameter)):
                assert not th.equal(parameter[net], heads[name][net]), (name, net)
    assert len(heads["critic.local_critics.net.0.weight"]) == 2 * 3
    assert len(heads["critic.global_critic.net.0.weight"]) == 2


def test_each_parameter_has_one_optimizer() -> None:
    model = ready_model()
    critic_side, actor_side = optimized(model.critic.optimizer), optimized(model.actor.optimizer)
    by_name = dict(model.policy.named_parameters())
    assert critic_side == {id(by_name[name]) for name in value_names(model)}
    assert actor_side == {id(parameter) for parameter in model.actor.parameters()}
    assert not critic_side & actor_side
    targets = [parameter for name, parameter in by_name.items() if name.startswith("critic_target.")]
    assert targets and not any(parameter.requires_grad for parameter in targets)
    assert len(by_name) == len(value_names(model)) + len(list(model.actor.parameters())) + len(targets)


@pytest.mark.parametrize("use_sde", [False, True])
def test_the_actors_loss_moves_the_actor_alone(use_sde: bool) -> None:
    model = ready_model(use_sde=use_sde)
    before = clone_parameters(model.policy)
    model.critic.optimizer.step = lambda *args: None  # type: ignore[method-assign, assignment]
    model.train(3, batch_size=32)
    moved = changed(before, model.policy)
    assert moved == {name for name in before if name.startswith("actor.")}


def test_the_critics_loss_moves_the_values_alone() -> None:
    model = ready_model()
    before = clone_parameters(model.policy)
    model.actor.optimizer.step = lambda *args: None  # type: ignore[method-assign, assignment]
    model.train(1, batch_size=32)
    moved = changed(before, model.policy)
    assert {name for name in moved if not name.startswith("critic_target.")} == value_names(model)


def test_the_actors_loss_leaves_no_gradient_in_the_values() -> None:
    """Gradients after a step are those of the critic's loss: with a critic's loss of nothing they are nothing."""
    model = ready_model(auxiliary=None)
    model._critic_loss = lambda values, target_q: 0.0 * values.q.sum()  # type: ignore[method-assign]
    model.train(1, batch_size=32)
    gradients = [p.grad for p in model.critic.parameters() if p.grad is not None]
    assert gradients and all(not gradient.any() for gradient in gradients)
    assert all(p.grad is not None and p.grad.any() for p in model.actor.latent_pi.parameters())


def test_auxiliary_losses_train_the_encoder() -> None:
    model = ready_model()
    model._critic_loss = lambda values, target_q: 0.0 * values.q.sum()  # type: ignore[method-assign]
    before = clone_parameters(model.critic.encoder)
    model.train(1, batch_size=32)
    assert changed(before, model.critic.encoder) == set(before)


def test_the_target_follows_by_tau_and_by_nothing_else() -> None:
    """After every update, target = (1 - tau) target + tau critic, for every parameter."""
    model = ready_model()
    with th.no_grad():
        for parameter in model.critic_target.parameters():
            parameter.add_(0.1 * th.randn_like(parameter))
    for _ in range(3):
        target = clone_parameters(model.critic_target)
        model.train(1, batch_size=32)
        assert changed(target, model.critic_target) == set(target)
        online = dict(model.critic.named_parameters())
        for name, parameter in model.critic_target.named_parameters():
            expected = (1 - TAU) * target[name] + TAU * online[name].detach()
            assert th.allclose(parameter, expected, rtol=1e-5, atol=1e-7), name
            by_half = (1 - TAU / 2) * target[name] + TAU / 2 * online[name].detach()
            assert not th.allclose(parameter, by_half, rtol=1e-5, atol=1e-7), name


def test_the_target_begins_as_a_copy_of_its_own() -> None:
    model = ready_model(mixed=False)
    fresh = tiny_model(vectors_space(3))
    online = dict(fresh.critic.named_parameters())
    for name, parameter in fresh.critic_target.named_parameters():
        assert th.equal(parameter, online[name]) and parameter.data_ptr() != online[name].data_ptr()
    with th.no_grad():
        next(model.critic.parameters()).zero_()
    assert next(model.critic_target.parameters()).any()


@pytest.mark.parametrize(
    "gradient_steps,interval,expected",
    [(1, 3, [False, False, True, False, False, True]), (2, 4, [False, True, False, True]), (3, 4, [False, True, True])],
)
def test_target_update_interval_counts_all_updates(gradient_steps: int, interval: int, expected: list[bool]) -> None:
    """SB3's SAC counts within a call of ``train``, so that there the interval does nothing with one update a call."""
    model = ready_model(mixed=False, target_update_interval=interval)
    history = [clone_parameters(model.critic_target)]
    for _ in expected:
        model.train(gradient_steps, batch_size=8)
        history.append(clone_parameters(model.critic_target))
    moved = [any(not th.equal(a[name], b[name]) for name in a) for a, b in pairwise(history)]
    assert moved == expected


def test_batch_norm_statistics_reach_the_target() -> None:
    class Normalised(th.nn.Module):
        def __init__(self, space: Any, features_dim: int):
            super().__init__()
            self.net = th.nn.Sequential(th.nn.Linear(space.shape[0], features_dim), th.nn.BatchNorm1d(features_dim))

        def forward(self, observations: th.Tensor) -> th.Tensor:
            features: th.Tensor = self.net(observations)
            return features

    model = ready_model(mixed=False, policy_kwargs={"encoder_classes": {"b": Normalised}})
    before = {name: buffer.clone() for name, buffer in model.critic_target.named_buffers() if "running" in name}
    assert before
    model.train(2, batch_size=32)
    online = dict(model.critic.named_buffers())
    for name, buffer in model.critic_target.named_buffers():
        if "running" in name:
            assert th.equal(buffer, online[name]) and not th.equal(buffer, before[name]), name


def test_gradient_steps_and_learning_rate_schedule() -> None:
    model = ready_model(mixed=False)
    model.lr_schedule = lambda progress: 1e-3 * progress
    model._current_progress_remaining = 0.25
    model.train(4, batch_size=8)
    assert model._n_updates == 4
    optimizers = [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]
    assert [optimizer.param_groups[0]["lr"] for optimizer in optimizers if optimizer] == [0.25e-3] * 3


@pytest.mark.parametrize("options", [{}, {"random_shift": 4, "n_augmentations": 2}], ids=str)
def test_every_observation_is_encoded_once(options: dict[str, Any]) -> None:
    """The encoder is the cost of an update: obs once by the critic's, next_obs once by the target's."""
    model = tiny_model(sensors_space(), **options)
    fill_buffer(model, 20)
    calls = {"critic": 0, "target": 0}

    def count(name: str) -> Callable[..., None]:
        def hook(*_: Any) -> None:
            calls[name] += 1

        return hook

    model.critic.encoder.register_forward_hook(count("critic"))
    model.critic_target.encoder.register_forward_hook(count("target"))
    model.train(3, batch_size=8)
    assert calls == {"critic": 3, "target": 3}


def test_frozen_actor_parameters_stay() -> None:
    model = tiny_model(vectors_space())
    fill_buffer(model, 20)
    model.actor.latent_pi.requires_grad_(False)
    before = clone_parameters(model.actor)
    model.train(2, batch_size=8)
    assert changed(before, model.actor) == {"mu.weight", "mu.bias", "log_std.weight", "log_std.bias"}


@pytest.mark.parametrize("options", [{"foreach": True}, {"fused": False}, {"weight_decay": 1e-4}])
def test_options_of_adam(options: dict[str, Any]) -> None:
    model = tiny_model(vectors_space(), {"optimizer_kwargs": options})
    fill_buffer(model, 20)
    model.train(1, batch_size=8)
    group = model.critic.optimizer.param_groups[0]
    assert all(group[name] == value for name, value in options.items())
