"""
Recorded event streams, read into the arrays that :class:`~sb3_have.sensors.EventCamera` returns.

Two public data sets are supported, both in HDF5 with one dataset per column and times in whole microseconds:

- DSEC: ``/events/{x,y,t,p}``, and ``/t_offset``, the microseconds to add to get the clock of the other sensors
  (Gehrig et al., "DSEC: A Stereo Event Camera Dataset for Driving Scenarios", RA-L 2021;
  https://dsec.ifi.uzh.ch/data-format/).
- M3ED: ``/prophesee/left/{x,y,t,p}``, ``/prophesee/right/{x,y,t,p}``, and ``calib/resolution`` in each group
  (Chaney et al., "M3ED: Multi-Robot, Multi-Sensor, Multi-Environment Event Dataset", CVPRW 2023;
  https://m3ed.io/data_overview/datafiles/).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from importlib import import_module
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sb3_have.sensors.event_camera import EVENT_DTYPE, FloatArray

PathLike = str | os.PathLike[str]

DSEC_GROUP: Final = "events"
DSEC_SIZE: Final = (480, 640)
M3ED_GROUPS: Final = ("prophesee/left", "prophesee/right")
# Times are bisected in the file down to this many rows, and then searched in memory.
BLOCK: Final = 4_096


class EventFile:
    """
    A recording of DSEC or M3ED. Only the requested rows are read. Use it as a context manager.

    Times are in seconds and count from where the file's own time stamps do, the start of the recording.

    :param path: HDF5 file.
    :param group: ``"prophesee/left"`` or ``"prophesee/right"``; only needed if the file holds both.
    :param height: Rows of the sensor. By default those that M3ED's files state, or DSEC's 480.
    :param width: Columns of the sensor. By default those that M3ED's files state, or DSEC's 640.
    :raises ImportError: If h5py or hdf5plugin is missing.
    :raises OSError: If the file does not exist, is damaged or is not HDF5.
    :raises ValueError: If the file holds no such stream, or if its columns are truncated or not in microseconds.
    """

    def __init__(
        self, path: PathLike, group: str | None = None, height: int | None = None, width: int | None = None
    ) -> None:
        self.path = os.fspath(path)
        self._file = _import_h5py().File(path, "r")
        try:
            # Name of the group that holds the columns
            self.group = self._find(group)
            self._columns = {name: self._file[self.group][name] for name in "xytp"}
            self._check_columns()
            stated = self._resolution() if height is None or width is None else (height, width)
            self.height = stated[0] if height is None else height
            self.width = stated[1] if width is None else width
            # Seconds to add to the times to get the clock of the other sensors
            self.t_offset = int(self._file["t_offset"][()]) / 1e6 if "t_offset" in self._file else 0.0
        except BaseException:
            self._file.close()
            raise

    def _find(self, group: str | None) -> str:
        groups = {name: self._file.get(name) for name in (DSEC_GROUP, *M3ED_GROUPS)}
        streams = [name for name, node in groups.items() if hasattr(node, "keys") and set("xytp") <= set(node)]
        if not streams:
            raise ValueError(
                f"{self.path} holds no event stream of DSEC (/events) or M3ED (/prophesee/left, /prophesee/right) with "
                "the datasets x, y, t and p. Other layouts do not state the order or the units of their columns: read "
                "them with h5py into an array of EVENT_DTYPE"
            )
        if group is None and len(streams) == 1:
            return streams[0]
        if group is None or group.strip("/") not in streams:
            raise ValueError(f"{self.path} holds the event streams {streams}, got group={group!r}")
        return group.strip("/")

    def _check_columns(self) -> None:
        lengths = {name: len(column) for name, column in self._columns.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"the columns of {self.group!r} in {self.path} differ in length, {lengths}: truncated")
        dtype = self._columns["t"].dtype
        if dtype.kind not in "iu":
            raise ValueError(f"t of {self.group!r} in {self.path} must hold whole microseconds, got {dtype}")

    def _resolution(self) -> tuple[int, int]:
        if self.group == DSEC_GROUP:
            return DSEC_SIZE
        width, height = self._file[self.group]["calib/resolution"][:]
        return int(height), int(width)

    def __len__(self) -> int:
        """Return the number of events."""
        return len(self._columns["t"])

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
        """Time of the last event in seconds; 0 without events."""
        return self._time(len(self) - 1) if len(self) else 0.0

    def read(self, start: float = -math.inf, end: float = math.inf) -> NDArray[np.void]:
        """
        Read the events with start <= t < end.

        :param start: Start in seconds.
        :param end: End in seconds.
        :return: Structured array of :data:`~sb3_have.sensors.EVENT_DTYPE`, sorted by time.
        :raises ValueError: If the rows read are not sorted by time.
        """
        first = self._row(start)
        rows = slice(first, max(first, self._row(end)))
        times = self._seconds(rows)
        back = np.flatnonzero(np.diff(times) < 0)
        if len(back):
            raise ValueError(f"t of {self.group!r} in {self.path} decreases after row {first + back[0]}; sort by time")
        events = np.empty(len(times), dtype=EVENT_DTYPE)
        events["t"] = times
        events["x"], events["y"] = self._columns["x"][rows], self._columns["y"][rows]
        # Both data sets store 1 for brighter and 0 for darker
        events["p"] = np.where(self._columns["p"][rows] > 0, 1, -1)
        return events

    def windows(self, duration: float, start: float = 0.0) -> Iterator[tuple[float, float, NDArray[np.void]]]:
        """
        Iterate over the recording in consecutive windows, with one window in memory at a time.

        Windows are half-open, so every event from ``start`` on is in exactly one of them. Empty windows before the
        first event are skipped, later ones are not.

        :param duration: Length of a window in seconds.
        :param start: Start of the first window in seconds.
        :return: Iterator over (t0, t1, events with t0 <= t < t1), up to the window of the last event.
        :raises ValueError: If ``duration`` is not positive and finite, or ``start`` not finite.
        """
        if not 0 < duration < math.inf or not math.isfinite(start):
            raise ValueError(f"need a finite duration > 0 and start, got duration={duration!r} and start={start!r}")
        if not len(self):
            return
        first, last = self._time(0), self.duration
        k = max(0, math.floor((first - start) / duration))
        # The quotient may have been rounded up
        while k and start + k * duration > first:
            k -= 1
        # Multiply instead of accumulating durations, whose rounding errors would add up
        while start + k * duration <= last:
            t0, t1 = start + k * duration, start + (k + 1) * duration
            yield t0, t1, self.read(t0, t1)
            k += 1

    def _seconds(self, rows: slice) -> FloatArray:
        return np.asarray(self._columns["t"][rows] / 1e6, np.float64)

    def _time(self, row: int) -> float:
        return float(self._seconds(slice(row, row + 1))[0])

    def _row(self, time: float) -> int:
        """First row at or after a time in seconds."""
        low, high = 0, len(self)
        if math.isinf(time):
            return low if time < 0 else high
        while high - low > BLOCK:
            middle = (low + high) // 2
            if self._time(middle) < time:
                low = middle + 1
            else:
                high = middle
        return low + int(np.searchsorted(self._seconds(slice(low, high)), time))


def read_events(
    path: PathLike, start: float = -math.inf, end: float = math.inf, group: str | None = None
) -> NDArray[np.void]:
    """
    Read the events of a recording with start <= t < end.

    :param path: As in :class:`EventFile`.
    :param start: Start in seconds.
    :param end: End in seconds.
    :param group: As in :class:`EventFile`.
    :return: As in :meth:`EventFile.read`.
    """
    with EventFile(path, group) as file:
        return file.read(start, end)


def _import_h5py() -> Any:
    """Import h5py with the compression filters of hdf5plugin registered (DSEC uses Blosc)."""
    try:
        import_module("hdf5plugin")
        return import_module("h5py")
    except ImportError as error:
        raise ImportError(f'event files need h5py and hdf5plugin: pip install "sb3_have[events]" ({error})') from error
