"""EVT 3.0: words of 16 bits that change a state (time, row, base column) or bring events: one, or a vector of 8 or 12.

The four highest bits are the kind:

== ================ ==========================================================================
0  row              ``camera:1 y:11``
2  event            ``polarity:1 x:11``
3  vector base      ``polarity:1 x:11``: where the next vector starts
4  vector of 12     bit ``i`` is an event at ``base + i``; the base then moves on by 12
5  vector of 8      the same with 8 bits
6  time low         bits 0 to 11 of the time (µs)
8  time high        bits 12 to 23; the clock wraps every 16.8 s
== ================ ==========================================================================

and 7, 10, 14, 15: continued, trigger, other, continued. As in Prophesee's own decoder, the low bits are 0 from a new time
high to the next time low, and a fall of the time high by half of its range or more is a wrap. Events before the first time
high and row, and vectors before the first base, are left out: nobody knows where or when they were.

Reference: docs.prophesee.ai, EVT 3.0 format.
"""

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.evt2 import count_unknown
from torchtrack.io.held_back import MOST_HELD_WORDS
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.time_high import HighClock, spread

_ROW, _EVENT, _BASE, _VECTOR_12, _VECTOR_8, _LOW, _HIGH = 0, 2, 3, 4, 5, 6, 8
_KNOWN = np.isin(np.arange(16), (0, 2, 3, 4, 5, 6, 7, 8, 10, 14, 15))
_BITS = 12
# A column and its polarity are packed in 32 bits. Vectors without a new base move the column on and on, by less than
# 2^21 a block; beyond _FAR_RIGHT it makes no difference how far, and from _UNKNOWN on there was no base at all.
_TO_BRIGHTER = 15
_BRIGHTER, _UNKNOWN, _FAR_RIGHT = 1 << 26, 1 << 24, 1 << 16
# Number of events that each of the 65536 words brings.
_EVENTS_OF = np.zeros(1 << 16, np.uint8)
_EVENTS_OF[_EVENT << 12 : (_EVENT + 1) << 12] = 1
_SET_BITS = np.unpackbits(np.arange(1 << 12, dtype="<u2").view(np.uint8).reshape(-1, 2), axis=1).sum(1)
_EVENTS_OF[_VECTOR_12 << 12 : (_VECTOR_12 + 1) << 12] = _SET_BITS
_EVENTS_OF[_VECTOR_8 << 12 : (_VECTOR_8 + 1) << 12] = np.tile(_SET_BITS[:256], 16)


