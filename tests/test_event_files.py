"""Recorded event streams: files as DSEC, M3ED and others have them, read whole, in windows and damaged."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from event_recordings import (
    DSEC_INDEX,
    DSEC_TIMES,
    HEIGHT,
    WIDTH,
    Array,
    assert_same,
    h5py,
    hdf5plugin,
    index_of,
    put,
    put_index,
    put_offset,
    recording,
    ticks_of,
)

from sb3_have.sensors import EVENT_DTYPE, EventFile, count_frames, event_files, read_events, write_events


def test_a_file_as_dsec_has_it(tmp_path: Path) -> None:
    events = recording(len(DSEC_TIMES) * 4)[: len(DSEC_TIMES)]
    events["t"] = np.array(DSEC_TIMES) / 1e6
    path = put(tmp_path / "events.h5", events, **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=2))
    put_index(path, "ms_to_idx", DSEC_INDEX)
    put_offset(path, np.int64(49_599_300_523))
    with EventFile(path) as recorded:
        assert (recorded.group, len(recorded), recorded.height, recorded.width) == ("events", 10, None, None)
        assert recorded.t_offset == 49_599.300523 and recorded.duration == 0.009
        assert_same(recorded.read(), events)
        assert_same(recorded.read(0.0021, 0.0072), events[2:6])
    with EventFile(path, "/events", height=480, width=640) as recorded:
        assert (recorded.height, recorded.width) == (480, 640)
    assert_same(read_events(path, end=0.005), events[:3])
    assert_same(read_events(path, start=0.005), events[3:])


def test_a_file_as_m3ed_has_it(tmp_path: Path) -> None:
    left, right = recording(), recording(seed=1)
    path = tmp_path / "m3ed.h5"
    for side, events in (("left", left), ("right", right)):
        group = f"prophesee/{side}"
        put(path, events, group, time="i8", compression="lzf")
        ticks = ticks_of(events)
        put_index(path, f"{group}/ms_map_idx", index_of(ticks)[: ticks[-1] // 1000])  # the last one is not in there
        with h5py.File(path, "a") as file:
            file[f"{group}/calib/resolution"] = np.array([WIDTH, HEIGHT])
            file[f"{group}/calib/intrinsics"] = np.ones(4)
    with h5py.File(path, "a") as file:
        file["ovc/rgb/data"] = np.zeros((2, 4, 4, 3), np.uint8)
    with pytest.raises(ValueError, match=r"\['prophesee/left', 'prophesee/right'\]; name one of them as group"):
        EventFile(path)
    with pytest.raises(ValueError, match=r"none is 'prophesee/up'; name one of them"):
        EventFile(path, "prophesee/up")
    for side, events in (("left", left), ("right", right)):
        with EventFile(path, f"/prophesee/{side}") as recorded:
            assert (recorded.height, recorded.width, recorded.t_offset) == (HEIGHT, WIDTH, 0.0)
            assert_same(recorded.read(), events)
            assert_same(recorded.read(0.02, 0.04), events[(events["t"] >= 0.02) & (events["t"] < 0.04)])
    with pytest.raises(ValueError, match=r"width is 5 in .*, got width=7"):
        EventFile(path, "prophesee/left", width=7)


@pytest.mark.parametrize("layout", ["flat", "mvsec"])
def test_files_that_count_in_seconds(tmp_path: Path, layout: str) -> None:
    """Their first time stamp is the offset: the times count from there."""
    events = recording()
    first = 1_506_117_866.25
    times, path = first + (events["t"] - events["t"][0]), tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        if layout == "flat":
            for name, values in (("xs", events["x"]), ("ys", events["y"]), ("ts", times), ("ps", events["p"] > 0)):
                file[f"events/{name}"] = values
        else:
            file["davis/left/events"] = np.stack([events["x"], events["y"], times, events["p"]], axis=1)
    with EventFile(path) as recorded:
        assert recorded.t_offset == first
        found = recorded.read()
        middle = recorded.read(0.02, 0.04)
    np.testing.assert_array_equal(found["t"], times - first)
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(found[name], events[name])
    assert_same(middle, found[(found["t"] >= 0.02) & (found["t"] < 0.04)])


def unix(path: Path, group: str = "events") -> tuple[Array, int]:
    """A stream in microseconds of Unix time, and the events by a clock that starts with them."""
    events, now = recording(), 1_506_117_866_250_001
    put(path, events, group, time="u8")
    with h5py.File(path, "a") as file:
        file[f"{group}/t"][:] += np.uint64(now)
    first = int(ticks_of(events)[0])
    events["t"] = (ticks_of(events) - first) / 1e6
    return events, now + first


@pytest.mark.parametrize("group", ["events", "prophesee/left"])
@pytest.mark.parametrize("index", ["none", "from the first event"])
def test_unix_time_counts_from_the_first_event(tmp_path: Path, index: str, group: str) -> None:
    events, first = unix(tmp_path / "events.h5", group)
    if index != "none":
        name = "ms_to_idx" if group == "events" else f"{group}/ms_map_idx"
        put_index(tmp_path / "events.h5", name, index_of(ticks_of(events)))
    with EventFile(tmp_path / "events.h5") as recorded:
        assert recorded.t_offset == first / 1e6 and recorded.duration == events["t"][-1]
        assert_same(recorded.read(), events)
        assert_same(recorded.read(0, 0.03), events[events["t"] < 0.03])
        windows = list(recorded.windows(0.01))
        assert windows[0][0] == 0.0
        assert_same(np.concatenate([inside for *_, inside in windows]), events)


@pytest.mark.parametrize("says", ["index", "t_offset"])
def test_a_file_that_says_where_time_starts_is_taken_at_its_word(tmp_path: Path, says: str) -> None:
    late = recording()
    late["t"] = (ticks_of(late) + 350_000) / 1e6  # nothing happens before
    path = put(tmp_path / "events.h5", late)
    if says == "index":
        put_index(path, "ms_to_idx", index_of(ticks_of(late)))
    else:
        put_offset(path, np.int64(5_000_000))
    with EventFile(path) as recorded:
        assert recorded.t_offset == (5.0 if says == "t_offset" else 0.0)
        assert len(recorded.read(0.0, 0.35)) == 0
        assert_same(recorded.read(0.0, 0.36), late[ticks_of(late) < 360_000])


@pytest.mark.parametrize("offset", [1.5, np.array([1, 2]), "now"], ids=str)
def test_an_offset_is_one_integer(tmp_path: Path, offset: Any) -> None:
    path = put(tmp_path / "events.h5", recording())
    put_offset(path, offset)
    with pytest.raises(ValueError, match=r"t_offset in .* must be one integer, of microseconds, got .*round\(1e6"):
        EventFile(path)


def test_only_the_rows_that_are_read_are_checked(tmp_path: Path) -> None:
    path = damaged(tmp_path / "events.h5", "t back")  # row 100
    put_offset(path, np.int64(0))
    events = recording()
    assert_same(read_events(path, end=events["t"][50]), events[events["t"] < events["t"][50]])
    with pytest.raises(ValueError, match="steps back after row 99"):
        read_events(path)


@pytest.mark.parametrize("index", ["right", "none", "short", "shifted", "garbage"])
def test_every_window_is_that_of_a_mask(tmp_path: Path, index: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The index of milliseconds may save reading, it cannot change what is read."""
    monkeypatch.setattr(event_files, "BLOCK", 8)
    events = recording()
    path = put(tmp_path / "events.h5", events)
    put_offset(path, np.int64(0))
    right = index_of(ticks_of(events))
    rows = {
        "right": right,
        "short": right[:9],
        "shifted": np.roll(right, 5),
        "garbage": np.random.default_rng(2).integers(0, 2 * len(events), len(right)),
    }
    if index in rows:
        put_index(path, "ms_to_idx", rows[index])
    edges = sorted({-0.0005, 0.0, 0.003, 0.0035, 0.01, 0.059999, 0.07, *events["t"][::9], *np.arange(0, 0.061, 0.004)})
    with EventFile(path) as recorded:
        for start in edges:
            for end in edges:
                if start <= end:
                    wanted = events[(events["t"] >= start) & (events["t"] < end)]
                    assert_same(recorded.read(start, end), wanted)
    assert_same(read_events(path, -1.0, np.inf), events)


