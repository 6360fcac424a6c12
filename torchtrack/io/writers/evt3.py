"""EVT 3.0 files, with vectors; see :mod:`torchtrack.io.evt3` for the format.

Neighbours in a row that fire at one time with one polarity, in order of their columns, become vectors of 12; the order
of events is never changed for the sake of a vector.
"""

from pathlib import Path

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.writers.base import steps_of_high
from torchtrack.io.writers.raw import RawWriter

_BITS, _FULL, _LOW_MASK = 12, 1 << 12, 0xFFF
# A vector takes a base and a mask; fewer events are no longer as single ones.
_FEWEST_IN_VECTOR = 3


class Evt3Writer(RawWriter):
    """Writes an EVT 3.0 file; see :class:`torchtrack.io.writers.raw.RawWriter`."""

    name, encoding, clock_bits = "EVT3", "3.0", 2 * _BITS

    def __init__(self, path: Path, width: int, height: int) -> None:
        super().__init__(path, width, height)
        self._high: int | None = None
        self._low: int | None = None
        self._row: int | None = None

    def _encode(self, t_us: np.ndarray, events: Columns) -> np.ndarray:
        leads, sizes = _groups(t_us, events)
        t_us, x, y = t_us[leads], events.x[leads].astype(np.int64), events.y[leads].astype(np.int64)
        is_vector = sizes >= _FEWEST_IN_VECTOR
        polarity = (events.polarity[leads] > 0).astype(np.int64) << 11
        counts, highs = steps_of_high(t_us >> _BITS, self._high, _FULL // 2 - 1)
        low = t_us & _LOW_MASK
        new_low = (counts > 0) | _changed(low, self._low)
        new_row = _changed(y, self._row)
        ends = np.cumsum(counts + new_low + new_row + is_vector + 1)
        words = np.empty(ends[-1], "<u2")
        last = ends - 1
        words[last] = np.where(is_vector, 4 << 12 | _masks(events, leads, sizes), 2 << 12 | polarity | x)
        words[last[is_vector] - 1] = (3 << 12 | polarity | x)[is_vector]
        at_row = last - is_vector - 1
        words[at_row[new_row]] = y[new_row]
        at_low = at_row - new_row
        words[at_low[new_low]] = 6 << 12 | low[new_low]
        first_high = at_low - new_low - counts + 1
        group = np.repeat(np.arange(len(counts)), counts)
        step = np.arange(len(highs)) - np.repeat(np.cumsum(counts) - counts, counts)
        words[first_high[group] + step] = 8 << 12 | highs % _FULL
        self._high, self._low, self._row = int(t_us[-1]) >> _BITS, int(low[-1]), int(y[-1])
        return words


def _changed(values: np.ndarray, last: int | None) -> np.ndarray:
    """Where a value differs from the one before it."""
    return np.concatenate([[last is None or values[0] != last], values[1:] != values[:-1]])


def _groups(t_us: np.ndarray, events: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Events that go into one vector, or are single: the first event of each, and how many they are.

    Runs of one time, row and polarity with growing columns are cut into cells of 12 columns, from the first one on.
    """
    x, y = events.x.astype(np.int64), events.y
    polarity = events.polarity > 0
    goes_on = (np.diff(t_us) == 0) & (y[1:] == y[:-1]) & (polarity[1:] == polarity[:-1]) & (np.diff(x) > 0)
    starts = np.concatenate([[0], np.flatnonzero(~goes_on) + 1])
    run = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(x))))
    cell = (x - x[starts][run]) // _BITS
    leads = np.flatnonzero(np.concatenate([[True], (run[1:] != run[:-1]) | (cell[1:] != cell[:-1])]))
    sizes = np.diff(np.append(leads, len(x)))
    # Too few for a vector: each on its own.
    small = np.repeat(sizes < _FEWEST_IN_VECTOR, sizes)
    is_lead = np.zeros(len(x), bool)
    is_lead[leads] = True
    leads = np.flatnonzero(is_lead | small)
    return leads, np.diff(np.append(leads, len(x)))


def _masks(events: Columns, leads: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Of each group, one bit per event, counted from the column of its first."""
    offset = events.x.astype(np.int64) - np.repeat(events.x[leads].astype(np.int64), sizes)
    return np.bitwise_or.reduceat(1 << offset, leads)
