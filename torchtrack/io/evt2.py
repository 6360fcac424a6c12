"""EVT 2.0: words of 32 bits, one event each, with the high bits of the time in words of their own.

The four highest bits are the kind: 0 darker, 1 brighter, 8 time high, 10 trigger, 14 other, 15 continued. An event is
``kind:4 time:6 x:11 y:11``; a time high word carries bits 6 to 33 of the time (µs).

Reference: docs.prophesee.ai, EVT 2.0 format. A fall of the time high by half of its range or more counts as a wrap.
"""

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.held_back import HoldingDecoder
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.time_high import HighClock, spread

TIME_HIGH_BITS, TIME_LOW_BITS = 28, 6
_TIME_HIGH = 8
_FIRST_OTHER = np.uint32(2 << 28)
_KNOWN = np.isin(np.arange(16), (0, 1, 8, 10, 14, 15))


class Evt2Decoder(HoldingDecoder):
    """Decoder of EVT 2.0 words; faults are counted in ``problems``."""

    dtype = np.dtype("<u4")

    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        super().__init__(HighClock(TIME_HIGH_BITS, 1 << TIME_LOW_BITS, problems))

    def _decoded(self, words: np.ndarray, *, is_last: bool = False) -> Columns:
        is_event = words < _FIRST_OTHER
        others = np.flatnonzero(~is_event)
        kinds = words[others] >> 28
        at = others[kinds == _TIME_HIGH]
        shown = words[at] & 0x0FFFFFFF
        if not is_last and (sure := self._sure(words, at, shown)) is not None:
            return sure
        count_unknown(kinds, _KNOWN, self._problems)
        events = words[is_event]
        # How many events come before each time high word: all words before it but the other ones.
        before = at - np.searchsorted(others, at)
        high = self._clock.advance(shown)
        times = spread(high, before, len(events))
        first = 0
        if high[0] < 0:
            first = headless(before, len(events), self._problems)
            times, events = times[first:], events[first:]
        t_us = (times << TIME_LOW_BITS) + ((events >> 22) & 0x3F)
        x, y = ((events >> 11) & 0x7FF).astype(np.uint16), (events & 0x7FF).astype(np.uint16)
        return Columns(t_us, x, y, events >= 1 << 28)

    def skip(self, words: np.ndarray) -> int | None:
        """Pass words over; returns the latest time that may have been reached (µs), None while it is unknown."""
        self._clock.passed(words[(words >> 28) == _TIME_HIGH] & 0x0FFFFFFF)
        return reached_us(self._clock)


def reached_us(clock: HighClock) -> int | None:
    """The latest time that may have been reached (µs), None while it is unknown."""
    return None if clock.last is None else (clock.last + 1 << TIME_LOW_BITS) - 1


def headless(before: np.ndarray, count: int, problems: Problems) -> int:
    """How many of ``count`` events come before the first time high word; they are counted as such."""
    first = int(before[0]) if len(before) else count
    problems.record(Problem.HEADLESS, first, f"{first} events come before the first time.")
    return first


def count_unknown(kinds: np.ndarray, known: np.ndarray, problems: Problems) -> None:
    """Count the words whose kind (4 bits) is none of the known ones."""
    unknown = int((~known[kinds]).sum()) if len(kinds) else 0
    if unknown:
        kind = int(kinds[np.argmax(~known[kinds])])
        problems.record(Problem.UNKNOWN, unknown, f"{unknown} words are of no kind of this encoding (first: {kind}). Copy it again.")
