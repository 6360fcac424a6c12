"""AEDAT 4 files, written by iniVation's own library (extra ``aedat``), so that their tools read them."""

import errno
import os
import shutil
from pathlib import Path

from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns
from torchtrack.io.extras import optional
from torchtrack.io.writers.base import EventWriter, check_addresses

_PACKET_EVENTS = 10_000
# The library ends the process where it cannot write, at last when it closes the file: so much room is left for that.
_ROOM_BYTES = 16 << 20
# An event in its packets, were it not compressed.
_EVENT_BYTES = 16


class Aedat4Writer(EventWriter):
    """Writes an AEDAT 4 file; see :class:`torchtrack.io.writers.base.EventWriter`.

    Raises:
        MissingExtraError: if dv-processing is not installed.
    """

    def __init__(self, path: Path, width: int, height: int) -> None:
        check_addresses(width, height, 1 << 15, "AEDAT4")
        # The library ends the process over another suffix.
        if path.suffix != ".aedat4":
            raise EventDataError(f"AEDAT4 files are named .aedat4, got '{path}'.")
        self._dv = optional("dv_processing", "dv-processing", "aedat", "writing AEDAT4")
        super().__init__(path, width, height)
        self._check_room(0)
        config = self._dv.io.MonoCameraWriter.EventOnlyConfig("torchtrack", (width, height), self._dv.CompressionType.LZ4)
        self._writer = self._dv.io.MonoCameraWriter(str(path), config)
        self._writer.setPackagingCount(_PACKET_EVENTS)

    def _append(self, events: Columns) -> None:
        if int(events.t_us[0]) < 0:
            raise EventDataError(f"AEDAT4 holds no times before 0, got {events.t_us[0]} µs. Choose another format.")
        self._check_room(len(events))
        for start in range(0, len(events), _PACKET_EVENTS):
            store = self._dv.EventStore()
            part = events[start : start + _PACKET_EVENTS]
            for event in zip(part.t_us.tolist(), part.x.tolist(), part.y.tolist(), (part.polarity > 0).tolist(), strict=True):
                store.push_back(*event)
            self._writer.writeEvents(store)

    def _check_room(self, events: int) -> None:
        """Raise ``OSError`` unless the disk can take some more events."""
        if shutil.disk_usage(self.path.parent).free < events * _EVENT_BYTES + _ROOM_BYTES:
            raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} (the AEDAT4 library needs {_ROOM_BYTES >> 20} MB to spare)")

    def close(self) -> None:
        """Write what is left, and close the file."""
        # The library closes its file when its object goes.
        del self._writer