class Evt3Decoder:
    """Decoder of EVT 3.0 words; faults are counted in ``problems``."""

    dtype = np.dtype("<u2")

    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        self._clock = HighClock(_BITS, 1 << _BITS, problems)
        self._rest = np.zeros(0, self.dtype)
        # -1 stands for not known yet.
        self._low, self._row = 0, -1
        # Column where the next vector starts, packed with its polarity.
        self._base = _UNKNOWN

    def feed(self, words: np.ndarray) -> Columns:
        """The events of the next words, without those whose time or address is not known yet; those after a leap come later, as in EVT 2.0."""
        return self._decoded(np.concatenate([self._rest, words]) if len(self._rest) else words)

    def finish(self) -> Columns:
        """The events of words that are held back, when no more come."""
        return self._decoded(self._rest, is_last=True)

    def _decoded(self, words: np.ndarray, *, is_last: bool = False) -> Columns:
        self._rest = words[:0]
        if len(words) == 0:
            return Columns.empty()
        kinds = words >> _BITS
        if not is_last and (until := self._doubtful(words, kinds)) is not None:
            sure = self._decoded(words[:until], is_last=True)
            self._rest = words[until:].copy()
            return sure
        _report_unknown(kinds, self._problems)
        ends = np.cumsum(_EVENTS_OF[words], dtype=np.int32)
        rows, row_at = self._rows(words, kinds)
        times, time_at = self._times(words, kinds)
        x, polarity = self._columns(words, kinds, ends)
        total = int(ends[-1])
        events = Columns(spread(times, ends[time_at], total), x, spread(rows, ends[row_at], total), polarity)
        if times[0] >= 0 and rows[0] >= 0 and (x.dtype == np.uint16 or x.min(initial=0) >= 0):
            return events
        return self._headed(events)

    def skip(self, words: np.ndarray) -> int | None:
        """Pass words over; returns the time reached (µs), None while it is unknown."""
        kinds = words >> _BITS
        self._rows(words, kinds)
        until = self._doubtful(words, kinds)
        # What leaps at the end is not believed.
        times, _ = self._times(words[:until], kinds[:until])
        self._move_base(words, kinds)
        return int(times[-1]) if times[-1] >= 0 else None

    def _doubtful(self, words: np.ndarray, kinds: np.ndarray) -> int | None:
        """The last time high word, where it leaps, and only the next one tells whether it is damaged."""
        highs = np.flatnonzero(kinds[-MOST_HELD_WORDS:] == _HIGH) + max(len(words) - MOST_HELD_WORDS, 0)
        return int(highs[-1]) if self._clock.doubts(words[highs[-4:]] & 0xFFF) else None

    def _headed(self, events: Columns) -> Columns:
        """Only events whose time, row and column are known."""
        known = (events.t_us >= 0) & (events.y >= 0) & (events.x >= 0)
        count = int((~known).sum())
        self._problems.record(Problem.HEADLESS, count, f"{count} events come before the first time, row or base.")
        return events[known]

    def _rows(self, words: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows, the one that held before in front (-1 where it is unknown), and the words that set them."""
        at = np.flatnonzero(kinds == _ROW)
        rows = np.empty(len(at) + 1, np.int16)
        rows[0] = self._row
        rows[1:] = words[at] & 0x7FF
        self._row = int(rows[-1])
        return rows, at

    def _times(self, words: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Times (µs), the one that held before in front (-1 where it is unknown), and the words that set them."""
        at = np.flatnonzero((kinds == _LOW) | (kinds == _HIGH))
        is_high = kinds[at] == _HIGH
        shown = (words[at] & 0xFFF).astype(np.int64)
        highs = self._clock.advance(shown[is_high])
        high = highs[np.cumsum(is_high)]
        low = np.where(is_high, 0, shown)
        # A time high that says nothing new leaves the low bits as they are.
        repeated = is_high.copy()
        repeated[is_high] = np.diff(highs) == 0
        held = np.maximum.accumulate(np.where(repeated, -1, np.arange(len(at)))) if len(at) else at
        low = np.where(held < 0, self._low, low[held]) if len(at) else low
        times = np.empty(len(at) + 1, np.int64)
        times[0] = -1 if highs[0] < 0 else (highs[0] << _BITS) | self._low
        times[1:] = np.where(high < 0, -1, (high << _BITS) | low)
        self._low = int(low[-1]) if len(at) else self._low
        return times, at

    def _columns(self, words: np.ndarray, kinds: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column (-1 where it is unknown) and polarity of every event."""
        singles = np.flatnonzero(kinds == _EVENT)
        single = words[singles]
        vectors, starts = self._move_base(words, kinds)
        if len(vectors) == 0:
            return single & 0x7FF, (single & 0x800) > 0
        # Column and polarity travel together; events of vectors and single ones are put where they belong.
        packed = np.empty(int(ends[-1]), np.int32)
        packed[ends[singles] - 1] = (single & 0x7FF) | (single & 0x800).astype(np.int32) << _TO_BRIGHTER
        vector = words[vectors]
        masks = np.where(kinds[vectors] == _VECTOR_12, vector & 0xFFF, vector & 0xFF)
        hits = np.flatnonzero(np.unpackbits(masks.view(np.uint8), bitorder="little").view(bool))
        of_vector = hits >> 4
        # Place of a vector's first event, less the number of events of all vectors before it.
        shift = ends[vectors] - np.cumsum(_EVENTS_OF[vector], dtype=np.int32)
        packed[shift[of_vector] + np.arange(len(hits), dtype=np.int32)] = starts[of_vector] + (hits & 15)
        x = packed & (_BRIGHTER - 1)
        if (x >= _UNKNOWN).any():
            x[x >= _UNKNOWN] = -1
        return x, packed >= _BRIGHTER

    def _move_base(self, words: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The words that are vectors, and the column where each starts, packed with its polarity."""
        vectors = np.flatnonzero((kinds == _VECTOR_12) | (kinds == _VECTOR_8))
        bases = np.flatnonzero(kinds == _BASE)
        if len(vectors) == 0 and len(bases) == 0:
            return vectors, vectors
        moved = np.zeros(len(vectors) + 1, np.int32)
        np.cumsum(np.where(kinds[vectors] == _VECTOR_12, np.int32(12), np.int32(8)), out=moved[1:])
        # A vector counts from the base before it, and from the vectors since then.
        before = np.searchsorted(vectors, bases)
        origin = np.empty(len(bases) + 1, np.int32)
        origin[0], word = self._base, words[bases]
        origin[1:] = ((word & 0x7FF) | (word & 0x800).astype(np.int32) << _TO_BRIGHTER) - moved[before]
        starts = spread(origin, before, len(vectors)) + moved[:-1]
        packed = int(origin[-1] + moved[-1])
        self._base = packed & _BRIGHTER | min(packed & (_BRIGHTER - 1), _FAR_RIGHT if packed & (_BRIGHTER - 1) < _UNKNOWN else _UNKNOWN)
        return vectors, starts


def _report_unknown(kinds: np.ndarray, problems: Problems) -> None:
    unknown = (kinds == 1) | ((kinds > _HIGH) & (kinds != 10) & (kinds < 14))
    if unknown.any():
        count_unknown(kinds[unknown], _KNOWN, problems)
