"""Background activity: lone events, which noise makes and edges do not.

An event stays if a neighbour of its pixel fired shortly before it. This is the nearest-neighbour filter of Delbruck,
*Frame-free dynamic digital vision* (2008), with two choices of ours: polarity does not count, and events of the very same
time support each other, as their order is arbitrary.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError
from torchtrack.io.filters.stage import Stage

_NEIGHBOURS = [(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dx, dy) != (0, 0)]


@dataclass(frozen=True)
class BackgroundFilter(Stage):
    """Events that neighbours support.

    Args:
        inner: the stream.
        max_age_us: how long before the event a neighbour may have fired.
        min_support: how many of the eight neighbours must have fired.

    Raises:
        EventDataError: if the age is not positive, or the support not 1 to 8.
    """

    max_age_us: int = 5000
    min_support: int = 1

    def __post_init__(self) -> None:
        if self.max_age_us < 1 or not 1 <= self.min_support <= len(_NEIGHBOURS):
            raise EventDataError(f"max_age_us must be positive and min_support 1 to 8, got {self.max_age_us} and {self.min_support}.")

    def _passed(self, chunks: Iterator[EventBatch]) -> Iterator[EventBatch]:
        recent, held = EventBatch.empty(), EventBatch.empty()
        for chunk in chunks:
            # Events of the last time may be supported by some that are yet to come.
            ready = concatenate([held, chunk])
            newest_us = int(ready.t_us[-1])
            cut = int(torch.searchsorted(ready.t_us, newest_us))
            ready, held = ready[:cut], ready[cut:]
            yield self._kept(recent, ready)
            recent = concatenate([recent, ready])
            recent = recent[int(torch.searchsorted(recent.t_us, newest_us - self.max_age_us)) :]
        yield self._kept(recent, held)

    def _kept(self, before: EventBatch, events: EventBatch) -> EventBatch:
        """Those of ``events`` that are supported, by themselves or by what was before."""
        if len(events) == 0:
            return events
        every = concatenate([before, events])
        support = _support(every.x.numpy(), every.y.numpy(), every.t_us.numpy(), self.width, self.max_age_us)
        return events[torch.from_numpy(np.flatnonzero(support[len(before) :] >= self.min_support))]


def _support(x: np.ndarray, y: np.ndarray, t_us: np.ndarray, width: int, max_age_us: int) -> np.ndarray:
    """How many neighbours of each event's pixel fired up to ``max_age_us`` before it, or at the same time."""
    # One sorted list of (pixel, time) holds the times of all pixels; a pixel's stretch of it begins and ends with a gap.
    age = t_us - t_us[0] + max_age_us
    span = int(age[-1]) + 1
    columns = width + 2
    keys = ((y.astype(np.int64) + 1) * columns + x + 1) * span + age
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    support = np.zeros(len(keys), np.int8)
    for dx, dy in _NEIGHBOURS:
        wanted = keys + (dy * columns + dx) * span
        newest = np.searchsorted(keys, wanted, side="right") - 1
        support += (newest >= 0) & (keys[newest] >= wanted - max_age_us)
    unsorted = np.empty_like(support)
    unsorted[order] = support
    return unsorted
