"""EVT 2.1: words of 64 bits, each with up to 32 events of one row, one time and one polarity.

The four highest bits are the kind, as in EVT 2.0 (0 darker, 1 brighter, 8 time high, …). A word of events is
``kind:4 time:6 x:11 y:11 valid:32``: bit ``i`` of ``valid`` is an event at ``x + i``. A time high word carries bits 6 to 33
of the time in its upper half. Cameras before the GenX320 send the upper half first ("legacy"); their words are turned.

Reference: docs.prophesee.ai, EVT 2.1 format.
"""

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.evt2 import TIME_HIGH_BITS, TIME_LOW_BITS, count_unknown, headless, reached_us
from torchtrack.io.held_back import HoldingDecoder
from torchtrack.io.problems import Problems
from torchtrack.io.time_high import HighClock, spread

_TIME_HIGH = 8
_KNOWN = np.isin(np.arange(16), (0, 1, 8, 10, 14, 15))


class Evt21Decoder(HoldingDecoder):
    """Decoder of EVT 2.1 words; faults are counted in ``problems``."""

    dtype = np.dtype("<u8")

    def __init__(self, problems: Problems, legacy: bool = False) -> None:
        self._problems = problems
        self._legacy = legacy
        super().__init__(HighClock(TIME_HIGH_BITS, 1 << TIME_LOW_BITS, problems))

    def _decoded(self, words: np.ndarray, *, is_last: bool = False) -> Columns:
        address, valid = self._halves(words)
        kinds = address >> 28
        at = np.flatnonzero(kinds == _TIME_HIGH)
        shown = address[at] & 0x0FFFFFFF
        if not is_last and (sure := self._sure(words, at, shown)) is not None:
            return sure
        count_unknown(kinds, _KNOWN, self._problems)
        is_event = kinds < 2
        bits = np.unpackbits(np.ascontiguousarray(valid[is_event]).view(np.uint8).reshape(-1, 4), axis=1, bitorder="little")
        word, bit = np.nonzero(bits)
        before = np.searchsorted(word, np.cumsum(is_event)[at]) if len(at) else at
        high = self._clock.advance(shown)
        times = spread(high, before, len(word))
        if high[0] < 0:
            first = headless(before, len(word), self._problems)
            times, word, bit = times[first:], word[first:], bit[first:]
        events = address[is_event][word]
        t_us = (times << TIME_LOW_BITS) + ((events >> 22) & 0x3F)
        x = (((events >> 11) & 0x7FF) + bit).astype(np.uint16)
        return Columns(t_us, x, (events & 0x7FF).astype(np.uint16), events >= 1 << 28)

    def skip(self, words: np.ndarray) -> int | None:
        """Pass words over; returns the latest time that may have been reached (µs), None while it is unknown."""
        address, _ = self._halves(words)
        self._clock.passed(address[(address >> 28) == _TIME_HIGH] & 0x0FFFFFFF)
        return reached_us(self._clock)

    def _halves(self, words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The halves with kind and address, and with the valid bits."""
        halves = words.view("<u4")
        return (halves[0::2], halves[1::2]) if self._legacy else (halves[1::2], halves[0::2])


def is_legacy(words: np.ndarray) -> bool:
    """Whether words make more sense with their halves exchanged: that side has more time high words, whose other half is 0."""
    halves = np.ascontiguousarray(words).view("<u4")
    first, second = halves[0::2], halves[1::2]
    return bool(((first >> 28 == _TIME_HIGH) & (second == 0)).sum() > ((second >> 28 == _TIME_HIGH) & (first == 0)).sum())
