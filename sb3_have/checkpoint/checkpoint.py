"""Checkpoints from which a training goes on exactly, bit for bit on a CPU, as if it had never stopped."""

from __future__ import annotations

import io
import os
import random
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import MethodType
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_have.checkpoint.archive import DamagedCheckpointError, check_archive, read_archive, read_info, write_archive
from sb3_have.checkpoint.callback_state import Callbacks, callbacks_state, restore_callbacks
from sb3_have.checkpoint.env_state import environments_state, restore_environments
from sb3_have.checkpoint.files import locked
from sb3_have.checkpoint.replay_state import at_full_size, end_last_episode, filled_part


def save_checkpoint(
    model: OffPolicyAlgorithm,
    path: str | os.PathLike[str],
    callbacks: Callbacks = None,
    info: Mapping[str, Any] | None = None,
    rollout_started: bool | None = None,
) -> None:
    """Write all that the further training depends on into one file, which appears whole or not at all.

    That is the model with every optimizer, the replay buffer, the environments in the middle of their episodes, with
    the state of all wrappers (VecNormalize's statistics, stacked frames, Monitor), the random numbers of Python, NumPy
    and PyTorch, and the callbacks' state. The logger's pending values are left out, and so are the environments of
    callbacks that evaluate.

    What an environment draws with, and Monitor's file, are made anew. An environment that cannot be pickled otherwise
    (a simulator's connection, a MuJoCo renderer that has drawn) is named in a warning; when the training goes on, its
    episodes begin anew, from its own random numbers, and the rest is exact. ``SubprocVecEnv`` needs
    :class:`~sb3_have.checkpoint.env_state.ResumableEnv` around every environment.

    The right moment is between two calls of ``learn``. In its midst a callback finds the training between two steps of
    its own only at the start of a rollout, see :class:`ResumableCheckpointCallback`; not in ``_on_step``, when the last
    transition is not stored yet.

    :param model: any off-policy algorithm of Stable-Baselines3, with its environment
    :param path: of the file; one that is there is replaced
    :param callbacks: of which to keep every attribute that is plain data (numbers, text, arrays, random generators,
        and containers of such) and no parameter of the constructor; those with ``get_state()`` and
        ``set_state(state)`` choose themselves
    :param info: further values, in JSON, for :func:`checkpoint_info`
    :param rollout_started: None between two calls of ``learn``, each of which begins by resetting the action noise;
        for a training that goes on as if ``learn`` had not ended, whether it is called in a callback's
        ``_on_rollout_start``
    :raises TypeError: if the algorithm is on-policy
    :raises OSError: if the file cannot be written, as on a full disk; nothing is left of it then
    """
    _check_off_policy(model)
    assert model.replay_buffer is not None  # for the type checker
    env = model.get_env()
    if env is None:
        raise ValueError("the model has no environment, and a checkpoint holds the environment's state; use set_env")
    environments = environments_state(env, (model.observation_space, model.action_space))
    if environments.lost:
        warnings.warn(
            f"The state of the environment cannot be saved: {'; '.join(environments.lost)}. When the training goes on "
            "from this checkpoint, its episodes begin anew; everything else is exact.",
            stacklevel=2,
        )
    noise: dict[str, th.Tensor] = {}
    # SB3 draws gSDE's noise before it calls `on_rollout_start`; a model that was just loaded has it still
    if model.use_sde and (rollout_started or "reset_noise" in vars(model.actor)):
        drawn = vars(model.actor.action_dist)
        noise = {name: drawn[name].detach().cpu() for name in ("exploration_mat", "exploration_matrices")}
    state = {
        "algorithm": type(model),
        "environments": environments,
        "replay_buffer": filled_part(model.replay_buffer),
        "noise": noise,
        "within_learn": rollout_started is not None,
        "callbacks": callbacks_state(callbacks),
        "random": random_states(),  # last: whatever drew before is drawn
    }
    told = {"steps": model.num_timesteps, "algorithm": type(model).__name__, "info": dict(info or {})}
    saved = io.BytesIO()
    model.save(saved)
    write_archive(Path(path), told, saved.getbuffer(), state)


