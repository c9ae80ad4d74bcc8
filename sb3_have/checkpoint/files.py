"""Locked folders and atomic writes, for files that several processes share."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from filelock import AcquireReturnProxy, FileLock, Timeout


def locked(folder: Path, patience: float = 5.0) -> AcquireReturnProxy[FileLock]:
    """
    Lock a folder against other processes, for a ``with`` block or until ``.lock.release()``.

    The lock ends with the process, however it ends. A process may lock a folder that it has locked already.

    :param folder: Folder to lock, by the file ``.lock`` in it
    :param patience: Seconds to wait for another process to release it
    :raises BlockingIOError: If another process still holds it then
    """
    try:
        return FileLock(folder.resolve() / ".lock", is_singleton=True, thread_local=False).acquire(patience)
    except Timeout:
        raise BlockingIOError(f"another process is using {folder}; end it, or wait for it") from None


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """
    Write a file completely, or leave the previous one as it was if that fails or the process dies.

    :param path: Path of the file
    :param write: Function that writes to the path it is given
    """
    unfinished = path.with_name(f"{path.name}.partial")
    try:
        write(unfinished)
        unfinished.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise
