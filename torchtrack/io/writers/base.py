"""What every writer of events does: take batches in order of time, and leave a whole file or none."""

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns
from torchtrack.io.problems import Problems
from torchtrack.io.soundness import check_order, inside


class EventWriter(ABC):
    """Writes one stream of events to ``path``; what it writes is complete once :meth:`close` has been called.

    Args:
        path: the file.
        width, height: sensor size in pixels.

    Raises:
        EventDataError: if the format cannot hold such a sensor.
    """

    def __init__(self, path: Path, width: int, height: int) -> None:
        self.path, self.width, self.height = path, width, height
        self._last_us: int | None = None
        self._count = 0

    def write(self, events: EventBatch) -> None:
        """Append events.

        Raises:
            EventDataError: if they lie outside the sensor, go back in time, or do not fit into the format.
        """
        if len(events) == 0:
            return
        columns = inside(Columns.from_batch(events), self.width, self.height, Problems("events to write", strict=True), self._count)
        check_order(columns.t_us, "events to write", self._last_us, self._count)
        self._append(columns)
        self._last_us = int(columns.t_us[-1])
        self._count += len(columns)

    @abstractmethod
    def _append(self, events: Columns) -> None:
        """Write events that have been checked."""

    @abstractmethod
    def close(self) -> None:
        """Write what is left, and close the file."""


def check_addresses(width: int, height: int, largest: int, name: str) -> None:
    """Raise :class:`EventDataError` unless a format with addresses below ``largest`` can hold the sensor."""
    if max(width, height) > largest:
        raise EventDataError(f"{name} holds sensors of up to {largest}x{largest} pixels, got {width}x{height}. Choose another format.")


def steps_of_high(high: np.ndarray, last: int | None, most: int) -> tuple[np.ndarray, np.ndarray]:
    """High parts of the time to be sent before each event, so that no reader mistakes a gap for a wrap.

    Args:
        high: high part of each event's time, not decreasing.
        last: the one sent before, or None at the beginning.
        most: the largest step that a reader is sure to follow.

    Returns:
        How many parts to send before each event, and all of these parts in order.
    """
    before = np.empty_like(high)
    before[0], before[1:] = high[0] - 1 if last is None else last, high[:-1]
    counts = -((before - high) // most)
    event = np.repeat(np.arange(len(high)), counts)
    step = np.arange(len(event)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    return counts, np.minimum(before[event] + step * most, high[event])
