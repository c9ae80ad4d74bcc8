"""Files and folders that processes share, any of which may die at any moment."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]

_held: set[Path] = set()


@contextlib.contextmanager
def locked(folder: Path, patience: float = 5.0) -> Iterator[None]:
    """Keep other processes out of a folder; the lock goes with the process, however it ends.

    A process that has the lock may take it again. Where files cannot be locked (Windows), nobody is kept out.

    :param folder: to lock, by its file ``.lock``
    :param patience: seconds to wait for another process to end
    :raises BlockingIOError: if it does not
    """
    key = folder.resolve()
    if fcntl is None or key in _held:
        yield
        return
    # a file open for writing, as NFS locks neither folders nor what is open for reading
    handle, start = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o666), time.monotonic()
    try:
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() - start > patience:
                    raise BlockingIOError(f"another process works in {folder}; end it, or wait for it") from None
                time.sleep(0.5)
        _held.add(key)
        try:
            yield
        finally:
            _held.remove(key)
    finally:
        os.close(handle)


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file so that it is whole or, if that fails or the process dies, still as it was.

    :param path: of the file
    :param write: is given the path to write to
    """
    unfinished = path.with_name(f"{path.name}.partial")
    try:
        write(unfinished)
        unfinished.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise
