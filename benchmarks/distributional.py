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
from typing import Any, ClassVar

import torch as th
import torch.nn.functional as F
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_have import HAVESAC, MultiModalPolicy
from sb3_have.common.networks import ParallelLinear
from sb3_have.have.critic import MultiModalCritic, Values

# Standard deviation of a projected target in atoms, as in HL-Gauss (Farebrother et al. 2024)
SIGMA = 0.75


@dataclass(frozen=True)
class Atoms:
    """
    The support of the distributions, and the projection of scalar targets onto it.

    :param low: Lowest return, or its symlog if ``symlog``
    :param high: Highest return, or its symlog if ``symlog``
    :param number: Number of atoms (m)
    :param symlog: Whether the atoms are equally spaced in symlog(x) = sign(x) log(1 + |x|) and targets are projected
        onto the two atoms next to them, as in DreamerV3. Otherwise the atoms are equally spaced, and a target becomes a
        normal distribution that is integrated over each atom's bin (HL-Gauss).
    """

    low: float
    high: float
    number: int = 81
    symlog: bool = False

    def values(self) -> th.Tensor:
        """Return the atoms (m,)."""
        scale = th.linspace(self.low, self.high, self.number)
        return scale.sign() * scale.abs().expm1() if self.symlog else scale

    def project(self, target: th.Tensor) -> th.Tensor:
        """
        Project scalar targets (B,) to distributions (B, m). Targets outside the range are clipped.

        :param target: Regression target
        """
        atoms = self.values().to(target)
        target = target.clamp(atoms[0], atoms[-1])
        if self.symlog:
            above = th.searchsorted(atoms, target).clamp(1, self.number - 1)
            share = (target - atoms[above - 1]) / (atoms[above] - atoms[above - 1])
            distribution = target.new_zeros(len(target), self.number)
            distribution.scatter_(1, (above - 1).unsqueeze(1), (1 - share).unsqueeze(1))
            return distribution.scatter_(1, above.unsqueeze(1), share.unsqueeze(1))
        width = (self.high - self.low) / (self.number - 1)
        edges = th.linspace(self.low - width / 2, self.high + width / 2, self.number + 1).to(target)
        below = th.erf((edges - target.unsqueeze(1)) / (math.sqrt(2) * SIGMA * width))
        return below.diff(dim=1) / (below[:, -1:] - below[:, :1])


# A range around the soft returns of ReliabilityDrive-v0 and of the driving benchmark with gamma .98
FIXED = Atoms(-25.0, 55.0)
# Lowest and highest reward over 1 - gamma: -0.83 and 1.36 in the 800 random steps with seed 0 that start a training
FROM_REWARDS = Atoms(-41.0, 68.0)
SYMLOG = Atoms(-10.0, 10.0, number=161, symlog=True)


class DistributionalValues(Values):
    """Expected values, and the logarithms of the distributions."""

    log_p: th.Tensor
    """(K, B, m): of q."""
    log_parts: tuple[th.Tensor, ...]
    """(K, ..., B, m): of the local values and, with re-fusion, also of the global value and LVE."""


def distributional(values: Values, log_p: th.Tensor, *log_parts: th.Tensor) -> DistributionalValues:
    """Add distributions to expected values."""
    result = DistributionalValues(*values)
    result.log_p, result.log_parts = log_p, log_parts
    return result


class DistributionalCritic(MultiModalCritic):
    """
    :class:`~sb3_have.have.critic.MultiModalCritic` with distributions.

    :param atoms: Support of the distributions and projection of the targets
    :raises ValueError: for a re-fusion other than "convex", which would not be a mixture
    """

    atoms: th.Tensor

    def __init__(self, *args: Any, atoms: Atoms = FIXED, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.value_estimation == "have" and self.refusion.refusion != "convex":
            raise ValueError(f'refusion={self.refusion.refusion!r}: distributional critics need "convex".')
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

    def values(self, features: th.Tensor, actions: th.Tensor) -> DistributionalValues:
        """
        Compute the Q-values, their parts and the distributions.

        :param features: (B, d, F)
        :param actions: (B, A), scaled to [-1, 1]
        """
        if self.value_estimation == "gve":
            log_global = F.log_softmax(self.global_critic(features, actions), dim=2)
            q_global = self._mean(log_global)
            return distributional(Values(q_global, q_global, None, None, None), log_global)
        # (K, d, B, m)
        log_local = F.log_softmax(self.local_critics(features, actions).unflatten(2, (len(features), -1)), dim=3)
        weights = self.weights(features)
        # log(0) would make the gradient NaN
        log_weights = weights.clamp_min(1e-30).log().t().unsqueeze(2)  # (d, B, 1)
        log_lve = th.logsumexp(log_local + log_weights, dim=1)  # Eq. 6
        q_local, q_lve = self._mean(log_local), self._mean(log_lve)
        if self.value_estimation == "lve":
            return distributional(Values(q_lve, None, q_local, q_lve, weights), log_lve, log_local)
        log_global = F.log_softmax(self.global_critic(features, actions), dim=2)
        log_gate = F.log_softmax(self.refusion.gate(features.flatten(start_dim=1)), dim=1)  # (B, 2)
        log_p = th.logaddexp(log_global + log_gate[:, :1], log_lve + log_gate[:, 1:])  # section 3.4
        values = Values(self._mean(log_p), self._mean(log_global), q_local, q_lve, weights)
        return distributional(values, log_p, log_local, log_global, log_lve)

    def _mean(self, log_p: th.Tensor) -> th.Tensor:
        return log_p.exp() @ self.atoms


class DistributionalPolicy(MultiModalPolicy):
    """
    Policy with a :class:`DistributionalCritic`.

    :param atoms: Support of the distributions and projection of the targets
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
            return -(projected * log_p).sum(dim=-1).flatten(start_dim=1).mean(dim=1).sum()

        loss = cross_entropy(values.log_p)
        if self.local_coef > 0:
            loss = loss + self.local_coef * sum(cross_entropy(log_p) for log_p in values.log_parts)
        return loss
