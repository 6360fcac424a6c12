"""CSV files: a line that says the sensor size, one that names the columns, then ``t,x,y,p`` with t in whole µs."""

from pathlib import Path

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.writers.base import EventWriter


class CsvWriter(EventWriter):
    """Writes a CSV file; see :class:`torchtrack.io.writers.base.EventWriter`."""

    def __init__(self, path: Path, width: int, height: int) -> None:
        super().__init__(path, width, height)
        self._stream = path.open("wb")
        self._stream.write(f"# width={width} height={height}\nt,x,y,p\n".encode("ascii"))

    def _append(self, events: Columns) -> None:
        columns = (events.t_us, events.x, events.y, np.asarray(events.polarity > 0, np.int64))
        rows = zip(*(column.tolist() for column in columns), strict=True)
        self._stream.write("".join(f"{t},{x},{y},{p}\n" for t, x, y, p in rows).encode("ascii"))

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
