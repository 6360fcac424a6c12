"""Events in ROS bags: ROS 1 ``.bag``, ROS 2 ``.db3`` and ``.mcap``, as one file or as the folder of a recording (extra ``ros``)."""

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from torchtrack.errors import EventDataError, TorchtrackError, UnknownFormatError
from torchtrack.files import check_is_file, read_bytes
from torchtrack.io.columns import Columns
from torchtrack.io.event_file import EventFile
from torchtrack.io.extras import optional
from torchtrack.io.problems import Problems
from torchtrack.io.ros_compression import bounded_decompression, take_over_messages
from torchtrack.io.ros_messages import ARRAYS, PACKETS, MessageDecoder
from torchtrack.yaml_text import load_document

ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"
_KINDS = {
    "event_camera_msgs/msg/EventPacket": PACKETS,
    # Its name before it was called event_camera_msgs.
    "event_array_msgs/msg/EventArray": PACKETS,
    "dvs_msgs/msg/EventArray": ARRAYS,
    "prophesee_event_msgs/msg/EventArray": ARRAYS,
}
# What the library is known to raise over damaged bytes, beside its own error.
_DAMAGED = (
    OSError,
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
    AssertionError,
    MemoryError,
    struct.error,
    sqlite3.Error,
)
# Small messages are decoded together.
_FEWEST_BYTES = 1 << 18


@dataclass(frozen=True)
class RosBag(EventFile):
    """Events of the first topic of a bag that has events, or of the one named; see :class:`torchtrack.io.event_file.EventFile`.

    Times are those of the events: sensor time with the encoding evt3, ROS time otherwise.

    Raises:
        MissingExtraError: if the library that reads bags is not installed.
        UnknownFormatError: if there is no topic of events.
        EventDataError: if the bag is damaged.
    """

    topic: str = field(default="")

    def _open(self) -> None:
        with self._messages() as (connection, messages):
            decoder = self._decoder(connection, Problems(str(self.path), strict=False))
            object.__setattr__(self, "topic", connection.topic)
            first = next(messages, None)
            width, height = (0, 0) if first is None else decoder.size(first)
        self._settle_size(width if 0 < width <= 1 << 16 else None, height if 0 < height <= 1 << 16 else None)

    def _read(self, max_events: int) -> Iterator[Columns]:
        waiting: list[bytes] = []
        size = 0
        with self._messages() as (connection, messages):
            decoder = self._decoder(connection, self.problems)
            for message in messages:
                waiting.append(message)
                size += len(message)
                if size >= _FEWEST_BYTES:
                    yield decoder.events(waiting)
                    waiting, size = [], 0
            yield decoder.events(waiting)

    def _decoder(self, connection: Any, problems: Problems) -> MessageDecoder:
        return MessageDecoder(_KINDS[connection.msgtype], not _is_ros1(self.path), problems)

    @contextmanager
    def _messages(self) -> Iterator[tuple[Any, Iterator[bytes]]]:
        """The connection with the events, and its messages; what the library raises becomes an :class:`EventDataError`."""
        purpose = f"reading '{self.path}'"
        if self.path.is_dir():
            _check_folder(self.path)
        module = optional("rosbags.rosbag1" if _is_ros1(self.path) else "rosbags.rosbag2", "rosbags", "ros", purpose)
        damaged = (module.ReaderError, *bounded_decompression(), *_DAMAGED)
        try:
            with module.Reader(self.path) as reader:
                unpack = take_over_messages(reader)
                known = [connection for connection in reader.connections if connection.msgtype in _KINDS]
                chosen = [connection for connection in known if self.topic in ("", connection.topic)]
                if not chosen:
                    topics = ", ".join(f"{connection.topic} ({connection.msgtype})" for connection in reader.connections) or "none"
                    wanted = f"topic '{self.topic}' of events" if self.topic else "topic of events"
                    raise UnknownFormatError(f"'{self.path}' has no {wanted} (event_camera_msgs or dvs_msgs). Its topics: {topics}.")
                same = [connection for connection in chosen if connection.topic == chosen[0].topic]
                yield chosen[0], (unpack(data) for _, _, data in reader.messages(connections=same))
        except TorchtrackError:
            raise
        except damaged as error:
            raise EventDataError(f"'{self.path}' is truncated or damaged ({type(error).__name__}: {error}). Copy it again.") from error


def _check_folder(path: Path) -> None:
    """Refuse a recording whose list of files costs too much to read, or which has a pipe or a device in the place of a file."""
    try:
        load_document(read_bytes(path / "metadata.yaml", "list of files", "text_bytes").decode("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise EventDataError(f"'{path / 'metadata.yaml'}' is damaged: {' '.join(str(error).split())}. Copy it again.") from error
    for file in path.iterdir():
        if not file.is_dir():
            check_is_file(file, "part of a recording")


def _is_ros1(path: Path) -> bool:
    if path.is_dir():
        return False
    with path.open("rb") as stream:
        return stream.read(len(ROS1_MAGIC)) == ROS1_MAGIC


def is_bag_folder(path: Path) -> bool:
    """Whether a folder is a recording of ROS 2."""
    return path.is_dir() and (path / "metadata.yaml").is_file()