def load_checkpoint(
    path: str | os.PathLike[str],
    env: gym.Env[Any, Any] | VecEnv,
    callbacks: Callbacks = None,
    device: th.device | str = "auto",
) -> Any:
    """The model of a checkpoint, ready to go on::

        callback = ResumableCheckpointCallback("checkpoints", save_freq=10_000)
        HAVESAC("MultiInputPolicy", env, seed=0).learn(200_000, callback)
        # the process dies; in a new one:
        model = load_checkpoint("checkpoints", env, callback)
        model.learn(200_000 - model.num_timesteps, callback, reset_num_timesteps=False)

    With ``reset_num_timesteps=False`` SB3's ``learn`` resets neither counters nor, as the model has its last
    observation, the environment; it counts ``total_timesteps`` from here, so schedules go on too. Call it at once:
    random numbers that are drawn in between are missing later.

    The file is unpickled, which can run any code, as SB3's replay buffers: load what you wrote yourself, and share
    weights by :func:`~sb3_have.export_safetensors`.

    :param path: of the file, or of a folder of ``checkpoint-<step>``, of which the newest whole one is taken
    :param env: made as in the training that wrote it, settings, wrappers and number of environments included, since
        the checkpoint's state overrides them; to train on in another one, give that to ``model.set_env`` afterwards.
        Monitor with ``override_existing=False`` goes on with its file
    :param callbacks: to put into the state that those of the same classes had, in their order
    :param device: for the model
    :return: the model
    :raises DamagedCheckpointError: if the file is damaged
    :raises FileNotFoundError: if there is none
    :raises ValueError: if the environment is another or has other settings, or the folder is of an older form
    """
    file = _file_of(Path(path))
    _, saved, state = read_archive(file)
    buffer = at_full_size(state.pop("replay_buffer"))
    with warnings.catch_warnings():
        # SB3 would warn that n-step returns have to be set up: they are, in the replay buffer of the checkpoint, which
        # is given so that SB3 does not make another one
        warnings.filterwarnings("ignore", message="`n_steps=")
        model = state["algorithm"].load(saved, env=env, device=device, force_reset=False, replay_buffer=buffer)
    model.observation_space, model.action_space = restore_environments(model.env, state["environments"])
    buffer.device = model.device
    if hasattr(buffer, "set_env"):  # HerReplayBuffer
        buffer.set_env(model.env)
    if state["environments"].lost:
        model._last_obs = None  # so that `learn` resets the environments
        end_last_episode(buffer)
    if state["noise"]:
        vars(model.actor.action_dist).update({name: noise.to(model.device) for name, noise in state["noise"].items()})
        _skip_once(model.actor, "reset_noise")
    # where the episodes begin anew, so does the noise
    if state.get("within_learn", True) and model.action_noise is not None and model._last_obs is not None:
        _skip_once(model.action_noise, "reset")  # by which `learn` begins
    restore_callbacks(callbacks, state["callbacks"])
    set_random_states(state["random"])
    return model


def _check_off_policy(model: BaseAlgorithm) -> None:
    """
    :raises TypeError: if an algorithm is on-policy
    """
    if not isinstance(model, OffPolicyAlgorithm):
        raise TypeError(
            f"{type(model).__name__} is on-policy, and checkpoints are of off-policy algorithms; use SB3's "
            "CheckpointCallback"
        )


def _skip_once(owner: Any, method: str) -> None:
    """Let the next call of a method do nothing: what it would draw or reset has been, before the checkpoint."""

    def skip(self: Any, *args: Any, **kwargs: Any) -> None:
        delattr(self, method)

    setattr(owner, method, MethodType(skip, owner))  # which goes along when the owner is copied


def checkpoint_info(path: str | os.PathLike[str]) -> dict[str, Any]:
    """``steps``, ``algorithm`` and the ``info`` that a checkpoint was saved with; nothing is unpickled.

    :raises DamagedCheckpointError: if the file is damaged
    """
    return read_info(Path(path))


