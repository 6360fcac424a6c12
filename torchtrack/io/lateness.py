"""Which events of a stream came late, which were there already, and where late ones belong."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from torchtrack.io.columns import Columns, join

# As long as packets are that may be sent twice.
_RECENT_EVENTS = 1 << 14
# Time and address of an event as one number: times within 2^28 µs, addresses of 35 bits.
_ADDRESS_BITS, _LONGEST_US = 35, 1 << 27


class Arrivals:
    """Times in the order in which they came, after ``newest_us``.

    Attributes:
        newest_before: of each, the newest time before it.
        late: which came after a later one.
    """

    def __init__(self, t_us: np.ndarray, newest_us: int) -> None:
        self._t_us = t_us
        self.newest_before = np.empty(len(t_us), np.int64)
        self.newest_before[0] = newest_us
        np.maximum(np.maximum.accumulate(t_us[:-1]), newest_us, out=self.newest_before[1:])
        self.late = t_us < self.newest_before

    @property
    def first_late(self) -> int:
        """Which one is the first that is late."""
        return int(np.argmax(self.late))

    @property
    def first_step_back(self) -> tuple[int, int]:
        """The times before and after the first step back."""
        return int(self.newest_before[self.first_late]), int(self._t_us[self.first_late])

    def follows(self, marked: np.ndarray) -> np.ndarray:
        """Which come at the newest time, and right after a ``marked`` one that is earlier, or others of the kind."""
        at_newest = self._t_us == self.newest_before
        last_other = np.maximum.accumulate(np.where(at_newest, -1, np.arange(len(at_newest))))
        return np.asarray(at_newest & (last_other >= 0) & marked[last_other])

    @property
    def latest_by(self) -> int:
        """How late the latest one is (µs)."""
        return int((self.newest_before - self._t_us).max())


class Recent:
    """What was given on last, to know what comes twice."""

    def __init__(self) -> None:
        self.newest_us: int | None = None
        self._pieces: deque[Columns] = deque()
        self._count = 0

    def add(self, pieces: Sequence[Columns]) -> None:
        """Take note of events that were given on."""
        for piece in pieces:
            self._pieces.append(piece)
            self._count += len(piece)
            self.newest_us = int(piece.t_us[-1])
        while self._pieces and self._count - len(self._pieces[0]) >= _RECENT_EVENTS:
            self._count -= len(self._pieces.popleft())

    def knows(self, events: Columns, held: Sequence[Columns] = ()) -> np.ndarray:
        """Which events are equal to some that were given on, or are ``held``."""
        if len(events) == 0:
            return np.zeros(0, bool)
        origin_us = int(events.t_us.min())
        before = join([piece for piece in (*self._pieces, *held) if piece.t_us[-1] >= origin_us])
        if len(before) == 0:
            return np.zeros(len(events), bool)
        near = before[(before.t_us >= origin_us) & (before.t_us <= min(int(events.t_us.max()), origin_us + _LONGEST_US))]
        within = events.t_us.astype(np.int64) - origin_us <= _LONGEST_US
        return within & np.isin(_codes(events, origin_us), _codes(near, origin_us))


def merged(held: Sequence[Columns], events: Columns, arrivals: Arrivals, recent: Recent) -> tuple[Columns, int, int, int]:
    """Held events and those that come after them, in any order, as one piece that is sorted.

    Returns:
        The piece; and how many of the events were there already, came too late to be sorted in, and were sorted in.
    """
    count = sum(map(len, held))
    both = join([*held, events])
    t_us = both.t_us.astype(np.int64)
    late, again, too_late = np.zeros(len(both), bool), _again(both), np.zeros(len(both), bool)
    late[count:] = arrivals.late
    if recent.newest_us is not None:
        passed = np.flatnonzero(t_us <= recent.newest_us)
        again[passed] |= recent.knows(both[passed])
        too_late = late & ~again & (t_us < recent.newest_us)
    repeated = late & again
    # What was sent twice ends at the newest time. Events of one time may well be equal otherwise.
    repeated[count:] |= arrivals.follows(repeated[count:]) & again[count:]
    sorted_in = int((late & ~repeated & ~too_late).sum())
    kept = both[~(repeated | too_late)]
    return kept[np.argsort(kept.t_us, kind="stable")], int(repeated.sum()), int(too_late.sum()), sorted_in


def _again(events: Columns) -> np.ndarray:
    """Which events are equal to one before them."""
    codes = _codes(events, int(events.t_us.min()))
    order = np.argsort(codes, kind="stable")
    again = np.zeros(len(events), bool)
    again[order[1:]] = codes[order[1:]] == codes[order[:-1]]
    return again


def _codes(events: Columns, origin_us: int) -> np.ndarray:
    """A number for each event, the same for equal ones."""
    address = (events.y.astype(np.int64) << 17) | (events.x.astype(np.int64) << 1) | (events.polarity > 0)
    return (events.t_us.astype(np.int64) - origin_us << _ADDRESS_BITS) | address
