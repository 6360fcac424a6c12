"""EVT 2.0 files; see :mod:`torchtrack.io.evt2` for the format."""

from pathlib import Path

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.evt2 import TIME_HIGH_BITS, TIME_LOW_BITS
from torchtrack.io.writers.base import steps_of_high
from torchtrack.io.writers.raw import RawWriter

_FULL = 1 << TIME_HIGH_BITS


class Evt2Writer(RawWriter):
    """Writes an EVT 2.0 file; see :class:`torchtrack.io.writers.raw.RawWriter`."""

    name, encoding, clock_bits = "EVT2", "2.0", TIME_HIGH_BITS + TIME_LOW_BITS

    def __init__(self, path: Path, width: int, height: int) -> None:
        super().__init__(path, width, height)
        self._high: int | None = None

    def _encode(self, t_us: np.ndarray, events: Columns) -> np.ndarray:
        counts, highs = steps_of_high(t_us >> TIME_LOW_BITS, self._high, _FULL // 2 - 1)
        words = np.empty(len(events) + len(highs), "<u4")
        is_event = np.zeros(len(words), bool)
        is_event[np.cumsum(counts + 1) - 1] = True
        words[~is_event] = 8 << 28 | highs % _FULL
        low = t_us & (1 << TIME_LOW_BITS) - 1
        words[is_event] = (events.polarity > 0).astype(np.int64) << 28 | low << 22 | events.x.astype(np.int64) << 11 | events.y
        self._high = int(t_us[-1]) >> TIME_LOW_BITS
        return words
