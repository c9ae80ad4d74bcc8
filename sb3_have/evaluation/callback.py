"""The callback that evaluates a model in several weathers during training."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_have.checkpoint.files import write_atomically
from sb3_have.checkpoint.random_state import same_random_numbers
from sb3_have.checkpoint.stopping import StopTrainingOnSignal, handle_signals, stop_training
from sb3_have.evaluation.evaluation import check_environment, evaluate

# The same for all runs, so that their evaluations drive the same episodes
EVALUATION_SEED = 1_000_000


class WeatherEvalCallback(BaseCallback):
    """
    Callback for evaluating a model in each weather, as :func:`~sb3_have.evaluate` does.

    It evaluates between two rollouts, after the gradient steps, and does not change the training: random numbers are
    restored afterwards. Each evaluation appends a row for each weather to a CSV file: ``step, seed, wall_time`` and the
    columns of :func:`~sb3_have.evaluate`. Training that resumes from a checkpoint drops the rows of later steps and
    makes up for an evaluation that is missing. Ctrl-C interrupts an evaluation, and then the training.

    :param env_id: Id of the environment, which takes the keyword ``weather``
    :param weathers: Names of the weathers
    :param path: CSV file
    :param eval_freq: Steps from one evaluation to the next, counted over all environments; 0 for none
    :param n_eval_episodes: Episodes in each weather
    :param seed: Seed of the episodes
    :param env_kwargs: Keywords for ``gym.make``, the same as in training
    :param env_wrapper: Wrapper of every environment
    :param n_envs: Number of environments driven at a time
    :param vec_env_cls: ``SubprocVecEnv`` steps each environment in a process of its own
    :param seconds_before: Seconds of training before a resumed one, added to ``wall_time``
    :param progress_bar: Whether to show a progress bar for each evaluation
    :param verbose: Verbosity level: 0 for no output, 1 for a line for each evaluation
    """

    def __init__(
        self,
        env_id: str,
        weathers: Sequence[str],
        path: str | os.PathLike[str],
        eval_freq: int = 10_000,
        n_eval_episodes: int = 2,
        seed: int = EVALUATION_SEED,
        env_kwargs: Mapping[str, Any] | None = None,
        env_wrapper: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] | None = None,
        n_envs: int = 1,
        vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
        seconds_before: float = 0.0,
        progress_bar: bool = False,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.path, self.eval_freq, self.seconds_before = Path(path), eval_freq, seconds_before
        self._evaluate = partial(
            evaluate,
            env_id=env_id,
            weathers=weathers,
            n_episodes=n_eval_episodes,
            seed=seed,
            env_kwargs=env_kwargs,
            n_envs=n_envs,
            progress_bar=progress_bar,
            env_wrapper=env_wrapper,
            vec_env_cls=vec_env_cls,
        )

        self._check = partial(check_environment, env_id, next(iter(weathers), ""), env_kwargs, env_wrapper)

    def check(self) -> None:
        """
        Check that an environment for evaluations can be made, before a training that may take hours.

        :raises ValueError: If it cannot be made
        """
        if self.eval_freq > 0:
            with same_random_numbers():
                self._check(model=getattr(self, "model", None))

    def _init_callback(self) -> None:
        self.check()

    def _on_training_start(self) -> None:
        self._started, self._last_step = time.monotonic(), 0
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self.path.exists():
            return
        # Drop the rows after the checkpoint that training resumes from
        head, *rows = self.path.read_text().splitlines(keepends=True)
        kept = [row for row in rows if int(row.partition(",")[0]) <= self.num_timesteps]
        if rows and self.num_timesteps == 0:
            raise ValueError(f"{self.path} has the evaluations of another training; remove it, or choose another path")
        write_atomically(self.path, partial(Path.write_text, data="".join([head, *kept])))
        self._last_step = max((int(row.partition(",")[0]) for row in kept), default=0)

    def _on_rollout_start(self) -> None:
        if not self._evaluate_if_due():
            stop_training(self)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        # Evaluate the final model, but not one whose training was stopped
        if self.model.num_timesteps >= self.locals["total_timesteps"]:
            self._evaluate_if_due()

    def _evaluate_if_due(self) -> bool:
        """Evaluate the model if an evaluation is due, and return whether it was not interrupted."""
        step = self.model.num_timesteps
        if self.eval_freq <= 0 or step // self.eval_freq == self._last_step // self.eval_freq:
            return True
        signals: list[int] = []

        def interrupt(number: int, frame: FrameType | None) -> None:
            signals.append(number)
            raise KeyboardInterrupt

        try:
            with handle_signals(interrupt), same_random_numbers():
                self._append(step)
        except KeyboardInterrupt:
            if not signals:
                raise
            # Pass the signal on to the handler that was there before; if it does not end training, raise
            handler = signal.getsignal(signals[0])
            signal.raise_signal(signals[0])
            if isinstance(getattr(handler, "__self__", None), StopTrainingOnSignal):
                return False
            raise
        self._last_step = step
        return True

    def _append(self, step: int) -> None:
        """Evaluate the model and append a row per weather."""
        seconds = self.seconds_before + time.monotonic() - self._started
        frame = self._evaluate(self.model)
        frame.insert(0, "step", step)
        frame.insert(1, "seed", self.model.seed)
        frame.insert(2, "wall_time", round(seconds, 1))
        before = self.path.read_text() if self.path.exists() else ""
        rows = frame.to_csv(header=not before, index=False, lineterminator="\n")
        write_atomically(self.path, partial(Path.write_text, data=before + rows))
        if self.verbose >= 1:
            print(
                f"step {step}: return {frame['return_mean'].mean():.1f}, distance {frame['distance_mean'].mean():.0f} "
                f"m over {len(frame)} weathers, {seconds / 60:.1f} min",
                flush=True,
            )
