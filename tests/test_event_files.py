"""Recorded event streams of DSEC and M3ED: whole, in windows, and damaged."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from event_recordings import Array, assert_same, h5py, hdf5plugin, put, recording

from sb3_have.sensors import EVENT_DTYPE, EventFile, count_frames, event_files, read_events


def test_dsec(tmp_path: Path) -> None:
    events = recording()
    path = put(tmp_path / "events.h5", events, **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=2))
    with h5py.File(path, "a") as file:
        file["t_offset"] = np.int64(49_599_300_523)
        file["ms_to_idx"] = np.arange(3)
    with EventFile(path) as recorded:
        assert (recorded.group, len(recorded)) == ("events", len(events))
        assert (recorded.height, recorded.width) == (480, 640)
        assert recorded.t_offset == 49_599.300523 and recorded.duration == events["t"][-1]
        assert_same(recorded.read(), events)
    with EventFile(path, "/events", height=260, width=346) as recorded:
        assert (recorded.height, recorded.width) == (260, 346)
    middle = events["t"][100]
    assert_same(read_events(path, end=middle), events[events["t"] < middle])
    assert_same(read_events(path, start=middle), events[events["t"] >= middle])


def test_m3ed(tmp_path: Path) -> None:
    streams = {"prophesee/left": recording(), "prophesee/right": recording(seed=1)}
    path = tmp_path / "m3ed.h5"
    for group, events in streams.items():
        put(path, events, group, time="i8", compression="lzf")
        with h5py.File(path, "a") as file:
            file[f"{group}/calib/resolution"] = np.array([1280, 720])
    for wrong in (None, "prophesee/up", "events"):
        with pytest.raises(ValueError, match=r"\['prophesee/left', 'prophesee/right'\], got group="):
            EventFile(path, wrong)
    for group, events in streams.items():
        with EventFile(path, f"/{group}") as recorded:
            assert (recorded.height, recorded.width, recorded.t_offset) == (720, 1280, 0.0)
            assert_same(recorded.read(), events)
            assert_same(recorded.read(0.02, 0.04), events[(events["t"] >= 0.02) & (events["t"] < 0.04)])


def test_every_window_equals_a_mask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_files, "BLOCK", 8)
    events = recording()
    path = put(tmp_path / "events.h5", events)
    edges = sorted({-0.0005, 0.0, 0.003, 0.0035, 0.01, 0.059999, 0.07, *events["t"][::9], *np.arange(0, 0.061, 0.004)})
    with EventFile(path) as recorded:
        for start in edges:
            for end in edges:
                assert_same(recorded.read(start, end), events[(events["t"] >= start) & (events["t"] < end)])


def test_windows_hold_every_event_once(tmp_path: Path) -> None:
    events = recording()
    with EventFile(put(tmp_path / "events.h5", events)) as recorded:
        for duration in (0.003, 0.0071, 0.1):
            windows = list(recorded.windows(duration))
            assert_same(np.concatenate([inside for *_, inside in windows]), events)
            assert all(one[1] == two[0] for one, two in pairwise(windows))
            assert all(((inside["t"] >= t0) & (inside["t"] < t1)).all() for t0, t1, inside in windows)
            assert windows[0][0] == 0.0 and len(windows[-1][2])
            # The representations include t1, but no event of a window lies there
            images = [count_frames(inside, 2, t0, t1, 6, 5) for t0, t1, inside in windows]
            assert np.sum(images) == len(events)
        assert any(not len(inside) for *_, inside in recorded.windows(0.0005))
        assert_same(np.concatenate([w[2] for w in recorded.windows(0.01, start=0.02)]), events[events["t"] >= 0.02])
        assert list(recorded.windows(0.01, start=1.0)) == []
        for bad in (0.0, -1.0, np.nan, np.inf):
            with pytest.raises(ValueError, match="finite duration > 0"):
                next(recorded.windows(bad))


@pytest.mark.parametrize(
    ("times", "counts"), [((0.35, 0.36), [1, 0, 1]), ((0.01, 0.02), [1, 1]), ((0.0,), [1]), ((), [])], ids=str
)
def test_events_on_the_edge_of_a_window(tmp_path: Path, times: tuple[float, ...], counts: list[int]) -> None:
    """In floating point 35 times 0.01 exceeds 0.35, which therefore belongs to the window before."""
    events = np.zeros(len(times), EVENT_DTYPE)
    events["t"], events["p"] = times, 1
    with EventFile(put(tmp_path / "events.h5", events)) as recorded:
        windows = list(recorded.windows(0.01))
        assert recorded.duration == (times[-1] if times else 0)
    # Windows start with the first event
    assert [len(inside) for *_, inside in windows] == counts
    assert all(t0 <= t < t1 for t0, t1, inside in windows for t in inside["t"])


def test_a_window_reads_only_its_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path / "events.h5", recording(300_000, last=30_000_000))
    rows: list[int] = []
    read = h5py.Dataset.__getitem__

    def count(dataset: Any, *args: Any, **options: Any) -> Any:
        values = read(dataset, *args, **options)
        rows.append(np.size(values))
        return values

    monkeypatch.setattr(h5py.Dataset, "__getitem__", count)
    with EventFile(path) as recorded:
        window = recorded.read(12.0, 12.01)
    assert len(window) > 50
    # Four columns, and two blocks at the end of a bisection
    assert 4 * len(window) <= sum(rows) <= 4 * len(window) + 2 * event_files.BLOCK + 100


def damaged(path: Path, change: str) -> Path:
    put(path, recording())
    with h5py.File(path, "a") as file:
        group = file["events"]
        column = change.split()[0]
        values: Array = group[column][:]
        if change == "t back":
            group["t"][100] = values[99] - 1
        else:
            del group[column]
        if change == "p short":
            group["p"] = values[:-3]
        elif change == "t seconds":
            group["t"] = values / 1e6
        elif change == "x table":
            del file["events"]
            file["events"] = np.zeros((9, 4))
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("p missing", r"no event stream of DSEC .* order or the units of their columns"),
        ("x table", r"no event stream of DSEC"),
        ("p short", "differ in length, .*truncated"),
        ("t back", "decreases after row 99; sort by time"),
        ("t seconds", "must hold whole microseconds, got float64"),
    ],
)
def test_damaged_and_other_files(tmp_path: Path, change: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_events(damaged(tmp_path / "events.h5", change))


def test_only_the_rows_read_are_checked(tmp_path: Path) -> None:
    events = recording()
    path = damaged(tmp_path / "events.h5", "t back")
    assert_same(read_events(path, end=events["t"][50]), events[events["t"] < events["t"][50]])


def test_h5py_is_imported_only_when_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import sys, sb3_have.sensors; print(sorted({'h5py', 'hdf5plugin'} & set(sys.modules)))"
    root = Path(__file__).parent.parent
    found = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
    for name in ("h5py", "hdf5plugin"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            with pytest.raises(ImportError, match=r'pip install "sb3_have\[events\]"'):
                read_events(tmp_path / "events.h5")
