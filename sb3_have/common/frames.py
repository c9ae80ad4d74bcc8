"""A pool of frames: the memory behind the replay buffer."""

import os
import tempfile
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import get_device

try:
    import psutil  # type: ignore[import-untyped, unused-ignore]  # optional, as in SB3's buffers
except ImportError:
    psutil = None

STORAGES = ("memory", "mmap", "device")
EMPTY = 0  # the slot whose frame is all zeros, as the padding of frame stacking


class FramePool:
    """
    Slots that each hold one frame of every observation key, handed out and taken back one by one.

    A freed slot is the first to be used again, so the memory touched is what was in use at once, whatever the
    capacity. The pool grows by a quarter when it is exhausted.

    :param capacity: number of slots to begin with
    :param shapes: shape of a frame, for each key
    :param dtypes: NumPy dtype of each key
    :param storage: "memory", "mmap" (unnamed temporary files, for more frames than fit into memory) or "device"
    :param device: where "device" keeps its frames
    :param mmap_dir: directory for the files of "mmap"; by default the system's, which may itself be in memory
    :raises ValueError: for an unknown storage, or a directory that does not exist
    :raises MemoryError: if the device has no room for the frames
    :raises OSError: if the disk has no room for the files
    """

    def __init__(
        self,
        capacity: int,
        shapes: Mapping[str, tuple[int, ...]],
        dtypes: Mapping[str, np.dtype[Any]],
        storage: str = "memory",
        device: th.device | str = "cpu",
        mmap_dir: str | os.PathLike[str] | None = None,
    ):
        if storage not in STORAGES:
            raise ValueError(f"storage={storage!r}: expected one of {STORAGES}.")
        if mmap_dir is not None and not (storage == "mmap" and os.path.isdir(mmap_dir)):
            raise ValueError(
                f"mmap_dir={os.fspath(mmap_dir)!r}: expected an existing directory, together with storage='mmap'."
            )
        self.shapes, self.dtypes = dict(shapes), dict(dtypes)
        self.storage, self.mmap_dir = storage, mmap_dir
        self.device = get_device(device) if storage == "device" else th.device("cpu")
        self.frames: dict[str, th.Tensor] = {}
        self._files: dict[str, Any] = {}
        self._capacity = 0
        self._n_touched = 0  # slots below have been written
        self._free: list[int] = []
        self._check_memory(capacity)
        self._reserve(max(capacity, 2))
        self.write(self.take(), {key: np.zeros(shape) for key, shape in self.shapes.items()})  # EMPTY

    def take(self) -> int:
        """A free slot, which is the caller's until it is given back."""
        if self._free:
            return self._free.pop()
        if self._n_touched == self._capacity:
            self._reserve(self._capacity + max(self._capacity // 4, 16))
        self._n_touched += 1
        return self._n_touched - 1

    def give_back(self, slots: Iterable[int]) -> None:
        """Frees these slots."""
        self._free.extend(slots)

    def write(self, slot: int, frames: Mapping[str, np.ndarray]) -> None:
        """Stores a frame of some keys."""
        for key, frame in frames.items():
            self.frames[key][slot] = th.from_numpy(np.array(frame, self.dtypes[key], order="C"))  # of any layout

    def gather(self, key: str, slots: np.ndarray, pin_memory: bool = False) -> th.Tensor:
        """Copies of the frames of ``key`` in these slots, (n,) to (n, *shape); in pinned memory where asked for."""
        frames = self.frames[key]
        out = self._empty(key, len(slots))
        if pin_memory and out.device.type == "cpu":
            out = th.empty(out.shape, dtype=out.dtype, pin_memory=True)
        return th.index_select(frames, 0, th.from_numpy(slots).to(frames.device), out=out)

    def to(self, device: th.device) -> None:
        """Moves the frames of "device" storage; the others stay where they are."""
        if self.storage == "device" and device != self.device:
            self.device = device
            self.frames = {key: frames.to(device) for key, frames in self.frames.items()}

    @property
    def n_used(self) -> int:
        """Slots in use, :data:`EMPTY` among them."""
        return self._n_touched - len(self._free)

    @property
    def nbytes(self) -> int:
        """Bytes of as many frames as were ever in use at once: what the pool really takes."""
        return sum(frames[: self._n_touched].nbytes for frames in self.frames.values())

    def _check_memory(self, capacity: int) -> None:
        """Warns like SB3's buffers: memory is only taken when frames come in, so it would run out in mid-training."""
        if self.storage != "memory" or psutil is None:
            return
        needed = capacity * sum(int(np.prod(shape)) * self.dtypes[key].itemsize for key, shape in self.shapes.items())
        available = psutil.virtual_memory().available
        if needed > available:
            warnings.warn(
                f"The replay buffer's frames will take {needed / 1e9:.1f} GB, but only {available / 1e9:.1f} GB of "
                'memory are available: lower `buffer_size`, or use `replay_buffer_kwargs=dict(storage="mmap")`.',
                stacklevel=4,
            )

    def _reserve(self, capacity: int) -> None:
        for key, shape in self.shapes.items():
            if self.storage == "mmap":
                self.frames[key] = self._map(key, (capacity, *shape))
                continue
            try:
                larger = self._empty(key, capacity)
            except (MemoryError, RuntimeError) as error:
                raise MemoryError(
                    f"No memory on {self.device} for {capacity} frames {shape} of {key!r}: lower `buffer_size`, or "
                    'use `replay_buffer_kwargs=dict(storage="mmap")`.'
                ) from error
            if self._n_touched:
                larger[: self._n_touched] = self.frames[key][: self._n_touched]
            self.frames[key] = larger
        self._capacity = capacity

    def _empty(self, key: str, n_frames: int) -> th.Tensor:
        """Room for frames, which takes no memory until they are written; NumPy's comes in huge pages, PyTorch's not."""
        empty = th.from_numpy(np.empty((n_frames, *self.shapes[key]), self.dtypes[key]))
        return empty if self.device.type == "cpu" else th.empty_like(empty, device=self.device)

    def _map(self, key: str, shape: tuple[int, ...]) -> th.Tensor:
        """The key's file at its new size, mapped. It has no name, so the system removes it with the process."""
        if key not in self._files:
            self._files[key] = tempfile.TemporaryFile(dir=self.mmap_dir)  # noqa: SIM115 open as long as it is mapped
        file = self._files[key]
        n_bytes = int(np.prod(shape)) * self.dtypes[key].itemsize
        file.truncate(n_bytes)
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, n_bytes)  # a full disk is an error now and not a crash later
        return th.from_numpy(np.memmap(file, self.dtypes[key], "r+", shape=shape))

    def __del__(self) -> None:
        for file in self.__dict__.get("_files", {}).values():
            file.close()

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        del state["_files"]
        state["frames"] = {key: frames[: self._n_touched].cpu().numpy() for key, frames in self.frames.items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        frames = state.pop("frames")
        self.__dict__.update(state)
        if self.device.type == "cuda" and not th.cuda.is_available():
            self.device = th.device("cpu")
        if self.mmap_dir is not None and not os.path.isdir(self.mmap_dir):
            self.mmap_dir = None  # another machine
        self.frames, self._files = {}, {}
        n_touched, self._n_touched = self._n_touched, 0
        self._reserve(self._capacity)
        self._n_touched = n_touched
        for key, saved in frames.items():
            self.frames[key][:n_touched] = th.from_numpy(saved)
