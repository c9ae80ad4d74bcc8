"""Files of checkpoints: complete or absent, damaged ones refused, full disks survived."""

import errno
import os
import re
import shutil
import sys
import tracemalloc
import warnings
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import TINY, RandomSensors, image
from gymnasium import spaces
from resuming import Drifting, assert_same, everything, leaves
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.callbacks import EveryNTimesteps
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_have import HAVESAC
from sb3_have.checkpoint import (
    DamagedCheckpointError,
    ResumableCheckpointCallback,
    checkpoint_info,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
)
from sb3_have.checkpoint.archive import damage, dumps, loads, read_archive, write_archive


def make_env() -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(Drifting())])


def make_model(**kwargs: Any) -> SAC:
    defaults: dict[str, Any] = {"buffer_size": 60, "learning_starts": 8, "batch_size": 8, "seed": 0, "device": "cpu"}
    return SAC("MlpPolicy", make_env(), policy_kwargs={"net_arch": [8]}, **{**defaults, **kwargs})


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("[!.]*"))


def contents(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def full_disk(*args: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_the_newest_stay(tmp_path: Path) -> None:
    make_model().learn(35, ResumableCheckpointCallback(tmp_path / "new" / "folder", 10, keep=3))
    assert names(tmp_path / "new" / "folder") == ["checkpoint-20", "checkpoint-30", "checkpoint-35"]
    with pytest.raises(ValueError, match="keep=0"):
        ResumableCheckpointCallback(tmp_path, 10, keep=0)


def test_info_is_read_without_the_rest(tmp_path: Path) -> None:
    model = make_model().learn(9)
    save_checkpoint(model, tmp_path / "mine", info={"minutes": 1.5})
    assert checkpoint_info(tmp_path / "mine") == {"steps": 9, "algorithm": "SAC", "info": {"minutes": 1.5}}


def test_damage_is_refused_by_name(tmp_path: Path) -> None:
    """Truncated or with a flipped bit: nothing is unpickled, and the previous checkpoint is loaded."""
    callback = ResumableCheckpointCallback(tmp_path, 10)
    make_model().learn(20, callback)
    newest = tmp_path / "checkpoint-20"
    whole, intact, rng = newest.read_bytes(), contents(newest), np.random.default_rng(0)
    n_refused = 0
    for i, position in enumerate(rng.integers(0, len(whole) - 100, 30).tolist()):
        broken = bytearray(whole)
        broken[position] ^= 1 << rng.integers(8)
        newest.write_bytes(bytes(broken) if i % 2 else whole[:position])
        if error := damage(newest):
            assert re.search(r"checkpoint-20 is damaged .*\(.*\); use another", str(error))
            n_refused += 1
        else:  # a redundant or unused bit of the zip format
            assert contents(newest) == intact
        if i < 6:
            with pytest.raises(DamagedCheckpointError, match="checkpoint-20 is damaged"):
                load_checkpoint(newest, make_env())
    assert n_refused >= 27
    with pytest.warns(UserWarning, match="checkpoint-20 is damaged.*Skipping to the previous"):
        assert newest_checkpoint(tmp_path) == tmp_path / "checkpoint-10"
    with pytest.warns(UserWarning, match="checkpoint-20 is damaged"):
        model = load_checkpoint(tmp_path, make_env(), device="cpu")
    assert model.num_timesteps == 10
    model.learn(10, callback, reset_num_timesteps=False)
    assert newest_checkpoint(tmp_path) == newest


def test_damaged_directory(tmp_path: Path) -> None:
    """Its names, sizes and methods have no checksum."""
    file, state = tmp_path / "file", {"frames": np.arange(1 << 20, dtype=np.uint8), "small": 1}
    write_archive(file, {"steps": 1}, memoryview(b"model"), state)
    whole = file.read_bytes()
    start = whole.rindex(b"PK\1\2")  # of the last array's entry
    n_refused = 0
    for position in range(8 * start, 8 * len(whole), 3):
        with open(file, "r+b") as broken:
            broken.seek(position // 8)
            broken.write(bytes([whole[position // 8] ^ 1 << position % 8]))
        try:
            loaded = read_archive(file)[2]
        except DamagedCheckpointError:
            n_refused += 1
        else:
            assert_same(leaves(loaded), leaves(state))
        with open(file, "r+b") as broken:
            broken.seek(position // 8)
            broken.write(whole[position // 8 : position // 8 + 1])
    assert n_refused > 50


def test_what_is_no_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="has no checkpoint-<step> that can be read"):
        load_checkpoint(tmp_path, make_env())
    with pytest.raises(FileNotFoundError):
        load_checkpoint(tmp_path / "nowhere", make_env())
    make_model().save(tmp_path / "model.zip")
    with pytest.raises(DamagedCheckpointError, match=r"model\.zip is damaged"):
        load_checkpoint(tmp_path / "model.zip", make_env())


@pytest.mark.parametrize("where", ["write", "fsync", "replace"])
def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """A warning is issued and training continues; previous checkpoints are kept, and nothing is left half-written."""
    expected = everything(make_model().learn(30))

    class DiskThatFills(ResumableCheckpointCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 15:
                if where == "write":
                    monkeypatch.setattr(zipfile._ZipWriteFile, "write", full_disk)  # type: ignore[attr-defined]
                else:
                    monkeypatch.setattr(Path if where == "replace" else os, where, full_disk)
            return super()._on_step()

    with pytest.warns(
        UserWarning, match=r"checkpoint-[23]0 could not be written \(.*No space left on device\)"
    ) as told:
        model = make_model().learn(30, DiskThatFills(tmp_path, 10))
    assert len(told) == 2  # at 20 and at 30
    monkeypatch.undo()
    assert_same(everything(model), expected)
    assert names(tmp_path) == ["checkpoint-10"]
    resumed = load_checkpoint(tmp_path, make_env(), device="cpu").learn(20, reset_num_timesteps=False)
    assert_same(everything(resumed), expected)


def test_a_disk_that_is_too_small_is_noticed_at_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """HAVESAC stores 36x36x3 bytes per step, however many frames are stacked; SB3's buffers store all of them twice."""
    env = VecFrameStack(DummyVecEnv([lambda: RandomSensors(spaces.Dict({"rgb": image(3)}))]), 3)
    kwargs: dict[str, Any] = {"env": env, "policy_kwargs": TINY, "learning_starts": 100, "device": "cpu"}
    stored_once = HAVESAC("MultiInputPolicy", buffer_size=20, **kwargs)
    stored_twice = HAVESAC("MultiInputPolicy", buffer_size=20, replay_buffer_class=DictReplayBuffer, **kwargs)
    frames = 3 * 36 * 36 * 3  # in three checkpoints: two that are kept, and one that is being written
    cases = [(stored_once, 30, 20 * frames), (stored_once, 9, 9 * frames), (stored_twice, 9, 2 * 3 * 9 * frames)]
    for model, steps, needed in cases:
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=needed: SimpleNamespace(free=free))
        model.learn(steps, ResumableCheckpointCallback(tmp_path / f"{needed}", 1000))
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=needed - 1: SimpleNamespace(free=free))
        with pytest.warns(UserWarning, match=r"3 checkpoints in .* may need \d MB, and the disk has \d MB left"):
            model.learn(steps, ResumableCheckpointCallback(tmp_path / f"{needed} less", 1000))


def test_unfinished_file_that_cannot_be_removed(tmp_path: Path) -> None:
    """As in a folder that has become read-only; here it is a folder."""
    (tmp_path / "checkpoint-3.partial").mkdir()
    with pytest.warns(UserWarning, match=r"checkpoint-9 could not be written \(.*; training continues without it"):
        assert make_model().learn(9, ResumableCheckpointCallback(tmp_path, 100)).num_timesteps == 9


def test_folder_that_cannot_be_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on some network file systems; the checkpoint is written nevertheless."""

    def fsync(handle: int, original: Any = os.fsync) -> None:
        if os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        original(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    make_model().learn(20, ResumableCheckpointCallback(tmp_path, 5, keep=1))
    assert names(tmp_path) == ["checkpoint-20"]


def test_callback_within_another_is_refused(tmp_path: Path) -> None:
    every = EveryNTimesteps(5, ResumableCheckpointCallback(tmp_path, 5))
    with pytest.raises(ValueError, match="within EveryNTimesteps would never save"):
        make_model().learn(9, every)


def test_full_disk_is_an_error_without_callback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        save_checkpoint(make_model(), tmp_path / "mine")
    assert names(tmp_path) == []


def test_file_and_folder_are_synced_before_and_after_renaming(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def fsync(handle: int) -> None:
        done.append("folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "file")

    def replace(source: Path, target: Path) -> Path:
        done.append("renamed")
        return source.rename(target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", replace)
    write_archive(tmp_path / "file", {}, memoryview(b"model"), {})
    assert done == ["file", "renamed", "folder"]


def test_large_arrays_are_not_copied(tmp_path: Path) -> None:
    """Saving takes hardly any memory, loading that of the arrays."""
    rng, file = np.random.default_rng(0), tmp_path / "file"
    frames, fortran = rng.integers(0, 256, (8, 1 << 20), np.uint8), np.asfortranarray(rng.random((512, 999)))
    state = {"frames": frames, "fortran": fortran}
    total = sum(array.nbytes for array in state.values())
    peaks = []
    for act in (lambda: write_archive(file, {}, memoryview(b""), state), lambda: read_archive(file)):
        tracemalloc.start()
        result = act()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert result is not None
    loaded = result[2]
    assert_same(leaves(loaded), leaves(state))
    assert loaded["frames"].flags.writeable and loaded["fortran"].flags.f_contiguous
    assert peaks[0] < 0.2 * total and peaks[1] < 1.4 * total


class Known:
    """Stands in for a class that a script defines."""


def test_classes_of_the_running_script(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are pickled by name; isinstance fails for the copies that cloudpickle makes."""
    main = sys.modules["__main__"]
    again = type("Known", (), {"__module__": "__main__"})
    monkeypatch.setattr(Known, "__module__", "__main__")
    monkeypatch.setattr(main, "Known", Known, raising=False)
    pickled = dumps([Known(), lambda: 3])
    monkeypatch.setattr(main, "Known", again)
    known, function = loads(pickled)
    assert type(known) is again and function() == 3


def test_objects_that_exist_are_not_pickled() -> None:
    owner = th.nn.Linear(1, 1)
    pickled = dumps({"owner": owner, "others": [owner]}, [warnings, owner])
    other = th.nn.Linear(1, 1)
    assert loads(pickled, [None, other]) == {"owner": other, "others": [other]}
