"""Save and load checkpoints, from which training resumes bit for bit on a CPU."""

from __future__ import annotations

import io
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_have.checkpoint.archive import damage, read_archive, read_info, write_archive
from sb3_have.checkpoint.callback_state import Callbacks, callbacks_state, flattened, restore_callbacks
from sb3_have.checkpoint.env_state import environments_state, restore_environments
from sb3_have.checkpoint.random_state import random_states, set_random_states
from sb3_have.checkpoint.replay_state import at_full_size, filled_part


def save_checkpoint(
    model: OffPolicyAlgorithm,
    path: str | os.PathLike[str],
    callbacks: Callbacks = None,
    info: Mapping[str, Any] | None = None,
) -> None:
    """
    Save a model and everything that its further training depends on in one file.

    This includes all optimizers, the replay buffer, the environments in the middle of their episodes with all their
    wrappers (VecNormalize's statistics, stacked frames, Monitor), the random numbers of Python, NumPy and PyTorch, and
    the callbacks' state. It does not include pending values of the logger and the environments of callbacks that
    evaluate. The file is written completely or not at all.

    A warning names environments that cannot be pickled (a simulator's connection, a MuJoCo renderer that has drawn).
    After resuming they begin new episodes; everything else is exact. ``SubprocVecEnv`` needs
    :class:`~sb3_have.checkpoint.ResumableEnv` around every environment.

    Call this between two calls of ``learn``. Within ``learn``, use :class:`~sb3_have.ResumableCheckpointCallback`: in
    ``_on_step`` of a callback the last transition is not stored yet.

    :param model: Off-policy algorithm of Stable-Baselines3 with its environment
    :param path: Path of the file; an existing one is replaced
    :param callbacks: Callbacks to save, with ``n_calls`` and what SB3's own remember; others are asked for
        ``get_state()`` and given it back by ``set_state(state)``, if they have both
    :param info: More values for :func:`checkpoint_info`, in JSON
    :raises OSError: If the file cannot be written, for instance on a full disk
    """
    env = model.get_env()
    if env is None:
        raise ValueError("the model has no environment, and a checkpoint holds the environment's state; use set_env")
    environments = environments_state(env, (model.observation_space, model.action_space))
    if environments.lost:
        warnings.warn(
            f"The state of the environment cannot be saved: {'; '.join(environments.lost)}. Training that resumes from "
            "this checkpoint begins new episodes; everything else is exact.",
            stacklevel=2,
        )
    buffer = model.replay_buffer
    assert buffer is not None  # for mypy
    state = {
        "algorithm": type(model),
        "environments": environments,
        "replay_buffer": filled_part(buffer),
        "callbacks": callbacks_state(callbacks),
        # Last, after everything that may draw
        "random": random_states(),
    }
    header = {"steps": model.num_timesteps, "algorithm": type(model).__name__, "info": dict(info or {})}
    saved = io.BytesIO()
    model.save(saved)
    write_archive(Path(path), header, saved.getbuffer(), state)