def test_an_index_into_the_middle_of_simultaneous_events(tmp_path: Path) -> None:
    events = recording(len(DSEC_TIMES) * 4)[: len(DSEC_TIMES)]
    events["t"] = np.array(DSEC_TIMES) / 1e6
    path = put(tmp_path / "events.h5", events)
    put_index(path, "ms_to_idx", [*DSEC_INDEX[:5], 4, *DSEC_INDEX[6:]])
    assert_same(read_events(path, 0.005, 0.0055), events[3:5])


def test_windows_hold_every_event_once(tmp_path: Path) -> None:
    events, path = recording(), tmp_path / "events.h5"
    write_events(path, events, HEIGHT, WIDTH)
    with EventFile(path) as recorded:
        for duration in (0.003, 0.0071, 0.1):
            windows = list(recorded.windows(duration))
            assert_same(np.concatenate([inside for *_, inside in windows]), events)
            assert all(one[1] == two[0] for one, two in pairwise(windows))
            assert all(((inside["t"] >= t0) & (inside["t"] < t1)).all() for t0, t1, inside in windows)
            assert windows[0][0] == 0.0 and len(windows[-1][2])
            images = [count_frames(inside, 2, t0, t1, HEIGHT, WIDTH) for t0, t1, inside in windows]
            assert np.sum(images) == len(events)  # although an image takes events at t1 too
        assert any(not len(inside) for *_, inside in recorded.windows(0.0005))
        assert_same(np.concatenate([w[2] for w in recorded.windows(0.01, start=0.02)]), events[events["t"] >= 0.02])
        assert list(recorded.windows(0.01, start=1.0)) == []
        for bad in (0.0, -1.0, np.nan, np.inf):
            with pytest.raises(ValueError, match="finite duration > 0"):
                recorded.windows(bad)


