"""What happens to a run between its steps: evaluations, checkpoints, and the end when it is asked to stop."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.callbacks import BaseCallback

if TYPE_CHECKING:
    from sb3_have.train import Run


class TrainingStopped(Exception):
    """Ends ``learn`` between two rollouts; a callback's False would lose the transition it has just made."""


def is_due(frequency: int, step: int, last_step: int) -> bool:
    """Whether a multiple of a frequency, 0 for never, lies between two steps; rollouts go several steps at a time."""
    return frequency > 0 and step // frequency > last_step // frequency


class RunCallback(BaseCallback):
    """Evaluates and saves a run as it goes, and ends it in good order on Ctrl-C, SIGTERM or a time limit.

    :param run: what to evaluate and where to save
    """

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run
        self.stopping = False
        self._in_evaluation = False
        self._handlers: dict[int, Any] = {}

    def _on_training_start(self) -> None:
        self._started, self._earlier = time.monotonic(), self.run.seconds
        self._first_step = self._last_step = self.model.num_timesteps
        # SB3 finishes the rollout it is in and the updates, so that buffer and optimizers stay whole
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._stop)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.stopping or self._in_evaluation:
            self.stopping = True
            raise KeyboardInterrupt
        self.stopping = True

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps == self._first_step:
            return
        self._evaluate_and_save(rollout_started=True)
        limit = self.run.time_limit
        if self.stopping or (limit is not None and time.monotonic() - self._started > limit):
            self.locals["callback"].on_training_end()  # closes the progress bar
            raise TrainingStopped

    def _on_training_end(self) -> None:
        self._evaluate_and_save(rollout_started=False)

    def _evaluate_and_save(self, rollout_started: bool) -> None:
        """Between rollouts, where nothing is pending: a run that goes on from here misses nothing."""
        run, step = self.run, self.model.num_timesteps
        run.seconds = self._earlier + time.monotonic() - self._started
        # an evaluation that a stop prevents is made up for when the run goes on
        if not self.stopping:
            self._in_evaluation = True
            try:
                run.evaluate_if_due(self.model)
            except KeyboardInterrupt:
                self.stopping = True
            self._in_evaluation = False
        if is_due(run.save_freq, step, self._last_step):
            run.save(self.model, rollout_started)
        self._last_step = step

    def restore_handlers(self) -> None:
        """Give the signals back to whoever had them."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
