"""The file of a checkpoint: pickled state and large arrays in a zip archive that appears whole or not at all."""

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

import cloudpickle  # type: ignore[import-untyped, unused-ignore]  # of SB3's requirements
import numpy as np

LARGE = 1 << 20
"""Bytes from which on an array is an entry of its own, which is written from its memory and read into it."""

ENTRIES = ("info.json", "model.zip", "state.pkl")
"""What every archive begins with; large arrays follow."""

DAMAGES = (zipfile.BadZipFile, KeyError, EOFError, NotImplementedError, RuntimeError, ValueError)
"""What ``zipfile`` raises where bytes are missing or others, besides OSError EINVAL and EIO."""


class DamagedCheckpointError(ValueError):
    """A checkpoint that cannot be read: cut off, changed, or no checkpoint at all."""


class Pickler(cloudpickle.Pickler):  # type: ignore[misc, unused-ignore]
    """Pickles functions too, and stands numbers for objects that exist on the other side already.

    :param file: to write to
    :param existing: objects that are not pickled, wherever they occur: :class:`Unpickler` puts its own in their place
    :param buffer_callback: as of ``pickle.Pickler``
    """

    def __init__(self, file: IO[bytes], existing: Sequence[object] = (), buffer_callback: Any = None):
        super().__init__(file, protocol=5, buffer_callback=buffer_callback)
        self._numbers = {id(obj): number for number, obj in enumerate(existing)}

    def persistent_id(self, obj: Any) -> int | None:
        return self._numbers.get(id(obj))

    def reducer_override(self, obj: Any) -> Any:
        # cloudpickle would copy what the running script defines; when that runs again, it has these classes itself
        if isinstance(obj, type | FunctionType):
            name: str = obj.__qualname__
            if getattr(sys.modules["__main__"], name, None) is obj:
                return name
        return super().reducer_override(obj)


class Unpickler(pickle.Unpickler):
    """
    :param file: that a :class:`Pickler` wrote
    :param existing: as many objects as it had, in the same order
    :param buffers: as of ``pickle.Unpickler``
    """

    def __init__(self, file: IO[bytes], existing: Sequence[object] = (), buffers: Any = None):
        super().__init__(file, buffers=buffers)
        self._existing = existing

    def persistent_load(self, number: Any) -> Any:
        return self._existing[number]


def dumps(obj: Any, existing: Sequence[object] = ()) -> bytes:
    """An object as bytes, see :class:`Pickler`."""
    file = io.BytesIO()
    Pickler(file, existing).dump(obj)
    return file.getvalue()


def loads(data: bytes, existing: Sequence[object] = ()) -> Any:
    """The object of :func:`dumps`."""
    return Unpickler(io.BytesIO(data), existing).load()


def write_archive(path: Path, info: Mapping[str, Any], model: memoryview, state: Any) -> None:
    """Write an archive, or leave what is there as it is.

    Large arrays are written from where they lie, so that this takes hardly any memory.

    :param path: of the file; its folder is made where it is missing
    :param info: small, in JSON
    :param model: the model's own file
    :param state: to pickle
    :raises OSError: if it cannot be written, as on a full disk; nothing is left of it then
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.partial")
    try:
        with open(unfinished, "wb") as file:
            with zipfile.ZipFile(file, "w") as archive:  # stored, not compressed: images of sensors gain little
                archive.writestr("info.json", json.dumps(info, indent=1))
                with archive.open("model.zip", "w", force_zip64=True) as entry:
                    entry.write(model)
                arrays: list[pickle.PickleBuffer] = []
                with archive.open("state.pkl", "w", force_zip64=True) as entry:
                    Pickler(entry, buffer_callback=lambda array: _set_aside(array, arrays)).dump(state)
                for number, array in enumerate(arrays):
                    with archive.open(f"array-{number}", "w", force_zip64=True) as entry:
                        entry.write(array.raw())
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink()
        raise
    _sync_folder(path.parent)


def _set_aside(array: pickle.PickleBuffer, arrays: list[pickle.PickleBuffer]) -> bool:
    """Whether an array stays in the pickle."""
    if array.raw().nbytes < LARGE:
        return True
    arrays.append(array)
    return False


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
    """What :func:`write_archive` wrote: the info, the model's file and the state.

    The state is unpickled, which can run any code: read nothing but what you wrote.

    :raises DamagedCheckpointError: if a checksum is wrong, or the file is cut off; nothing has been unpickled then
    """
    with _opened(path) as archive:
        info = json.loads(archive.read("info.json"))
        model, pickled = io.BytesIO(archive.read("model.zip")), archive.read("state.pkl")
        arrays = [_read_array(archive, name) for name in archive.namelist()[len(ENTRIES) :]]
    # outside, where an error is no damage but a class that is missing or another
    return info, model, Unpickler(io.BytesIO(pickled), buffers=arrays).load()


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """An entry in memory of its own; the checksum is compared at its end."""
    array = np.empty(archive.getinfo(name).file_size, np.uint8)
    start = 0
    with archive.open(name) as entry:
        while part := entry.read(LARGE):
            array[start : start + len(part)] = np.frombuffer(part, np.uint8)
            start += len(part)
    return array


def read_info(path: Path) -> dict[str, Any]:
    """The info of an archive alone.

    :raises DamagedCheckpointError: if it cannot be read
    """
    with _opened(path) as archive:
        return dict(json.loads(archive.read("info.json")))


def check_archive(path: Path) -> None:
    """Compare all checksums.

    :raises DamagedCheckpointError: if one is wrong, or the file is cut off
    """
    with _opened(path) as archive:
        broken = archive.testzip()
        if broken is not None:
            raise zipfile.BadZipFile(f"Bad CRC-32 for file {broken!r}")


def _check_directory(archive: zipfile.ZipFile) -> None:
    """Names and lengths, which have no checksum; and cut off, a file may end with the model, an archive too."""
    entries = archive.infolist()
    names = [*ENTRIES, *(f"array-{number}" for number in range(len(entries) - len(ENTRIES)))]
    stored = all(
        entry.compress_type == zipfile.ZIP_STORED and entry.compress_size == entry.file_size for entry in entries
    )
    if not stored or [entry.filename for entry in entries] != names:
        raise zipfile.BadZipFile("its entries are not those of a checkpoint")


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            _check_directory(archive)
            yield archive
    except (*DAMAGES, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (errno.EINVAL, errno.EIO, None):
            raise  # there is no such file, or it may not be read
        raise DamagedCheckpointError(
            f"{path} is damaged or no checkpoint at all ({error}); go on from another one"
        ) from error