@pytest.mark.parametrize(
    ("times", "counts"), [((0.35, 0.36), [1, 0, 1]), ((0.01, 0.02), [1, 1]), ((0.0,), [1])], ids=str
)
def test_events_on_the_edge_of_a_window(tmp_path: Path, times: tuple[float, ...], counts: list[int]) -> None:
    """In floating point 35 times 0.01 lies above 0.35, which then belongs to the window before."""
    events = np.zeros(len(times), EVENT_DTYPE)
    events["t"], events["p"] = times, 1
    write_events(tmp_path / "events.h5", events, HEIGHT, WIDTH)
    with EventFile(tmp_path / "events.h5") as recorded:
        windows = list(recorded.windows(0.01))
    assert [len(inside) for *_, inside in windows] == counts
    assert all(t0 <= t < t1 for t0, t1, inside in windows for t in inside["t"])


def test_windows_begin_with_the_first_event(tmp_path: Path) -> None:
    """A clock that started long before the recording does not cost hours of empty windows."""
    events = recording()
    events["t"] += 3600
    write_events(tmp_path / "events.h5", events, HEIGHT, WIDTH)
    with EventFile(tmp_path / "events.h5") as recorded:
        windows = list(recorded.windows(0.01, start=0.005))
        assert len(windows[0][2]) and len(windows) == 7
        assert_same(np.concatenate([inside for *_, inside in windows]), read_events(tmp_path / "events.h5"))


