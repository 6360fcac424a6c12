"""Polarities of a stream, part by part: the code that the file has, or the one that the user says."""

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from torchtrack.core.events import EventBatch
from torchtrack.core.polarity import brighter, known_codes, shown_values
from torchtrack.errors import TorchtrackWarning
from torchtrack.io.columns import Columns
from torchtrack.io.problems import Problem, Problems

PolarityChoice = Literal["auto", "inverted"] | int
_CHOOSE = "Set events.polarity (--polarity) to the value that means brighter."
# A share of wrong values up to this is damage, a larger one another code.
_MOST_DAMAGED = 0.01
# So many events of one polarity are told.
_MANY, _FEW = 10_000, 1_000


@dataclass
class PolarityCode:
    """Turns the polarities of one pass through a stream into booleans.

    Args:
        choice: ``auto``: 0/1 or -1/1; ``inverted``: the same, the other way round; a number: those that have it got brighter.
        problems: where single wrong values are counted.
    """

    choice: PolarityChoice
    problems: Problems

    def applied(self, events: Columns) -> Columns:
        """The same events with booleans; those whose polarity is damaged are left out.

        Raises:
            EventDataError: if the code is none that is known, and nobody says what it means.
        """
        if len(events) == 0:
            return events
        events = events if isinstance(self.choice, int) else self._without_damage(events)
        if isinstance(self.choice, int):
            polarity = events.polarity == self.choice
        else:
            polarity = brighter(events.polarity, self.problems.source, _advice)
            polarity = ~polarity if self.choice == "inverted" else polarity
        return replace(events, polarity=polarity)

    def _without_damage(self, events: Columns) -> Columns:
        known = known_codes(events.polarity)
        wrong = 0 if known is None else int((~known).sum())
        if known is None or wrong > max(_MOST_DAMAGED * len(events), 1):
            return events
        self.problems.record(Problem.MALFORMED, wrong, f"polarity holds {shown_values(events.polarity[~known])} in {wrong} events; expected 0 or 1.")
        return events[known]


def with_one_polarity_reported(chunks: Iterable[EventBatch], source: str) -> Iterator[EventBatch]:
    """The same events, with a warning where all of them have one polarity: it may be coded in another way."""
    count, seen = 0, set[bool]()
    for chunk in chunks:
        if len(seen) < 2 and len(chunk):
            count += len(chunk)
            seen |= {bool(chunk.polarity.any()), bool(chunk.polarity.all())}
            if count >= _MANY and len(seen) == 1:
                _warn_of_one_polarity(count, seen.pop(), source)
                # Once is enough.
                seen = {False, True}
        yield chunk
    if len(seen) == 1 and count >= _FEW:
        _warn_of_one_polarity(count, seen.pop(), source)


def _warn_of_one_polarity(count: int, are_brighter: bool, source: str) -> None:
    which = "brighter" if are_brighter else "darker"
    message = f"{source}: all of its first {count} events got {which}. If both should be there, polarity is coded in another way. {_CHOOSE}"
    warnings.warn(message, TorchtrackWarning, stacklevel=3)


def _advice(values: np.ndarray) -> str:
    """How to say what a code means, and what one that tools are known to write by mistake is likely to mean."""
    distinct = set(np.unique(values).tolist())
    if distinct == {1, 255}:
        return f" {_CHOOSE} 255 is -1 stored without a sign, so that is probably 1."
    return f" {_CHOOSE}{' Here that is probably 2.' if distinct == {1, 2} else ''}"
