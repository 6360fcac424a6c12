"""``.npz`` files: arrays t (µs), x, y, p, width and height, written in constant memory.

An array's header says its length, which is known at the end alone; until then the columns lie in files of their own.
"""

import tempfile
import zipfile
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.writers.base import EventWriter, check_addresses

_TYPES: dict[str, np.dtype[Any]] = {"t": np.dtype(np.int64), "x": np.dtype(np.uint16), "y": np.dtype(np.uint16), "p": np.dtype(np.uint8)}
_COPY_BYTES = 1 << 22


class NpzWriter(EventWriter):
    """Writes an ``.npz`` file; see :class:`torchtrack.io.writers.base.EventWriter`.

    Args:
        path: the file.
        width, height: sensor size in pixels, up to 65536.
        arrays: what else to put into the file.
        columns: names and types of further columns, of which :meth:`annotate` takes the values.
    """

    def __init__(
        self, path: Path, width: int, height: int, arrays: Mapping[str, Any] | None = None, columns: Mapping[str, np.dtype[Any]] | None = None
    ) -> None:
        check_addresses(width, height, 1 << 16, "npz")
        super().__init__(path, width, height)
        self._arrays = {"width": np.int64(width), "height": np.int64(height), **(arrays or {})}
        self._types = {**_TYPES, **(columns or {})}
        self._folder = tempfile.TemporaryDirectory(dir=path.parent, prefix=".columns.")
        self._files = {name: (Path(self._folder.name) / name).open("wb+") for name in self._types}

    def _append(self, events: Columns) -> None:
        for name, values in (("t", events.t_us), ("x", events.x), ("y", events.y), ("p", events.polarity > 0)):
            self.annotate(name, values)

    def annotate(self, name: str, values: np.ndarray) -> None:
        """Append the values of a further column, for the events written last."""
        self._files[name].write(np.ascontiguousarray(values, self._types[name]).tobytes())

    def close(self) -> None:
        """Put the columns together, and close the file."""
        with self._folder, ExitStack() as columns, zipfile.ZipFile(self.path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for file in self._files.values():
                columns.callback(file.close)
            for name, file in self._files.items():
                file.seek(0)
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    header = {"descr": np.lib.format.dtype_to_descr(self._types[name]), "fortran_order": False, "shape": (self._count,)}
                    np.lib.format.write_array_header_1_0(member, header)
                    while data := file.read(_COPY_BYTES):
                        member.write(data)
            for name, values in self._arrays.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
