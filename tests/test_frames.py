"""The pool of frames behind the replay buffer: blocks, saving and loading, and what it says when there is no room."""

import errno
import os
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_have.common.frames import EMPTY, FramePool

SHAPES = {"rgb": (3, 16, 16)}
DTYPES: dict[str, np.dtype[Any]] = {"rgb": np.dtype(np.uint8)}


def test_directory_that_does_not_exist() -> None:
    pool = FramePool(8, SHAPES, DTYPES, "mmap", mmap_dir="no/such/folder")
    with pytest.raises(ValueError, match="mmap_dir='no/such/folder'"):
        pool.take()


def test_full_disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As the system reports it; the message says what to do."""

    def no_space(*args: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", no_space, raising=False)
    with pytest.raises(OSError, match=r"No space left.*'rgb'.*buffer_size.*mmap_dir") as error:
        FramePool(8, SHAPES, DTYPES, "mmap", mmap_dir=tmp_path).take()
    assert error.value.errno == errno.ENOSPC


def test_no_memory() -> None:
    pool = FramePool(10**10, {"rgb": (9, 128, 128)}, {"rgb": np.dtype(np.uint8)})
    with pytest.raises(MemoryError, match=r"'rgb'.*buffer_size.*mmap"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that it will not do, where psutil is there to say so
        pool.take()


@pytest.mark.parametrize("storage", ["memory", "mmap", "device"])
def test_blocks_of_a_pool_that_grows(storage: str) -> None:
    """Frames stay where they are, whatever is taken, given back, saved and loaded in between."""
    rng = np.random.default_rng(0)
    pool = FramePool(4, {"a": (2, 3)}, {"a": np.dtype(np.int16)}, storage)
    frames: dict[int, np.ndarray] = {}
    for turn in range(200):
        if turn % 50 == 49:
            pool = pickle.loads(pickle.dumps(pool))
        for slot in rng.permutation(list(frames))[: rng.integers(0, 3)].tolist():
            pool.give_back([slot])
            del frames[slot]
        for _ in range(rng.integers(0, 4)):
            slot = pool.take()
            assert slot not in frames and slot != EMPTY
            frames[slot] = rng.integers(-9, 9, (2, 3)).astype(np.int16)
            pool.write(slot, {"a": frames[slot]})
        slots = np.array([EMPTY, *frames], np.int32)
        if frames:
            expected = np.stack([np.zeros((2, 3)), *frames.values()])
            assert np.array_equal(pool.gather("a", slots).numpy(), expected)
        assert pool.n_used == 1 + len(frames) if frames else pool.n_used <= 1
    assert len(pool._blocks) > 2


def test_loaded_pool_grows_to_its_capacity() -> None:
    pool = FramePool(20, {"a": (2,)}, {"a": np.dtype(np.uint8)})
    for _ in range(17):
        pool.take()
    pool = pickle.loads(pickle.dumps(pool))
    for _ in range(2):
        pool.take()
    assert pool._n_reserved == 20
    pool.take()
    assert pool._n_reserved > 20
