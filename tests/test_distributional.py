"""Distributional critics of the study: projections, mixtures and their loss."""

import numpy as np
import pytest
import torch as th

from benchmarks.distributional import FIXED, TWO_HOT_SYMLOG, Atoms, DistributionalValues
from benchmarks.reliability_runs import DISTRIBUTIONAL, critic_size, gve_width, make_model

TARGETS = th.tensor([-20.0, -0.3, 0.0, 0.4, 37.2])
FORMS = ["have-distributional", "lve-distributional", "gve-wide-distributional"]


def test_hl_gauss() -> None:
    """Each bin gets the probability that a normal distribution around the target gives it."""
    projected = FIXED.project(TARGETS)
    edges = np.arange(-25.5, 56.0)
    cdf = 0.5 * (1 + th.erf((th.tensor(edges, dtype=th.float32) - TARGETS.unsqueeze(1)) / (0.75 * 2**0.5)))
    expected = cdf.diff(dim=1) / (cdf[:, -1:] - cdf[:, :1])
    th.testing.assert_close(projected, expected, atol=1e-6, rtol=1e-5)
    th.testing.assert_close(projected @ FIXED.values(), TARGETS, atol=1e-3, rtol=0)


@pytest.mark.parametrize("atoms", [TWO_HOT_SYMLOG, Atoms(-25, 55, sigma=0)])
def test_two_hot_keeps_the_mean(atoms: Atoms) -> None:
    projected = atoms.project(TARGETS)
    assert ((projected > 0).sum(dim=1) <= 2).all() and (projected >= 0).all()
    th.testing.assert_close(projected.sum(dim=1), th.ones(5))
    th.testing.assert_close(projected @ atoms.values(), TARGETS, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("atoms", [FIXED, TWO_HOT_SYMLOG])
def test_targets_beyond_the_ends(atoms: Atoms) -> None:
    beyond = atoms.project(th.tensor([-1e9, 1e9]))
    assert beyond.argmax(dim=1).tolist() == [0, atoms.number - 1]
    th.testing.assert_close(beyond.sum(dim=1), th.ones(2))


def filled(method: str) -> DistributionalValues:
    """Values of a batch after some training, so that the distributions differ."""
    model = make_model(method, 0, learning_starts=16, gradient_steps=2)
    model.learn(64)
    assert model.replay_buffer is not None
    batch = model.replay_buffer.sample(7)
    values = model.critic.values(model.policy.encode(batch.observations), batch.actions)
    assert isinstance(values, DistributionalValues)
    return values


@pytest.mark.parametrize("method", FORMS)
def test_mixtures(method: str) -> None:
    """The Q-value is Eq. 6 and the convex re-fusion of the expected values of the parts."""
    values = filled(method)
    th.testing.assert_close(values.log_p.exp().sum(dim=2), th.ones(2, 7))
    assert values.q.std() > 0
    if method.startswith("gve"):
        assert values.weights is None and values.log_parts == ()
        return
    assert values.q_local is not None and values.weights is not None and values.q_lve is not None
    th.testing.assert_close(values.q_lve, (values.q_local * values.weights.t()).sum(dim=1))
    if method.startswith("have"):
        assert values.q_global is not None
        share = (values.q - values.q_lve) / (values.q_global - values.q_lve)  # of the global value
        assert ((share > 0) & (share < 1)).all()
        th.testing.assert_close(share[0], share[1], atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("method", FORMS)
def test_loss(method: str) -> None:
    model = make_model(method, 0, local_coef=0.5)
    values = filled(method)
    target = th.linspace(-3, 9, 7)
    loss = float(model._critic_loss(values, target).detach())  # type: ignore[arg-type]
    projected = FIXED.project(target)
    expected = 0.0
    for twin in range(2):
        expected -= float((projected * values.log_p[twin].detach()).sum()) / 7
        for part in values.log_parts:
            each = part[twin].detach().reshape(-1, 7, FIXED.number)  # local values have one distribution per modality
            expected -= 0.5 * float((projected * each).sum()) / (7 * len(each))
    assert loss == pytest.approx(expected, rel=1e-5)


def test_gradient_of_the_weights_is_that_of_a_mixture_of_experts() -> None:
    """d CE / d log w_i = w_i minus the responsibility of modality i for the target."""
    model = make_model("lve-distributional", 0, local_coef=0.0)
    log_p = th.randn(2, 3, 1, FIXED.number).log_softmax(dim=3)
    scores = th.randn(3).requires_grad_()
    mixture = th.logsumexp(log_p + scores.log_softmax(0).view(3, 1, 1), dim=1)
    target = th.tensor([4.0])
    values = DistributionalValues(th.zeros(2, 1), None, None, None, None, mixture, ())
    model._critic_loss(values, target).backward()  # type: ignore[arg-type, no-untyped-call]
    weights, projected = scores.detach().softmax(0), FIXED.project(target)[0]
    joint = log_p[:, :, 0].exp() * weights.view(3, 1)  # (K, d, m)
    responsibility = (projected * joint / joint.sum(dim=1, keepdim=True)).sum(dim=2)  # (K, d)
    th.testing.assert_close(scores.grad, (weights - responsibility).sum(dim=0), atol=1e-5, rtol=1e-4)


def test_rivals_have_as_many_parameters() -> None:
    sizes = [critic_size(64, "have", True), critic_size(gve_width(True), "gve", True)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.01)
    assert gve_width(True) > gve_width()


@pytest.mark.parametrize("method", DISTRIBUTIONAL)
def test_first_values_are_small(method: str) -> None:
    """Before training, every observation and action has the same value near zero, far from the ends of the range."""
    model = make_model(method, 0)
    features = th.randn(5, 3, 32)
    q = model.critic.values(features, th.rand(5, 3)[:, : model.action_space.shape[0]]).q  # type: ignore[index]
    assert q.abs().max() < 0.5 and q.std() < 1e-4
