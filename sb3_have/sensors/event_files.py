"""Recorded event streams in HDF5, read into the arrays that :class:`~sb3_have.sensors.EventCamera` yields.

The conventions are those of two large data sets, wherever in a file the group lies:

- DSEC: ``/events/{x,y,t,p}``, p 0 or 1, ``/ms_to_idx`` (row of the first event at or after each millisecond) and
  ``/t_offset`` (microseconds to add for the clock of the other sensors), compressed with Blosc (Gehrig et al., "DSEC: A
  Stereo Event Camera Dataset for Driving Scenarios", RA-L 2021; https://dsec.ifi.uzh.ch/data-format/).
- M3ED: ``/prophesee/left/{x,y,t,p}``, p 0 or 1, ``ms_map_idx`` and ``calib/resolution`` (width, height) in the
  same group (Chaney et al., "M3ED: Multi-Robot, Multi-Sensor, Multi-Environment Event Dataset", CVPRW 2023;
  https://m3ed.io/data_overview/datafiles/).

Also read: ``{xs,ys,ts,ps}`` and, as in MVSEC, an N x 4 dataset ``events`` with the columns x, y, t, p.

In all of them a ``t`` of integers counts microseconds and one of floats seconds. In memory times are seconds from the
start of the recording, which is

- where the file puts it, if its ``t`` are integers and it has a ``t_offset`` or an index of milliseconds that reaches
  the first event: the times are then those of the file;
- else, as in files that hold Unix time, the first event. Its time stamp is subtracted, and becomes ``t_offset``.

Either way ``t + t_offset`` is the time by the clock of the recording.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sb3_have.sensors.event_camera import EVENT_DTYPE, FloatArray

PathLike = str | os.PathLike[str]

#: Rows in which a time is looked up in memory; above, the file is bisected.
BLOCK: Final = 4_096
COORDINATES: Final = int(np.iinfo(np.uint16).max) + 1


@dataclass(frozen=True)
class _Column:
    """x, y, t or p of a stream: a dataset, or a column of an N x 4 one."""

    dataset: Any
    field: int | None = None

    def __len__(self) -> int:
        return int(self.dataset.shape[0])

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        try:
            return np.asarray(self.dataset[rows] if self.field is None else self.dataset[rows, self.field])
        except OSError as error:
            raise OSError(
                f"cannot read {self.dataset.name} in {self.dataset.file.filename}: {error}; the file is damaged, or "
                "compressed by a filter that hdf5plugin does not have"
            ) from error


class EventFile:
    """
    A recorded event stream, of which only the rows that are asked for are read. Use it as a context manager.

    :param path: HDF5 file in one of the layouts above.
    :param group: Group of the stream (``"prophesee/right"``), or the path of an N x 4 dataset; may be left out where
        the file holds one stream only.
    :param height: Rows of the sensor, where the file does not say (DSEC's own files do not: 480 x 640).
    :param width: Columns of the sensor, likewise.
    :raises ImportError: without h5py and hdf5plugin.
    :raises FileNotFoundError: if there is no such file.
    :raises OSError: on a damaged or truncated file.
    :raises ValueError: on a file that is not HDF5, without a stream or with several, with columns of unequal length,
        times before the start that the file declares, columns that are no numbers, a ``t_offset`` that is no integer,
        or a size other than the one given.
    """

    path: Path
    #: Group of the stream.
    group: str
    #: Rows and columns of the sensor; None where neither the file nor the caller says.
    height: int | None
    width: int | None
    #: Seconds to add to the times for the clock of the recording: the file's ``t_offset``; 0 where it has only an
    #: index; the first time stamp where it has neither.
    t_offset: float

    def __init__(
        self, path: PathLike, group: str | None = None, height: int | None = None, width: int | None = None
    ) -> None:
        self.path = Path(path)
        h5py = load_h5py()
        self._file = _open(h5py, self.path)
        try:
            self.group, self._columns = _select(h5py, self._file, self.path, group)
            self._describe(height, width)
        except BaseException:
            self._file.close()
            raise

    def _describe(self, height: int | None, width: int | None) -> None:
        lengths = {name: len(column) for name, column in self._columns.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(
                f"the columns of {self.group!r} in {self.path} differ in length, {lengths}: the recording is "
                "truncated; cut all of them to the shortest"
            )
        for name, column in self._columns.items():
            if column.dataset.dtype.kind not in ("iufb" if name == "p" else "iuf"):
                raise ValueError(f"{name} of {self.group!r} in {self.path} must be numbers, got {column.dataset.dtype}")
        self._size = lengths["t"]
        node = self._file[self.group]
        # DSEC keeps index and offset beside the group, M3ED the index inside of it.
        places = (node.parent,) if self._columns["t"].field is not None else (node, node.parent)
        self._set_clock(_lookup(places, "t_offset"), _lookup(places, "ms_to_idx", "ms_map_idx"))

        resolution = _lookup(places[:1], "calib/resolution")
        stored = (None, None) if resolution is None else (int(resolution[1]), int(resolution[0]))
        self.height = self._agreed("height", height, node.attrs.get("height", stored[0]))
        self.width = self._agreed("width", width, node.attrs.get("width", stored[1]))

    def _set_clock(self, offset: Any, index: Any) -> None:
        """Find out where the times count from, by the rule of this module."""
        self._counts = self._columns["t"].dataset.dtype.kind in "iu"
        self._zero: float = 0  # in the unit of t
        self.t_offset = 0.0
        first = self._columns["t"][slice(0, 1)].item() if self._size else 0
        self._index = index if self._counts and index is not None and first <= 1000 * len(index) else None
        if not self._counts or (offset is None and self._index is None):
            self._zero, self.t_offset = first, float(first / 1e6 if self._counts else first)
            return
        if first < 0:
            raise ValueError(
                f"t of {self.group!r} in {self.path} starts at {first / 1e6} s, but its t_offset or index counts from "
                "0; shift it to start at 0 or later"
            )
        if offset is not None:
            if offset.dtype.kind not in "iu" or offset.size != 1:
                raise ValueError(
                    f"t_offset in {self.path} must be one integer, of microseconds, got {offset.dtype} of shape "
                    f"{offset.shape}; store round(1e6 * seconds)"
                )
            self.t_offset = int(np.asarray(offset[()]).item()) / 1e6

    def _agreed(self, name: str, given: int | None, stored: Any) -> int | None:
        if stored is None:
            return given
        if given not in (None, int(stored)):
            raise ValueError(f"{name} is {int(stored)} in {self.path}, got {name}={given}")
        return int(stored)

    def __len__(self) -> int:
        """Number of events."""
        return self._size

    def __enter__(self) -> EventFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def duration(self) -> float:
        """Time of the last event in seconds from the start of the recording; 0 without events."""
        return self._time(self._size - 1) if self._size else 0.0

    def read(self, start: float | None = None, end: float | None = None) -> NDArray[np.void]:
        """
        The events with start <= t < end.

        :param start: In seconds from the start of the recording, without :attr:`t_offset`; None is the first event.
        :param end: Likewise; None is after the last event.
        :return: Structured array of :data:`~sb3_have.sensors.EVENT_DTYPE`, sorted by time: t in seconds (whole
            microseconds, divided by 1e6), p +1 or -1.
        :raises ValueError: if start > end, or on rows that are not sorted by time, that lie outside of the sensor, or
            whose polarities are neither 0 and 1 nor -1 and 1. Only the rows that are read are checked: an event out of
            its order elsewhere in the file is not found.
        """
        low, high = -math.inf if start is None else start, math.inf if end is None else end
        if not low <= high:
            raise ValueError(f"need start <= end, got start={start!r} and end={end!r}")
        first = 0 if start is None else self._row(start)
        rows = slice(first, self._size if end is None else max(first, self._row(end)))
        events = np.empty(rows.stop - rows.start, dtype=EVENT_DTYPE)
        if not len(events):
            return events
        times = self._seconds(rows)
        back = np.flatnonzero(~(np.diff(times) >= 0))
        if len(back):
            raise ValueError(
                f"t of {self.group!r} in {self.path} steps back after row {first + back[0]}, from {times[back[0]]} s "
                f"to {times[back[0] + 1]} s; sort the events by time first"
            )
        events["t"] = times
        events["x"] = self._coordinate("x", rows, self.width, "width")
        events["y"] = self._coordinate("y", rows, self.height, "height")
        events["p"] = self._polarity(rows)
        return events

    def windows(self, duration: float, start: float = 0.0) -> Iterator[tuple[float, float, NDArray[np.void]]]:
        """
        The recording in consecutive windows, in the memory of one: every event from ``start`` on is in exactly one.

        A window is half-open. The representations take events at t1 as well, but there are none: an event on an edge is
        in the later window only, and so in one image.

        :param duration: Length of a window in seconds.
        :param start: Start of the first one in seconds. Windows before the first event are left out.
        :return: Iterator over (t0, t1, the events with t0 <= t < t1), up to the window of the last event; a window in
            which nothing happened has no events.
        :raises ValueError: if the duration is not a positive number or ``start`` not a finite one.
        """
        if not 0 < duration < math.inf or not math.isfinite(start):
            raise ValueError(f"need a finite duration > 0 and start, got duration={duration!r} and start={start!r}")
        return self._windows(duration, start)

    def _windows(self, duration: float, start: float) -> Iterator[tuple[float, float, NDArray[np.void]]]:
        if not self._size:
            return
        first, last = self._time(0), self.duration
        k = max(0, math.floor((first - start) / duration))
        while k and start + k * duration > first:  # the quotient was rounded up
            k -= 1
        while start + k * duration <= last:
            # A sum of durations would drift.
            t0, t1 = start + k * duration, start + (k + 1) * duration
            yield t0, t1, self.read(t0, t1)
            k += 1

    def _seconds(self, rows: slice) -> FloatArray:
        raw = self._columns["t"][rows]
        # In integers: the microseconds of Unix time fill a float.
        return np.asarray((raw.astype(np.int64) - self._zero) / 1e6 if self._counts else raw - self._zero, np.float64)

    def _time(self, row: int) -> float:
        return float(self._seconds(slice(row, row + 1))[0])

    def _row(self, time: float) -> int:
        """The first row at or after a time."""
        low, high = self._bracket(time)
        while high - low > BLOCK:
            middle = (low + high) // 2
            if self._time(middle) < time:
                low = middle + 1
            else:
                high = middle
        return low + int(np.searchsorted(self._seconds(slice(low, high)), time))

    def _bracket(self, time: float) -> tuple[int, int]:
        """Rows between which that one lies: by the index of milliseconds, as far as the time stamps bear it out."""
        millisecond = math.floor(time * 1e3) if np.isfinite(time) else -1
        if self._index is None or time <= 0 or not 0 <= millisecond < len(self._index):
            return 0, self._size
        low, *rest = (int(row) for row in self._index[millisecond : millisecond + 2])
        high = rest[0] if rest else self._size
        fits = 0 <= low <= high <= self._size
        fits = fits and (low == 0 or self._time(low - 1) < time) and (high == self._size or self._time(high) >= time)
        return (low, high) if fits else (0, self._size)

    def _coordinate(self, name: str, rows: slice, size: int | None, side: str) -> NDArray[Any]:
        values = self._columns[name][rows]
        low, high = values.min(), values.max()
        if not (low >= 0 and high < (COORDINATES if size is None else size)):
            raise ValueError(
                f"{name} of {self.group!r} in {self.path} spans {low}..{high} in rows {rows.start}..{rows.stop - 1}, "
                f"outside of a {side} of {size}; give the {side} of the sensor that recorded it"
            )
        if values.dtype.kind == "f" and np.any(values % 1):
            raise ValueError(
                f"{name} of {self.group!r} in {self.path} has fractions of a pixel; round rectified coordinates first"
            )
        return values

    def _polarity(self, rows: slice) -> NDArray[np.int8]:
        values = self._columns["p"][rows]
        positive = values > 0
        ones, others = values[positive], values[~positive]
        if np.any(ones != 1) or not (np.all(others == 0) or np.all(others == -1)):
            raise ValueError(
                f"p of {self.group!r} in {self.path} must be 0 and 1 or -1 and 1, got {np.unique(values)[:5].tolist()}"
            )
        return np.where(positive, 1, -1).astype(np.int8)


def read_events(
    path: PathLike, start: float | None = None, end: float | None = None, group: str | None = None
) -> NDArray[np.void]:
    """
    The events of a recording with start <= t < end, in seconds from its start; only they are read.

    ``path`` and ``group`` are those of :class:`EventFile`; ``start``, ``end`` and the return those of
    :meth:`EventFile.read`; the errors those of both. The times leave out :attr:`EventFile.t_offset`. Only a size
    that the file itself states bounds the coordinates; :class:`EventFile` can be told one.
    """
    with EventFile(path, group) as file:
        return file.read(start, end)


def load_h5py() -> Any:
    """The module h5py, with the compression filters of hdf5plugin registered."""
    try:
        import_module("hdf5plugin")
        return import_module("h5py")
    except ImportError as error:
        raise ImportError(f'event files need h5py and hdf5plugin: pip install "sb3_have[events]" ({error})') from error


def _open(h5py: Any, path: Path) -> Any:
    if not path.is_file():
        raise FileNotFoundError(f"no event file {path}")
    if not h5py.is_hdf5(path):
        raise ValueError(f"{path} is not an HDF5 file; convert other formats (.raw, .dat, .aedat, .bag) first")
    try:
        return h5py.File(path, "r")
    except OSError as error:
        reason = "it is damaged or truncated (copy it again), or a writer still has it open"
        raise OSError(f"cannot open {path}: {error}; {reason}") from error


def _select(h5py: Any, file: Any, path: Path, group: str | None) -> tuple[str, dict[str, _Column]]:
    """The stream of that name, or the only one."""
    streams: dict[str, dict[str, _Column]] = {}
    datasets: list[str] = []

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset):
            datasets.append(name)
            if name.split("/")[-1] == "events" and node.ndim == 2 and node.shape[1] == 4:
                streams[name] = {column: _Column(node, k) for k, column in enumerate("xytp")}
            return
        for suffix in ("", "s"):
            columns = {column: node.get(column + suffix) for column in "xytp"}
            if all(isinstance(column, h5py.Dataset) and column.ndim == 1 for column in columns.values()):
                streams[name] = {column: _Column(dataset) for column, dataset in columns.items()}

    visit("/", file)
    file.visititems(visit)
    if group is not None:
        group = group.strip("/") or "/"
        if group in streams:
            return group, streams[group]
    elif len(streams) == 1:
        return next(iter(streams.items()))
    if streams:
        place = "" if group is None else f"none is {group!r}; "
        raise ValueError(f"{path} holds the event streams {sorted(streams)}; {place}name one of them as group")
    raise ValueError(
        f"{path} holds no event stream, that is a group with the datasets x, y, t and p (DSEC: events, M3ED: "
        f"prophesee/left) or an N x 4 dataset events; it holds {datasets[:20] or 'no datasets'}"
    )


def _lookup(places: tuple[Any, ...], *names: str) -> Any:
    """The first dataset of such a name in these groups, or None."""
    return next((place[name] for place in places for name in names if name in place), None)
