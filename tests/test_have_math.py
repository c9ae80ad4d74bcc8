"""The algorithm against a second one, written from the equations: loops over numbers, float64, no shared code."""

import math
from collections.abc import Mapping

import numpy as np
import pytest
import torch as th
from envs import FixedBatch, fill_buffer, tiny_model, vectors_space
from numpy.typing import NDArray

from sb3_have import HAVESAC
from sb3_have.have import AssignmentNetwork, LocalCritics, RefusionNetwork

Array = NDArray[np.float64]
Parameters = Mapping[str, Array]
BATCH, MODALITIES, TWINS = 4, 3, 2
GAMMA, ENT_COEF = 0.9, 0.3


# -- The slow reference: p holds every parameter of the policy by name


def linear(p: Parameters, name: str, x: Array) -> Array:
    """torch.nn.Linear: weight (out, in)."""
    weight, bias = p[f"{name}.weight"], p.get(f"{name}.bias")
    return np.array([weight[o] @ x + (0.0 if bias is None else bias[o]) for o in range(len(weight))])


def head(p: Parameters, name: str, net: int, x: Array) -> Array:
    """Net number ``net`` of several side by side, one hidden layer: weights (net, in, out)."""
    for layer in (0, 2):
        weight, bias = p[f"{name}.{layer}.weight"][net], p[f"{name}.{layer}.bias"][net, 0]
        x = np.array([x @ weight[:, o] + bias[o] for o in range(len(bias))])
        x = np.maximum(x, 0.0) if layer == 0 else x
    return x


def encode(p: Parameters, critic: str, observation: Mapping[str, Array]) -> list[Array]:
    """z_i of one observation: linear, ReLU, linear, LayerNorm."""
    features = []
    for i, vector in enumerate(observation.values()):
        name = f"{critic}.encoder.encoders.{i}.net"
        x = linear(p, f"{name}.2", np.maximum(linear(p, f"{name}.0", vector), 0.0))
        mean = sum(x) / len(x)
        variance = sum((value - mean) ** 2 for value in x) / len(x)
        features.append((x - mean) / math.sqrt(variance + 1e-5) * p[f"{name}.3.weight"] + p[f"{name}.3.bias"])
    return features


def local_value(p: Parameters, critic: str, k: int, i: int, z: list[Array], a: Array) -> float:
    return float(head(p, f"{critic}.local_critics.net", k * len(z) + i, np.concatenate([z[i], a]))[0])


def global_value(p: Parameters, critic: str, k: int, z: list[Array], a: Array) -> float:
    return float(head(p, f"{critic}.global_critic.net", k, np.concatenate([*z, a]))[0])


def assignment(p: Parameters, critic: str, z: list[Array]) -> list[float]:
    """Eq. 9."""
    query = linear(p, f"{critic}.assignment.query", np.concatenate(z))
    scores = []
    for z_i in z:
        key = linear(p, f"{critic}.assignment.key", z_i)
        scores.append(sum(q * k for q, k in zip(query, key, strict=True)) / math.sqrt(len(query)))
    total = sum(math.exp(score) for score in scores)
    return [math.exp(score) / total for score in scores]


def lve(p: Parameters, critic: str, k: int, z: list[Array], a: Array) -> float:
    """Eq. 6."""
    return sum(w * local_value(p, critic, k, i, z, a) for i, w in enumerate(assignment(p, critic, z)))


def refuse(p: Parameters, critic: str, form: str, q_g: float, q_l: float, z: list[Array]) -> float:
    """H(q_g, q_l; z_g), section 3.4."""
    z_g = np.concatenate(z)
    if form == "convex":
        gate = linear(p, f"{critic}.refusion.gate", z_g)
        b_g = 1 / (1 + math.exp(gate[1] - gate[0]))
        return b_g * q_g + (1 - b_g) * q_l
    w1, b1, w2, (b2,) = (linear(p, f"{critic}.refusion.hyper_{name}", z_g) for name in ("w1", "b1", "w2", "b2"))
    units, mixed = len(b1), b2
    for j in range(units):
        from_global, from_local, out = w1[j], w1[units + j], w2[j]
        if form == "monotone":
            from_global, from_local = math.log1p(math.exp(from_global)), math.log1p(math.exp(from_local))
            out = math.log1p(math.exp(out)) / units
        hidden = from_global * q_g + from_local * q_l + b1[j]
        mixed += out * (hidden if hidden > 0 else 0.1 * hidden)
    return float(mixed)


