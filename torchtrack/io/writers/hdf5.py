"""HDF5 files of events in the layout of DSEC: ``events/{x,y,t,p}``, ``t_offset`` and ``ms_to_idx``.

Times are stored from ``t_offset`` on, the whole millisecond at or before the first event. ``ms_to_idx[i]`` is the number of
events before millisecond ``i``; it covers the first three hours. The sensor size is in the attributes ``width`` and
``height`` of the file.
"""

from contextlib import closing
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.writers.base import EventWriter, check_addresses

_CHUNK = 1 << 16
_TYPES = {"t": np.dtype(np.int64), "x": np.dtype(np.uint16), "y": np.dtype(np.uint16), "p": np.dtype(np.uint8)}
_LONGEST_TABLE = 3 * 3_600_000


class _GuardedFile:
    """A file to the HDF5 library, whose own ends the process where it cannot write: here the library goes on, and the error is kept."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb+", buffering=0)
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        size = memoryview(data).nbytes
        written = 0
        try:
            while written < size and self.error is None:
                written += self._file.write(data[written:])
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return self._file.truncate(size)
        except OSError as error:
            self.error = error
            return size or 0

    def read(self, size: int = -1) -> bytes:
        return self._file.read(size)

    def readinto(self, buffer: Any) -> int:
        return self._file.readinto(buffer)

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        """Nothing waits."""

    def close(self) -> None:
        """Close the file, and raise the error, if there was one."""
        self._file.close()
        self.check()

    def check(self) -> None:
        """Raise the error, if there was one."""
        if self.error is not None:
            raise self.error


class Hdf5Writer(EventWriter):
    """Writes an HDF5 file in the layout of DSEC; see :class:`torchtrack.io.writers.base.EventWriter`."""

    def __init__(self, path: Path, width: int, height: int) -> None:
        check_addresses(width, height, 1 << 16, "HDF5")
        super().__init__(path, width, height)
        self._guarded = _GuardedFile(path)
        self.file = h5py.File(self._guarded, "w")
        self.file.attrs["width"], self.file.attrs["height"] = width, height
        group = self.file.create_group("events")
        self._arrays = {name: group.create_dataset(name, (0,), dtype, maxshape=(None,), chunks=(_CHUNK,)) for name, dtype in _TYPES.items()}
        self._offset_us: int | None = None
        self._table: list[np.ndarray] = []
        self._milliseconds = 0

    def _append(self, events: Columns) -> None:
        if self._offset_us is None:
            self._offset_us = int(events.t_us[0]) // 1000 * 1000
        t_us = events.t_us - self._offset_us
        for name, values in (("t", t_us), ("x", events.x), ("y", events.y), ("p", events.polarity > 0)):
            append(self._arrays[name], values)
        self._guarded.check()
        reached = min(int(t_us[-1]) // 1000 + 1, _LONGEST_TABLE)
        if reached > self._milliseconds:
            begins = 1000 * np.arange(self._milliseconds, reached)
            self._table.append(self._count + np.searchsorted(t_us, begins))
            self._milliseconds = reached

    def close(self) -> None:
        """Write offset and table, and close the file."""
        with closing(self._guarded), self.file:
            self.file["t_offset"] = np.int64(self._offset_us or 0)
            self.file["ms_to_idx"] = np.concatenate(self._table).astype(np.uint64) if self._table else np.zeros(0, np.uint64)


def append(array: h5py.Dataset, values: np.ndarray) -> None:
    """Put values behind those that an array has."""
    start = array.shape[0]
    array.resize(start + len(values), axis=0)
    array[start:] = values
