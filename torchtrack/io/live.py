"""Events as they come: from a network, from standard input, from a camera.

- ``dv://HOST:PORT``: the network stream of dv-processing and DV (extra ``aedat``).
- ``stdin://`` or ``-``: RAW words on standard input, with a header or without (EVT3 then).
- ``evk4://`` or ``evk4://SERIAL``: a Prophesee EVK4 (extra ``live``).
- ``davis://`` or ``davis://NAME``: a DAVIS or DVXplorer (extra ``aedat``).
- ``ros:///TOPIC``: packets of a topic of ROS 2; see :mod:`torchtrack.io.ros_live`.
"""

import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns
from torchtrack.io.extras import optional
from torchtrack.io.live_source import LiveSource
from torchtrack.io.prophesee_header import parse_header
from torchtrack.io.raw_file import make_decoder
from torchtrack.io.ros_live import RosSource

_WAIT_S = 0.05
_POLL_S = 0.0005
_READ_BYTES = 1 << 18
_HEADER_BYTES = 1 << 12


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
        source: ``dv://HOST:PORT``, ``evk4://[SERIAL]``, ``davis://[NAME]``, ``ros:///TOPIC``, ``stdin://`` or ``-``.
        width, height: sensor size (px), where the source does not say it.

    Raises:
        MissingExtraError: if a library that it needs is not installed.
        ConfigError: if it is a topic of ROS, and this Python has no ROS.
        EventDataError: if nobody answers, there is no such camera, or the sensor size is unknown.
    """
    scheme, _, rest = source.partition("://")
    if scheme in ("-", "stdin"):
        return _opened(source, lambda: StreamSource("standard input", sys.stdin.fileno(), width or 0, height or 0))
    purpose = f"the source '{source}'"
    if scheme == "evk4":
        drivers = optional("neuromorphic_drivers", "neuromorphic-drivers", "live", purpose)
        return _opened(source, lambda: Evk4Source(source, drivers, rest))
    if scheme == "ros":
        return RosSource(_ros_topic(source, rest), width or 0, height or 0)
    dv = optional("dv_processing", "dv-processing", "aedat", purpose)
    if scheme == "davis":
        return _opened(source, lambda: DvSource(source, dv.io.camera.open(rest) if rest else dv.io.camera.open()))
    host, _, port = rest.rpartition(":")
    if scheme != "dv" or not host or not port.isdigit():
        raise EventDataError(f"'{source}' is no live source. Known: dv://HOST:PORT, evk4://, davis://, ros:///TOPIC, stdin://.")
    return _opened(source, lambda: DvSource(source, dv.io.NetworkReader(host, int(port))))


def _ros_topic(source: str, topic: str) -> str:
    if not topic.strip("/"):
        raise EventDataError(f"'{source}' names no topic of ROS. Give its name, as in ros:///event_camera/events.")
    return topic if topic.startswith("/") else f"/{topic}"


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
