"""Recorded event streams for the tests: random ones, and files made by h5py alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.sensors import EVENT_DTYPE

Array = NDArray[Any]

h5py = pytest.importorskip("h5py", reason="recorded events need the extra 'events'")
hdf5plugin = pytest.importorskip("hdf5plugin", reason="recorded events need the extra 'events'")

#: The example with which DSEC documents its index of milliseconds.
DSEC_TIMES = [0, 500, 2100, 5000, 5000, 7100, 7200, 7200, 8100, 9000]
DSEC_INDEX = [0, 2, 2, 3, 3, 3, 5, 5, 8, 9]
HEIGHT, WIDTH = 6, 5


def recording(count: int = 400, last: int = 60_000, seed: int = 0) -> Array:
    """Random events on whole microseconds, several at one time, none in some milliseconds."""
    rng = np.random.default_rng(seed)
    ticks = np.sort(rng.integers(0, last // 10, count) * 10)
    ticks = ticks[(ticks // 1000) % 7 != 3]
    events = np.zeros(len(ticks), EVENT_DTYPE)
    events["t"] = ticks / 1e6
    events["x"], events["y"] = rng.integers(0, WIDTH, len(ticks)), rng.integers(0, HEIGHT, len(ticks))
    events["p"] = rng.choice((-1, 1), len(ticks))
    return events


def ticks_of(events: Array) -> Array:
    return np.asarray(np.rint(events["t"] * 1e6).astype(np.int64))


def put(path: Path, events: Array, group: str = "events", **options: Any) -> Path:
    """A stream by h5py alone, p as 0 and 1."""
    with h5py.File(path, "a") as file:
        for name, dtype in (("x", "u2"), ("y", "u2"), ("t", options.pop("time", "u4")), ("p", "u1")):
            values = {"t": ticks_of(events), "p": events["p"] > 0}.get(name, events[name])
            file.create_dataset(f"{group}/{name}", data=values.astype(dtype), chunks=(min(64, len(events)),), **options)
    return path


def put_index(path: Path, name: str, index: Any) -> None:
    with h5py.File(path, "a") as file:
        file.create_dataset(name, data=np.asarray(index, dtype="u8"))


def put_offset(path: Path, offset: Any) -> None:
    with h5py.File(path, "a") as file:
        file["t_offset"] = offset


def index_of(ticks: Array) -> Array:
    return np.array([np.flatnonzero(ticks >= 1000 * ms)[0] for ms in range(ticks[-1] // 1000 + 1)])


def assert_same(found: Array, wanted: Array) -> None:
    assert found.dtype == EVENT_DTYPE
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)
