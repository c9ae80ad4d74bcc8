"""The algorithm against a second one, written from the equations (have_reference)."""

import math

import numpy as np
import pytest
import torch as th
from envs import FixedBatch, fill_buffer, tiny_model, vectors_space
from have_reference import (
    BATCH,
    MODALITIES,
    TWINS,
    Reference,
    act,
    assert_gradients,
    draw_noise,
    encode,
    global_value,
    local_value,
    make_model,
    refuse,
)

from sb3_have.have import AssignmentNetwork, LocalCritics, RefusionNetwork

CASES = [
    ("have", "convex", "bellman", 1.0),
    ("have", "convex", "paper", 0.5),
    ("have", "monotone", "bellman", 0.25),
    ("have", "monotone", "paper", 1.0),
    ("have", "free", "bellman", 1.0),
    ("have", "free", "paper", 0.0),  # the paper
    ("lve", "convex", "bellman", 1.0),
    ("lve", "convex", "paper", 0.0),
    ("gve", "convex", "bellman", 1.0),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_losses_and_their_gradients(case: tuple[str, str, str, float]) -> None:
    """A training step against the reference: each loss, and one gradient entry of every parameter by differences."""
    model = make_model(*case)
    reference = Reference(model, case[1], draw_noise())
    for optimizer in (model.actor.optimizer, model.critic.optimizer):
        optimizer.zero_grad()
    model.train(gradient_steps=1, batch_size=BATCH)
    logged = model.logger.name_to_value
    p = reference.p
    assert logged["train/critic_loss"] == pytest.approx(reference.critic_loss(p), rel=1e-4)
    assert logged["train/actor_loss"] == pytest.approx(reference.actor_loss(p), rel=1e-4)
    assert logged["train/aux_transition_loss"] == pytest.approx(reference.transition_loss(p), rel=1e-4)
    assert logged["train/aux_reward_loss"] == pytest.approx(reference.reward_loss(p), rel=1e-4)
    assert_gradients(model, reference)


@pytest.mark.parametrize(
    "estimation, refusion, equal",
    [("lve", "free", True), ("gve", "free", True), ("have", "convex", True), ("have", "free", False)],
)
def test_where_the_papers_target_is_the_bellman_target(estimation: str, refusion: str, equal: bool) -> None:
    """Where nothing is re-fused, bit by bit; with convex re-fusion but for rounding; with the paper's not at all."""
    losses = []
    for target in ("bellman", "paper"):
        model = make_model(estimation, refusion, target, 0.0)
        draw_noise()
        model.train(1, BATCH)
        losses.append(model.logger.name_to_value["train/critic_loss"])
    assert losses[0] == losses[1] or estimation == "have"
    assert (losses[0] == pytest.approx(losses[1], rel=1e-5)) is equal


@pytest.mark.parametrize("refusion", ["convex", "monotone", "free"])
def test_parts_of_the_value(refusion: str) -> None:
    """``decompose`` and the critic's call: local and global values, weights (Eq. 9), LVE (Eq. 6), H (3.4)."""
    model = make_model("have", refusion, "bellman", 1.0)
    reference = Reference(model, refusion, draw_noise())
    assert isinstance(model.replay_buffer, FixedBatch)
    batch = model.replay_buffer.batch
    with th.no_grad():
        parts = model.critic.decompose(batch.observations, batch.actions)
        q_values = model.critic(batch.observations, batch.actions)
    assert [q.shape for q in q_values] == [(BATCH, 1)] * TWINS
    for b in range(BATCH):
        z, a = reference.features[b], reference.actions[b]
        np.testing.assert_allclose(parts["weights"][b], reference.weights(reference.p, "critic", z), rtol=1e-4)
        for k in range(TWINS):
            q_g, q_l = global_value(reference.p, "critic", k, z, a), reference.lve(reference.p, "critic", k, z, a)
            local = [local_value(reference.p, "critic", k, i, z, a) for i in range(MODALITIES)]
            np.testing.assert_allclose(parts["q_local"][k, :, b], local, rtol=1e-3, atol=1e-5)
            assert float(parts["q_global"][k, b]) == pytest.approx(q_g, rel=1e-3, abs=1e-5)
            assert float(parts["q_lve"][k, b]) == pytest.approx(q_l, rel=1e-3, abs=1e-5)
            expected = refuse(reference.p, "critic", refusion, q_g, q_l, z)
            assert float(parts["q"][k, b]) == pytest.approx(expected, rel=1e-3, abs=1e-5)
            assert float(q_values[k][b]) == float(parts["q"][k, b])


def test_entropy_temperature_loss() -> None:
    """Automatic temperature: J(alpha) = -log alpha (log pi + target entropy), and the alpha that the losses use."""
    model = tiny_model(vectors_space(), ent_coef="auto_0.5", learning_rate=0.0, replay_buffer_class=FixedBatch)
    fill_buffer(model, 20)
    assert isinstance(model.replay_buffer, FixedBatch)
    model.replay_buffer.batch = super(FixedBatch, model.replay_buffer).sample(BATCH)
    p = {name: value.detach().double().numpy() for name, value in model.policy.named_parameters()}
    noise = draw_noise()
    observations = model.replay_buffer.batch.observations
    log_probs = []
    for b in range(BATCH):
        z = encode(p, "critic", {key: value[b].double().numpy() for key, value in observations.items()})
        log_probs.append(act(p, z, noise[0, b])[1])
    model.train(1, BATCH)
    expected = sum(-math.log(0.5) * (log_prob - 2.0) for log_prob in log_probs) / BATCH  # target entropy: -A = -2
    assert model.logger.name_to_value["train/ent_coef"] == pytest.approx(0.5)
    assert model.logger.name_to_value["train/ent_coef_loss"] == pytest.approx(expected, rel=1e-4)


def random_heads(form: str, n_states: int, scale: float, seed: int = 0) -> tuple[RefusionNetwork, th.Tensor]:
    """A re-fusion network with weights far from their initial ones, and random features."""
    th.manual_seed(seed)
    network = RefusionNetwork(MODALITIES, 6, form)
    with th.no_grad():
        for parameter in network.parameters():
            parameter.add_(scale * th.randn_like(parameter))
    return network, th.randn(n_states, MODALITIES, 6)


@pytest.mark.parametrize("form", ["convex", "monotone"])
@pytest.mark.parametrize("low,high", [(-1.0, 1.0), (-500.0, 0.0), (0.0, 1000.0)])
def test_mixing_rises_with_both_values(form: str, low: float, high: float) -> None:
    """Remark 1: dH/dq_g > 0 and dH/dq_l > 0, by autograd, in 10,000 random states."""
    network, features = random_heads(form, 10_000, 0.5)
    q_g, q_l = ((low + (high - low) * th.rand(TWINS, 10_000)).requires_grad_() for _ in range(2))
    gradients = th.autograd.grad(network(q_g, q_l, features).sum(), (q_g, q_l))
    for gradient in gradients:
        assert gradient.shape == (TWINS, 10_000)
        assert float(gradient.min()) > 0


def test_free_mixing_has_no_such_guarantee() -> None:
    """The contrast: without the constraint the paper's form falls in one of the values in many states."""
    network, features = random_heads("free", 2_000, 0.5)
    q_g, q_l = (th.rand(TWINS, 2_000).requires_grad_() for _ in range(2))
    (gradient,) = th.autograd.grad(network(q_g, q_l, features).sum(), q_g)
    assert 0.1 < float((gradient < 0).float().mean()) < 0.9


def test_convex_mixing_is_a_weighted_mean_and_begins_even() -> None:
    network, features = random_heads("convex", 500, 0.5)
    q_g, q_l = th.randn(TWINS, 500), th.randn(TWINS, 500)
    mixed = network(q_g, q_l, features)
    assert th.all(mixed <= th.maximum(q_g, q_l) + 1e-6) and th.all(mixed >= th.minimum(q_g, q_l) - 1e-6)
    assert th.allclose(network(q_g, q_g, features), q_g, atol=1e-6)
    fresh = RefusionNetwork(MODALITIES, 6)(th.ones(1, 500), th.zeros(1, 500), features)
    assert th.allclose(fresh, th.full_like(fresh, 0.5), atol=0.1)


def test_weights_are_a_distribution() -> None:
    th.manual_seed(0)
    for scale in (1.0, 30.0):
        weights = AssignmentNetwork(MODALITIES, 6)(scale * th.randn(10_000, MODALITIES, 6)).detach()
        assert weights.shape == (10_000, MODALITIES)
        assert float(weights.min()) >= 0
        assert scale > 1 or float(weights.min()) > 0
        assert th.allclose(weights.sum(dim=1), th.ones(10_000), atol=1e-5)
    assert float(weights.std()) > 0.05  # they do depend on the state


def test_permuting_the_modalities_permutes_the_weights() -> None:
    th.manual_seed(0)
    network, permuted = AssignmentNetwork(MODALITIES, 6), AssignmentNetwork(MODALITIES, 6)
    order = [2, 0, 1]
    with th.no_grad():
        permuted.key.weight.copy_(network.key.weight)
        blocks = network.query.weight.view(-1, MODALITIES, 6)
        permuted.query.weight.copy_(blocks[:, order].flatten(start_dim=1))
    features = 3 * th.randn(50, MODALITIES, 6)
    weights = network(features)
    assert th.allclose(permuted(features[:, order]), weights[:, order], atol=1e-5)
    assert not th.allclose(permuted(features[:, order]), weights, atol=1e-2)


def test_a_local_critic_sees_its_own_modality_and_the_action_alone() -> None:
    th.manual_seed(0)
    critics = LocalCritics(MODALITIES, 6, 2, [16])
    features, actions = th.randn(20, MODALITIES, 6), th.randn(20, 2)
    before = critics(features, actions)
    for i in range(MODALITIES):
        other = features.clone()
        other[:, i] = th.randn(20, 6)
        moved = (critics(other, actions) != before).any(dim=2)  # (K, d)
        assert moved[:, i].all() and moved.sum() == TWINS
    assert (critics(features, th.randn(20, 2)) != before).all(dim=2).all()
