"""Faults to plant in HAVE's formulas, one at a time, which a check of the formulas has to find.

    with FAULTS["swapped_modalities"]():
        ...  # every HAVESAC that is created and trained here has the fault

Each fault is a context manager that patches a method of the package and restores it at the end.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from inspect import signature
from types import MappingProxyType
from typing import Any, TypeAlias
from unittest.mock import patch
from weakref import WeakKeyDictionary

import torch as th
from torch import nn

from sb3_have import HAVESAC, MultiModalCritic, MultiModalPolicy
from sb3_have.have.critic import Values

Arguments: TypeAlias = dict[str, Any]
Edit: TypeAlias = Callable[[HAVESAC, Arguments], AbstractContextManager[object]]


def weights_of_wrong_step() -> AbstractContextManager[None]:
    """The target weighs the local values of z_{t+1} by the weights of z_t."""
    encode = MultiModalPolicy.encode
    last: list[th.Tensor] = []

    def remembering(policy: MultiModalPolicy, obs: Any) -> th.Tensor:
        last[:] = [encode(policy, obs)]
        return last[0]

    def edit(model: HAVESAC, _: Arguments) -> AbstractContextManager[object]:
        assignment = model.critic_target.assignment
        weights = type(assignment).forward(assignment, last[0].detach())
        return patch.object(assignment, "forward", lambda features: weights)

    return _together(lambda: patch.object(MultiModalPolicy, "encode", remembering), lambda: _edited_target(edit))


def unsupervised_locals() -> AbstractContextManager[None]:
    """``local_coef`` is ignored: only the value that acts is regressed on the target."""

    def edit(model: HAVESAC, _: Arguments) -> AbstractContextManager[object]:
        return patch.object(model, "local_coef", 0.0)

    return _edited(HAVESAC, "_critic_loss", edit)


def target_without_entropy() -> AbstractContextManager[None]:
    """y = r + gamma (1 - done) min_k H'_k, without -alpha log pi."""

    def edit(_: HAVESAC, arguments: Arguments) -> AbstractContextManager[object]:
        arguments["entropy_bonus"] = th.zeros_like(arguments["entropy_bonus"])
        return ExitStack()

    return _edited_target(edit)


def frozen_refusion() -> AbstractContextManager[None]:
    """The re-fusion network is in no optimizer."""
    build = MultiModalPolicy._build

    def broken(policy: MultiModalPolicy, lr_schedule: Any) -> None:
        build(policy, lr_schedule)
        frozen = {id(parameter) for parameter in _refusion(policy.critic).parameters()}
        for group in policy.critic.optimizer.param_groups:
            group["params"] = [parameter for parameter in group["params"] if id(parameter) not in frozen]

    return _together(lambda: patch.object(MultiModalPolicy, "_build", broken))


def swapped_modalities() -> AbstractContextManager[None]:
    """The target weighs each local value by another modality's weight: their order is reversed."""

    def edit(model: HAVESAC, _: Arguments) -> AbstractContextManager[object]:
        assignment = model.critic_target.assignment
        return patch.object(assignment, "forward", lambda z: type(assignment).forward(assignment, z).flip(1))

    return _edited_target(edit)


def ends_ignored() -> AbstractContextManager[None]:
    """y = r + gamma (min_k H'_k - alpha log pi) after the last step, too."""

    def edit(model: HAVESAC, arguments: Arguments) -> AbstractContextManager[object]:
        arguments["discounts"] = th.full_like(arguments["discounts"], model.gamma)
        return ExitStack()

    return _edited_target(edit)


def frozen_local_targets() -> AbstractContextManager[None]:
    """The local critics of the target stay what they were at first."""
    first: WeakKeyDictionary[HAVESAC, nn.Module] = WeakKeyDictionary()

    def edit(model: HAVESAC, _: Arguments) -> AbstractContextManager[object]:
        stale = first.setdefault(model, copy.deepcopy(model.critic_target.local_critics))
        return patch.object(model.critic_target.local_critics, "forward", stale.forward)

    return _edited_target(edit)


def detached_refusion() -> AbstractContextManager[None]:
    """The re-fusion network is in the optimizer, but no gradient reaches it."""
    values = MultiModalCritic.values

    def broken(critic: MultiModalCritic, *args: Any, **kwargs: Any) -> Values:
        _refusion(critic).requires_grad_(False)
        return values(critic, *args, **kwargs)

    return _together(lambda: patch.object(MultiModalCritic, "values", broken))


def reversed_actor() -> AbstractContextManager[None]:
    """The actor descends the value instead of climbing it: L_pi = alpha log pi + min_k H_k; the target is sound."""
    min_q = MultiModalCritic.min_q

    def broken(critic: MultiModalCritic, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        q = min_q(critic, features, actions)
        return -q if th.is_grad_enabled() else q  # the target needs no gradient

    return _together(lambda: patch.object(MultiModalCritic, "min_q", broken))


FAULTS: Mapping[str, Callable[[], AbstractContextManager[None]]] = MappingProxyType(
    {
        fault.__name__: fault
        for fault in (
            weights_of_wrong_step, unsupervised_locals, target_without_entropy, frozen_refusion, swapped_modalities,
            ends_ignored, frozen_local_targets, detached_refusion, reversed_actor,
        )
    }
)  # fmt: skip


def _refusion(critic: MultiModalCritic) -> nn.Module:
    return critic.refusion if critic.value_estimation == "have" else nn.Module()


@contextmanager
def _together(*contexts: Callable[[], AbstractContextManager[object]]) -> Iterator[None]:
    with ExitStack() as stack:
        for context in contexts:
            stack.enter_context(context())
        yield


def _edited(owner: type, name: str, edit: Edit) -> AbstractContextManager[None]:
    """
    Patch a method so that its arguments, and its model during the call, are edited.

    :param owner: The class
    :param name: Name of the method
    :param edit: Function of the model and the arguments by name, which it may change. The method runs in the context
        that it returns.
    """
    method = getattr(owner, name)

    def broken(model: HAVESAC, *args: Any, **kwargs: Any) -> Any:
        bound = signature(method).bind(model, *args, **kwargs)
        with edit(model, bound.arguments):
            return method(*bound.args, **bound.kwargs)

    return _together(lambda: patch.object(owner, name, broken))


def _edited_target(edit: Edit) -> AbstractContextManager[None]:
    return _edited(HAVESAC, "_target_values", edit)