def act(p: Parameters, z: list[Array], noise: Array) -> tuple[Array, float]:
    """Squashed Gaussian: the action and its log probability."""
    hidden = np.maximum(linear(p, "actor.latent_pi.0", np.concatenate(z)), 0.0)
    mean = linear(p, "actor.mu", hidden)
    log_std = np.clip(linear(p, "actor.log_std", hidden), -20, 2)
    action = np.tanh(mean + np.exp(log_std) * noise)
    log_prob = 0.0
    for j in range(len(noise)):
        log_prob += -0.5 * noise[j] ** 2 - log_std[j] - 0.5 * math.log(2 * math.pi)
        log_prob -= math.log(1 - action[j] ** 2 + 1e-6)
    return action, log_prob


class Reference:
    """The losses of one batch, each a mean over its samples.

    :param model: whose settings and parameters are read
    :param form: refusion
    :param noise: of the actions at the observations and at the next observations, (2, B, A)
    """

    def __init__(self, model: HAVESAC, form: str, noise: Array):
        self.estimation, self.form, self.target = model.critic.value_estimation, form, model.target
        self.local_coef, self.noise = model.local_coef, noise
        self.p = {name: value.detach().double().numpy().copy() for name, value in model.policy.named_parameters()}
        assert isinstance(model.replay_buffer, FixedBatch)
        batch = model.replay_buffer.batch
        as_rows = [batch.observations, batch.next_observations]
        self.obs, self.next_obs = (
            [{key: value[b].double().numpy() for key, value in rows.items()} for b in range(BATCH)] for rows in as_rows
        )
        self.actions = batch.actions.double().numpy()
        self.rewards = [float(value) for value in batch.rewards[:, 0]]
        self.dones = [float(value) for value in batch.dones[:, 0]]
        # Fixed in the losses' gradients
        self.targets = [self._target(b) for b in range(BATCH)]
        self.next_features = [encode(self.p, "critic_target", obs) for obs in self.next_obs]
        self.features = [encode(self.p, "critic", obs) for obs in self.obs]

    def value(self, p: Parameters, critic: str, k: int, z: list[Array], a: Array) -> float:
        if self.estimation == "lve":
            return lve(p, critic, k, z, a)
        q_g = global_value(p, critic, k, z, a)
        return q_g if self.estimation == "gve" else refuse(p, critic, self.form, q_g, lve(p, critic, k, z, a), z)

    def _target(self, b: int) -> float:
        z = encode(self.p, "critic_target", self.next_obs[b])
        a, log_prob = act(self.p, z, self.noise[1, b])
        r, discount, entropy = self.rewards[b], GAMMA * (1 - self.dones[b]), -ENT_COEF * log_prob
        if self.target == "bellman" or self.estimation != "have":
            q = min(self.value(self.p, "critic_target", k, z, a) for k in range(TWINS))
            return r + discount * (q + entropy)
        mixed = []
        for k in range(TWINS):  # Eq. 10
            y_g = r + discount * (global_value(self.p, "critic_target", k, z, a) + entropy)
            y_l = r + discount * (lve(self.p, "critic_target", k, z, a) + entropy)
            mixed.append(refuse(self.p, "critic_target", self.form, y_g, y_l, z))
        return min(mixed)

    def critic_loss(self, p: Parameters) -> float:
        total = 0.0
        for b in range(BATCH):
            z, a, y = encode(p, "critic", self.obs[b]), self.actions[b], self.targets[b]
            for k in range(TWINS):
                total += 0.5 * (self.value(p, "critic", k, z, a) - y) ** 2 / BATCH
                supervised = []
                if self.estimation != "gve":
                    local = [local_value(p, "critic", k, i, z, a) for i in range(MODALITIES)]
                    supervised.append(sum((q - y) ** 2 for q in local) / MODALITIES)
                if self.estimation == "have":
                    supervised.append((global_value(p, "critic", k, z, a) - y) ** 2)
                    supervised.append((lve(p, "critic", k, z, a) - y) ** 2)
                total += self.local_coef * 0.5 * sum(supervised) / BATCH
        return total

    def transition_loss(self, p: Parameters) -> float:
        """Eq. 12, the next latent: half from each modality's own features, half from all of them."""
        name, local, fused = "auxiliary.deepmdp", 0.0, 0.0
        for b in range(BATCH):
            z, a, z_next = encode(p, "critic", self.obs[b]), self.actions[b], self.next_features[b]
            for i in range(MODALITIES):
                error = head(p, f"{name}.local_transition", i, np.concatenate([z[i], a])) - z_next[i]
                local += sum(error**2) / len(error) / MODALITIES / BATCH
            error = head(p, f"{name}.global_transition", 0, np.concatenate([*z, a])) - np.concatenate(z_next)
            fused += sum(error**2) / len(error) / BATCH
        return 0.5 * (local + fused)

    def reward_loss(self, p: Parameters) -> float:
        """Eq. 12, the reward from all features."""
        total = 0.0
        for b in range(BATCH):
            z = encode(p, "critic", self.obs[b])
            prediction = head(p, "auxiliary.deepmdp.reward", 0, np.concatenate([*z, self.actions[b]]))[0]
            total += (prediction - self.rewards[b]) ** 2 / BATCH
        return float(total)

    def actor_loss(self, p: Parameters) -> float:
        """Eq. 11: the minimum over the twins after mixing, the entropy once and outside."""
        total = 0.0
        for b in range(BATCH):
            z = self.features[b]
            a, log_prob = act(p, z, self.noise[0, b])
            total += (ENT_COEF * log_prob - min(self.value(p, "critic", k, z, a) for k in range(TWINS))) / BATCH
        return total


