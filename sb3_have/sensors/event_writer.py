"""Event streams written to HDF5 as DSEC and M3ED have them, while they are recorded or in one go."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sb3_have.sensors.event_camera import EVENT_DTYPE
from sb3_have.sensors.event_files import COORDINATES, PathLike, load_h5py

Convention = Literal["dsec", "m3ed"]

#: Rows per chunk of a file, and so the events that a killed process loses at most.
CHUNK: Final = 32_768


@dataclass(frozen=True)
class _Layout:
    """Where a convention keeps its events: the group, its index of milliseconds, types, and the last microsecond."""

    group: str
    index: str
    time: str
    polarity: str
    last: int


_LAYOUTS: Final[dict[str, _Layout]] = {
    "dsec": _Layout("events", "ms_to_idx", "u4", "u1", 2**32 - 1),
    # Its i8 has no end; a day of milliseconds bounds the index.
    "m3ed": _Layout("prophesee/left", "prophesee/left/ms_map_idx", "i8", "i1", 86_400 * 10**6),
}


class EventWriter:
    """
    Writes a stream while it is recorded: chunks of events go in, whole chunks of :data:`CHUNK` rows go to disk.

    The file grows beside its place, as ``<path>.part``, and is moved there by :meth:`close`. It is complete and flushed
    after every chunk, so that a killed process leaves a ``.part`` that can be read, with all but the last :data:`CHUNK`
    events; :meth:`flush` spares these too.

    Use it as a context manager: leaving it closes the file, also by an exception; but then a file that was to be
    overwritten stays, and the new one beside it.

    Time stamps are rounded to the nearest microsecond, which keeps their order.

    :param path: File to write.
    :param height: Rows of the sensor.
    :param width: Columns of the sensor.
    :param convention: ``"dsec"`` (u4 microseconds: at most 4294.967295 s) or ``"m3ed"`` (i8, here at most a day).
    :param t_offset: ``"dsec"`` only: seconds to add to the times for the clock of the recording, kept as whole
        microseconds. The times themselves count from the start of the recording.
    :param overwrite: Replace a file that is there.
    :raises ImportError: without h5py and hdf5plugin.
    :raises FileExistsError: if there is a file, or a ``.part`` of an earlier writer, and ``overwrite`` is false.
    :raises ValueError: on an unknown convention, a size outside of 1..65535, or an offset that M3ED has no place for.
    """

    def __init__(
        self,
        path: PathLike,
        height: int,
        width: int,
        convention: Convention = "dsec",
        t_offset: float = 0.0,
        overwrite: bool = False,
    ) -> None:
        if convention not in _LAYOUTS:
            raise ValueError(f"convention must be one of {get_args(Convention)}, got {convention!r}")
        if not (1 <= height < COORDINATES and 1 <= width < COORDINATES):
            raise ValueError(f"height and width must lie in 1..65535, got {height} and {width}")
        if not math.isfinite(t_offset) or (t_offset and convention == "m3ed"):
            raise ValueError(f"t_offset must be a finite number, and 0 for 'm3ed', got {t_offset!r} for {convention!r}")
        h5py = load_h5py()
        self.path = Path(path)
        self._part = self.path.with_name(self.path.name + ".part")
        for file in (self.path, self._part):
            if file.exists() and not overwrite:
                raise FileExistsError(f"{file} exists; move it away, or pass overwrite=True to replace it")
        self.height, self.width = height, width
        self._layout = _LAYOUTS[convention]
        self._pending: list[NDArray[np.void]] = []
        self._last = 0
        self._file = h5py.File(self._part, "w")
        try:
            self._lay_out(convention, t_offset)
        except BaseException:
            self.discard()
            raise

    def _lay_out(self, convention: Convention, t_offset: float) -> None:
        layout = self._layout
        group = self._file.create_group(layout.group)
        group.attrs["height"], group.attrs["width"] = self.height, self.width
        compression: dict[str, Any] = {"compression": "lzf"}
        if convention == "dsec":
            compression = dict(import_module("hdf5plugin").Blosc(cname="zstd"))
            self._file.create_dataset("t_offset", data=np.int64(round(t_offset * 1e6)))
        else:
            group.create_dataset("calib/resolution", data=np.array((self.width, self.height), dtype=np.int64))
        types = {"x": "u2", "y": "u2", "t": layout.time, "p": layout.polarity}
        self._columns = {
            name: group.create_dataset(name, (0,), dtype, maxshape=(None,), chunks=(CHUNK,), **compression)
            for name, dtype in types.items()
        }
        self._index = self._file.create_dataset(layout.index, (0,), "u8", maxshape=(None,), chunks=(CHUNK,))
        self._file.flush()

    def __enter__(self) -> EventWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and self.path.exists():
            self._finish()
        else:
            self.close()

    def append(self, events: NDArray[np.void]) -> None:
        """
        Append events. Those that are refused leave the file as it was.

        :param events: Array of :data:`~sb3_have.sensors.EVENT_DTYPE`, sorted by time, none before the last one written.
        :raises ValueError: after :meth:`close`, or on times that are negative, not finite, out of order or too late for
            the convention, coordinates outside of the sensor, or polarities other than -1 and 1.
        """
        if not self._file:
            raise ValueError(f"the writer of {self.path} is closed")
        dtype = getattr(events, "dtype", None)
        if set(EVENT_DTYPE.names or ()) - set(getattr(dtype, "names", None) or ()):
            got = type(events).__name__ if dtype is None else f"dtype {dtype}"
            raise ValueError(f"events need the fields x, y, t and p, got {got}; use np.array(events, EVENT_DTYPE)")
        if not len(events):
            return
        ticks = self._ticks(events["t"])
        for name, size in (("x", self.width), ("y", self.height)):
            if events[name].min() < 0 or events[name].max() >= size:
                raise ValueError(
                    f"{name} of the events spans {events[name].min()}..{events[name].max()}, outside of a sensor of "
                    f"{self.height} rows and {self.width} columns"
                )
        if not np.all(np.abs(events["p"].astype(np.int64)) == 1):
            raise ValueError(f"p must be -1 or 1, got {np.unique(events['p'])[:5].tolist()}")
        rows = np.empty(len(events), dtype=[("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "i1")])
        rows["x"], rows["y"], rows["t"], rows["p"] = events["x"], events["y"], ticks, events["p"] > 0
        self._pending.append(rows)
        self._last = int(ticks[-1])
        if sum(map(len, self._pending)) >= CHUNK:
            rows = np.concatenate(self._pending)
            # Up to the end of a chunk: one that is extended later is compressed and stored anew.
            stored = len(self._columns["t"])
            whole = (stored + len(rows)) // CHUNK * CHUNK - stored
            self._pending = [rows[whole:]]
            self._write(rows[:whole])

    def _ticks(self, times: NDArray[Any]) -> NDArray[np.int64]:
        if not np.isfinite(times).all() or times.min() < 0:
            raise ValueError(
                f"t must be finite and >= 0, got {times.min()}..{times.max()} s; count from the start of the recording"
            )
        ticks = np.rint(times.astype(np.float64) * 1e6)
        if ticks.max() > self._layout.last:
            raise ValueError(
                f"t reaches {times.max()} s, more than the {self._layout.last / 1e6} s that the convention of "
                f"{self.path} holds; count from the start of the recording"
            )
        if ticks[0] < self._last or np.any(np.diff(ticks) < 0):
            raise ValueError(f"events must be sorted by t and come after those before, up to {self._last / 1e6} s")
        return ticks.astype(np.int64)

    def _write(self, rows: NDArray[np.void]) -> None:
        start = len(self._columns["t"])
        for name, column in self._columns.items():
            column.resize((start + len(rows),))
            column[start:] = rows[name]
        # An entry is known as soon as an event at or after its millisecond is.
        known = len(self._index)
        milliseconds = np.arange(known, int(rows["t"][-1]) // 1000 + 1)
        self._index.resize((known + len(milliseconds),))
        self._index[known:] = start + np.searchsorted(rows["t"], milliseconds * 1000)
        self._file.flush()

    def flush(self) -> None:
        """Write out what :meth:`append` still holds back, at the price of a chunk that is stored twice."""
        pending, self._pending = self._pending, []
        if sum(map(len, pending)):
            self._write(np.concatenate(pending))

    def close(self) -> None:
        """Write the rest, close the file and move it to its place. Closing twice is fine."""
        if self._finish():
            os.replace(self._part, self.path)

    def discard(self) -> None:
        """Close the file and remove it. One that was to be overwritten stays; so does one that is in its place."""
        if self._file:
            self._file.close()
            self._part.unlink(missing_ok=True)

    def _finish(self) -> bool:
        """Write the rest and close the file, if it is open."""
        if not self._file:
            return False
        try:
            self.flush()
        finally:
            self._file.close()
        return True


def write_events(
    path: PathLike,
    events: NDArray[np.void],
    height: int,
    width: int,
    convention: Convention = "dsec",
    t_offset: float = 0.0,
    overwrite: bool = False,
) -> None:
    """
    Write a recording in one go. Parameters and errors as :class:`EventWriter` and :meth:`EventWriter.append`.

    Events that are refused leave no file, and one that was to be overwritten as it was.
    """
    writer = EventWriter(path, height, width, convention, t_offset, overwrite)
    try:
        writer.append(events)
        writer.flush()
    except BaseException:
        writer.discard()
        raise
    writer.close()
