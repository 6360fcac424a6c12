"""Event Stream files (``.es``), version 2, of DVS and ATIS events.

After ``Event Stream``, three bytes of version, one of type and the sensor size (two numbers of 16 bits), an event of a DVS
has 5 bytes: ``delay:7 polarity:1``, then x and y of 16 bits; delays are in µs since the event before. In place of an event
there may be one byte: 255 adds 127 µs, 254 means nothing. An ATIS has ``delay:6 kind:2`` (0 darker, 2 brighter, the odd
ones are exposures and left out) and adds 63 µs for each of the two low bits' count in a byte of 252 or more.

Rows are taken as they are stored. Reference: github.com/neuromorphicsystems/event_stream.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from torchtrack.errors import UnknownFormatError
from torchtrack.io.columns import Columns
from torchtrack.io.event_file import EventFile
from torchtrack.io.problems import Problem

ES_MAGIC = b"Event Stream"
_HEADER_BYTES = 20
_EVENT_BYTES = 5
_BLOCK_BYTES = 1 << 19
_DVS, _ATIS = 1, 2


@dataclass(frozen=True)
class EsFile(EventFile):
    """Events of an Event Stream file; see :class:`torchtrack.io.event_file.EventFile`.

    Raises:
        UnknownFormatError: if it is none of version 2, or one of other things than DVS or ATIS events.
    """

    kind: int = field(init=False, default=_DVS)

    @property
    def known_count(self) -> int | None:
        """An estimate: delays of more than 126 µs take further bytes."""
        return max(self.path.stat().st_size - _HEADER_BYTES, 0) // _EVENT_BYTES

    def _open(self) -> None:
        with self.path.open("rb") as stream:
            head = stream.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or not head.startswith(ES_MAGIC) or head[12] != 2 or head[15] not in (_DVS, _ATIS):
            raise UnknownFormatError(f"'{self.path}' is no Event Stream of version 2 with DVS (1) or ATIS (2) events; it starts with {head!r}.")
        object.__setattr__(self, "kind", head[15])
        width, height = np.frombuffer(head, "<u2", count=2, offset=16).tolist()
        self._settle_size(width, height)

    def _read(self, max_events: int) -> Iterator[Columns]:
        reached_us, rest = 0, b""
        with self._bytes() as stream:
            stream.seek(_HEADER_BYTES)
            while data := stream.read(_BLOCK_BYTES):
                data = rest + data
                events, reached_us, used = self._decode(np.frombuffer(data, np.uint8), reached_us)
                rest = data[used:]
                yield events
        self.problems.record(Problem.DAMAGED, bool(rest), f"it ends within an event: {len(rest)} bytes are left over. Copy it again.")

    def _decode(self, data: np.ndarray, reached_us: int) -> tuple[Columns, int, int]:
        """Events of some bytes that begin with an event; the time reached; and how many bytes were used."""
        lowest, delay_shift = (254, 1) if self.kind == _DVS else (252, 2)
        starts, alone, before = _framed(data, lowest)
        added = np.zeros(len(alone) + 1, np.int64)
        code = data[alone].astype(np.int64)
        added[1:] = np.cumsum(127 * (code & 1) if self.kind == _DVS else 63 * (code & 3))
        lead = data[starts]
        t_us = reached_us + np.cumsum((lead >> delay_shift).astype(np.int64)) + added[before]
        x = data[starts + 1] | data[starts + 2].astype(np.uint16) << 8
        y = data[starts + 3] | data[starts + 4].astype(np.uint16) << 8
        events = Columns(t_us, x, y, lead & delay_shift > 0)
        used = max(int(starts[-1]) + _EVENT_BYTES if len(starts) else 0, int(alone[-1]) + 1 if len(alone) else 0)
        reached_us += int((lead >> delay_shift).sum(dtype=np.int64)) + int(added[-1])
        return (events[lead & 1 == 0] if self.kind == _ATIS else events), reached_us, used


def _framed(data: np.ndarray, lowest: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where events start; where bytes stand alone (``lowest`` or more in an event's place); how many of these are before each event."""
    position = 0
    runs, alone = [], []
    for candidate in np.flatnonzero(data >= lowest).tolist():
        # Within an event such a byte is an address.
        if candidate >= position and (candidate - position) % _EVENT_BYTES == 0:
            runs.append((position, (candidate - position) // _EVENT_BYTES))
            alone.append(candidate)
            position = candidate + 1
    runs.append((position, (len(data) - position) // _EVENT_BYTES))
    begins, counts = np.array(runs, np.int64).T
    before = np.repeat(np.arange(len(runs)), counts)
    within = np.arange(len(before)) - np.repeat(np.cumsum(counts) - counts, counts)
    return begins[before] + _EVENT_BYTES * within, np.array(alone, np.int64), before
