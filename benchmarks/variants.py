"""Forms of HAVE that are not options of the package, for studies: each changes one thing by overriding one method.

    HAVESAC(MinBeforeMixing, env)                   # a policy in the place of "MultiInputPolicy"
    HAVESAC(temperature(2.0), env)
    CompetingWeights("MultiInputPolicy", env)       # an algorithm in the place of HAVESAC

Policies: :class:`MinBeforeMixing`, :class:`DetachedKeys`, :class:`DetachedAttention`, ``temperature(x)``,
:class:`FlatAttention`, :class:`GlobalResidual`. Algorithm: :class:`CompetingWeights`. Modality dropout, supervision of
the parts and the forms of re-fusion are options of HAVESAC itself.

``BELLMAN_ONLY`` are the policies that mix otherwise than by the re-fusion network, or after the minimum. The paper's
Eq. 10 (``target="paper"``) mixes by that network and takes the minimum after it, and so does not know them.
"""

import math
from typing import Any, ClassVar

import torch as th
from torch import nn

from sb3_have import HAVESAC, MultiModalCritic, MultiModalPolicy
from sb3_have.have import AssignmentNetwork
from sb3_have.have.critic import Values

# -- Minimum over the twins


class MinBeforeMixingCritic(MultiModalCritic):
    """min_k q_g^k and min_k q_i^k, then the mixing, where HAVE mixes each twin and then takes the minimum."""

    def min_q(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        values = self.values(features, actions)
        q_global, q_local = (
            None if q is None else q.min(dim=0, keepdim=True).values for q in (values.q_global, values.q_local)
        )
        return self.mix(q_global, q_local, values.weights, features).q.squeeze(0)


class MinBeforeMixing(MultiModalPolicy):
    """Policy with :class:`MinBeforeMixingCritic`."""

    critic_class = MinBeforeMixingCritic


# -- Assignment


class DetachedKeysAssignment(AssignmentNetwork):
    """The keys W_k z_i train W_k and not the encoders; the query still trains them."""

    def keys(self, features: th.Tensor) -> th.Tensor:
        return super().keys(features.detach())


class DetachedAssignment(AssignmentNetwork):
    """Neither keys nor query train the encoders."""

    def scores(self, features: th.Tensor) -> th.Tensor:
        return super().scores(features.detach())


class TemperedAssignment(AssignmentNetwork):
    """Scores divided by a temperature: above 1 the weights are more even, below 1 sharper."""

    temperature: ClassVar[float] = 1.0

    def scores(self, features: th.Tensor) -> th.Tensor:
        return super().scores(features) / self.temperature


def policy_with(assignment_class: type[AssignmentNetwork], name: str) -> type[MultiModalPolicy]:
    """A policy named ``name`` whose attention is of this class."""
    here = {"__module__": __name__}
    critic_class = type(f"{name}Critic", (MultiModalCritic,), {"assignment_class": assignment_class, **here})
    return type(name, (MultiModalPolicy,), {"critic_class": critic_class, **here})


def temperature(x: float) -> type[MultiModalPolicy]:
    """
    A policy whose attention has the temperature ``x``.

    :raises ValueError: if it is not positive
    """
    if not 0 < x < math.inf:
        raise ValueError(f"temperature {x}: expected a number > 0.")
    assignment_class = type("Assignment", (TemperedAssignment,), {"temperature": x})
    return policy_with(assignment_class, f"Temperature{x:g}")


DetachedKeys = policy_with(DetachedKeysAssignment, "DetachedKeys")
DetachedAttention = policy_with(DetachedAssignment, "DetachedAttention")
HalfTemperature, DoubleTemperature = temperature(0.5), temperature(2.0)


# -- What the hierarchy adds


class FlatAttentionCritic(MultiModalCritic):
    """
    One softmax over d + 1 critics, the local ones and the global one, whose key is made of all features.

    With the scores s_i and s_g that is HAVE's convex re-fusion with another gate: q_g's share is
    sigmoid(s_g - log sum_i exp s_i), and the rest is shared as in Eq. 9. So the global critic competes with the local
    ones, by the same attention, instead of by a hypernetwork that does not see their scores.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.value_estimation != "have":
            raise ValueError(f'value_estimation={self.value_estimation!r}: flat attention needs all critics, "have".')
        del self.refusion
        query = self.assignment.query
        self.global_key = nn.Linear(query.in_features, query.out_features, bias=False)

    def mix(
        self, q_global: th.Tensor | None, q_local: th.Tensor | None, weights: th.Tensor | None, features: th.Tensor
    ) -> Values:
        assert q_global is not None and q_local is not None and weights is not None
        z = features.flatten(start_dim=1)
        query = self.assignment.query(z)
        global_score = (query * self.global_key(z)).sum(dim=1) / math.sqrt(query.shape[1])
        share = th.sigmoid(global_score - self.assignment.scores(features).logsumexp(dim=1))
        q_lve = (q_local * weights.t()).sum(dim=1)
        return Values(share * q_global + (1 - share) * q_lve, q_global, q_local, q_lve, weights)


class FlatAttention(MultiModalPolicy):
    """Policy with :class:`FlatAttentionCritic`."""

    critic_class = FlatAttentionCritic


class GlobalResidualCritic(MultiModalCritic):
    """
    H = q_l + q_g without a gate: the global critic gives what the weighted local values leave unexplained, such as
    what only several sensors together show. It is trained through H alone, the local side on the target too.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.value_estimation != "have":
            raise ValueError(f'value_estimation={self.value_estimation!r}: a residual needs all critics, "have".')
        del self.refusion

    def mix(
        self, q_global: th.Tensor | None, q_local: th.Tensor | None, weights: th.Tensor | None, features: th.Tensor
    ) -> Values:
        assert q_global is not None and q_local is not None and weights is not None
        q_lve = (q_local * weights.t()).sum(dim=1)
        return Values(q_lve + q_global, None, q_local, q_lve, weights)  # no q_global: it is no value of its own


class GlobalResidual(MultiModalPolicy):
    """Policy with :class:`GlobalResidualCritic`."""

    critic_class = GlobalResidualCritic


BELLMAN_ONLY = (MinBeforeMixing, FlatAttention, GlobalResidual)


class CompetingWeights(HAVESAC):
    """
    Weights that are also trained as a mixture of experts (Jacobs et al. 1991), by each sample's log likelihood under
    sum_i w_i N(y; q_i, s^2), s^2 the batch's mean squared error of the local values. So the weight goes to the critic
    that is right, where Eq. 6 alone gives it to whichever brings the sum nearer to the target. The local values do not
    learn by it.
    """

    competition_coef: ClassVar[float] = 1.0

    def _critic_loss(self, values: Values, target_q: th.Tensor) -> th.Tensor:
        loss = super()._critic_loss(values, target_q)
        if values.q_local is None or values.weights is None:
            raise ValueError(f'value_estimation={self.critic.value_estimation!r}: only "have" and "lve" have weights.')
        errors = (values.q_local.detach() - target_q).square()  # (K, d, B)
        log_weights = values.weights.t().clamp(min=1e-6).log()
        log_likelihood = (log_weights - 0.5 * errors / errors.mean()).logsumexp(dim=1)
        return loss - self.competition_coef * log_likelihood.mean(dim=1).sum()
