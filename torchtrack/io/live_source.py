"""What every live source has in common: events as they come, mended, one after the other."""

import threading
from abc import abstractmethod
from collections.abc import Iterator

from torchtrack.core.events import EventBatch
from torchtrack.io.columns import Columns, batches_of
from torchtrack.io.event_source import DEFAULT_CHUNK_EVENTS, check_max_events, check_sensor_size
from torchtrack.io.event_stream import EventStream
from torchtrack.io.mending import Mender
from torchtrack.io.problems import Problems
from torchtrack.io.soundness import inside


class LiveSource(EventStream):
    """Events as they come. :meth:`chunks` goes on where the one before it stopped; it ends when the sender does, or after :meth:`stop`.
    A camera that is unplugged, or any other fault of what it reads from, is an :class:`EventDataError`.

    Args:
        name: what the source is called.
        width, height: sensor size (px).
    """

    def __init__(self, name: str, width: int, height: int) -> None:
        check_sensor_size(width, height, name)
        self.name, self.width, self.height = name, width, height
        self.problems = Problems(name, strict=False)
        self._stopped = threading.Event()
        self._ended = False
        self._waiting: list[EventBatch] = []
        self._mender = Mender(self.problems, waits=False)

    def stop(self) -> None:
        """End the stream soon; may be called from another thread."""
        self._stopped.set()

    def chunks(self, max_events: int = DEFAULT_CHUNK_EVENTS) -> Iterator[EventBatch]:
        """The events that come; see :class:`torchtrack.io.event_source.EventSource`."""
        check_max_events(max_events)
        while not self._stopped.is_set():
            if not self._waiting:
                if self._ended:
                    return
                received = self._receive()
                self._ended = received is None
                self._waiting = list(batches_of(self._mended(received), max_events))
                continue
            # It stays in line until the next one is asked for: who looks at the first events only does not lose them.
            yield self._waiting[0]
            del self._waiting[0]

    def _mended(self, received: Columns | None) -> list[Columns]:
        if received is None:
            return self._mender.rest()
        return self._mender.add(inside(received, self.width, self.height, self.problems))

    @abstractmethod
    def _receive(self) -> Columns | None:
        """What has come, which may be nothing, after a short wait at most; None at the end of the stream."""
