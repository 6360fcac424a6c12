"""DAT files of Prophesee: a text header, two bytes (kind and size of an event), and events of 64 bits.

An event is ``t:32`` (µs) and then ``x:14 y:14 polarity:4``, lowest bits first. The clock wraps after 71.6 minutes.

Reference: docs.prophesee.ai, DAT file format, version 2.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from torchtrack.errors import UnknownFormatError
from torchtrack.io.columns import Columns
from torchtrack.io.event_file import EventFile
from torchtrack.io.prophesee_header import read_header
from torchtrack.io.raw_file import words_of

_EVENT_BYTES = 8
_KINDS = (0x00, 0x0C)
# The ATIS, the camera of the data sets that come without a size.
_DEFAULT_SIZE = (304, 240)
_CLOCK_BITS = 32


@dataclass(frozen=True)
class DatFile(EventFile):
    """Events of a DAT file; see :class:`torchtrack.io.event_file.EventFile`.

    Where the header does not say the sensor size, 304x240 is taken.

    Raises:
        UnknownFormatError: if it is no DAT file of version 2, or one of something other than events.
    """

    offset: int = field(init=False, default=0)

    @property
    def known_count(self) -> int | None:
        """How many events there are."""
        return max(self.path.stat().st_size - self.offset, 0) // _EVENT_BYTES

    @property
    def counter_bits(self) -> int | None:
        """Of how many bits the counter of µs is."""
        return _CLOCK_BITS

    def _open(self) -> None:
        header = read_header(self.path)
        if header is None or header.encoding != "dat" or header.fields.get("version", "2") != "2":
            raise UnknownFormatError(f"'{self.path}' has no header of a DAT file of version 2.")
        with self.path.open("rb") as stream:
            stream.seek(header.offset)
            kind_and_size = stream.read(2)
        if len(kind_and_size) == 2 and (kind_and_size[0] not in _KINDS or kind_and_size[1] != _EVENT_BYTES):
            raise UnknownFormatError(
                f"'{self.path}' holds entries of kind {kind_and_size[0]} with {kind_and_size[1]} bytes, expected events: kind 0 or 12 with 8 bytes."
            )
        object.__setattr__(self, "offset", header.offset + 2)
        self._settle_size(*header.size, default=_DEFAULT_SIZE)

    def _read(self, max_events: int) -> Iterator[Columns]:
        with self._bytes() as stream:
            stream.seek(self.offset)
            for words in words_of(stream, np.dtype("<u8"), self.problems):
                shown, address = words.view("<u4")[0::2], words.view("<u4")[1::2]
                yield Columns(
                    shown.astype(np.int64), (address & 0x3FFF).astype(np.uint16), ((address >> 14) & 0x3FFF).astype(np.uint16), address >> 28 > 0
                )
