"""One interface to every source of events: windows by time or count, seeking, and facts about the stream."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

from torchtrack.core.events import EventBatch
from torchtrack.core.windows import EventWindow, windows_by_count, windows_by_time
from torchtrack.errors import EventDataError
from torchtrack.io.event_source import DEFAULT_CHUNK_EVENTS, EventSource
from torchtrack.io.info import EventInfo, summarise
from torchtrack.io.reading import Progress


class EventStream(ABC):
    """A stream of events of one sensor, as :class:`torchtrack.io.event_source.EventSource` says, with more to ask of it."""

    width: int
    height: int

    @abstractmethod
    def chunks(self, max_events: int = DEFAULT_CHUNK_EVENTS) -> Iterator[EventBatch]:
        """The events in time order, in batches of 1 to ``max_events`` events, in constant memory."""

    def windows(self, duration_us: int | None = None, count: int | None = None, max_age_us: int | None = None) -> Iterator[EventWindow]:
        """The stream cut into windows: by time (``duration_us``), by ``count``, or by count with a maximum age.

        Raises:
            EventDataError: if neither or both of duration and count are given, or they are not positive.
        """
        if (duration_us is None) == (count is None):
            raise EventDataError(f"give duration_us or count (with or without max_age_us), got {duration_us} and {count}.")
        if duration_us is not None:
            if max_age_us is not None:
                raise EventDataError("max_age_us goes with count: a window by time has its age already.")
            return windows_by_time(self.chunks(), duration_us)
        # One of the two was given.
        return windows_by_count(self.chunks(), count or 0, max_age_us)

    def seek(self, t_us: int) -> EventSource:
        """The same stream from the first event with ``t >= t_us`` on; what comes before is not decoded where that can be avoided."""
        return LaterStream(self, t_us)

    def info(self, max_events: int | None = None, progress: Progress | None = None) -> EventInfo:
        """Facts about the stream: counts, times, rates, gaps. Reads all of it, or the first ``max_events`` events."""
        return summarise(self, max_events, progress)


@dataclass(frozen=True)
class DerivedStream(EventStream):
    """A stream made of another one, batch by batch."""

    inner: EventSource

    @property
    def width(self) -> int:  # type: ignore[override]
        """Sensor width in pixels."""
        return self.inner.width

    @property
    def height(self) -> int:  # type: ignore[override]
        """Sensor height in pixels."""
        return self.inner.height

    def chunks(self, max_events: int = DEFAULT_CHUNK_EVENTS) -> Iterator[EventBatch]:
        """The events in time order; see :class:`torchtrack.io.event_source.EventSource`."""
        for chunk in self._passed(self.inner.chunks(max_events)):
            if len(chunk):
                yield chunk

    @abstractmethod
    def _passed(self, chunks: Iterator[EventBatch]) -> Iterator[EventBatch]:
        """What becomes of the batches."""


@dataclass(frozen=True)
class LaterStream(DerivedStream):
    """Another stream without the events before ``start_us``."""

    start_us: int

    def _passed(self, chunks: Iterator[EventBatch]) -> Iterator[EventBatch]:
        return (chunk.slice_time(self.start_us - 1, int(chunk.t_us[-1])) for chunk in chunks)
