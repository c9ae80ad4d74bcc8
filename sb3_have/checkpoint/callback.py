"""The callback that saves checkpoints during training."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_have.checkpoint.archive import damage
from sb3_have.checkpoint.checkpoint import checkpoint_step, checkpoints, save_checkpoint
from sb3_have.checkpoint.files import locked
from sb3_have.checkpoint.random_state import random_states, set_random_states
from sb3_have.common.buffers import ModalityReplayBuffer


class ResumableCheckpointCallback(BaseCallback):
    """
    Callback for saving checkpoints, from which :func:`~sb3_have.load_checkpoint` resumes training exactly.

    Put it first in the list of callbacks, so that no callback's ``_on_rollout_start`` runs twice after resuming. The
    state of all callbacks is saved. If a checkpoint cannot be written, a warning is issued and training continues.
    A warning at the start says if the disk looks too small.

    There is a checkpoint at the end of training too, unless a callback ended it: its last step is incomplete then.

    :param folder: Folder for the files ``checkpoint-<step>`` of this training alone; no other process may train in it
    :param save_freq: Steps from one checkpoint to the next, counted over all environments as in ``num_timesteps``; 0
        for only one at the end
    :param keep: Number of checkpoints to keep; older ones are removed
    :param info: Function that returns more values for :func:`~sb3_have.checkpoint.checkpoint_info`
    :param verbose: Verbosity level: 0 for no output, 1 for a message at every checkpoint
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        save_freq: int,
        keep: int = 2,
        info: Callable[[], Mapping[str, Any]] | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if save_freq < 0 or keep < 1:
            raise ValueError(f"save_freq={save_freq}, keep={keep}: expected save_freq >= 0 and keep >= 1.")
        self.folder, self.save_freq, self.keep, self.info = Path(folder), save_freq, keep, info
        self._lock: FileLock | None = None
        self._last_step = self._saved_step = 0
        self._rollout_started = False
        # What `learn` has reset or drawn before it calls the callbacks, and has to be put back after resuming
        self._noise: dict[str, Any] | None = None

    def get_state(self) -> dict[str, Any] | None:
        """Return the noise at the moment of saving."""
        return self._noise

    def set_state(self, state: dict[str, Any] | None) -> None:
        """Set the noise with which the next call of ``learn`` begins."""
        self._noise = state

    def _init_callback(self) -> None:
        if self.parent is not None:
            raise ValueError(
                f"ResumableCheckpointCallback within {type(self.parent).__name__} would never save; pass it to "
                "`learn`, alone or in a list, and set how often it saves by `save_freq`"
            )
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise TypeError(
                f"{type(self.model).__name__} is on-policy, and checkpoints are for off-policy algorithms; use SB3's "
                "CheckpointCallback"
            )

    def _on_training_start(self) -> None:
        assert isinstance(self.model, OffPolicyAlgorithm)  # for mypy
        self._last_step = self._saved_step = self.model.num_timesteps
        self.folder.mkdir(parents=True, exist_ok=True)
        # A call of `learn` that failed may still hold the lock
        if self._lock is None:
            self._lock = locked(self.folder).lock
        self._refuse_later_checkpoints()
        self._warn_if_disk_is_small()
        # `learn` begins by resetting the action noise
        if self._noise is not None:
            self.model.action_noise = self._noise["action_noise"]

    def _refuse_later_checkpoints(self) -> None:
        for path in reversed(checkpoints(self.folder)):
            if checkpoint_step(path) > self._last_step and damage(path) is None:
                self.release()
                raise ValueError(
                    f"{path} is later than this training, which has {self._last_step} steps. To resume from it, use "
                    "load_checkpoint and `learn(..., reset_num_timesteps=False)`; to start a new training, choose "
                    "another folder, or remove this one."
                )

    def _warn_if_disk_is_small(self) -> None:
        """Warn if the checkpoints may not fit. The replay buffer takes most of their space."""
        model: Any = self.model
        steps = min(model.buffer_size, self.locals["total_timesteps"])
        space = model.observation_space
        parts: list[Any] = [*space.spaces.values()] if isinstance(space, spaces.Dict) else [space]
        observation = sum(part.dtype.itemsize * int(np.prod(part.shape)) for part in parts)
        # SB3's buffers store each observation twice, and all of its stacked frames
        copies = 1 / model.replay_buffer.n_stack if isinstance(model.replay_buffer, ModalityReplayBuffer) else 2
        # Checkpoints that are already there will be replaced, and each is written before an old one is removed
        new = max(1, self.keep + 1 - len(checkpoints(self.folder)))
        needed = new * steps * observation * copies
        free = shutil.disk_usage(self.folder).free
        if needed > free:
            warnings.warn(
                f"{new} checkpoints in {self.folder} may need {needed / 1e6:,.0f} MB, and the disk has "
                f"{free / 1e6:,.0f} MB left: make room, choose another folder or reduce buffer_size.",
                stacklevel=2,
            )

    def _on_rollout_start(self) -> None:
        # Save between two rollouts, where nothing is pending: in `_on_step` the transition is not stored yet, and in
        # `_on_rollout_end` the gradient steps have not been made
        self._rollout_started = True
        self._restore_rollout()
        step = self.model.num_timesteps
        if self.save_freq > 0 and step // self.save_freq > self._last_step // self.save_freq:
            self._save()
        self._last_step = step

    def _restore_rollout(self) -> None:
        """Restore what ``collect_rollouts`` has drawn before it calls the callbacks."""
        model: Any = self.model
        if self._noise is not None and "gsde" in self._noise:
            drawn = {name: noise.to(model.device) for name, noise in self._noise["gsde"].items()}
            vars(model.actor.action_dist).update(drawn)
            set_random_states(self._noise["random"])
        self._noise = None

    def _on_step(self) -> bool:
        self._rollout_started = False
        return True

    def _on_training_end(self) -> None:
        new_obs = self.locals.get("new_obs")
        if new_obs is self.model._last_obs:
            self._save()
        elif new_obs is not None:
            warnings.warn(
                f"A callback ended the training at step {self.model.num_timesteps} before its transition was stored, "
                "so no checkpoint was saved.",
                stacklevel=2,
            )
        self.release()

    def _save(self) -> None:
        """Save ``checkpoint-<step>``, unless it has just been saved, and remove old checkpoints."""
        assert isinstance(self.model, OffPolicyAlgorithm)  # for mypy
        step = self.model.num_timesteps
        if step == self._saved_step:
            return
        path = self.folder / f"checkpoint-{step}"
        self._noise = self._current_noise()
        try:
            # Remove what is left of a process that was killed while it wrote
            for unfinished in self.folder.glob("checkpoint-*.partial"):
                unfinished.unlink()
            save_checkpoint(self.model, path, self.locals["callback"], self.info() if self.info is not None else None)
        except OSError as error:
            warnings.warn(f"{path} could not be written ({error}); training continues without it.", stacklevel=2)
            return
        finally:
            self._noise = None
        self._saved_step = step
        for old in [each for each in checkpoints(self.folder) if checkpoint_step(each) <= step][: -self.keep]:
            with suppress(OSError):
                old.unlink()
        if self.verbose >= 1:
            print(f"Saved {path}")

    def _current_noise(self) -> dict[str, Any]:
        model: Any = self.model
        noise = {"action_noise": model.action_noise}
        if self._rollout_started and model.use_sde:
            drawn = vars(model.actor.action_dist)
            noise["gsde"] = {name: drawn[name].detach().cpu() for name in ("exploration_mat", "exploration_matrices")}
            noise["random"] = random_states()
        return noise

    def release(self) -> None:
        """Unlock the folder. The callback does it at the end of a training, unless that failed."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
