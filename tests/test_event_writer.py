"""Event streams written as DSEC and M3ED have them: bit by bit, in chunks, by processes that are killed."""

import signal
import subprocess
import sys
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
    index_of,
    recording,
    ticks_of,
)

from sb3_have.sensors import (
    EVENT_DTYPE,
    EventCamera,
    EventFile,
    EventWriter,
    count_frames,
    event_writer,
    read_events,
    stack_by_time,
    voxel_grid,
    write_events,
)
from sb3_have.sensors.event_writer import Convention


@pytest.mark.parametrize("convention", ["dsec", "m3ed"])
def test_what_is_written_is_read(tmp_path: Path, convention: Convention) -> None:
    events, path = recording(), tmp_path / "events.h5"
    offset = 8.2 if convention == "dsec" else 0.0
    write_events(path, events, HEIGHT, WIDTH, convention, t_offset=offset)
    with EventFile(path) as recorded:
        assert (recorded.height, recorded.width, recorded.t_offset) == (HEIGHT, WIDTH, offset)
        assert recorded.duration == events["t"][-1]
        assert_same(recorded.read(), events)
    assert_same(read_events(path, 0.013, 0.014), events[(events["t"] >= 0.013) & (events["t"] < 0.014)])


def test_what_is_written_is_what_the_data_sets_have(tmp_path: Path) -> None:
    events = recording(len(DSEC_TIMES) * 4)[: len(DSEC_TIMES)]
    events["t"] = np.array(DSEC_TIMES) / 1e6
    write_events(tmp_path / "dsec.h5", events, HEIGHT, WIDTH, t_offset=2.5)
    write_events(tmp_path / "m3ed.h5", events, HEIGHT, WIDTH, "m3ed")
    with h5py.File(tmp_path / "dsec.h5") as file:
        assert file["t_offset"][()] == 2_500_000
        assert file["ms_to_idx"][:].tolist() == DSEC_INDEX
        assert [file["events"][name].dtype.str for name in "xytp"] == ["<u2", "<u2", "<u4", "|u1"]
        assert file["events/t"][:].tolist() == DSEC_TIMES
        np.testing.assert_array_equal(file["events/p"], events["p"] > 0)
        # 32001 is Blosc in the registry of HDF5 filters
        assert file["events/t"].id.get_create_plist().get_filter(0)[0] == 32001
    with h5py.File(tmp_path / "m3ed.h5") as file:
        group = file["prophesee/left"]
        assert group["ms_map_idx"][:].tolist() == DSEC_INDEX
        assert [group[name].dtype.str for name in "xytp"] == ["<u2", "<u2", "<i8", "|i1"]
        assert group["calib/resolution"][:].tolist() == [WIDTH, HEIGHT]
        np.testing.assert_array_equal(group["p"], events["p"] > 0)
        assert group["t"].compression == "lzf"


def test_times_are_rounded_to_the_nearest_microsecond_in_order(tmp_path: Path) -> None:
    events = np.zeros(5, EVENT_DTYPE)
    events["t"], events["p"] = [0.0, 0.4e-6, 0.6e-6, 1.4e-6, 4000.1234564], 1
    write_events(tmp_path / "events.h5", events, HEIGHT, WIDTH)
    assert read_events(tmp_path / "events.h5")["t"].tolist() == [0.0, 0.0, 1e-6, 1e-6, 4000.123456]


def film(frames: int = 12) -> Array:
    rng = np.random.default_rng(3)
    return np.asarray(np.cumsum(rng.normal(0, 0.8, (frames, HEIGHT, WIDTH)), axis=0))


@pytest.mark.parametrize("convention", ["dsec", "m3ed"])
def test_a_recorded_camera_gives_the_frames_of_the_live_one(
    tmp_path: Path, convention: Convention, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_writer, "CHUNK", 64)
    camera, path = EventCamera(HEIGHT, WIDTH, mapping="identity", seed=0), tmp_path / "events.h5"
    live = []
    with EventWriter(path, HEIGHT, WIDTH, convention) as writer:
        for k, frame in enumerate(film()):
            events = camera.step(frame, 0.05 * k)
            events["t"] = np.rint(events["t"] * 1e6) / 1e6  # a camera whose clock ticks in microseconds
            writer.append(events)
            live.append(events)
    with EventFile(path) as recorded:
        assert len(recorded) == sum(map(len, live)) > 10 * 64
        assert_same(recorded.read(), np.concatenate(live))
        for k in range(1, len(live)):
            window = 0.05 * (k - 1), 0.05 * k
            # The window of a live step is closed: its last event may fall on the frame.
            found = recorded.read(window[0], window[1] + 0.5e-6)
            for image in (stack_by_time, voxel_grid, count_frames):
                size = (5, *window, HEIGHT, WIDTH)
                wanted = image(live[k], *size)
                assert wanted.any()
                np.testing.assert_array_equal(image(found, *size), wanted)


