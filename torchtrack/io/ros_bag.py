"""Events in ROS bags: ROS 1 ``.bag``, ROS 2 ``.db3`` and ``.mcap``, as one file or as the folder of a recording (extra ``ros``)."""

import re
import sqlite3
import struct
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import yaml

from torchtrack.core.files import check_is_file, read_bytes
from torchtrack.core.yaml_text import load_document
from torchtrack.errors import EventDataError, TorchtrackError, TorchtrackWarning, UnknownFormatError
from torchtrack.io.columns import Columns
from torchtrack.io.event_file import EventFile
from torchtrack.io.extras import optional
from torchtrack.io.one_of_several import chosen_stream
from torchtrack.io.problems import Problems
from torchtrack.io.ros_compression import bounded_decompression, take_over_messages
from torchtrack.io.ros_messages import ARRAYS, PACKETS, MessageDecoder

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
# The list of the files of a recording of ROS 2.
_LIST = "metadata.yaml"
# Small messages are decoded together.
_FEWEST_BYTES = 1 << 18


@dataclass(frozen=True)
class RosBag(EventFile):
    """Events of the first topic of a bag that has events, or of the one chosen; see :class:`torchtrack.io.event_file.EventFile`.

    Times are those of the events: sensor time with the encoding evt3, ROS time otherwise.

    Raises:
        MissingExtraError: if the library that reads bags is not installed.
        UnknownFormatError: if there is no topic of events.
        EventDataError: if the bag is damaged.
    """

    has_streams: ClassVar[bool] = True

    topic: str = field(init=False, default="")
    message_count: int = field(init=False, default=0)

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
            for number, message in enumerate(messages, 1):
                self.reading.position = number / self.message_count if self.message_count else None
                waiting.append(message)
                size += len(message)
                if size >= _FEWEST_BYTES:
                    yield decoder.events(waiting)
                    waiting, size = [], 0
            yield decoder.events(waiting)
            yield decoder.rest()

    def _decoder(self, connection: Any, problems: Problems) -> MessageDecoder:
        return MessageDecoder(_KINDS[connection.msgtype], not _is_ros1(self.path), problems)

    @contextmanager
    def _messages(self) -> Iterator[tuple[Any, Iterator[bytes]]]:
        """The connection with the events, and its messages; what the library raises becomes an :class:`EventDataError`."""
        purpose = f"reading '{self.path}'"
        parts = _parts(self.path)
        module = optional("rosbags.rosbag1" if _is_ros1(self.path) else "rosbags.rosbag2", "rosbags", "ros", purpose)
        damaged = (module.ReaderError, *bounded_decompression(), *_DAMAGED)
        try:
            with ExitStack() as stack:
                readers = [stack.enter_context(module.Reader(part)) for part in parts]
                unpack = [take_over_messages(reader) for reader in readers]
                chosen = [self._of_topic(reader.connections) for reader in readers]
                first = next(connections[0] for connections in chosen if connections)
                object.__setattr__(self, "message_count", sum(connection.msgcount for same in chosen for connection in same))
                read = zip(readers, unpack, chosen, strict=True)
                yield first, (undo(data) for reader, undo, same in read if same for _, _, data in reader.messages(connections=same))
        except TorchtrackError:
            raise
        except damaged as error:
            fault = f"'{self.path}' is truncated or damaged ({type(error).__name__}: {' '.join(str(error).split())})"
            raise EventDataError(f"{fault}. {_advice(self.path)}") from error

    def _of_topic(self, connections: list[Any]) -> list[Any]:
        """The connections of the topic to read; which one that is, is settled by the first part."""
        known = [connection for connection in connections if connection.msgtype in _KINDS]
        if not self.topic:
            if not known:
                topics = ", ".join(f"{connection.topic} ({connection.msgtype})" for connection in connections) or "none"
                raise UnknownFormatError(f"'{self.path}' has no topic of events (event_camera_msgs or dvs_msgs). Its topics: {topics}.")
            streams = tuple(dict.fromkeys(connection.topic for connection in known))
            object.__setattr__(self, "streams", streams)
            object.__setattr__(self, "topic", chosen_stream(streams, self.choices.topic, f"'{self.path}'"))
        return [connection for connection in known if connection.topic == self.topic]


def _parts(path: Path) -> list[Path]:
    """What to open: the file or folder itself, or the files of a folder that has no list of them, which is told."""
    if not path.is_dir():
        return [path]
    if (path / _LIST).exists():
        _check_folder(path)
        return [path]
    files = sorted(_files_of(path), key=lambda file: [int(word) if word.isdigit() else word for word in re.split(r"(\d+)", file.name)])
    for file in files:
        check_is_file(file, "part of a recording")
    names = ", ".join(file.name for file in files)
    message = f"'{path}' has no {_LIST}: {names} are read in this order. `ros2 bag reindex {path}` makes the list anew."
    warnings.warn(message, TorchtrackWarning, stacklevel=2)
    return files


def _files_of(folder: Path) -> list[Path]:
    return [file for file in folder.iterdir() if file.suffix in (".db3", ".mcap")]


def _advice(path: Path) -> str:
    """How a recording that was broken off, or damaged, is made readable by the tools of its makers."""
    if path.is_dir():
        return f"Try `ros2 bag reindex {path}`, or give one of its .db3 or .mcap files itself."
    if _is_ros1(path):
        return f"If its recording was broken off, `rosbag reindex {path}` writes the index that is missing."
    if path.suffix == ".mcap":
        return f"If its recording was broken off, `mcap recover {path} -o recovered.mcap` keeps what can be read."
    return f"If its recording was broken off, `sqlite3 {path} .recover | sqlite3 recovered.db3` keeps what can be read."


def _check_folder(path: Path) -> None:
    """Refuse a recording whose list of files costs too much to read, or which has a pipe or a device in the place of a file."""
    try:
        load_document(read_bytes(path / _LIST, "list of files", "text_bytes").decode("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise EventDataError(f"'{path / _LIST}' is damaged: {' '.join(str(error).split())}. {_advice(path)}") from error
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
    return path.is_dir() and ((path / _LIST).is_file() or bool(_files_of(path)))
