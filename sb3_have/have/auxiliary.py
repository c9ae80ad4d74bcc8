"""Auxiliary losses on the critic's features: the interface, and the callback that switches and schedules them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Mapping
from typing import Any, ClassVar, NamedTuple

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn


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


class AuxiliaryLossCallback(BaseCallback):
    """
    Callback for setting the coefficients of auxiliary losses, when training starts and at every step.

    The heads are part of the policy, and this callback switches their losses on and off. With a coefficient of 0 a loss
    has no gradient, but it is still computed and logged.

    :param coefficients: coefficient of each term
    :param schedule: factor on all of them as a function of the progress remaining (1 at the start, 0 at the end), as
        SB3's schedules
    :param verbose: as in SB3
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
        # not the model's own `_current_progress_remaining`, which is the last run's until the first update
        progress_remaining = 1 - self.model.num_timesteps / self.model._total_timesteps
        factor = 1.0 if self.schedule is None else self.schedule(progress_remaining)
        for term, coefficient in self.coefficients.items():
            self.model.auxiliary_coefs[term] = factor * coefficient


def auxiliary_classes(
    auxiliary: str | Mapping[str, type[AuxiliaryLoss]] | None, known: Mapping[str, type[AuxiliaryLoss]]
) -> dict[str, type[AuxiliaryLoss]]:
    """
    The losses that are switched on, by name.

    :param auxiliary: HAVESAC's argument
    :param known: the losses that a name alone stands for
    :raises ValueError: if it is neither a known name, None, nor a mapping of names to classes
    """
    if auxiliary is None:
        return {}
    if isinstance(auxiliary, str):
        if auxiliary not in known:
            raise ValueError(
                f"auxiliary={auxiliary!r}: expected one of {list(known)}, None, or {{name: AuxiliaryLoss class}}."
            )
        return {auxiliary: known[auxiliary]}
    classes = dict(auxiliary) if isinstance(auxiliary, Mapping) else {"": auxiliary}
    for name, loss in classes.items():
        if not (name and isinstance(loss, type) and issubclass(loss, AuxiliaryLoss)):
            raise ValueError(f"auxiliary={auxiliary!r}: expected 'deepmdp', None, or {{name: AuxiliaryLoss class}}.")
    return classes


def auxiliary_losses(modules: nn.ModuleDict, batch: LatentTransitions, terms: Container[str]) -> dict[str, th.Tensor]:
    """
    Those of the ``terms`` that the auxiliary losses of a policy know.

    :param modules: the losses
    :param batch: what they are computed of
    :param terms: names of the wanted terms
    :raises ValueError: if a loss does not return the terms that it announces
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
