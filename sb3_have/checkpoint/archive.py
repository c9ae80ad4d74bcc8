"""The file format of checkpoints: a zip archive of pickled state and large arrays, written completely or not at all."""

from __future__ import annotations

import errno
import io
import json
import os
import pickle
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FunctionType
from typing import IO, Any

import cloudpickle  # type: ignore[import-untyped, unused-ignore]  # a dependency of SB3
import numpy as np

from sb3_have.checkpoint.files import write_atomically

# Arrays of at least this many bytes become separate entries, written and read without a copy
LARGE = 1 << 20

# The first entries of every archive; large arrays follow.
ENTRIES = ["info.json", "model.zip", "state.pkl"]


class DamagedCheckpointError(ValueError):
    """A file that is truncated, corrupted or not a checkpoint."""


class Pickler(cloudpickle.Pickler):  # type: ignore[misc, unused-ignore]
    """
    Pickler for lambdas too, which replaces objects that exist on both sides by an index.

    :param file: File to write to
    :param existing: Objects to refer to instead of pickling them; the :class:`Unpickler` needs its own, in the same
        order
    :param buffer_callback: See ``pickle.Pickler``
    """

    def __init__(self, file: IO[bytes], existing: Sequence[object] = (), buffer_callback: Any = None):
        super().__init__(file, protocol=5, buffer_callback=buffer_callback)
        self._numbers = {id(obj): number for number, obj in enumerate(existing)}

    def persistent_id(self, obj: Any) -> int | None:
        return self._numbers.get(id(obj))

    def reducer_override(self, obj: Any) -> Any:
        # cloudpickle copies the classes of the running script, and isinstance fails for the copies when the script
        # runs again: pickle them by name
        if isinstance(obj, type | FunctionType):
            name: str = obj.__qualname__
            if getattr(sys.modules["__main__"], name, None) is obj:
                return name
        return super().reducer_override(obj)


class Unpickler(pickle.Unpickler):
    """
    Reads what :class:`Pickler` wrote.

    :param file: File to read from
    :param existing: Objects in place of those that the pickler referred to
    :param buffers: See ``pickle.Unpickler``
    """

    def __init__(self, file: IO[bytes], existing: Sequence[object] = (), buffers: Any = None):
        super().__init__(file, buffers=buffers)
        self._existing = existing

    def persistent_load(self, number: Any) -> Any:
        return self._existing[number]


def dumps(obj: Any, existing: Sequence[object] = ()) -> bytes:
    """Pickle an object, see :class:`Pickler`."""
    file = io.BytesIO()
    Pickler(file, existing).dump(obj)
    return file.getvalue()


def loads(data: bytes, existing: Sequence[object] = ()) -> Any:
    """Unpickle the object of :func:`dumps`."""
    return Unpickler(io.BytesIO(data), existing).load()


def write_archive(path: Path, info: Mapping[str, Any], model: memoryview, state: Any) -> None:
    """
    Write an archive, without copying large arrays.

    :param path: Path of the file; missing folders are created
    :param info: A few values for JSON
    :param model: Content of the model's own zip
    :param state: Anything that can be pickled
    :raises OSError: If the file cannot be written, for instance on a full disk; the previous file is kept then
    """

    def write(unfinished: Path) -> None:
        with open(unfinished, "wb") as file:
            _write(file, info, model, state)
            file.flush()
            os.fsync(file.fileno())

    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, write)
    _sync_folder(path.parent)


def _write(file: IO[bytes], info: Mapping[str, Any], model: memoryview, state: Any) -> None:
    arrays: list[pickle.PickleBuffer] = []

    def stays_in_pickle(array: pickle.PickleBuffer) -> bool:
        if array.raw().nbytes < LARGE:
            return True
        arrays.append(array)
        return False

    # Do not compress: images of sensors gain little
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("info.json", json.dumps(info, indent=1))
        with archive.open("model.zip", "w", force_zip64=True) as entry:
            entry.write(model)
        with archive.open("state.pkl", "w", force_zip64=True) as entry:
            Pickler(entry, buffer_callback=stays_in_pickle).dump(state)
        for number, array in enumerate(arrays):
            with archive.open(f"array-{number}", "w", force_zip64=True) as entry:
                entry.write(array.raw())


def _sync_folder(folder: Path) -> None:
    """Fsync the folder so that the rename survives a power failure, where the file system supports it."""
    if hasattr(os, "O_DIRECTORY"):  # not on Windows
        with suppress(OSError):
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)


def read_archive(path: Path) -> tuple[dict[str, Any], io.BytesIO, Any]:
    """
    Read info, model and state from the file of :func:`write_archive`.

    The state is unpickled, which can execute any code: read only files that you wrote yourself.

    :raises DamagedCheckpointError: If the file is truncated or a checksum is wrong; nothing is unpickled then
    """
    with _opened(path) as archive:
        info = json.loads(archive.read("info.json"))
        model, pickled = io.BytesIO(archive.read("model.zip")), archive.read("state.pkl")
        arrays = [_read_array(archive, name) for name in archive.namelist()[len(ENTRIES) :]]
    # An error from here on is not damage, but for instance a class that no longer exists
    return info, model, Unpickler(io.BytesIO(pickled), buffers=arrays).load()


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Read an entry into an array; ``zipfile`` compares the checksum at the end."""
    array = np.empty(archive.getinfo(name).file_size, np.uint8)
    start = 0
    with archive.open(name) as entry:
        while part := entry.read(LARGE):
            array[start : start + len(part)] = np.frombuffer(part, np.uint8)
            start += len(part)
    return array


def read_info(path: Path) -> dict[str, Any]:
    """
    Read only the info of an archive.

    :raises DamagedCheckpointError: If it cannot be read
    """
    with _opened(path) as archive:
        return dict(json.loads(archive.read("info.json")))


def damage(path: Path) -> DamagedCheckpointError | None:
    """Compare all checksums, and return what is wrong with a checkpoint or None."""
    try:
        with _opened(path) as archive:
            if broken := archive.testzip():
                raise zipfile.BadZipFile(f"Bad CRC-32 for file {broken!r}")
    except DamagedCheckpointError as error:
        return error
    return None


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            # Names and sizes have no checksum; a truncated file may also end with the zip of the model
            entries = archive.infolist()
            names = ENTRIES + [f"array-{number}" for number in range(len(entries) - len(ENTRIES))]
            stored = all(entry.compress_size == entry.file_size and entry.compress_type == 0 for entry in entries)
            if [entry.filename for entry in entries] != names or not stored:
                raise zipfile.BadZipFile("its entries are not those of a checkpoint")
            yield archive
    except MemoryError:
        raise
    except OSError as error:
        # Other errors, such as too many open files, do not mean that the file is damaged
        if error.errno not in (None, errno.EINVAL, errno.EIO):
            raise
        raise DamagedCheckpointError(f"{path} is damaged ({error}); use another one") from error
    except Exception as error:  # zipfile raises many kinds for corrupted bytes
        raise DamagedCheckpointError(f"{path} is damaged or not a checkpoint ({error}); use another one") from error
