"""Decoders that hold words back from a leap of the clock on: only the next word of the time tells whether it is one.

In go the words of a stream as they come, out come the events of those that are sure.
"""

from abc import ABC, abstractmethod

import numpy as np

from torchtrack.io.columns import Columns
from torchtrack.io.time_high import HighClock

# A time high word comes at least every so many words.
MOST_HELD_WORDS = 1 << 16


class HoldingDecoder(ABC):
    """What decoders have in common whose words of the time are apart from those of events.

    Args:
        clock: the high bits of the time.
    """

    dtype: np.dtype

    def __init__(self, clock: HighClock) -> None:
        self._clock = clock
        self._rest = np.zeros(0, self.dtype)

    def feed(self, words: np.ndarray) -> Columns:
        """The events of the next words; those before the first time are left out, those after a leap come with later words."""
        words = np.concatenate([self._rest, words]) if len(self._rest) else words
        self._rest = words[:0]
        return self._decoded(words)

    def finish(self) -> Columns:
        """The events of words that are held back, when no more come."""
        words, self._rest = self._rest, self._rest[:0]
        return self._decoded(words, is_last=True)

    def _sure(self, words: np.ndarray, at: np.ndarray, shown: np.ndarray) -> Columns | None:
        """The events before a leap at the end of the words, which are held back from there on; None where there is none.

        Args:
            words: what is being decoded.
            at: places in it of the words of the time.
            shown: what these show.
        """
        if not self._clock.doubts(shown) or len(words) - at[-1] >= MOST_HELD_WORDS:
            return None
        until = int(at[-1])
        self._rest = words[until:].copy()
        return self._decoded(words[:until], is_last=True)

    @abstractmethod
    def _decoded(self, words: np.ndarray, *, is_last: bool = False) -> Columns:
        """The events of words; where they are not the last, all from a leap on is held back."""
