"""Messages of ROS 1 and ROS 2 that carry events, read from their bytes without building objects.

``event_camera_msgs/EventPacket``: bytes in the encoding of the camera (``evt3``, ``libcaer``, ``libcaer_cmp``, ``mono``).
``dvs_msgs/EventArray``: ``x:16 y:16 seconds:32 nanoseconds:32 polarity:8`` each; ROS 2 aligns them to 16 bytes.

Reference: github.com/ros-event-camera/event_camera_msgs, github.com/uzh-rpg/rpg_dvs_ros.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns, join
from torchtrack.io.evt3 import Evt3Decoder
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.time_high import unwrap

PACKETS, ARRAYS = "EventPacket", "EventArray"
# After the year 2100; all that is added to it fits 64 bits.
_LATEST_NS = 1 << 62
_ROS1_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
# In ROS 2 the second and later events start two bytes after a multiple of four.
_FIRST_ROS2_BYTES = 14
_ROS2_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("padding", "V2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1"), ("end", "V1")])
# Kinds of words of libcaer_cmp (time high, time low, column, event, base, vector of 8), as EVT3 with rows and columns exchanged.
_AS_EVT3 = np.array([8, 6, 0, 2, 3, 5, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1], np.uint16)


class MessageHeader(NamedTuple):
    """When a message was made (ns, by the clock of ROS), and the frame that it is of."""

    stamp_ns: int
    frame: str


class _Cursor:
    """Reads the fields of a message one after the other."""

    def __init__(self, data: bytes, ros2: bool) -> None:
        # Alignment counts from after the four bytes that say how ROS 2 encodes.
        self._data, self._ros2 = memoryview(data)[4:] if ros2 else memoryview(data), ros2
        self.at = 0

    def number(self, size: int) -> int:
        if self._ros2:
            self.at += -self.at % size
        return int.from_bytes(self.take(size), "little")

    def take(self, size: int) -> memoryview:
        if self.at + size > len(self._data):
            raise EventDataError("a message ends early")
        part = self._data[self.at : self.at + size]
        self.at += size
        return part

    def text(self) -> str:
        return bytes(self.take(self.number(4))).rstrip(b"\0").decode("utf-8", errors="replace")

    def header(self) -> MessageHeader:
        """std_msgs/Header; ROS 1 has a sequence number in it."""
        if not self._ros2:
            self.number(4)
        seconds, nanoseconds = self.number(4), self.number(4)
        return MessageHeader(seconds * 1_000_000_000 + nanoseconds, self.text())


@dataclass
class MessageDecoder:
    """From messages of one topic to events; keeps what packets need to know from those before.

    Args:
        kind: ``EventPacket`` or ``EventArray``.
        ros2: whether the messages are of ROS 2.
        problems: where faults are counted.
    """

    kind: str
    ros2: bool
    problems: Problems
    _evt3: Evt3Decoder = field(init=False)

    def __post_init__(self) -> None:
        self._evt3 = Evt3Decoder(self.problems)

    def size(self, message: bytes) -> tuple[int, int]:
        """Sensor width and height, as a message says them."""
        cursor = _Cursor(message, self.ros2)
        cursor.header()
        height, width = cursor.number(4), cursor.number(4)
        return width, height

    def header(self, message: bytes) -> MessageHeader:
        """Time and frame of a message.

        Raises:
            EventDataError: if the message ends before them.
        """
        return _Cursor(message, self.ros2).header()

    def events(self, messages: Iterable[bytes]) -> Columns:
        """The events of messages; a damaged one counts as a fault."""
        parts: list[Columns] = []
        words: list[np.ndarray] = []
        for message in messages:
            content = self._content(message)
            if isinstance(content, np.ndarray):
                words.append(content)
            else:
                parts += [self._decoded(words), content]
                words = []
        return join([*parts, self._decoded(words)])

    def rest(self) -> Columns:
        """The events that are held back, when no more messages come."""
        return self._evt3.finish()

    def _decoded(self, words: list[np.ndarray]) -> Columns:
        """The events of EVT3 words, at once: messages are small."""
        return self._evt3.feed(np.concatenate(words)) if words else Columns.empty()

    def _content(self, message: bytes) -> Columns | np.ndarray:
        """The events of a message, or the words of EVT3 that it carries."""
        try:
            cursor = _Cursor(message, self.ros2)
            cursor.header()
            cursor.take(-cursor.at % 4 if self.ros2 else 0)
            cursor.take(8)
            return self._packet(cursor) if self.kind == PACKETS else self._array(cursor)
        except EventDataError as error:
            self.problems.record(Problem.DAMAGED, 1, f"a message cannot be read ({error}). Record it again.")
            return Columns.empty()

    def _packet(self, cursor: _Cursor) -> Columns | np.ndarray:
        cursor.number(8)
        base_ns, encoding, big_endian = cursor.number(8), cursor.text(), cursor.number(1)
        data = bytes(cursor.take(cursor.number(4)))
        if base_ns >= _LATEST_NS:
            raise EventDataError(f"its time is {base_ns} ns, which no clock shows")
        if big_endian:
            raise EventDataError("its numbers are big-endian, which is not known of any camera")
        if encoding == "evt3":
            return _words(data, "<u2")
        if encoding == "libcaer_cmp":
            return self._compressed(_words(data, "<u2"), base_ns)
        if encoding in ("mono", "libcaer"):
            return (_mono if encoding == "mono" else _libcaer)(_words(data, "<u8"), base_ns)
        raise EventDataError(f"the encoding '{encoding}' is not known; those known are evt3, libcaer, libcaer_cmp and mono")

    def _compressed(self, words: np.ndarray, base_ns: int) -> Columns:
        """libcaer_cmp: every packet counts from its own time."""
        start = np.array([8 << 12, 6 << 12, 0], np.uint16)
        words = _AS_EVT3[words >> 12] << 12 | words & 0xFFF
        decoder = Evt3Decoder(self.problems)
        turned = join([decoder.feed(np.concatenate([start, words])), decoder.finish()])
        return Columns(turned.t_us + (base_ns + 500) // 1000, turned.y, turned.x, turned.polarity)

    def _array(self, cursor: _Cursor) -> Columns:
        count = cursor.number(4)
        if not self.ros2:
            return _from_records(np.frombuffer(cursor.take(count * _ROS1_EVENT.itemsize), _ROS1_EVENT))
        if count == 0:
            return Columns.empty()
        first = np.frombuffer(cursor.take(_ROS1_EVENT.itemsize), _ROS1_EVENT)
        if count == 1:
            return _from_records(first)
        cursor.take(_FIRST_ROS2_BYTES - _ROS1_EVENT.itemsize)
        # The last one has no padding after it.
        data = bytes(cursor.take((count - 1) * _ROS2_EVENT.itemsize - 1)) + b"\0"
        parts = [_from_records(first), _from_records(np.frombuffer(data, _ROS2_EVENT))]
        return Columns(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("t_us", "x", "y", "polarity")))


def _words(data: bytes, dtype: str) -> np.ndarray:
    size = np.dtype(dtype).itemsize
    if len(data) % size:
        raise EventDataError(f"its events take {len(data)} bytes, which is no multiple of {size}")
    return np.frombuffer(data, dtype)


def _from_records(records: np.ndarray) -> Columns:
    t_ns = records["s"].astype(np.int64) * 1_000_000_000 + records["ns"]
    return Columns((t_ns + 500) // 1000, records["x"].copy(), records["y"].copy(), records["p"] > 0)


def _mono(words: np.ndarray, base_ns: int) -> Columns:
    """``delay:32`` (ns since the time of the packet), ``x:16 y:15 polarity:1``."""
    t_ns = base_ns + (words & 0xFFFFFFFF).astype(np.int64)
    x, y = (words >> np.uint64(32) & np.uint64(0xFFFF)).astype(np.uint16), (words >> np.uint64(48) & np.uint64(0x7FFF)).astype(np.uint16)
    return Columns((t_ns + 500) // 1000, x, y, words >= np.uint64(1 << 63))


def _libcaer(words: np.ndarray, base_ns: int) -> Columns:
    """``valid:1 polarity:1 y:15 x:15``, then ``t:32``, µs since the time of the packet, of which 31 bits count."""
    address, shown = words.view("<u4")[0::2], words.view("<u4")[1::2]
    t_us = (shown & 0x7FFFFFFF).astype(np.int64)
    if len(t_us):
        t_us = unwrap(t_us, 31, int(t_us[0]))
    x, y = (address >> 17).astype(np.uint16), (address >> 2 & 0x7FFF).astype(np.uint16)
    return Columns(t_us + (base_ns + 500) // 1000, x, y, (address >> 1 & 1) > 0)