def checkpoint_step(path: Path) -> int:
    """Training steps of a ``checkpoint-<step>``."""
    return int(path.name.rpartition("-")[2])


def checkpoints(folder: str | os.PathLike[str]) -> list[Path]:
    """The files ``checkpoint-<step>`` of a folder, oldest first."""
    files = [path for path in Path(folder).glob("checkpoint-*") if re.fullmatch(r"checkpoint-\d+", path.name)]
    return sorted((path for path in files if path.is_file()), key=checkpoint_step)


def newest_checkpoint(folder: str | os.PathLike[str]) -> Path | None:
    """The checkpoint with the most steps that can be read, or None; a warning names those that are damaged."""
    for path in reversed(checkpoints(folder)):
        damage = _damage(path)
        if damage is None:
            return path
        warnings.warn(f"{damage}: the one before it is taken, if there is one.", stacklevel=2)
    return None


def _damage(path: Path) -> DamagedCheckpointError | None:
    try:
        check_archive(path)
    except DamagedCheckpointError as error:
        return error
    return None


def _file_of(path: Path) -> Path:
    if not path.is_dir():
        return path
    refuse_older_form(path)
    newest = newest_checkpoint(path)
    if newest is None:
        raise FileNotFoundError(f"{path} has no checkpoint-<step> that can be read")
    return newest


def refuse_older_form(folder: Path) -> None:
    """
    :raises ValueError: if all that a folder has are checkpoints that are folders, as they were once
    """
    older = [path for path in [folder, *folder.glob("checkpoint-*")] if (path / "replay_buffer.pkl").exists()]
    if older and not checkpoints(folder):
        raise ValueError(
            f"{older[0]} is a checkpoint of an older form, from which a training cannot go on exactly; begin anew in "
            "another folder, or load its model.zip and replay_buffer.pkl as SB3 does"
        )


def write_checkpoint(folder: Path, model: OffPolicyAlgorithm, keep: int, **kwargs: Any) -> bool:
    """Save ``checkpoint-<step>`` and remove the oldest of more than ``keep``.

    :param kwargs: of :func:`save_checkpoint`
    :return: whether it was saved; a warning tells why it was not, as on a full disk
    """
    path = folder / f"checkpoint-{model.num_timesteps}"
    try:
        for remains in folder.glob("checkpoint-*.partial"):  # of a process that was killed while it wrote
            remains.unlink(missing_ok=True)
        save_checkpoint(model, path, **kwargs)
    except OSError as error:
        warnings.warn(f"{path} could not be written ({error}); the training goes on without it.", stacklevel=2)
        return False
    so_far = [each for each in checkpoints(folder) if checkpoint_step(each) <= model.num_timesteps]
    for old in so_far[:-keep]:
        with suppress(OSError):  # someone may be reading it; the next time
            old.unlink()
    return True


_locks: dict[Path, ExitStack] = {}
"""Of the folders that this process trains in; it keeps one where a training failed, until it trains there again."""


