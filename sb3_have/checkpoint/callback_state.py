"""The state of callbacks: of SB3's own, and of those with ``get_state`` and ``set_state``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)

Callbacks = BaseCallback | Sequence[BaseCallback] | None

# What SB3's callbacks remember from one step to the next
ATTRIBUTES: dict[Any, tuple[str, ...]] = {
    BaseCallback: ("n_calls",),
    EvalCallback: (
        "best_mean_reward",
        "last_mean_reward",
        "evaluations_results",
        "evaluations_timesteps",
        "evaluations_length",
        "evaluations_successes",
    ),
    EveryNTimesteps: ("last_time_trigger",),
    StopTrainingOnMaxEpisodes: ("n_episodes",),
    StopTrainingOnNoModelImprovement: ("last_best_mean_reward", "no_improvement_evals"),
}


@runtime_checkable
class Stateful(Protocol):
    """A callback that chooses its own state."""

    def get_state(self) -> Any: ...
    def set_state(self, state: Any) -> None: ...


def flattened(callbacks: Callbacks) -> list[BaseCallback]:
    """List callbacks and the callbacks within them, as SB3's own nest them."""
    found: list[BaseCallback] = []
    for callback in [callbacks] if isinstance(callbacks, BaseCallback) else callbacks or ():
        children = [getattr(callback, name, None) for name in ("callback", "callback_on_new_best")]
        children += getattr(callback, "callbacks", [])
        found += [callback, *flattened([child for child in children if isinstance(child, BaseCallback)])]
    return found


def callbacks_state(callbacks: Callbacks) -> list[tuple[str, dict[str, Any], Any]]:
    """Return class, attributes and own state of every callback."""
    states = []
    for callback in flattened(callbacks):
        names = [name for base in ATTRIBUTES if isinstance(callback, base) for name in ATTRIBUTES[base]]
        attributes = {name: getattr(callback, name) for name in names}
        own = callback.get_state() if isinstance(callback, Stateful) else None
        states.append((type(callback).__qualname__, attributes, own))
    return states


def restore_callbacks(callbacks: Callbacks, states: list[tuple[str, dict[str, Any], Any]]) -> None:
    """Restore callbacks from the states of those of the same class, in their order; others stay as they are."""
    waiting = list(states)
    for callback in flattened(callbacks):
        index = next((i for i, (name, *_) in enumerate(waiting) if name == type(callback).__qualname__), None)
        if index is None:
            continue
        _, attributes, own = waiting.pop(index)
        vars(callback).update(attributes)
        if isinstance(callback, Stateful):
            callback.set_state(own)
