"""Clocks that send their high bits apart, and wrap around."""

import numpy as np

from torchtrack.io.problems import Problem, Problems

# A leap of the clock by more is believed only if the next word goes on from there.
_LEAP_US = 10_000


class HighClock:
    """The high parts of the time over the words of a stream, continued without the wraps.

    A word that contradicts the one before it and the one after it, which agree, is damaged: what the one before it said goes on.

    Args:
        bits: how many bits a part has.
        unit_us: what its lowest bit stands for.
        problems: where damaged words are counted.
    """

    def __init__(self, bits: int, unit_us: int, problems: Problems) -> None:
        self._bits, self._unit_us, self._problems = bits, unit_us, problems
        # The unwrapped part that held last; its low bits are what the clock showed. None as long as there is none.
        self.last: int | None = None

    def advance(self, shown: np.ndarray) -> np.ndarray:
        """Unwrapped high parts of the next words, with the one before them in front (-1 for none)."""
        sound, wild = self._without_wild(shown.astype(np.int64))
        self._problems.record(Problem.TIME_WORD, wild, f"{wild} time words contradict those before and after them. Copy it again.")
        high = np.full(len(sound) + 1, -1 if self.last is None else self.last, np.int64)
        if len(sound):
            high[1:] = unwrap(sound, self._bits, int(sound[0]) if self.last is None else self.last)
            self.last = int(high[-1])
        return high

    def doubts(self, shown: np.ndarray) -> bool:
        """Whether the last of the next words leaps: only the one after it tells whether it is damaged."""
        if len(shown) == 0:
            return False
        newest = np.concatenate([self._before, shown[-4:].astype(np.int64)])[-4:]
        if len(newest) < 2:
            return False
        if 0 <= int(newest[-1]) - int(newest[-2]) <= _LEAP_US // self._unit_us:
            return False
        newest, _ = self._repaired(newest)
        return (int(newest[-1]) - int(newest[-2])) % (1 << self._bits) > _LEAP_US // self._unit_us

    def passed(self, shown: np.ndarray) -> None:
        """Take words that are passed over; one that leaps at their end is not believed."""
        self.advance(shown[:-1] if self.doubts(shown) else shown)

    @property
    def _before(self) -> np.ndarray:
        """What the clock showed last, if it did."""
        return np.array([] if self.last is None else [self.last % (1 << self._bits)], np.int64)

    def _without_wild(self, shown: np.ndarray) -> tuple[np.ndarray, int]:
        if (shown[1:] >= shown[:-1]).all() and (len(shown) == 0 or self.last is None or shown[0] >= self.last % (1 << self._bits)):
            return shown, 0
        repaired, wild = self._repaired(np.concatenate([self._before, shown]))
        return repaired[len(repaired) - len(shown) :], wild

    def _repaired(self, values: np.ndarray) -> tuple[np.ndarray, int]:
        """Words that lie not between those before and after them, replaced by the one before; and how many."""
        full = 1 << self._bits
        if len(values) < 3:
            return values, 0
        to_this, to_next = (values[1:-1] - values[:-2]) % full, (values[2:] - values[:-2]) % full
        wild = np.flatnonzero((to_this > to_next) & (to_next < full // 4)) + 1
        # The first word of all has none before it.
        first_is_wild = self.last is None and 0 < int(values[0] - values[1]) <= full // 2 and int(values[2] - values[1]) % full < full // 4
        if len(wild) == 0 and not first_is_wild:
            return values, 0
        repaired = values.copy()
        repaired[wild] = values[wild - 1]
        if first_is_wild:
            repaired[0] = values[1]
        return repaired, len(wild) + first_is_wild


def unwrap(high: np.ndarray, bits: int, last: int) -> np.ndarray:
    """High parts of a clock with ``bits`` bits, each continued from the one before it, without the wrap.

    A fall by half of the range or more is a wrap; a smaller one is a step back and stays one.

    Args:
        high: the parts, int64.
        bits: how many bits a part has.
        last: the unwrapped part before the first one; its low ``bits`` bits are what the clock showed.
    """
    full = 1 << bits
    before = np.empty_like(high)
    before[0], before[1:] = last % full, high[:-1]
    loops = np.cumsum(before - high >= full // 2)
    return high + full * (loops + last // full)


def spread(values: np.ndarray, ends: np.ndarray, total: int) -> np.ndarray:
    """Values held until the next one: ``values[0]`` up to ``ends[0]``, and so on; the last one up to ``total``."""
    bounds = np.empty(len(values) + 1, np.int64)
    bounds[0], bounds[1:-1], bounds[-1] = 0, ends, total
    return np.repeat(values, np.diff(bounds))
