"""Training that dies at a given moment, in a process of its own; for ``test_checkpoint_killed``."""

import io
import json
import os
import signal
import sys
import traceback
from pathlib import Path
from typing import Any

import torch as th
from resuming import Drifting
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_have.checkpoint import ResumableCheckpointCallback, archive, checkpoints, load_checkpoint

STEPS, SAVE_FREQ = 240, 10
MINUTES = 120


def kill(*args: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


class Mortal(Drifting):
    """Kills the process after a number of steps."""

    steps_left = float("inf")

    def step(self, action: Any) -> Any:
        self.steps_left -= 1
        if self.steps_left == 0:
            kill()
        return super().step(action)


class MortalFile(io.FileIO):
    """Kills the process in the middle of writing.

    :param n_bytes: Number of bytes that are still written
    """

    def __init__(self, path: Path, n_bytes: int):
        super().__init__(path, "wb")
        self.n_bytes = n_bytes

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self.n_bytes:
            super().write(bytes(data)[: self.n_bytes - self.tell()])
            kill()
        return super().write(data)


def prepare(moment: str, number: int) -> None:
    """Make the process die while it writes its ``number``-th checkpoint, or at its ``number``-th byte."""
    original, calls = Path.replace, 0

    def replace(source: Path, target: Path) -> Path:
        nonlocal calls
        calls += Path(target).name.startswith("checkpoint-")  # not another library's cache
        if calls == number and moment == "before renaming":
            kill()
        renamed = original(source, target)
        if calls == number:
            kill()
        return renamed

    if moment == "byte":
        archive.open = lambda path, mode: io.BufferedWriter(MortalFile(path, number))  # type: ignore[attr-defined]
    elif moment.endswith("renaming"):
        Path.replace = replace  # type: ignore[assignment, method-assign]


def make_env() -> VecEnv:
    return VecNormalize(DummyVecEnv([lambda: Monitor(Mortal())]))


def train(folder: Path, moment: str = "never", number: int = 0, keep: int = 2) -> SAC:
    """Train to the end, from the newest checkpoint if there is one.

    :param folder: Folder of the checkpoints
    :param moment: When it dies: "step", "byte", "before renaming", "after renaming" or "never"
    :param number: Number of the step, byte or checkpoint, counted from here
    :param keep: Number of checkpoints to keep
    """
    prepare(moment, number)
    callback = ResumableCheckpointCallback(folder, SAVE_FREQ, keep)
    env = make_env()
    if checkpoints(folder):
        model: SAC = load_checkpoint(folder, env, callback, device="cpu")
    else:
        kwargs: dict[str, Any] = {"buffer_size": 300, "learning_starts": 15, "batch_size": 8, "seed": 1}
        model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", **kwargs)
    # a checkpoint holds the number that was left when it was saved
    steps_left = number if moment == "step" else float("inf")
    env.unwrapped.envs[0].unwrapped.steps_left = steps_left  # type: ignore[attr-defined]
    steps = STEPS - model.num_timesteps
    return model.learn(steps, callback, reset_num_timesteps=model.num_timesteps == 0)


def serve() -> None:
    """Train in a fork of this process for every line of input, and print the signal that ended it."""
    signal.alarm(60 * MINUTES)  # not to outlive the test that started this
    th.set_num_threads(1)
    for line in sys.stdin:
        folder, moment, number = json.loads(line)
        pid = os.fork()
        if pid == 0:
            signal.alarm(60 * MINUTES)
            try:
                train(Path(folder), moment, number)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(1)
        _, status = os.waitpid(pid, 0)
        print(os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0, flush=True)