@pytest.mark.parametrize("index", [True, False])
def test_a_window_reads_its_rows_only(tmp_path: Path, index: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    events, path = recording(300_000, last=30_000_000), tmp_path / "events.h5"
    write_events(path, events, HEIGHT, WIDTH)
    if not index:
        with h5py.File(path, "a") as file:
            del file["ms_to_idx"]
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
    # Four columns, and what finding two rows takes: two milliseconds, or two blocks at the end of a bisection.
    lookup = 200 if index else 2 * event_files.BLOCK + 100
    assert 4 * len(window) <= sum(rows) <= 4 * len(window) + lookup


def damaged(path: Path, change: str) -> Path:
    events = recording()
    put(path, events)
    with h5py.File(path, "a") as file:
        group = file["events"]
        column = change.split()[0]
        values: Array = group[column][:]
        if change == "p missing":
            del group["p"]
        elif change == "p short":
            del group["p"]
            group["p"] = values[:-3]
        elif change == "t back":
            group["t"][100] = values[99] - 1
        elif change == "p two":
            group["p"][7] = 2
        elif change == "t negative":
            del group["t"]
            group["t"] = values.astype("i8") - 10**6
            file["t_offset"] = np.int64(0)
        elif change == "t words":
            del group["t"]
            group["t"] = values.astype("S8")
        elif change == "x wide":
            group.attrs["height"], group.attrs["width"] = HEIGHT, WIDTH
            group["x"][3] = WIDTH
        elif change == "y fractions":
            del group["y"]
            group["y"] = values + 0.5
        elif change == "y negative":
            del group["y"]
            group["y"] = values.astype("i2") - 2
        elif change == "p three":
            del group["p"]
            group["p"] = np.resize(np.array([-1, 0, 1], np.int8), len(values))
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("p missing", r"holds no event stream, .* it holds \['events/t', 'events/x', 'events/y'\]"),
        ("p short", "differ in length, .*truncated"),
        ("t back", "steps back after row 99, from .*; sort the events"),
        ("t negative", r"starts at -0\.99984 s, but its t_offset or index counts from 0; shift it"),
        ("t words", r"t of 'events' in .* must be numbers, got \|S8"),
        ("p two", r"must be 0 and 1 or -1 and 1, got \[0, 1, 2\]"),
        ("p three", r"must be 0 and 1 or -1 and 1, got \[-1, 0, 1\]"),
        ("x wide", r"x of 'events' .* spans 0..5 in rows 0..333, outside of a width of 5"),
        ("y fractions", "fractions of a pixel"),
        ("y negative", r"y of 'events' .* spans -2..3"),
    ],
)
def test_damaged_streams(tmp_path: Path, change: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_events(damaged(tmp_path / "events.h5", change))


def test_files_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no event file .*none\.h5"):
        EventFile(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("x y t p\n1 2 0.5 1\n")
    with pytest.raises(ValueError, match=r"text\.h5 is not an HDF5 file"):
        EventFile(tmp_path / "text.h5")
    with h5py.File(tmp_path / "empty.h5", "w"):
        pass
    with pytest.raises(ValueError, match="it holds no datasets"):
        EventFile(tmp_path / "empty.h5")
    path = put(tmp_path / "cut.h5", recording())
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(OSError, match=r"cannot open .*cut\.h5.*truncated .copy it again.,"):
        EventFile(path)
    path = put(tmp_path / "rotten.h5", recording(), compression="gzip", fletcher32=True)
    with h5py.File(path) as file:
        offset = file["events/x"].id.get_chunk_info(0).byte_offset
    data = bytearray(path.read_bytes())
    data[offset : offset + 8] = bytes(8)
    path.write_bytes(data)
    with pytest.raises(OSError, match=r"cannot read /events/x in .*rotten\.h5.*damaged"):
        read_events(path)
    with EventFile(put(tmp_path / "good.h5", recording())) as recorded, pytest.raises(ValueError, match="start <= end"):
        recorded.read(2.0, 1.0)


def test_h5py_is_imported_only_when_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import sys, sb3_have.sensors; print(sorted({'h5py', 'hdf5plugin'} & set(sys.modules)))"
    command = [sys.executable, "-c", code]
    root = Path(__file__).parent.parent
    found = subprocess.run(command, cwd=root, timeout=120, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
    for name in ("h5py", "hdf5plugin"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            with pytest.raises(ImportError, match=r'pip install "sb3_have\[events\]"'):
                read_events(tmp_path / "events.h5")
            with pytest.raises(ImportError, match=r'pip install "sb3_have\[events\]"'):
                write_events(tmp_path / "events.h5", recording(), HEIGHT, WIDTH)


def test_the_end_of_the_index_by_the_last_bit(tmp_path: Path) -> None:
    events = np.zeros(2, EVENT_DTYPE)
    events["t"], events["p"] = [0.001, 0.1161], 1
    write_events(tmp_path / "events.h5", events, HEIGHT, WIDTH)
    with EventFile(tmp_path / "events.h5") as recorded:
        for end in (np.nextafter(0.117, 0), 0.117, np.nextafter(0.117, 1), np.inf):
            assert len(recorded.read(0, end)) == 2
        assert len(recorded.read(0, 0.1161)) == 1