# -- The tests

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


def make_model(estimation: str, refusion: str, target: str, local_coef: float) -> HAVESAC:
    """A model that learns nothing (learning rate 0), target and online networks different, and one batch."""
    model = tiny_model(
        vectors_space(MODALITIES),
        value_estimation=estimation,
        refusion=refusion,
        target=target,
        local_coef=local_coef,
        gamma=GAMMA,
        ent_coef=ENT_COEF,
        learning_rate=0.0,
        tau=0.0,
        replay_buffer_class=FixedBatch,
        policy_kwargs={"features_dim": 4, "net_arch": [5], "encoder_kwargs": {"a": {"net_arch": [3]}}},
    )
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.3 * th.randn_like(parameter))
        for parameter in [*model.actor.mu.parameters(), *model.actor.log_std.parameters()]:  # type: ignore[attr-defined]
            parameter.mul_(0.3)  # away from actions of 1, where log(1 - a^2) loses float32's digits
    fill_buffer(model, 20)
    buffer = model.replay_buffer
    assert isinstance(buffer, FixedBatch)
    batch = super(FixedBatch, buffer).sample(BATCH)
    buffer.batch = batch._replace(dones=th.tensor([[0.0], [1.0], [0.0], [0.0]]))
    return model


def draw_noise() -> Array:
    """What ``train`` draws after the same seed: for the next actions first, so the order of ``Reference`` reversed."""
    th.manual_seed(7)
    zeros, ones = th.zeros(BATCH, 2), th.ones(BATCH, 2)
    noise = np.stack([th.normal(zeros, ones).double().numpy() for _ in range(2)][::-1])
    th.manual_seed(7)
    return noise


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

    def loss_of(name: str, values: Parameters) -> float:
        if name.startswith("actor."):
            return reference.actor_loss(values)
        return reference.critic_loss(values) + reference.transition_loss(values) + reference.reward_loss(values)

    for name, parameter in model.policy.named_parameters():
        if name.startswith("critic_target."):
            assert parameter.grad is None, name
            continue
        assert parameter.grad is not None, name
        gradient = parameter.grad.double().numpy()
        entry = np.unravel_index(np.abs(gradient).argmax(), gradient.shape)
        step, sides = 1e-6, []
        for sign in (1, -1):
            moved = p[name].copy()
            moved[entry] += sign * step
            sides.append(loss_of(name, {**p, name: moved}))
        slope = (sides[0] - sides[1]) / (2 * step)
        assert gradient[entry] == pytest.approx(slope, rel=2e-3, abs=1e-5), name


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
        np.testing.assert_allclose(parts["weights"][b], assignment(reference.p, "critic", z), rtol=1e-4)
        for k in range(TWINS):
            q_g, q_l = global_value(reference.p, "critic", k, z, a), lve(reference.p, "critic", k, z, a)
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
