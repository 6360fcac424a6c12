"""What every reader of events gives: one stream, in time order, checked, in constant memory."""

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from torchtrack.core.events import EventBatch
from torchtrack.core.limits import check_limit
from torchtrack.errors import EventDataError

DEFAULT_CHUNK_EVENTS = 500_000
# Readers that may choose read about so many events at a time: what is made of them stays in the processor's cache.
PART_EVENTS = 1 << 16


@runtime_checkable
class EventSource(Protocol):
    """A stream of events of one sensor.

    :meth:`chunks` may be called again and starts from the beginning each time. A stream without events yields nothing:
    whoever needs events says so.
    """

    @property
    def width(self) -> int:
        """Sensor width in pixels."""
        ...

    @property
    def height(self) -> int:
        """Sensor height in pixels."""
        ...

    def chunks(self, max_events: int = DEFAULT_CHUNK_EVENTS) -> Iterator[EventBatch]:
        """The events in time order, in batches of 1 to ``max_events`` events, in constant memory.

        Raises:
            EventDataError: if events are malformed, go back in time (also from one batch to the next) or lie outside
                the sensor.
        """
        ...


def check_max_events(max_events: int) -> None:
    """Raise :class:`EventDataError` unless a chunk may hold at least one event."""
    if max_events < 1:
        raise EventDataError(f"max_events must be at least 1, got {max_events}.")


def check_sensor_size(width: int, height: int, source: str) -> None:
    """Raise :class:`EventDataError` unless the sensor has at least one pixel, and :class:`LimitError` where it has too many."""
    if width < 1 or height < 1:
        raise EventDataError(f"{source}: the sensor size must be positive, got {width}x{height}.")
    check_limit("sensor_pixels", width * height, source)
