"""Auxiliary losses on the critic's features (Eq. 12): the interface, DeepMDP, and a callback for their coefficients."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Mapping
from typing import Any, ClassVar, NamedTuple

import torch as th
import torch.nn.functional as F
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_have.common.networks import ParallelMLP


class LatentTransitions(NamedTuple):
    """A batch of transitions as an auxiliary loss sees it (B batch, d modalities, F features, A action dimensions)."""

    features: th.Tensor
    """(B, d, F), with gradient: an auxiliary loss trains the encoder through these."""
    actions: th.Tensor
    """(B, A), in [-1, 1]."""
    rewards: th.Tensor
    """(B, 1)."""
    next_features: th.Tensor
    """(B, d, F), by the target encoder, without gradient."""
    dones: th.Tensor
    """(B, 1), 1 where the episode ended by termination."""


class AuxiliaryLoss(nn.Module, ABC):
    """
    Heads and losses that help the critic's encoder to learn (as in Eq. 12).

    Subclass it, name the loss ``terms``, and pass ``auxiliary={"my_loss": MyLoss}`` to HAVESAC: the heads then live in
    the policy (so in its state_dict and zip), the critic's optimizer trains them together with the encoder, and each
    term is logged as ``train/aux_<term>_loss``.

    :param n_modalities: d
    :param features_dim: F
    :param action_dim: A
    """

    terms: ClassVar[tuple[str, ...]]

    def __init__(self, n_modalities: int, features_dim: int, action_dim: int):
        super().__init__()
        self.n_modalities, self.features_dim, self.action_dim = n_modalities, features_dim, action_dim

    @abstractmethod
    def forward(self, batch: LatentTransitions) -> dict[str, th.Tensor]:
        """One scalar loss for each of ``terms``, unweighted."""


class DeepMDP(AuxiliaryLoss):
    """
    DeepMDP (Gelada et al. 2019, https://arxiv.org/abs/1906.02736), the auxiliary losses of HAVE (Eq. 12).

    It predicts the next features of each modality from (z_i, a), those of all modalities from (z_g, a), and the reward
    from (z_g, a). The next features come from the target encoder, without gradient; the LayerNorm of the encoders keeps
    them from collapsing. Both losses are mean squared errors; ``transition`` is the mean of the global and the local
    loss.

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


def draw_as_deepmdp(n_modalities: int, features_dim: int, action_dim: int, hidden_dim: int = 256) -> None:
    """Draw as many random numbers as the initialization of :class:`DeepMDP` does."""
    n_fused = n_modalities * features_dim
    for n_nets, n_inputs, n_outputs in (
        (n_modalities, features_dim + action_dim, features_dim),
        (1, n_fused + action_dim, n_fused),
        (1, n_fused + action_dim, 1),
    ):
        for n_in, n_out in ((n_inputs, hidden_dim), (hidden_dim, n_outputs)):
            th.rand(n_nets, n_in, n_out)
            th.rand(n_nets, 1, n_out)


class AuxiliaryLossCallback(BaseCallback):
    """
    Callback for setting the coefficients of auxiliary losses, when training starts and at every step.

    With a coefficient of 0 a loss has no gradient, but it is still computed and logged.

    :param coefficients: Coefficient of each term
    :param schedule: Factor on all of them as a function of the progress remaining (from 1 to 0), as in SB3
    :param verbose: Verbosity level
    """

    model: Any  # a HAVESAC, whose module imports this one

    def __init__(
        self,
        coefficients: Mapping[str, float],
        schedule: Callable[[float], float] | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.coefficients = dict(coefficients)
        self.schedule = schedule

    def _on_training_start(self) -> None:
        known = [term for loss in getattr(self.model.policy, "auxiliary", {}).values() for term in loss.terms]
        unknown = [term for term in self.coefficients if term not in known]
        if unknown:
            raise ValueError(
                f"{type(self).__name__}: the model has no auxiliary loss {', '.join(map(repr, unknown))}, it has "
                f"{', '.join(map(repr, known)) or 'none'}; build it with "
                "HAVESAC(..., auxiliary='deepmdp') or auxiliary={<name>: <AuxiliaryLoss class>}."
            )
        self._set_coefficients()

    def _on_step(self) -> bool:
        if self.schedule is not None:
            self._set_coefficients()
        return True

    def _set_coefficients(self) -> None:
        # The model's `_current_progress_remaining` is that of the previous run until the first update
        progress_remaining = 1 - self.model.num_timesteps / self.model._total_timesteps
        factor = 1.0 if self.schedule is None else self.schedule(progress_remaining)
        for term, coefficient in self.coefficients.items():
            self.model.auxiliary_coefs[term] = factor * coefficient


class DeepMDPCallback(AuxiliaryLossCallback):
    """
    Callback for setting the coefficients of the DeepMDP losses.

    ``HAVESAC(auxiliary="deepmdp")``, the default, trains them with coefficient 1, so this callback is only needed for
    other coefficients and for a schedule.

    :param transition_coef: Coefficient of the next-features loss
    :param reward_coef: Coefficient of the reward loss
    :param schedule: Factor on both as a function of the progress remaining (from 1 to 0)
    :param verbose: Verbosity level
    """

    def __init__(
        self,
        transition_coef: float = 1.0,
        reward_coef: float = 1.0,
        schedule: Callable[[float], float] | None = None,
        verbose: int = 0,
    ):
        super().__init__({"transition": transition_coef, "reward": reward_coef}, schedule, verbose)


def auxiliary_classes(auxiliary: str | Mapping[str, type[AuxiliaryLoss]] | None) -> dict[str, type[AuxiliaryLoss]]:
    """
    Return the classes of the auxiliary losses by name.

    :param auxiliary: HAVESAC's argument
    :raises ValueError: if it is neither "deepmdp", None, nor a mapping of names to classes
    """
    if auxiliary is None:
        return {}
    if auxiliary == "deepmdp":
        return {"deepmdp": DeepMDP}
    classes: dict[str, Any] = dict(auxiliary) if isinstance(auxiliary, Mapping) else {"": auxiliary}
    for name, loss in classes.items():
        if not (name and isinstance(loss, type) and issubclass(loss, AuxiliaryLoss)):
            raise ValueError(f"auxiliary={auxiliary!r}: expected 'deepmdp', None, or {{name: AuxiliaryLoss class}}.")
    return classes


def auxiliary_losses(modules: nn.ModuleDict, batch: LatentTransitions, terms: Container[str]) -> dict[str, th.Tensor]:
    """
    Compute the auxiliary losses of a policy.

    :param modules: the auxiliary losses
    :param batch: transitions
    :param terms: names of the terms to return; a module without any of them is not called
    :raises ValueError: if a module does not return the terms that it announces
    """
    losses: dict[str, th.Tensor] = {}
    for module in modules.values():
        announced: tuple[str, ...] = module.terms  # type: ignore[assignment]
        if any(term in terms for term in announced):
            values: dict[str, th.Tensor] = module(batch)
            if values.keys() != set(announced):
                raise ValueError(
                    f"{type(module).__name__}: forward returned the losses {sorted(values)}, but `terms` announces "
                    f"{sorted(announced)}; make them the same."
                )
            losses.update(values)
    return {term: loss for term, loss in losses.items() if term in terms}
