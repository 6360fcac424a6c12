"""What is wrong with a recording: counted and reported, or an error where the reader is strict."""

import warnings
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum

from torchtrack.errors import EventDataError, TorchtrackWarning


class Problem(Enum):
    """Kinds of faults; the value says what was left out of the stream."""

    OUTSIDE = "events outside the sensor"
    BACK = "events that go back in time"
    UNKNOWN = "words of unknown kind"
    MALFORMED = "entries that cannot be read"
    DAMAGED = "damaged parts"
    HEADLESS = "events before the first time and address (the recording starts mid-stream)"


# A recording may be cut out of a longer one; this is no fault of it.
_HARMLESS = {Problem.HEADLESS}


@dataclass
class Problems:
    """Faults of one pass through a source.

    Args:
        source: name of the source, for messages.
        strict: whether a fault is an error.
    """

    source: str
    strict: bool
    counts: Counter[Problem] = field(default_factory=Counter)
    first: dict[Problem, str] = field(default_factory=dict)

    def found(self, problem: Problem, count: int, detail: str) -> None:
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

    def clear(self) -> None:
        """Forget all faults: a new pass begins."""
        self.counts.clear()
        self.first.clear()

    def __str__(self) -> str:
        return ", ".join(f"{count} {problem.value}" for problem, count in self.counts.items()) or "none"

    def warn(self) -> None:
        """Tell what was left out, once a pass is over."""
        faults = {problem: detail for problem, detail in self.first.items() if problem not in _HARMLESS}
        if faults:
            details = " ".join(f"First of {self.counts[problem]} {problem.value}: {detail}" for problem, detail in faults.items())
            warnings.warn(f"{self.source}: some of it was left out. {details}", TorchtrackWarning, stacklevel=3)