def load_checkpoint(
    path: str | os.PathLike[str],
    env: gym.Env[Any, Any] | VecEnv,
    callbacks: Callbacks = None,
    device: th.device | str = "auto",
) -> Any:
    """
    Load the model of a checkpoint, ready to resume training::

        callback = ResumableCheckpointCallback("checkpoints", save_freq=10_000)
        HAVESAC("MultiInputPolicy", env, seed=0).learn(200_000, callback)
        # The process dies; in a new one:
        model = load_checkpoint("checkpoints", env, callback)
        model.learn(200_000 - model.num_timesteps, callback, reset_num_timesteps=False)

    With ``reset_num_timesteps=False``, ``learn`` resets neither counters nor the environment, and continues schedules.
    Call it at once: random numbers that are drawn in between are missing later.

    The file is unpickled, which can execute any code, as SB3's replay buffers can: load only what you wrote yourself,
    and share weights with :func:`~sb3_have.export_safetensors`.

    :param path: Path of the file, or of a folder of ``checkpoint-<step>``; the newest that is not damaged is loaded
    :param env: Environment made as in the training that wrote it, with the same wrappers and number of environments:
        the checkpoint's state overrides other settings. To continue in another one, call ``model.set_env`` afterwards.
        Monitor with ``override_existing=False`` continues its file
    :param callbacks: Callbacks to restore, matched by class and order. Include ResumableCheckpointCallback, which
        restores action noise and gSDE's noise
    :param device: Device of the model
    :return: The model
    :raises DamagedCheckpointError: If the file is damaged
    :raises FileNotFoundError: If there is none
    :raises ValueError: If the environments have other wrappers, or differ in number
    """
    file = Path(path)
    if file.is_dir():
        newest = newest_checkpoint(file)
        if newest is None:
            raise FileNotFoundError(f"{file} has no checkpoint-<step> that can be read")
        file = newest
    _, saved, state = read_archive(file)
    buffer = at_full_size(state["replay_buffer"])
    with warnings.catch_warnings():
        # Give SB3 the buffer, so that it does not create a second one; n-step returns are set up in it
        warnings.filterwarnings("ignore", message="`n_steps=")
        model = state["algorithm"].load(saved, env=env, device=device, force_reset=False, replay_buffer=buffer)
    model.observation_space, model.action_space = restore_environments(model.env, state["environments"])
    buffer.device = model.device
    if hasattr(buffer, "set_env"):  # HerReplayBuffer
        buffer.set_env(model.env)
    if state["environments"].lost:
        # Let `learn` reset the environments
        model._last_obs = None
        end_last_episode(buffer)
    restore_callbacks(callbacks, state["callbacks"])
    given = {type(callback).__qualname__ for callback in flattened(callbacks)}
    saved_by = {name for name, *_ in state["callbacks"]}
    has_noise = model.action_noise is not None or model.use_sde
    if has_noise and "ResumableCheckpointCallback" in saved_by - given:
        warnings.warn(
            "Action noise and gSDE's noise are not restored: pass the ResumableCheckpointCallback to load_checkpoint.",
            stacklevel=2,
        )
    set_random_states(state["random"])
    return model


def end_last_episode(buffer: ReplayBuffer) -> None:
    """End the last episode, so that n-step returns and next observations do not cross into later transitions."""
    if hasattr(buffer, "truncate_last_trajectory"):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The last trajectory in the replay buffer will be truncated")
            buffer.truncate_last_trajectory()
    elif buffer.size() > 0 and (buffer.optimize_memory_usage or isinstance(buffer, NStepReplayBuffer)):
        last = buffer.pos - 1
        # Without handling of timeouts the cut is a termination, as in SB3's `learn`
        if buffer.handle_timeout_termination:
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], 1 - buffer.dones[last])
        buffer.dones[last] = 1


def checkpoint_info(path: str | os.PathLike[str]) -> dict[str, Any]:
    """
    Read ``steps``, ``algorithm`` and ``info`` of a checkpoint without unpickling anything.

    :raises DamagedCheckpointError: If the file is damaged
    """
    return read_info(Path(path))


def checkpoint_step(path: Path) -> int:
    """Return the training steps of a ``checkpoint-<step>``."""
    return int(path.name.rpartition("-")[2])


def checkpoints(folder: str | os.PathLike[str]) -> list[Path]:
    """List the files ``checkpoint-<step>`` of a folder, oldest first."""
    found = [path for path in Path(folder).glob("checkpoint-*") if re.fullmatch(r"checkpoint-\d+", path.name)]
    files = [path for path in found if path.is_file()]
    return sorted(files, key=checkpoint_step)


def newest_checkpoint(folder: str | os.PathLike[str]) -> Path | None:
    """Return the checkpoint with the most steps that is not damaged, or None; a warning names damaged ones."""
    for path in reversed(checkpoints(folder)):
        error = damage(path)
        if error is None:
            return path
        warnings.warn(f"{error}. Skipping to the previous checkpoint, if there is one.", stacklevel=2)
    return None
