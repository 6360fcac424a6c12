"""RAW files of Prophesee cameras: a text header, and words of one of the encodings EVT2, EVT2.1 and EVT3."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from torchtrack.errors import UnknownFormatError
from torchtrack.io.columns import Columns, shifted
from torchtrack.io.event_file import EventFile
from torchtrack.io.evt2 import Evt2Decoder
from torchtrack.io.evt3 import Evt3Decoder
from torchtrack.io.evt21 import Evt21Decoder, is_legacy
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.prophesee_header import PropheseeHeader, read_header

# Small enough that a block and what is made of it stay in the processor's cache.
_BLOCK_BYTES = 1 << 18
_ESTIMATE_BYTES = 1 << 20
_HD, _VGA = (1280, 720), (640, 480)


WordDecoder = Evt2Decoder | Evt21Decoder | Evt3Decoder


@dataclass(frozen=True)
class RawFile(EventFile):
    """Events of a RAW file; see :class:`torchtrack.io.event_file.EventFile`.

    Where the header does not say the sensor size, that of the camera's generation is taken, else 640x480 for EVT2 and
    1280x720 for the others.

    Raises:
        UnknownFormatError: if there is no header of a RAW file, or the encoding is not known.
    """

    encoding: str = field(init=False, default="")
    offset: int = field(init=False, default=0)
    legacy: bool = field(init=False, default=False)
    base_us: int = field(init=False, default=0)

    @property
    def known_count(self) -> int | None:
        """An estimate: as many events per byte as at the beginning."""
        decoder = self.decoder(Problems(str(self.path), strict=False))
        with self.path.open("rb") as stream:
            stream.seek(self.offset)
            data = stream.read(_ESTIMATE_BYTES)
        whole = len(data) // decoder.dtype.itemsize
        if whole == 0:
            return 0
        count = len(decoder.feed(np.frombuffer(data, decoder.dtype, count=whole)))
        return round(count * (self.path.stat().st_size - self.offset) / len(data))

    def decoder(self, problems: Problems) -> WordDecoder:
        """A decoder for this file's words."""
        return make_decoder(self.encoding, problems, self.legacy)

    def _open(self) -> None:
        header = read_header(self.path) or PropheseeHeader({}, 0)
        encoding = header.encoding or "unknown: none given"
        if encoding not in ("evt2", "evt21", "evt3"):
            raise UnknownFormatError(f"'{self.path}' is no RAW file of a known encoding (EVT2, EVT2.1 or EVT3): {encoding}.")
        object.__setattr__(self, "encoding", encoding)
        object.__setattr__(self, "offset", header.offset)
        object.__setattr__(self, "base_us", header.time_base_us)
        if encoding == "evt21":
            object.__setattr__(self, "legacy", _legacy(header, self.path))
        self._settle_size(*header.size, default=header.default_size or (_VGA if encoding == "evt2" else _HD))

    def _read(self, max_events: int) -> Iterator[Columns]:
        decoder = self.decoder(self.problems)
        with self._bytes() as stream:
            stream.seek(self.offset)
            if self.start_us is not None:
                decoder = _skip_to(stream, decoder, self.start_us - self.base_us, self.problems)
            for words in words_of(stream, decoder.dtype, self.problems):
                events = decoder.feed(words)
                yield replace(events, t_us=shifted(events.t_us, self.base_us))
            left = decoder.finish()
            yield replace(left, t_us=shifted(left.t_us, self.base_us))


def make_decoder(encoding: str, problems: Problems, legacy: bool = False) -> WordDecoder:
    """A decoder for ``evt2``, ``evt21`` or ``evt3``; ``legacy``: EVT2.1 words come with their halves exchanged."""
    if encoding == "evt2":
        return Evt2Decoder(problems)
    return Evt21Decoder(problems, legacy) if encoding == "evt21" else Evt3Decoder(problems)


def words_of(stream: BinaryIO, dtype: np.dtype, problems: Problems) -> Iterator[np.ndarray]:
    """A stream of bytes as blocks of words; bytes that are left over at the end count as damaged."""
    rest = b""
    while data := stream.read(_BLOCK_BYTES):
        data = rest + data if rest else data
        whole = len(data) - len(data) % dtype.itemsize
        rest = data[whole:]
        if whole:
            yield np.frombuffer(data, dtype, count=whole // dtype.itemsize)
    problems.record(Problem.DAMAGED, bool(rest), f"it ends within a word: {len(rest)} bytes are left over. Copy it again.")


def _skip_to(stream: BinaryIO, decoder: WordDecoder, start_us: int, problems: Problems) -> WordDecoder:
    """Leave the stream at a block that may hold ``start_us``; returns a decoder that knows what was before it."""
    while True:
        # Its clock is a copy, too: what is looked at beyond this place must not move it. Faults are counted in one place.
        at, before = stream.tell(), copy.deepcopy(decoder, {id(problems): problems})
        words = np.frombuffer(stream.read(_BLOCK_BYTES)[: _BLOCK_BYTES // 8 * 8], np.uint8)
        words = words[: len(words) // decoder.dtype.itemsize * decoder.dtype.itemsize].view(decoder.dtype)
        reached = decoder.skip(words)
        if len(words) == 0 or (reached is not None and reached >= start_us):
            stream.seek(at)
            return before


def _legacy(header: PropheseeHeader, path: Path) -> bool:
    """Whether the halves of EVT2.1 words are exchanged: as the header says, else as the words make sense."""
    endianness = header.options.get("endianness")
    if endianness is not None:
        return endianness == "legacy"
    with path.open("rb") as stream:
        stream.seek(header.offset)
        data = stream.read(_BLOCK_BYTES)
    return is_legacy(np.frombuffer(data, "<u8", count=len(data) // 8))
