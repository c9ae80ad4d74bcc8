"""The forms of HAVE in benchmarks/variants.py against the reference, each with its own formula."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch as th
from envs import RandomSensors, changed, clone_parameters, fill_buffer, vectors_space
from have_reference import (
    BATCH,
    MODALITIES,
    TWINS,
    Array,
    Parameters,
    Reference,
    assert_gradients,
    assignment,
    draw_noise,
    encode,
    global_value,
    linear,
    local_value,
    make_model,
    refuse,
)

from benchmarks import variants
from sb3_have import HAVESAC, MultiModalPolicy


class MinBeforeMixing(Reference):
    def min_value(self, p: Parameters, critic: str, z: list[Array], a: Array) -> float:
        local = [min(local_value(p, critic, k, i, z, a) for k in range(TWINS)) for i in range(MODALITIES)]
        q_l = sum(w * q for w, q in zip(self.weights(p, critic, z), local, strict=True))
        if self.estimation == "lve":
            return q_l
        return refuse(p, critic, self.form, min(global_value(p, critic, k, z, a) for k in range(TWINS)), q_l, z)


class DoubleTemperature(Reference):
    def weights(self, p: Parameters, critic: str, z: list[Array]) -> list[float]:
        """softmax(s / 2) is the square root of softmax(s), normalised."""
        roots = [math.sqrt(w) for w in assignment(p, critic, z)]
        return [root / sum(roots) for root in roots]


class FlatAttention(Reference):
    def value(self, p: Parameters, critic: str, k: int, z: list[Array], a: Array) -> float:
        query = linear(p, f"{critic}.assignment.query", np.concatenate(z))
        keys = [linear(p, f"{critic}.global_key", np.concatenate(z))]
        keys += [linear(p, f"{critic}.assignment.key", z_i) for z_i in z]
        values = [global_value(p, critic, k, z, a), *(local_value(p, critic, k, i, z, a) for i in range(MODALITIES))]
        powers = [math.exp(query @ key / math.sqrt(len(query))) for key in keys]
        return sum(power * value for power, value in zip(powers, values, strict=True)) / sum(powers)


class GlobalResidual(Reference):
    def value(self, p: Parameters, critic: str, k: int, z: list[Array], a: Array) -> float:
        return self.lve(p, critic, k, z, a) + global_value(p, critic, k, z, a)

    def errors_of_parts(self, p: Parameters, k: int, z: list[Array], a: Array, y: float) -> list[float]:
        local, _, mixed = super().errors_of_parts(p, k, z, a, y)
        return [local, mixed]


class CompetingWeights(Reference):
    def critic_loss(self, p: Parameters) -> float:
        """The local values in the likelihood are those of ``self.p``, whatever ``p`` is: they do not learn by it."""
        errors = np.array(
            [
                [
                    [
                        (local_value(self.p, "critic", k, i, z, a) - y) ** 2
                        for z, a, y in zip(self.features, self.actions, self.targets, strict=True)
                    ]
                    for i in range(MODALITIES)
                ]
                for k in range(TWINS)
            ]
        )
        variance, log_likelihood = errors.mean(), 0.0
        for b in range(BATCH):
            weights = self.weights(p, "critic", encode(p, "critic", self.obs[b]))
            for k in range(TWINS):
                density = sum(w * math.exp(-errors[k, i, b] / 2 / variance) for i, w in enumerate(weights))
                log_likelihood += math.log(density) / BATCH
        return super().critic_loss(p) - log_likelihood


FORMS: dict[str, tuple[str | type[MultiModalPolicy], type[HAVESAC], type[Reference]]] = {
    "min_before_mixing": (variants.MinBeforeMixing, HAVESAC, MinBeforeMixing),
    "double_temperature": (variants.DoubleTemperature, HAVESAC, DoubleTemperature),
    "flat_attention": (variants.FlatAttention, HAVESAC, FlatAttention),
    "global_residual": (variants.GlobalResidual, HAVESAC, GlobalResidual),
    "competing_weights": ("MultiInputPolicy", variants.CompetingWeights, CompetingWeights),
}
CASES = [("have", name) for name in FORMS]
CASES += [("lve", name) for name in ("min_before_mixing", "double_temperature", "competing_weights")]


@pytest.mark.parametrize("estimation, name", CASES)
def test_losses_and_their_gradients(estimation: str, name: str) -> None:
    policy, algorithm, reference_class = FORMS[name]
    model = make_model(estimation, "convex", "bellman", 1.0, policy, algorithm)
    reference = reference_class(model, "convex", draw_noise())
    model.train(gradient_steps=1, batch_size=BATCH)
    logged = model.logger.name_to_value
    assert logged["train/critic_loss"] == pytest.approx(reference.critic_loss(reference.p), rel=1e-4)
    assert logged["train/actor_loss"] == pytest.approx(reference.actor_loss(reference.p), rel=1e-4)
    if name == "competing_weights":
        assert abs(logged["train/critic_loss"] - Reference.critic_loss(reference, reference.p)) > 0.01
    assert_gradients(model, reference)


def test_minimum_before_mixing_is_the_lower_one() -> None:
    model = make_model("have", "convex", "bellman", 1.0, variants.MinBeforeMixing)
    features, actions = th.randn(500, MODALITIES, 4), th.rand(500, 2) * 2 - 1
    with th.no_grad():
        before, values = model.critic.min_q(features, actions), model.critic.values(features, actions)
    after = values.q.min(dim=0).values
    assert bool((before <= after + 1e-5).all()) and float((before < after - 1e-4).float().mean()) > 0.1


@pytest.mark.parametrize("policy, path", [(variants.DetachedKeys, "query"), (variants.DetachedAttention, None)])
def test_what_detached_attention_teaches_the_encoder(policy: type[MultiModalPolicy], path: str | None) -> None:
    """The scores are HAVE's; their gradient in the features is the query's alone, or none."""
    model, plain = make_model("have", "convex", "bellman", 1.0, policy), make_model("have", "convex", "bellman", 1.0)
    attention = model.critic.assignment
    attention.load_state_dict(plain.critic.assignment.state_dict())
    features = th.randn(5, MODALITIES, 4, requires_grad=True)
    coefficients = th.randn(5, MODALITIES)
    scores = attention.scores(features)
    assert th.equal(scores, plain.critic.assignment.scores(features))
    (scores * coefficients).sum().backward()  # type: ignore[no-untyped-call]
    assert attention.key.weight.grad is not None and attention.key.weight.grad.any()
    assert attention.query.weight.grad is not None and attention.query.weight.grad.any()
    if path is None:
        assert features.grad is None
        return
    query, key = attention.query.weight.detach(), attention.key.weight.detach()  # (p, d F), (p, F)
    for b in range(5):
        expected = th.zeros(MODALITIES * 4)
        for i in range(MODALITIES):
            expected += coefficients[b, i] * query.t() @ (key @ features[b, i].detach()) / math.sqrt(len(query))
        assert features.grad is not None
        assert th.allclose(features.grad[b].flatten(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("x", [0.0, -1.0, math.inf, math.nan])
def test_temperatures_that_make_no_sense(x: float) -> None:
    with pytest.raises(ValueError, match="temperature"):
        variants.temperature(x)


@pytest.mark.parametrize("policy", [variants.FlatAttention, variants.GlobalResidual])
def test_forms_that_need_every_critic(policy: type[MultiModalPolicy]) -> None:
    with pytest.raises(ValueError, match=r"'lve'.*needs? all critics"):
        make_model("lve", "convex", "bellman", 1.0, policy)


POLICIES: dict[str, type[MultiModalPolicy]] = {
    "min_before_mixing": variants.MinBeforeMixing,
    "detached_keys": variants.DetachedKeys,
    "detached_attention": variants.DetachedAttention,
    "half_temperature": variants.HalfTemperature,
    "temperature": variants.temperature(3.0),
    "flat_attention": variants.FlatAttention,
    "global_residual": variants.GlobalResidual,
}


@pytest.mark.parametrize("name", POLICIES)
def test_forms_train_save_and_load(name: str, tmp_path: Path) -> None:
    space = vectors_space(3)
    model = HAVESAC(POLICIES[name], RandomSensors(space), buffer_size=100, seed=0, device="cpu")
    fill_buffer(model, 40)
    before = clone_parameters(model.policy)
    model.train(1, 16)
    learnt = {name for name in before if not name.startswith("critic_target.")}
    assert changed(before, model.policy) >= learnt, learnt - changed(before, model.policy)
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", device="cpu")
    observation = space.sample()
    weights, again = model.modality_weights(observation), loaded.modality_weights(observation)
    assert weights == again and sum(float(weight[0]) for weight in weights.values()) == pytest.approx(1)
