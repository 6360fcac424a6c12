r"""AEDAT 4 files of iniVation's cameras, read without their library: damage costs a packet, not the process.

After ``#!AER-DAT4.0\r\n`` comes a flatbuffer with the compression and a description of the streams (XML), then packets:
``stream:32 size:32`` and a compressed flatbuffer. A packet of events is a vector of 16 bytes each: ``t:64`` (µs),
``x:16 y:16 on:8``. Packets may be compressed as LZ4 or Zstandard frames (extra ``aedat``).

Reference: docs.inivation.com, AEDAT file formats.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from torchtrack.core.limits import current_limits
from torchtrack.errors import EventDataError, UnknownFormatError
from torchtrack.io.columns import Columns
from torchtrack.io.event_file import EventFile
from torchtrack.io.extras import optional
from torchtrack.io.flatbuffer import field_offset, root_table, vector, whole
from torchtrack.io.one_of_several import chosen_stream
from torchtrack.io.problems import Problem

AEDAT4_MAGIC = b"#!AER-DAT4.0\r\n"
_EVENT = np.dtype({"names": ["t", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "u1"], "offsets": [0, 8, 10, 12], "itemsize": 16})
_LARGEST_HEADER, _LARGEST_PACKET = 1 << 24, 1 << 27
# What Zstandard itself takes for granted.
_LARGEST_WINDOW = 1 << 27
# Small packets are decoded together.
_FEWEST_BYTES = 1 << 20
_NODE = re.compile(r'<node name="(\d{1,9})" path="[^"<]*/outInfo/\d{1,9}/">')
_NONE, _LZ4, _ZSTD = (0,), (1, 2), (3, 4)


@dataclass(frozen=True)
class Aedat4File(EventFile):
    """Events of an AEDAT 4 file, of one of its streams of events; see :class:`torchtrack.io.event_file.EventFile`.

    Raises:
        UnknownFormatError: if it is no AEDAT 4 file, or has no events.
        MissingExtraError: if what its compression needs is not installed.
    """

    has_streams: ClassVar[bool] = True

    stream_id: int = field(init=False, default=0)
    compression: int = field(init=False, default=0)
    offset: int = field(init=False, default=0)
    end: int = field(init=False, default=-1)

    def _open(self) -> None:
        with self.path.open("rb") as stream:
            magic = stream.read(len(AEDAT4_MAGIC))
            if magic != AEDAT4_MAGIC:
                raise UnknownFormatError(f"'{self.path}' is no AEDAT 4 file; it starts with {magic!r}.")
            size = int.from_bytes(stream.read(4), "little")
            header = stream.read(min(size, _LARGEST_HEADER))
        if len(header) != size:
            raise EventDataError(f"'{self.path}' is truncated or damaged: its header should have {size} bytes. Copy it again.")
        compression, end, description = self._parse_header(header)
        streams = _event_streams(description)
        if not streams:
            raise UnknownFormatError(f"'{self.path}' holds no stream of events.")
        chosen = streams[chosen_stream(tuple(streams), self.choices.topic, f"'{self.path}'")]
        values = {"stream_id": chosen[0], "compression": compression, "offset": len(AEDAT4_MAGIC) + 4 + size, "end": end, "streams": tuple(streams)}
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self._settle_size(chosen[1], chosen[2])
        # Told at once, not at the first packet.
        _decompressor(self.compression, self.path)

    def _parse_header(self, header: bytes) -> tuple[int, int, str]:
        try:
            table = root_table(header)
            compression = whole(header, field_offset(header, table, 0), 4, default=0)
            end = whole(header, field_offset(header, table, 1), 8, default=-1)
            start, count = vector(header, field_offset(header, table, 2))
        except EventDataError as error:
            raise EventDataError(f"'{self.path}': its header is damaged ({error}). Copy it again.") from error
        return compression, end, header[start : start + count].decode("utf-8", errors="replace")

    def _read(self, max_events: int) -> Iterator[Columns]:
        decompress = _decompressor(self.compression, self.path)
        waiting: list[bytes] = []
        with self._bytes() as stream:
            stream.seek(self.offset)
            for packet in self._packets(stream):
                try:
                    content = decompress(packet)
                    table = root_table(content, prefixed=True)
                    start, count = vector(content, field_offset(content, table, 0), _EVENT.itemsize)
                except EventDataError as error:
                    self.problems.record(Problem.DAMAGED, 1, f"a packet of events is damaged ({error}). Copy it again.")
                    continue
                waiting.append(content[start : start + count * _EVENT.itemsize])
                if sum(map(len, waiting)) >= _FEWEST_BYTES:
                    yield _events(waiting)
                    waiting = []
        yield _events(waiting)

    def _packets(self, stream: BinaryIO) -> Iterator[bytes]:
        """The packets of the stream of events."""
        size_now = self.path.stat().st_size
        last = self.end if self.end >= self.offset else size_now
        while stream.tell() < last:
            head = stream.read(8)
            stream_id, size = int.from_bytes(head[:4], "little", signed=True), int.from_bytes(head[4:], "little", signed=True)
            if len(head) < 8 or not 0 <= size <= _LARGEST_PACKET or stream.tell() + size > size_now:
                self.problems.record(Problem.DAMAGED, 1, f"it ends within a packet at byte {stream.tell()}, or is damaged there. Copy it again.")
                return
            if stream_id == self.stream_id:
                yield stream.read(size)
            else:
                stream.seek(size, 1)


def _events(parts: list[bytes]) -> Columns:
    table = np.frombuffer(b"".join(parts), _EVENT)
    return Columns(table["t"].astype(np.int64), table["x"].astype(np.int32), table["y"].astype(np.int32), table["on"].copy())


def _event_streams(description: str) -> dict[str, tuple[int, int | None, int | None]]:
    """Number, width and height of each stream of events, by the camera it is from; by its number where that does not tell them apart."""
    named_streams: list[tuple[str, tuple[int, int | None, int | None]]] = []
    starts = list(_NODE.finditer(description))
    ends = [match.start() for match in starts[1:]] + [len(description)]
    # Of no node there is still an end.
    for match, end in zip(starts, ends, strict=False):
        number, content = match[1], description[match.end() : end]
        if re.search(r'key="typeIdentifier" type="string">EVTS<', content):
            sizes = [re.search(rf'key="size{axis}" type="int">(\d{{1,5}})<', content) for axis in "XY"]
            width, height = (int(size[1]) if size else None for size in sizes)
            camera = re.search(r'key="source" type="string">([^<]+)<', content)
            named_streams.append((camera[1] if camera else number, (int(number), width, height)))
    distinct = len({name for name, _ in named_streams}) == len(named_streams)
    return {name if distinct else str(stream[0]): stream for name, stream in named_streams}


def _whole(content: bytes) -> bytes:
    """What a packet holds, if that is no more than the limit."""
    most = current_limits().block_bytes
    if len(content) > most:
        raise EventDataError(f"it holds more than {most:,} bytes; the setting limits.block_bytes raises this")
    return content


def _decompressor(compression: int, path: Path) -> Any:
    """A function from a packet's bytes to its content, which raises :class:`EventDataError` over damage."""
    if compression in _NONE:
        return bytes
    purpose = f"reading '{path}'"
    if compression in _LZ4:
        lz4 = optional("lz4.frame", "lz4", "aedat", purpose)

        def unpack(packet: bytes) -> bytes:
            try:
                return _whole(lz4.LZ4FrameDecompressor().decompress(packet, max_length=current_limits().block_bytes + 1))
            except (RuntimeError, ValueError, EOFError, MemoryError) as error:
                raise EventDataError(f"LZ4: {error}") from error

        return unpack
    if compression in _ZSTD:
        zstd = optional("zstandard", "zstandard", "aedat", purpose)

        def unpack_zstd(packet: bytes) -> bytes:
            try:
                # A stream gives no more than it is asked for, whatever the frame says.
                with zstd.ZstdDecompressor(max_window_size=_LARGEST_WINDOW).stream_reader(packet) as stream:
                    return _whole(stream.read(current_limits().block_bytes + 1))
            except (zstd.ZstdError, MemoryError) as error:
                raise EventDataError(f"Zstandard: {error}") from error

        return unpack_zstd
    raise EventDataError(f"'{path}' says that its packets are compressed in way {compression}, which is not known. Copy it again.")
