"""Recorded event streams for the tests: random events, and files written by h5py alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.sensors import EVENT_DTYPE

Array = NDArray[Any]

h5py = pytest.importorskip("h5py", reason="recorded events need the extra 'events'")
hdf5plugin = pytest.importorskip("hdf5plugin", reason="recorded events need the extra 'events'")


def recording(count: int = 400, last: int = 60_000, seed: int = 0) -> Array:
    """Random events on whole microseconds, some simultaneous, with none in some milliseconds."""
    rng = np.random.default_rng(seed)
    ticks = np.sort(rng.integers(0, last // 10, count) * 10)
    ticks = ticks[(ticks // 1000) % 7 != 3]
    events = np.zeros(len(ticks), EVENT_DTYPE)
    events["t"] = ticks / 1e6
    events["x"], events["y"] = rng.integers(0, 5, len(ticks)), rng.integers(0, 6, len(ticks))
    events["p"] = rng.choice((-1, 1), len(ticks))
    return events


def ticks_of(events: Array) -> Array:
    return np.asarray(np.rint(events["t"] * 1e6).astype(np.int64))


def put(path: Path, events: Array, group: str = "events", time: str = "u4", **options: Any) -> Path:
    """Write a stream with h5py, p as 0 and 1."""
    columns = {
        "x": events["x"],
        "y": events["y"],
        "t": ticks_of(events).astype(time),
        "p": (events["p"] > 0).astype("u1"),
    }
    chunks = (min(64, len(events)),) if len(events) else None
    with h5py.File(path, "a") as file:
        for name, values in columns.items():
            file.create_dataset(f"{group}/{name}", data=values, chunks=chunks, **options)
    return path


def assert_same(found: Array, wanted: Array) -> None:
    assert found.dtype == EVENT_DTYPE
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)
