"""End training cleanly."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType, TracebackType
from typing import NoReturn

from stable_baselines3.common.callbacks import BaseCallback


class TrainingStopped(Exception):
    """Leaves ``learn`` between two rollouts; a callback that returns False would lose the last transition."""


def stop_training(callback: BaseCallback) -> NoReturn:
    """End ``learn`` in a callback's ``_on_rollout_start``, where no transition is lost."""
    callback.locals["callback"].on_training_end()
    raise TrainingStopped


@contextmanager
def handle_signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle Ctrl-C and SIGTERM within a ``with`` block, if it is in the main thread, as Python requires."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


@contextmanager
def delay_signals() -> Iterator[None]:
    """Let a ``with`` block finish before Ctrl-C or SIGTERM takes effect. If the block fails, its error does instead."""
    received: list[int] = []
    with handle_signals(lambda number, frame: received.append(number)):
        yield
    for number in received:
        signal.raise_signal(number)


class StopTrainingOnSignal(BaseCallback):
    """
    Callback for ending training between two rollouts on Ctrl-C, SIGTERM or after a time limit.

    Call ``learn`` in its ``with`` block. Put it after the callback that saves checkpoints, which then saves one, and
    before slow callbacks, such as evaluations::

        with StopTrainingOnSignal(time_limit=3600) as stop:
            model.learn(1_000_000, [ResumableCheckpointCallback("checkpoints", 10_000), stop])

    The first signal lets the rollout and its gradient steps finish, a second one raises KeyboardInterrupt at once.

    :param time_limit: Seconds of training until it ends; None for no limit
    """

    def __init__(self, time_limit: float | None = None):
        super().__init__()
        self.time_limit = time_limit
        # Whether a signal has been received
        self.interrupted = False
        self._handlers = ExitStack()

    def __enter__(self) -> StopTrainingOnSignal:
        self._handlers.enter_context(handle_signals(self._on_signal))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> bool:
        self._handlers.close()
        return isinstance(error, TrainingStopped)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        self.interrupted = True

    def _on_training_start(self) -> None:
        self._started, self._first_step = time.monotonic(), self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps == self._first_step:
            return  # make at least one rollout
        time_is_over = self.time_limit is not None and time.monotonic() - self._started > self.time_limit
        if self.interrupted or time_is_over:
            stop_training(self)

    def _on_step(self) -> bool:
        return True
