"""DeepMDP (Gelada et al. 2019) as the auxiliary losses of HAVE (Eq. 12)."""

from collections.abc import Callable
from typing import ClassVar

import torch as th
import torch.nn.functional as F

from sb3_have.common.networks import ParallelMLP
from sb3_have.have.auxiliary import AuxiliaryLoss, AuxiliaryLossCallback, LatentTransitions


class DeepMDP(AuxiliaryLoss):
    """
    Predicts the next features, each modality's from its own (z_i, a) and all together from (z_g, a), and the reward
    from (z_g, a). The next features are the target encoder's, without gradient; the encoders' LayerNorm keeps them from
    collapsing. Both losses are mean squared errors; ``transition`` is the mean of the fused and the modalities' losses.

    :param n_modalities: d
    :param features_dim: F
    :param action_dim: A
    :param hidden_dim: width of the hidden layer of each head
    """

    terms: ClassVar[tuple[str, ...]] = ("transition", "reward")

    def __init__(self, n_modalities: int, features_dim: int, action_dim: int, hidden_dim: int = 256):
        super().__init__(n_modalities, features_dim, action_dim)
        n_fused = n_modalities * features_dim
        self.local_transition = ParallelMLP(n_modalities, features_dim + action_dim, features_dim, [hidden_dim])
        self.global_transition = ParallelMLP(1, n_fused + action_dim, n_fused, [hidden_dim])
        self.reward = ParallelMLP(1, n_fused + action_dim, 1, [hidden_dim])

    def forward(self, batch: LatentTransitions) -> dict[str, th.Tensor]:
        actions = batch.actions.unsqueeze(1).expand(-1, self.n_modalities, -1)
        local_inputs = th.cat([batch.features, actions], dim=2).transpose(0, 1)  # (d, B, F + A)
        global_inputs = th.cat([batch.features.flatten(start_dim=1), batch.actions], dim=1).unsqueeze(0)
        local_loss = F.mse_loss(self.local_transition(local_inputs), batch.next_features.transpose(0, 1))
        global_loss = F.mse_loss(self.global_transition(global_inputs)[0], batch.next_features.flatten(start_dim=1))
        return {
            "transition": 0.5 * (local_loss + global_loss),
            "reward": F.mse_loss(self.reward(global_inputs)[0], batch.rewards),
        }


class DeepMDPCallback(AuxiliaryLossCallback):
    """
    Sets, schedules or switches on the DeepMDP losses of a :class:`~sb3_have.HAVESAC` model.

    The heads are always part of the policy. ``HAVESAC(auxiliary="deepmdp")``, the default, trains them with
    coefficient 1, so this callback is only needed for other coefficients, for a schedule, or to switch the losses on
    later in a model made with ``auxiliary=None``.

    :param transition_coef: coefficient of the next-features loss
    :param reward_coef: coefficient of the reward loss
    :param schedule: factor on both, a function of the progress remaining (1 at the start, 0 at the end)
    :param verbose: as in SB3
    """

    def __init__(
        self,
        transition_coef: float = 1.0,
        reward_coef: float = 1.0,
        schedule: Callable[[float], float] | None = None,
        verbose: int = 0,
    ):
        super().__init__({"transition": transition_coef, "reward": reward_coef}, schedule, verbose)
