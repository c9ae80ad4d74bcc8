"""Distributional critics of the study: projections, mixtures and their loss."""

from typing import Any

import pytest
import torch as th
from torch import nn

from benchmarks.distributional import FIXED, FROM_REWARDS, SYMLOG, Atoms, DistributionalValues
from benchmarks.reliability_runs import DISTRIBUTIONAL, make_model
from sb3_have import HAVESAC

TARGETS = th.tensor([-20.0, -0.3, 0.0, 0.4, 37.2])
FORMS = ["have-distributional", "lve-distributional", "gve-wide-distributional"]


@pytest.mark.parametrize("atoms", [FIXED, FROM_REWARDS])
def test_hl_gauss(atoms: Atoms) -> None:
    """Each bin gets the probability that a normal distribution around the target gives it."""
    values = atoms.values()
    width = values[1] - values[0]
    edges = th.cat([values - width / 2, values[-1:] + width / 2])
    cdf = 0.5 * (1 + th.erf((edges - TARGETS.unsqueeze(1)) / (0.75 * width * 2**0.5)))
    projected = atoms.project(TARGETS)
    th.testing.assert_close(projected, cdf.diff(dim=1) / (cdf[:, -1:] - cdf[:, :1]), atol=1e-6, rtol=1e-4)
    th.testing.assert_close(projected @ values, TARGETS, atol=1e-3, rtol=0)


def test_two_hot_keeps_the_mean() -> None:
    projected = SYMLOG.project(TARGETS)
    assert ((projected > 0).sum(dim=1) <= 2).all() and (projected >= 0).all()
    th.testing.assert_close(projected.sum(dim=1), th.ones(5))
    th.testing.assert_close(projected @ SYMLOG.values(), TARGETS, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("atoms", [FIXED, SYMLOG])
def test_targets_outside_the_range(atoms: Atoms) -> None:
    projected = atoms.project(th.tensor([-1e9, 1e9]))
    assert projected.argmax(dim=1).tolist() == [0, atoms.number - 1]
    th.testing.assert_close(projected.sum(dim=1), th.ones(2))


def drawn(method: str, **kwargs: Any) -> tuple[HAVESAC, DistributionalValues, th.Tensor]:
    """Create a model whose distributions, weights and gate differ from sample to sample, and values of 7 samples."""
    model = make_model(method, 0, **kwargs)
    for name, module in model.critic.named_modules():
        if name.endswith(("net.4", "gate", "key", "query")):
            nn.init.normal_(module.weight, std=0.3)
    features = th.randn(7, 3, 32)
    values = model.critic.values(features, th.rand(7, 2))
    assert isinstance(values, DistributionalValues) and values.q.std() > 0.1
    return model, values, features


@pytest.mark.parametrize("method", FORMS)
def test_mixtures(method: str) -> None:
    """The expected values are those of Eq. 6 and the convex re-fusion, and every part has its distribution."""
    model, values, features = drawn(method)
    expected = []
    if values.weights is not None and values.q_local is not None:
        th.testing.assert_close(values.q_lve, (values.q_local * values.weights.t()).sum(dim=1))
        expected += [values.q_local]
    if method.startswith("have"):
        th.testing.assert_close(values.q, model.critic.refusion(values.q_global, values.q_lve, features))
        expected += [values.q_global, values.q_lve]  # type: ignore[list-item]
    for log_p, q in zip([values.log_p, *values.log_parts], [values.q, *expected], strict=True):
        th.testing.assert_close(log_p.exp().sum(dim=-1), th.ones(log_p.shape[:-1]))
        th.testing.assert_close(log_p.exp() @ FIXED.values(), q)


@pytest.mark.parametrize("method", FORMS)
def test_loss(method: str) -> None:
    model, values, _ = drawn(method, local_coef=0.5)
    target = th.linspace(-3, 9, 7)
    projected = FIXED.project(target)
    expected = 0.0
    for twin in range(2):
        expected -= float((projected * values.log_p[twin].detach()).sum()) / 7
        for part in values.log_parts:
            each = part[twin].detach().reshape(-1, 7, FIXED.number)  # local values have one distribution per modality
            expected -= 0.5 * float((projected * each).sum()) / (7 * len(each))
    assert float(model._critic_loss(values, target).detach()) == pytest.approx(expected, rel=1e-5)


def test_gradient_of_the_weights_is_that_of_a_mixture_of_experts(monkeypatch: pytest.MonkeyPatch) -> None:
    """With w = softmax(s), d CE / d s_i is w_i minus the responsibility of modality i for the target."""
    model = make_model("lve-distributional", 0, local_coef=0.0)
    logits, scores = th.randn(2, 3, FIXED.number), th.randn(1, 3).requires_grad_()
    monkeypatch.setattr(model.critic.local_critics, "forward", lambda *_: logits)
    monkeypatch.setattr(model.critic.assignment, "forward", lambda _: scores.softmax(dim=1))
    target = th.tensor([4.0])
    values = model.critic.values(th.zeros(1, 3, 32), th.zeros(1, 2))
    model._critic_loss(values, target).backward()  # type: ignore[no-untyped-call]
    weights = scores.detach().softmax(dim=1)[0]
    joint = logits.softmax(dim=2) * weights.view(3, 1)  # (K, d, m)
    responsibility = (FIXED.project(target)[0] * joint / joint.sum(dim=1, keepdim=True)).sum(dim=2)
    assert scores.grad is not None
    th.testing.assert_close(scores.grad[0], (weights - responsibility).sum(dim=0), atol=1e-5, rtol=1e-4)


def test_only_convex_refusion_is_a_mixture() -> None:
    with pytest.raises(ValueError, match="refusion='monotone'"):
        make_model("have-distributional", 0, refusion="monotone")


@pytest.mark.parametrize("method", DISTRIBUTIONAL)
def test_first_values_are_small(method: str) -> None:
    """Before training, every observation and action has the same value near zero, far from the ends of the range."""
    q = make_model(method, 0).critic.values(th.randn(5, 3, 32), th.rand(5, 2)).q
    assert q.abs().max() < 0.5 and q.std() < 1e-4
