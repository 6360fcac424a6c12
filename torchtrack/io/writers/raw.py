"""The parts that writers of Prophesee RAW files share: header, and times that do not fit the clock of the format.

A RAW clock starts near zero. Where a stream starts later than the clock's range (or before zero), the header says from
where its times count: ``% time_base_us N``. Readers that do not know this keyword give times that are ``N`` µs less.
"""

from abc import abstractmethod
from pathlib import Path

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.writers.base import EventWriter, check_addresses


class RawWriter(EventWriter):
    """Writes a RAW file.

    Args:
        path: the file.
        width, height: sensor size in pixels, up to 2048.
    """

    name: str
    encoding: str
    clock_bits: int

    def __init__(self, path: Path, width: int, height: int) -> None:
        check_addresses(width, height, 2048, self.name)
        super().__init__(path, width, height)
        self._stream = path.open("wb")
        self._base_us: int | None = None

    def _append(self, events: Columns) -> None:
        if self._base_us is None:
            self._begin(int(events.t_us[0]))
        self._stream.write(self._encode(events.t_us - (self._base_us or 0), events).tobytes())

    def close(self) -> None:
        """Write what is left, and close the file."""
        if self._base_us is None:
            self._begin(0)
        self._stream.close()

    def _begin(self, first_us: int) -> None:
        self._base_us = first_us >> self.clock_bits << self.clock_bits
        base = [f"% time_base_us {self._base_us}"] if self._base_us else []
        # Both forms of the header, so that old and new readers find theirs.
        lines = [
            f"% evt {self.encoding}",
            f"% format {self.name.replace('.', '')};height={self.height};width={self.width}",
            f"% geometry {self.width}x{self.height}",
            *base,
            "% end",
        ]
        self._stream.write(("\n".join(lines) + "\n").encode("ascii"))

    @abstractmethod
    def _encode(self, t_us: np.ndarray, events: Columns) -> np.ndarray:
        """Words of events at ``t_us`` by the clock of the file."""
