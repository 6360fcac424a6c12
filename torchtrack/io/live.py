"""Events as they come: from a network, from standard input, from a camera.

- ``dv://HOST:PORT``: the network stream of dv-processing and DV (extra ``aedat``).
- ``stdin://`` or ``-``: RAW words on standard input, with a header or without (EVT3 then).
- ``evk4://`` or ``evk4://SERIAL``: a Prophesee EVK4 (extra ``live``).
- ``davis://`` or ``davis://NAME``: a DAVIS or DVXplorer (extra ``aedat``).
"""

import os
import select
import sys
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns
from torchtrack.io.event_source import DEFAULT_CHUNK_EVENTS, check_max_events, check_sensor_size
from torchtrack.io.event_stream import EventStream
from torchtrack.io.extras import optional
from torchtrack.io.mending import Mender, all_of
from torchtrack.io.problems import Problems
from torchtrack.io.prophesee_header import parse_header
from torchtrack.io.raw_file import make_decoder
from torchtrack.io.soundness import inside

_WAIT_S = 0.05
_POLL_S = 0.0005
_READ_BYTES = 1 << 18
_HEADER_BYTES = 1 << 12


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
                self._waiting = list(all_of(self._mended(received), max_events))
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


class DvSource(LiveSource):
    """What an object of dv-processing receives: a network stream or a camera."""

    def __init__(self, name: str, reader: Any) -> None:
        resolution = reader.getEventResolution()
        super().__init__(name, *((0, 0) if resolution is None else (int(resolution[0]), int(resolution[1]))))
        self._reader = reader

    def _receive(self) -> Columns | None:
        with _as_event_data_errors(self.name):
            store = self._reader.getNextEventBatch()
            if store is None and not self._reader.isRunning():
                return None
            events = None if store is None else store.numpy()
        if events is None:
            time.sleep(_POLL_S)
            return Columns.empty()
        return Columns(
            events["timestamp"].astype(np.int64), events["x"].astype(np.int32), events["y"].astype(np.int32), events["polarity"].astype(np.int8) > 0
        )


class StreamSource(LiveSource):
    """RAW words from a file descriptor, such as standard input; with a header, it says encoding and sensor size."""

    def __init__(self, name: str, descriptor: int, width: int = 0, height: int = 0) -> None:
        self._descriptor = descriptor
        with _as_event_data_errors(name):
            self._rest = os.read(descriptor, _HEADER_BYTES)
        header = parse_header(self._rest)
        encoding = header.encoding if header is not None and header.encoding in ("evt2", "evt21", "evt3") else "evt3"
        stored = header.size if header is not None else (None, None)
        self._rest = self._rest[header.offset :] if header is not None else self._rest
        super().__init__(name, stored[0] or width, stored[1] or height)
        self._decoder = make_decoder(encoding, self.problems)

    def _receive(self) -> Columns | None:
        with _as_event_data_errors(self.name):
            if not select.select([self._descriptor], [], [], _WAIT_S)[0]:
                return Columns.empty()
            data = os.read(self._descriptor, _READ_BYTES)
        if not data:
            left = self._decoder.finish()
            return left if len(left) else None
        data = self._rest + data
        size = self._decoder.dtype.itemsize
        whole = len(data) - len(data) % size
        self._rest = data[whole:]
        return self._decoder.feed(np.frombuffer(data, self._decoder.dtype, count=whole // size)) if whole else Columns.empty()


class Evk4Source(LiveSource):
    """Events of a Prophesee EVK4."""

    def __init__(self, name: str, drivers: Any, serial: str) -> None:
        super().__init__(name, 1280, 720)
        self._device = iter(drivers.open(serial=serial or None))

    def _receive(self) -> Columns | None:
        with _as_event_data_errors(self.name):
            received = next(self._device, None)
        if received is None:
            return None
        events = received[1].polarity_events
        if events is None:
            return Columns.empty()
        return Columns(events["t"].astype(np.int64), events["x"].astype(np.int32), events["y"].astype(np.int32), events["on"] > 0)


def open_live(source: str, width: int | None = None, height: int | None = None) -> LiveSource:
    """Open a live source by its address.

    Args:
        source: ``dv://HOST:PORT``, ``evk4://[SERIAL]``, ``davis://[NAME]``, ``stdin://`` or ``-``.
        width, height: sensor size (px), where the source does not say it.

    Raises:
        MissingExtraError: if a library that it needs is not installed.
        EventDataError: if nobody answers, there is no such camera, or the sensor size is unknown.
    """
    scheme, _, rest = source.partition("://")
    if scheme in ("-", "stdin"):
        return _opened(source, lambda: StreamSource("standard input", sys.stdin.fileno(), width or 0, height or 0))
    purpose = f"the source '{source}'"
    if scheme == "evk4":
        drivers = optional("neuromorphic_drivers", "neuromorphic-drivers", "live", purpose)
        return _opened(source, lambda: Evk4Source(source, drivers, rest))
    dv = optional("dv_processing", "dv-processing", "aedat", purpose)
    if scheme == "davis":
        return _opened(source, lambda: DvSource(source, dv.io.camera.open(rest) if rest else dv.io.camera.open()))
    host, _, port = rest.rpartition(":")
    if scheme != "dv" or not host or not port.isdigit():
        raise EventDataError(f"'{source}' is no live source. Known: dv://HOST:PORT, evk4://, davis://, stdin://.")
    return _opened(source, lambda: DvSource(source, dv.io.NetworkReader(host, int(port))))


@contextmanager
def _as_event_data_errors(name: str) -> Iterator[None]:
    """What a driver or the system raises within it, as a camera is unplugged, becomes an :class:`EventDataError`."""
    try:
        yield
    except (RuntimeError, OSError, ValueError, LookupError) as error:
        raise EventDataError(
            f"'{name}' has failed while events were read: {_reason(error)}. "
            "Check cable and power, and that no other program uses it; then start again."
        ) from error


def _reason(error: Exception) -> str:
    """What an exception says, on one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _opened(source: str, make: Callable[[], LiveSource]) -> LiveSource:
    try:
        return make()
    except (RuntimeError, OSError, LookupError, ValueError, TypeError) as error:
        raise EventDataError(f"'{source}' cannot be opened: {_reason(error)}. Check that it is there, connected and not in use.") from error
