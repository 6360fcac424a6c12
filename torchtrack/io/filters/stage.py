"""The base of all stages."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace

from torchtrack.core.events import EventBatch
from torchtrack.io.event_source import DEFAULT_CHUNK_EVENTS, EventSource
from torchtrack.io.event_stream import EventStream, LaterStream


@dataclass(frozen=True)
class Stage(EventStream):
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

    def seek(self, t_us: int) -> "Stage":
        """The same stages over the stream from the first event with ``t >= t_us`` on."""
        inner = self.inner.seek(t_us) if isinstance(self.inner, EventStream) else LaterStream(self.inner, t_us)
        return replace(self, inner=inner)

    @abstractmethod
    def _passed(self, chunks: Iterator[EventBatch]) -> Iterator[EventBatch]:
        """What becomes of the batches."""