def test_chunks_add_up_to_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_writer, "CHUNK", 32)
    events = recording()
    write_events(tmp_path / "whole.h5", events, HEIGHT, WIDTH)
    with EventWriter(tmp_path / "parts.h5", HEIGHT, WIDTH) as writer:
        for k, part in enumerate(np.split(events, [0, 1, 5, 40, 41, 200, 300])):
            writer.append(part)
            if k == 3:
                writer.flush()
                writer.flush()
    assert_same(read_events(tmp_path / "parts.h5"), events)
    with h5py.File(tmp_path / "whole.h5") as whole, h5py.File(tmp_path / "parts.h5") as parts:
        np.testing.assert_array_equal(parts["ms_to_idx"], whole["ms_to_idx"])
        np.testing.assert_array_equal(parts["ms_to_idx"], index_of(ticks_of(events)))


def test_an_exception_keeps_what_was_appended(tmp_path: Path) -> None:
    events, path = recording(), tmp_path / "events.h5"
    with pytest.raises(ZeroDivisionError), EventWriter(path, HEIGHT, WIDTH) as writer:
        writer.append(events)
        raise ZeroDivisionError
    assert_same(read_events(path), events)
    writer.close()
    with pytest.raises(ValueError, match="is closed"):
        writer.append(events)


