"""
HAVE with critics that return distributions: every critic gives a categorical distribution of the return.

LVE is the mixture p_l = sum_i w_i p_i, and re-fusion the mixture b_g p_g + b_l p_l, so that the expected values are
exactly those of Eq. 6 and of the convex re-fusion. The loss is the cross entropy of the projected target under the
mixtures and under each part. The gradient of the weights is then that of a mixture of experts. The target is the same
scalar as with scalar critics: the minimum over the twins of the expected values.

Shapes are those of :mod:`sb3_have.have.critic`, and m is the number of atoms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch as th
import torch.nn.functional as F
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_have import HAVESAC, MultiModalPolicy
from sb3_have.common.networks import ParallelLinear
from sb3_have.have.critic import MultiModalCritic, Values


@dataclass(frozen=True)
class Atoms:
    """
    Returns that a distribution can take, and the projection of a scalar target on them.

    :param low: Lowest return of a linear scale, or of its symlog
    :param high: Highest return, or its symlog
    :param number: Number of atoms (m)
    :param symlog: Whether the atoms are equally spaced in symlog(x) = sign(x) log(1 + |x|), as in DreamerV3
    :param sigma: Standard deviation of the projected target in atoms (HL-Gauss, Farebrother et al. 2024), or 0 for a
        two-hot target, which keeps the mean
    """

    low: float
    high: float
    number: int = 81
    symlog: bool = False
    sigma: float = 0.75

    def values(self) -> th.Tensor:
        """Return the atoms (m,)."""
        scale = th.linspace(self.low, self.high, self.number)
        return scale.sign() * scale.abs().expm1() if self.symlog else scale

    def project(self, target: th.Tensor) -> th.Tensor:
        """
        Return the distribution (B, m) for scalar targets (B,). A target beyond the ends counts as an end.

        :param target: Regression target
        """
        atoms = self.values().to(target)
        target = target.clamp(atoms[0], atoms[-1])
        if self.sigma == 0:
            above = th.searchsorted(atoms, target).clamp(1, self.number - 1)
            share = (target - atoms[above - 1]) / (atoms[above] - atoms[above - 1])
            distribution = target.new_zeros(len(target), self.number)
            distribution.scatter_(1, (above - 1).unsqueeze(1), (1 - share).unsqueeze(1))
            return distribution.scatter_(1, above.unsqueeze(1), share.unsqueeze(1))
        if self.symlog:
            target = target.sign() * target.abs().log1p()
        width = (self.high - self.low) / (self.number - 1)
        edges = th.linspace(self.low - width / 2, self.high + width / 2, self.number + 1).to(target)
        below = th.erf((edges - target.unsqueeze(1)) / (math.sqrt(2) * self.sigma * width))
        return below.diff(dim=1) / (below[:, -1:] - below[:, :1])


# A range that contains the returns of ReliabilityDrive-v0 and of the driving benchmark with gamma .98
FIXED = Atoms(-25.0, 55.0)
# From the lowest and highest reward of random actions on ReliabilityDrive-v0 (-0.83 and 1.36) over 1 - gamma
FROM_REWARDS = Atoms(-41.0, 68.0)
TWO_HOT_SYMLOG = Atoms(-10.0, 10.0, number=161, symlog=True, sigma=0.0)


class DistributionalValues(NamedTuple):
    """Expected values as in :class:`~sb3_have.have.critic.Values`, and the logarithms of the distributions."""

    q: th.Tensor
    q_global: th.Tensor | None
    q_local: th.Tensor | None
    q_lve: th.Tensor | None
    weights: th.Tensor | None
    log_p: th.Tensor
    """(K, B, m): of q."""
    log_parts: tuple[th.Tensor, ...]
    """(K, ..., B, m): of the local values, and with re-fusion of the global value and LVE too."""


class DistributionalCritic(MultiModalCritic):
    """:class:`~sb3_have.have.critic.MultiModalCritic` with distributions; its re-fusion is "convex"."""

    atoms: th.Tensor

    def __init__(self, *args: Any, atoms: Atoms = FIXED, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.project = atoms.project
        self.register_buffer("atoms", atoms.values(), persistent=False)
        # Start far from the ends of the range, with the same distribution for all observations
        logits = -0.5 * (self.atoms / 5) ** 2
        for name in ("local_critics", "global_critic"):
            if hasattr(self, name):
                net = getattr(self, name).net
                n_nets, width, _ = net[-1].weight.shape
                net[-1] = ParallelLinear(n_nets, width, atoms.number)
                with th.no_grad():
                    net[-1].weight.zero_()
                    net[-1].bias.copy_(logits.expand_as(net[-1].bias))

    def values(self, features: th.Tensor, actions: th.Tensor) -> Values:
        """
        Compute the Q-values, their parts and the distributions.

        :param features: (B, d, F)
        :param actions: (B, A), scaled to [-1, 1]
        """
        weights = log_global = log_local = log_lve = None
        if self.value_estimation != "lve":
            log_global = F.log_softmax(self.global_critic(features, actions), dim=2)
        if self.value_estimation != "gve":
            # (K, d, B, m)
            log_local = F.log_softmax(self.local_critics(features, actions).unflatten(2, (len(features), -1)), dim=3)
            weights = self.weights(features)
            # A weight of exactly 0 would have an infinite gradient
            log_weights = weights.clamp_min(1e-30).log().t().unsqueeze(2)  # (d, B, 1)
            log_lve = th.logsumexp(log_local + log_weights, dim=1)  # Eq. 6
        parts: tuple[th.Tensor, ...] = ()
        if self.value_estimation == "have":
            assert log_global is not None and log_lve is not None and log_local is not None
            log_gate = F.log_softmax(self.refusion.gate(features.flatten(start_dim=1)), dim=1)  # (B, 2)
            log_p = th.logaddexp(log_global + log_gate[:, :1], log_lve + log_gate[:, 1:])  # section 3.4
            parts = (log_local, log_global, log_lve)
        elif log_lve is not None and log_local is not None:
            log_p, parts = log_lve, (log_local,)
        else:
            assert log_global is not None
            log_p = log_global
        q_global, q_local, q_lve = (
            None if log is None else log.exp() @ self.atoms for log in (log_global, log_local, log_lve)
        )
        values = DistributionalValues(
            log_p.exp() @ self.atoms, q_global, q_local, q_lve, weights, log_p=log_p, log_parts=parts
        )
        return values  # type: ignore[return-value]


class DistributionalPolicy(MultiModalPolicy):
    """
    Policy with a :class:`DistributionalCritic`.

    :param atoms: Range and projection
    """

    critic_class: ClassVar[type[MultiModalCritic]] = DistributionalCritic

    def __init__(self, *args: Any, atoms: Atoms = FIXED, **kwargs: Any):
        self.atoms = atoms
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        self.value_kwargs["atoms"] = self.atoms
        super()._build(lr_schedule)


class DistributionalHAVESAC(HAVESAC):
    """HAVESAC with a :class:`DistributionalPolicy`."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": DistributionalPolicy}
    critic: DistributionalCritic

    def _critic_loss(self, values: Values, target_q: th.Tensor) -> th.Tensor:
        """
        Compute the cross entropy of the projected target and, times ``local_coef``, that of the parts, summed over the
        twins.

        :param values: the critic's values at the sampled actions
        :param target_q: (B,)
        """
        assert isinstance(values, DistributionalValues)
        projected = self.critic.project(target_q)

        def cross_entropy(log_p: th.Tensor) -> th.Tensor:
            return -(projected * log_p).sum(dim=-1).mean(dim=tuple(range(1, log_p.dim() - 1))).sum()

        loss = cross_entropy(values.log_p)
        if self.local_coef > 0:
            loss = loss + self.local_coef * sum(cross_entropy(log_p) for log_p in values.log_parts)
        return loss
