"""What is wrong with a recording: counted and reported, or an error where the reader is strict."""

import warnings
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum

from torchtrack.errors import EventDataError, TorchtrackWarning


class Problem(Enum):
    """Kinds of faults; the value says what was left out of the stream, or mended in it."""

    OUTSIDE = "events outside the sensor"
    BACK = "events that go back in time"
    WILD = "events far ahead of those before and after them"
    REPEATED = "events that were sent twice"
    UNKNOWN = "words of unknown kind"
    MALFORMED = "entries that cannot be read"
    DAMAGED = "damaged parts"
    HEADLESS = "events before the first time and address (the recording starts mid-stream)"
    SORTED = "events that came late, sorted in"
    TIME_WORD = "time words that contradict their neighbours, ignored"
    WRAPPED = "wraps of the clock, taken out"
    RESET = "jumps back of the clock, taken out"


# A recording may be cut out of a longer one; this is no fault of it.
_HARMLESS = {Problem.HEADLESS}
# Of these, nothing is left out.
_MENDED = {Problem.SORTED, Problem.TIME_WORD, Problem.WRAPPED, Problem.RESET}
# A clock that changes all the time is told with so many changes; their number is in the counts.
_MOST_CHANGES = 100


@dataclass(frozen=True)
class ClockChange:
    """The clock of a stream went back, and time went on.

    Args:
        kind: ``wrap`` of a counter, or ``reset`` to an earlier time.
        at_us: time of the stream, as events and poses have it, from which on the clock is another (µs).
        from_us, to_us: what the clock showed before and after (µs).
    """

    kind: str
    at_us: int
    from_us: int
    to_us: int


@dataclass
class Problems:
    """Faults of one pass through a source.

    Args:
        source: name of the source, for messages.
        strict: whether a fault is an error.

    Attributes:
        counts: faults by kind.
        first: what the first one of each kind was.
        clock_changes: the first changes of the clock.
    """

    source: str
    strict: bool
    counts: Counter[Problem] = field(default_factory=Counter)
    first: dict[Problem, str] = field(default_factory=dict)
    clock_changes: list[ClockChange] = field(default_factory=list)

    def record(self, problem: Problem, count: int, detail: str) -> None:
        """Take note of ``count`` faults, of which ``detail`` describes the first.

        Raises:
            EventDataError: if the reader is strict and this is not harmless.
        """
        if count == 0:
            return
        if self.strict and problem not in _HARMLESS:
            raise EventDataError(f"{self.source}: {detail}")
        self.counts[problem] += count
        self.first.setdefault(problem, detail)

    def clock_changed(self, change: ClockChange) -> None:
        """Take note of another clock."""
        if len(self.clock_changes) < _MOST_CHANGES:
            self.clock_changes.append(change)

    def clear(self) -> None:
        """Forget all faults: a new pass begins."""
        self.counts.clear()
        self.first.clear()
        self.clock_changes.clear()

    def __str__(self) -> str:
        return ", ".join(f"{count} {problem.value}" for problem, count in self.counts.items()) or "none"

    def warn(self) -> None:
        """Tell what was left out or mended, once a pass is over."""
        faults = {problem: detail for problem, detail in self.first.items() if problem not in _HARMLESS}
        if faults:
            done = "it was mended" if faults.keys() <= _MENDED else "some of it was left out"
            details = " ".join(f"First of {self.counts[problem]} {problem.value}: {detail}" for problem, detail in faults.items())
            warnings.warn(f"{self.source}: {done}. {details}", TorchtrackWarning, stacklevel=3)