KILLED = """
import os, signal, sys
import numpy as np
from sb3_have.sensors import EVENT_DTYPE, EventWriter, event_writer
event_writer.CHUNK = 100
writer = EventWriter(sys.argv[1], 4, 4)
for k in range(25):
    events = np.zeros(30, EVENT_DTYPE)
    events["t"], events["p"], events["x"] = 0.001 * k, 1, k % 4
    writer.append(events)
    if k in (3, 12):
        writer.flush()
    if k == 12 and sys.argv[2] == "flush":
        break
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(("how", "kept"), [("append", 700), ("flush", 390)])
def test_a_killed_process_leaves_whole_chunks(tmp_path: Path, how: str, kept: int) -> None:
    path = tmp_path / "events.h5"
    command = [sys.executable, "-c", KILLED, str(path), how]
    assert subprocess.run(command, cwd=Path(__file__).parent.parent, timeout=120).returncode == -signal.SIGKILL
    assert not path.exists()
    left = path.with_name("events.h5.part")
    with EventFile(left) as recorded:
        assert len(recorded) == kept
        found = recorded.read()
        np.testing.assert_array_equal(found["t"], np.arange(kept) // 30 / 1e3)
        np.testing.assert_array_equal(found["x"], np.arange(kept) // 30 % 4)
        assert_same(recorded.read(0.004, 0.006), found[120:180])
    with pytest.raises(FileExistsError, match=r"events\.h5\.part exists; move it away"):
        EventWriter(path, HEIGHT, WIDTH)
    assert len(read_events(left)) == kept


def test_an_empty_recording(tmp_path: Path) -> None:
    path = tmp_path / "events.h5"
    write_events(path, np.zeros(0, EVENT_DTYPE), HEIGHT, WIDTH)
    with EventFile(path) as recorded:
        assert len(recorded) == 0 and recorded.duration == 0.0 and (recorded.height, recorded.width) == (HEIGHT, WIDTH)
        assert_same(recorded.read(), np.zeros(0, EVENT_DTYPE))
        assert_same(recorded.read(0.0, 1.0), np.zeros(0, EVENT_DTYPE))
        assert list(recorded.windows(0.1)) == []


def test_a_recording_is_not_replaced_unless_asked(tmp_path: Path) -> None:
    path = tmp_path / "events.h5"
    write_events(path, recording(), HEIGHT, WIDTH)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        write_events(path, recording(seed=1), HEIGHT, WIDTH)
    assert_same(read_events(path), recording())
    write_events(path, recording(seed=1), HEIGHT, WIDTH, overwrite=True)
    assert_same(read_events(path), recording(seed=1))
    assert list(tmp_path.iterdir()) == [path]


def interrupt(*args: Any, **kwargs: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("fault", ["refused", "list", "interrupted", "laid out"])
def test_a_recording_outlives_a_failed_attempt_to_replace_it(
    tmp_path: Path, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, good = tmp_path / "events.h5", recording()
    write_events(path, good, HEIGHT, WIDTH)
    events: Any = {"refused": good[::-1], "list": good.tolist()}.get(fault, good)
    if fault == "interrupted":
        monkeypatch.setattr(EventWriter, "_write", interrupt)
    elif fault == "laid out":
        monkeypatch.setattr(h5py.Group, "create_dataset", interrupt)
    with pytest.raises((ValueError, KeyboardInterrupt)):
        write_events(path, events, HEIGHT, WIDTH, overwrite=True)
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == [path]
    assert_same(read_events(path), good)


def test_an_exception_overwrites_nothing_and_keeps_what_was_appended(tmp_path: Path) -> None:
    path, old, new = tmp_path / "events.h5", recording(), recording(seed=1)
    write_events(path, old, HEIGHT, WIDTH)
    with pytest.raises(ZeroDivisionError), EventWriter(path, HEIGHT, WIDTH, overwrite=True) as writer:
        writer.append(new)
        raise ZeroDivisionError
    assert_same(read_events(path), old)
    assert_same(read_events(tmp_path / "events.h5.part"), new)
    with EventWriter(path, HEIGHT, WIDTH, overwrite=True) as writer:
        writer.append(new)
        assert_same(read_events(path), old)  # until it is closed
    writer.discard()  # has nothing left to discard
    assert_same(read_events(path), new)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("t", -0.1, "finite and >= 0"),
        ("t", np.nan, "finite and >= 0"),
        ("t", 0.0001, r"sorted by t and come after those before, up to 0\.5"),
        ("t", 5000.0, r"more than the 4294\.967295 s"),
        ("x", WIDTH, "x of the events spans 5..5, outside of a sensor of 6 rows and 5 columns"),
        ("y", HEIGHT, "y of the events spans 6..6"),
        ("p", 0, r"p must be -1 or 1, got \[0\]"),
    ],
)
def test_events_that_do_not_fit_are_refused(tmp_path: Path, field: str, value: float, message: str) -> None:
    good, bad = np.zeros(1, EVENT_DTYPE), np.zeros(1, EVENT_DTYPE)
    good["t"] = bad["t"] = 0.5
    good["p"] = bad["p"] = 1
    bad[field] = value
    path = tmp_path / "events.h5"
    with EventWriter(path, HEIGHT, WIDTH) as writer:
        writer.append(good)
        with pytest.raises(ValueError, match=message):
            writer.append(bad)
        writer.append(good)
    assert len(read_events(path)) == 2
    with pytest.raises(ValueError, match="sorted by t"):
        write_events(tmp_path / "refused.h5", recording()[::-1], HEIGHT, WIDTH)
    assert not (tmp_path / "refused.h5").exists()


def test_arguments_of_the_writer(tmp_path: Path) -> None:
    path = tmp_path / "events.h5"
    with pytest.raises(ValueError, match=r"one of \('dsec', 'm3ed'\), got 'rosbag'"):
        EventWriter(path, 4, 4, "rosbag")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"1\.\.65535, got 0 and 4"):
        EventWriter(path, 0, 4)
    with pytest.raises(ValueError, match=r"0 for 'm3ed', got 2\.0"):
        EventWriter(path, 4, 4, "m3ed", t_offset=2.0)
    with EventWriter(path, 4, 4) as writer, pytest.raises(ValueError, match="fields x, y, t and p"):
        writer.append(np.zeros(3, dtype=[("x", "u2"), ("y", "u2")]))
    untyped: Any = recording().tolist()
    with pytest.raises(ValueError, match=r"got list; use np\.array\(events, EVENT_DTYPE\)"):
        write_events(tmp_path / "list.h5", untyped, HEIGHT, WIDTH)
    assert not list(tmp_path.glob("list*"))
