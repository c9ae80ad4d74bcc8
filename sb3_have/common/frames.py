"""A pool of frames, the memory of the replay buffer."""

import os
import tempfile
import warnings
from bisect import bisect_right
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
    Slots that each hold one frame of every observation key.

    Freed slots are reused first, so memory is only written for the largest number of frames in use at once. The first
    slot taken reserves a block for the whole ``capacity``; a pool that needs more gets additional blocks, so frames are
    never moved.

    :param capacity: Number of slots of the first block
    :param shapes: Shape of a frame for each key
    :param dtypes: NumPy dtype of each key
    :param storage: "memory", "mmap" (unnamed temporary files, for more frames than fit into memory) or "device"
    :param device: PyTorch device of the frames with "device"
    :param mmap_dir: Directory for the files of "mmap"; by default the system's, which may itself be in memory
    :raises ValueError: for an unknown storage, or a directory without "mmap"
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
        if mmap_dir is not None and storage != "mmap":
            raise ValueError(f"mmap_dir={os.fspath(mmap_dir)!r} with storage={storage!r}: give it with 'mmap' only.")
        self.capacity, self.shapes, self.dtypes = capacity, dict(shapes), dict(dtypes)
        self.storage, self.mmap_dir = storage, mmap_dir
        self.device = get_device(device) if storage == "device" else th.device("cpu")
        self._blocks: list[dict[str, th.Tensor]] = []
        self._starts: list[int] = []  # first slot of each block
        self._n_reserved = 0
        self._n_written = 0  # slots below have been in use at some time
        self._free: list[int] = []

    def take(self) -> int:
        """
        Return a free slot, which belongs to the caller until it is given back.

        :raises ValueError: if ``mmap_dir`` does not exist
        :raises MemoryError: if there is not enough memory for another block
        :raises OSError: if there is not enough space on the disk
        """
        if self._free:
            return self._free.pop()
        if self._n_written == self._n_reserved:
            missing = self.capacity - self._n_reserved
            self._reserve(missing if missing > 0 else max(self._n_reserved // 4, 16))
        if self._n_written == 0:
            self._n_written = 1
            self.write(EMPTY, {key: np.zeros(shape) for key, shape in self.shapes.items()})
        self._n_written += 1
        return self._n_written - 1

    def give_back(self, slots: Iterable[int]) -> None:
        """Free these slots."""
        self._free.extend(slots)

    def write(self, slot: int, frames: Mapping[str, np.ndarray]) -> None:
        """Store a frame of some keys, from arrays of any memory layout."""
        number = bisect_right(self._starts, slot) - 1
        for key, frame in frames.items():
            array = np.array(frame, self.dtypes[key], order="C")
            self._blocks[number][key][slot - self._starts[number]] = th.from_numpy(array)

    def gather(self, key: str, slots: np.ndarray, pin_memory: bool = False) -> th.Tensor:
        """Return copies of the frames of ``key`` in these slots (n,), as (n, *shape)."""
        out = self._empty(key, len(slots), pin_memory)
        if len(self._blocks) == 1:
            return th.index_select(self._blocks[0][key], 0, self._index(slots), out=out)
        numbers = np.searchsorted(self._starts, slots, side="right") - 1
        offsets = slots - np.array(self._starts)[numbers]
        if self.device.type == "cpu":  # PyTorch's indexed assignment takes six times as long
            frames, rows = [block[key].numpy() for block in self._blocks], out.numpy()
            for row, (number, offset) in enumerate(zip(numbers.tolist(), offsets.tolist(), strict=True)):
                rows[row] = frames[number][offset]
            return out
        for number, block in enumerate(self._blocks):
            chosen = np.flatnonzero(numbers == number)
            out[self._index(chosen)] = block[key].index_select(0, self._index(offsets[chosen]))
        return out

    def _index(self, slots: np.ndarray) -> th.Tensor:
        index = th.from_numpy(slots)
        # Copy from pinned memory, so that the host does not wait for the GPU
        return index.pin_memory().to(self.device, non_blocking=True) if self.device.type == "cuda" else index

    def to(self, device: th.device) -> None:
        """Move the frames to another device if the storage is "device"."""
        if self.storage == "device" and device != self.device:
            self.device = device
            self._blocks = [{key: frames.to(device) for key, frames in block.items()} for block in self._blocks]

    @property
    def n_used(self) -> int:
        """Number of slots in use, including :data:`EMPTY`."""
        return self._n_written - len(self._free)

    @property
    def nbytes(self) -> int:
        """Bytes of the largest number of frames that were in use at once."""
        return self._n_written * self._frame_bytes

    @property
    def _frame_bytes(self) -> int:
        return sum(int(np.prod(shape)) * self.dtypes[key].itemsize for key, shape in self.shapes.items())

    def _reserve(self, n_frames: int) -> None:
        if self.storage == "memory" and psutil is not None:
            needed, available = n_frames * self._frame_bytes, psutil.virtual_memory().available
            # The system only allocates memory as frames are written, so it would run out during training
            if needed > available:
                warnings.warn(
                    f"The replay buffer's frames will take {needed / 1e9:.1f} GB, but only {available / 1e9:.1f} GB of "
                    'memory are available: lower `buffer_size`, or use `replay_buffer_kwargs=dict(storage="mmap")`.',
                    stacklevel=2,
                )
        block = {}
        for key, shape in self.shapes.items():
            try:
                block[key] = self._map(key, n_frames) if self.storage == "mmap" else self._empty(key, n_frames)
            except (MemoryError, RuntimeError) as error:
                raise MemoryError(
                    f"No memory on {self.device} for {n_frames} frames {shape} of {key!r}: lower `buffer_size`, or use "
                    '`replay_buffer_kwargs=dict(storage="mmap")`.'
                ) from error
        self._blocks.append(block)
        self._starts.append(self._n_reserved)
        self._n_reserved += n_frames

    def _empty(self, key: str, n_frames: int, pin_memory: bool = False) -> th.Tensor:
        """Allocate memory for frames; the system provides the host's memory, unless pinned, as it is written."""
        shape = (n_frames, *self.shapes[key])
        if self.device.type == "cpu" and not pin_memory:
            return th.from_numpy(np.empty(shape, self.dtypes[key]))  # NumPy uses huge pages, PyTorch does not
        dtype = th.from_numpy(np.empty(0, self.dtypes[key])).dtype
        return th.empty(shape, dtype=dtype, device=self.device, pin_memory=pin_memory and self.device.type == "cpu")

    def _map(self, key: str, n_frames: int) -> th.Tensor:
        """Allocate an unnamed file for frames, which the system removes with the process."""
        if self.mmap_dir is not None and not os.path.isdir(self.mmap_dir):
            raise ValueError(
                f"mmap_dir={os.fspath(self.mmap_dir)!r}: no such directory; create it, or use another one."
            )
        shape = (n_frames, *self.shapes[key])
        n_bytes = int(np.prod(shape)) * self.dtypes[key].itemsize
        with tempfile.TemporaryFile(dir=self.mmap_dir) as file:
            try:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, n_bytes)  # raises now if the disk is full
                else:
                    file.truncate(n_bytes)
            except OSError as error:
                raise OSError(
                    error.errno,
                    f"{error.strerror}: no space for {n_bytes / 1e9:.1f} GB of frames of {key!r} in "
                    f"{os.fspath(self.mmap_dir or tempfile.gettempdir())!r}; lower `buffer_size`, or use another "
                    "`mmap_dir`",
                ) from error
            return th.from_numpy(np.memmap(file, self.dtypes[key], "r+", shape=shape))

    def __getstate__(self) -> dict[str, Any]:
        """Pickle only the slots that have been written."""
        state = self.__dict__.copy()
        starts = [start for start in self._starts if start < self._n_written]
        state["_blocks"] = [
            {key: frames[: self._n_written - start].cpu().numpy() for key, frames in block.items()}
            for start, block in zip(starts, self._blocks, strict=False)
        ]
        state["_starts"], state["_n_reserved"] = starts, self._n_written
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self.device.type == "cuda" and not th.cuda.is_available():
            self.device = th.device("cpu")
        if self.mmap_dir is not None and not os.path.isdir(self.mmap_dir):
            self.mmap_dir = None  # another machine
        self._blocks = [
            {key: self._stored(key, np.require(frames, requirements="W")) for key, frames in block.items()}
            for block in state["_blocks"]
        ]

    def _stored(self, key: str, frames: np.ndarray) -> th.Tensor:
        """Put loaded frames into the storage, without a copy if that is memory."""
        if self.storage != "mmap":
            return th.from_numpy(frames).to(self.device)
        mapped = self._map(key, len(frames))
        mapped[:] = th.from_numpy(frames)
        return mapped