class ResumableCheckpointCallback(BaseCallback):
    """
    Callback for saving checkpoints, from which :func:`load_checkpoint` resumes the training exactly.

    Put it first, so that no callback's ``_on_rollout_start`` runs twice after resuming. The state of all callbacks is
    saved. If a checkpoint cannot be written, a warning says so. Inside another callback (``EveryNTimesteps``) it would
    miss the rollouts, so it is refused there; on-policy algorithms are refused too.

    :param folder: for ``checkpoint-<step>`` of this training alone: one that has later checkpoints than the training
        has steps is refused, and so is one in which another process trains, or has been interrupted and lives on
    :param save_freq: steps from one to the next, in all environments together as ``num_timesteps``; there is a further
        one at the end, but for a training that a callback ends, as its last step is incomplete: a warning says so
    :param keep: how many of the newest stay
    :param verbose: 1 tells of every one
    """

    def __init__(self, folder: str | os.PathLike[str], save_freq: int, keep: int = 2, verbose: int = 0):
        super().__init__(verbose)
        if save_freq < 1 or keep < 1:
            raise ValueError(f"save_freq={save_freq}, keep={keep}: expected whole numbers from 1 on.")
        self.folder, self.save_freq, self.keep = Path(folder), save_freq, keep
        self._last_step = 0

    def _init_callback(self) -> None:
        if self.parent is not None:
            raise ValueError(
                f"ResumableCheckpointCallback within {type(self.parent).__name__} never saves; give it to `learn`, "
                "alone or in a list, and how often it should save by `save_freq`"
            )
        _check_off_policy(self.model)

    def _on_training_start(self) -> None:
        self._last_step = self.model.num_timesteps
        self.folder.mkdir(parents=True, exist_ok=True)
        key = self.folder.resolve()
        if stale := _locks.pop(key, None):  # of a training that failed; the folder may have been made anew since
            stale.close()
        self._lock = _locks[key] = ExitStack()
        try:
            self._lock.enter_context(locked(self.folder))
        except BlockingIOError as error:
            raise BlockingIOError(
                f"{error}; a notebook whose training was interrupted keeps the folder until its kernel is restarted"
            ) from None
        later = [path for path in checkpoints(self.folder) if checkpoint_step(path) > self._last_step]
        newest = next((path for path in reversed(later) if _damage(path) is None), None)
        if newest is not None:
            self._lock.close()
            raise ValueError(
                f"{newest} is later than this training, which has {self._last_step} steps, and load_checkpoint would "
                "take it: to train the same model on, `learn(..., reset_num_timesteps=False)`, after "
                f"`model.num_timesteps = {checkpoint_step(newest)}` where SB3 has just set it to 0; to go on from the "
                "checkpoint, load_checkpoint and the same; to begin anew, choose another folder, or remove it"
            )

    def _on_rollout_start(self) -> None:
        # The only call of a callback with nothing pending: in `_on_step` the transition is still to be stored, and in
        # `_on_rollout_end` its gradient steps are still to be made.
        if self.model.num_timesteps // self.save_freq > self._last_step // self.save_freq:
            self._save(rollout_started=True)
        self._last_step = self.model.num_timesteps

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        if (new_obs := self.locals.get("new_obs")) is self.model._last_obs:
            self._save(rollout_started=False)
        elif new_obs is not None:
            warnings.warn(
                f"A callback ended the training in step {self.model.num_timesteps}, whose transition is in no replay "
                f"buffer, so that there is no checkpoint of it: the newest in {self.folder} is an earlier one, if any.",
                stacklevel=2,
            )
        self._lock.close()

    def _save(self, rollout_started: bool) -> None:
        assert isinstance(self.model, OffPolicyAlgorithm)
        saved = write_checkpoint(
            self.folder, self.model, self.keep, callbacks=self.locals["callback"], rollout_started=rollout_started
        )
        if saved and self.verbose >= 1:
            print(f"Saved checkpoint-{self.model.num_timesteps} in {self.folder}")


def _cuda_is_in_use() -> bool:
    """To ask for its random numbers would start it."""
    return bool(th.cuda.is_initialized())  # type: ignore[no-untyped-call, unused-ignore]


def random_states() -> dict[str, Any]:
    """States of the global random generators of Python, NumPy and PyTorch, CUDA's included where it is in use."""
    cuda = th.cuda.get_rng_state_all() if _cuda_is_in_use() else []
    return {"python": random.getstate(), "numpy": np.random.get_state(), "torch": th.get_rng_state(), "cuda": cuda}


def set_random_states(states: Mapping[str, Any]) -> None:
    """Put the global random generators into the states of :func:`random_states`."""
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if _cuda_is_in_use() and len(states["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(states["cuda"])


@contextmanager
def same_random_numbers() -> Iterator[None]:
    """Let what is done within draw no random numbers from those that come after."""
    states = random_states()
    try:
        yield
    finally:
        set_random_states(states)
