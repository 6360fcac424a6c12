"""Text files of events: out of a zip archive where they lie in one, in UTF-8 or UTF-16, in blocks of whole lines."""

import codecs
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

from torchtrack.errors import EventDataError
from torchtrack.io.event_file import EventFile
from torchtrack.io.zip_archive import damage_reported, is_zip, open_archive

HEAD_BYTES = 1 << 16
# So many of the first lines are looked at before a file is read.
ENOUGH_LINES = 1000
_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_SUFFIXES = (".txt", ".csv", ".tsv")


@runtime_checkable
class Readable(Protocol):
    """What bytes are read from."""

    def read(self, size: int = -1, /) -> bytes:
        """The next bytes: up to ``size`` of them."""
        ...


class TextFile(EventFile):
    """The base of readers of text; see :class:`torchtrack.io.event_file.EventFile`."""

    @contextmanager
    def _stream(self) -> Iterator[Readable]:
        """The text as UTF-8, out of its archive where it lies in one."""
        if not is_zip(self.path):
            with self._bytes() as stream:
                yield as_utf8(cast(BufferedIOBase, stream))
            return
        with open_archive(self.path) as archive:
            member = text_member(archive)
            if member is None:
                raise EventDataError(f"'{self.path}' is a zip archive without a text file of events.")
            with damage_reported(self.path), archive.open(member) as text:
                self.reading.stream, self.reading.size_bytes = text, archive.getinfo(member).file_size
                yield as_utf8(cast(BufferedIOBase, text))

    def _head(self) -> bytes:
        """The beginning of the text, as UTF-8."""
        with self._stream() as stream, damage_reported(self.path):
            return stream.read(HEAD_BYTES)


def text_member(archive: zipfile.ZipFile) -> str | None:
    """The text file of an archive that holds the events: one called ``events``, or the largest."""
    texts = [entry for entry in archive.infolist() if entry.filename.lower().endswith(_SUFFIXES) and not _is_hidden(entry.filename)]
    return max(texts, key=lambda entry: (Path(entry.filename).stem == "events", entry.file_size)).filename if texts else None


def _is_hidden(name: str) -> bool:
    """Whether a member is what macOS puts beside each file."""
    return name.startswith("__MACOSX/") or Path(name).name.startswith("._")


def as_utf8(stream: BufferedIOBase) -> Readable:
    """The same text as UTF-8 without a byte order mark."""
    mark = stream.read(3)
    if mark.startswith(_UTF16_MARKS):
        stream.seek(0)
        return cast(Readable, codecs.EncodedFile(stream, "utf-8", "utf-16", errors="replace"))
    if mark != codecs.BOM_UTF8:
        stream.seek(0)
    return stream


def utf8_head(head: bytes) -> bytes:
    """The beginning of a file as UTF-8 without a byte order mark, where it is text; as it is where it is not."""
    if head.startswith(_UTF16_MARKS):
        return head[: len(head) // 2 * 2].decode("utf-16", errors="replace").encode()
    return head.removeprefix(codecs.BOM_UTF8)


def whole_lines(head: bytes) -> str:
    """The whole lines at the beginning of a text: a last one that is cut off is left out."""
    cut = head.rfind(b"\n") + 1 if len(head) >= HEAD_BYTES else len(head)
    return head[:cut].decode("utf-8", errors="replace")
