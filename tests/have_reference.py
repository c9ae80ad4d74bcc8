"""The algorithm a second time, for the tests: loops over numbers, float64, written from the equations, no shared code.

``p`` holds every parameter of the policy by name.
"""

import math
from collections.abc import Mapping

import numpy as np
import pytest
import torch as th
from envs import FixedBatch, RandomSensors, fill_buffer, vectors_space
from numpy.typing import NDArray

from sb3_have import HAVESAC, MultiModalPolicy

Array = NDArray[np.float64]
Parameters = Mapping[str, Array]
BATCH, MODALITIES, TWINS = 4, 3, 2
GAMMA, ENT_COEF = 0.9, 0.3


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

    def weights(self, p: Parameters, critic: str, z: list[Array]) -> list[float]:
        return assignment(p, critic, z)

    def lve(self, p: Parameters, critic: str, k: int, z: list[Array], a: Array) -> float:
        """Eq. 6."""
        return sum(w * local_value(p, critic, k, i, z, a) for i, w in enumerate(self.weights(p, critic, z)))

    def value(self, p: Parameters, critic: str, k: int, z: list[Array], a: Array) -> float:
        if self.estimation == "lve":
            return self.lve(p, critic, k, z, a)
        q_g = global_value(p, critic, k, z, a)
        return q_g if self.estimation == "gve" else refuse(p, critic, self.form, q_g, self.lve(p, critic, k, z, a), z)

    def min_value(self, p: Parameters, critic: str, z: list[Array], a: Array) -> float:
        return min(self.value(p, critic, k, z, a) for k in range(TWINS))

    def _target(self, b: int) -> float:
        z = encode(self.p, "critic_target", self.next_obs[b])
        a, log_prob = act(self.p, z, self.noise[1, b])
        r, discount, entropy = self.rewards[b], GAMMA * (1 - self.dones[b]), -ENT_COEF * log_prob
        if self.target == "bellman" or self.estimation != "have":
            return r + discount * (self.min_value(self.p, "critic_target", z, a) + entropy)
        mixed = []
        for k in range(TWINS):  # Eq. 10
            y_g = r + discount * (global_value(self.p, "critic_target", k, z, a) + entropy)
            y_l = r + discount * (self.lve(self.p, "critic_target", k, z, a) + entropy)
            mixed.append(refuse(self.p, "critic_target", self.form, y_g, y_l, z))
        return min(mixed)

    def critic_loss(self, p: Parameters) -> float:
        total = 0.0
        for b in range(BATCH):
            z, a, y = encode(p, "critic", self.obs[b]), self.actions[b], self.targets[b]
            for k in range(TWINS):
                total += 0.5 * (self.value(p, "critic", k, z, a) - y) ** 2 / BATCH
                total += self.local_coef * 0.5 * sum(self.errors_of_parts(p, k, z, a, y)) / BATCH
        return total

    def errors_of_parts(self, p: Parameters, k: int, z: list[Array], a: Array, y: float) -> list[float]:
        errors = []
        if self.estimation != "gve":
            local = [local_value(p, "critic", k, i, z, a) for i in range(MODALITIES)]
            errors.append(sum((q - y) ** 2 for q in local) / MODALITIES)
        if self.estimation == "have":
            errors += [(q - y) ** 2 for q in (global_value(p, "critic", k, z, a), self.lve(p, "critic", k, z, a))]
        return errors

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
            total += (ENT_COEF * log_prob - self.min_value(p, "critic", z, a)) / BATCH
        return total


# -- A model to compare


def make_model(
    estimation: str,
    refusion: str,
    target: str,
    local_coef: float,
    policy: str | type[MultiModalPolicy] = "MultiInputPolicy",
    algorithm: type[HAVESAC] = HAVESAC,
) -> HAVESAC:
    """A model that learns nothing (learning rate 0), target and online networks different, and one batch."""
    model = algorithm(
        policy,
        RandomSensors(vectors_space(MODALITIES)),
        buffer_size=200,
        seed=0,
        device="cpu",
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


def assert_gradients(model: HAVESAC, reference: Reference) -> None:
    """The gradients that a step left in every parameter: the largest entry of each, by differences."""

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
            moved = reference.p[name].copy()
            moved[entry] += sign * step
            sides.append(loss_of(name, {**reference.p, name: moved}))
        slope = (sides[0] - sides[1]) / (2 * step)
        assert gradient[entry] == pytest.approx(slope, rel=2e-3, abs=1e-5), name
