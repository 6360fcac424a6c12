"""HDF5 files of events in the layout of DSEC: ``events/{x,y,t,p}``, ``t_offset`` and ``ms_to_idx``.

Times are stored from ``t_offset`` on, the whole millisecond at or before the first event. ``ms_to_idx[i]`` is the number of
events before millisecond ``i``; it covers the first three hours. The sensor size is in the attributes ``width`` and
``height`` of the file.
"""

from pathlib import Path

import h5py
import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.writers.base import EventWriter, check_addresses

_CHUNK = 1 << 16
_TYPES = {"t": np.dtype(np.int64), "x": np.dtype(np.uint16), "y": np.dtype(np.uint16), "p": np.dtype(np.uint8)}
_LONGEST_TABLE = 3 * 3_600_000


class Hdf5Writer(EventWriter):
    """Writes an HDF5 file in the layout of DSEC; see :class:`torchtrack.io.writers.base.EventWriter`."""

    def __init__(self, path: Path, width: int, height: int) -> None:
        check_addresses(width, height, 1 << 16, "HDF5")
        super().__init__(path, width, height)
        self.file = h5py.File(path, "w")
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
        reached = min(int(t_us[-1]) // 1000 + 1, _LONGEST_TABLE)
        if reached > self._milliseconds:
            begins = 1000 * np.arange(self._milliseconds, reached)
            self._table.append(self._count + np.searchsorted(t_us, begins))
            self._milliseconds = reached

    def close(self) -> None:
        """Write offset and table, and close the file."""
        self.file["t_offset"] = np.int64(self._offset_us or 0)
        self.file["ms_to_idx"] = np.concatenate(self._table).astype(np.uint64) if self._table else np.zeros(0, np.uint64)
        self.file.close()


def append(array: h5py.Dataset, values: np.ndarray) -> None:
    """Put values behind those that an array has."""
    start = array.shape[0]
    array.resize(start + len(values), axis=0)
    array[start:] = values
