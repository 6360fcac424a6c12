"""Events in the text format of the DAVIS data sets: a line ``t x y p`` each, ``t`` in seconds, polarity 1 = brighter.

The file may lie in a zip archive. Lines that begin with ``#`` and blank lines are skipped. Times are parsed as decimals,
never through binary floats, and rounded to the nearest microsecond, halves up: ``2.097134001`` is 2097134 µs.

The file is read in blocks of a few MB. A block of plain lines is parsed with whole-array operations on its bytes; one
that holds anything else (a comment, an exponent, a sign) is halved until the odd lines stand alone, and those are read
one by one.
"""

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import cast

import numpy as np

from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns, join
from torchtrack.io.digits import digits
from torchtrack.io.event_file import EventFile
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.seconds import parse_seconds
from torchtrack.io.zip_archive import damage_reported, is_zip, open_archive

DAVIS240C_SIZE = (240, 180)
_BLOCK_BYTES = 2 << 20
_HEAD_BYTES = 1 << 16
_FEW_BYTES = 512
_EXPECTED = "expected 't x y p' (seconds, pixels, polarity 0 or 1)"

_NEWLINE, _DOT = b"\n."
_IS_SPACE = np.zeros(256, dtype=bool)
_IS_SPACE[list(b" \t\r\n")] = True
_IS_PLAIN = _IS_SPACE.copy()
_IS_PLAIN[list(b"0123456789.")] = True
# More digits than these may overflow on the way and are left to exact integers.
_MOST_DIGITS = {"seconds": 12, "pixel": 9}
_FRACTION_DIGITS = 6


@dataclass(frozen=True)
class DavisTextEvents(EventFile):
    """Events of a DAVIS text file; see :class:`torchtrack.io.event_file.EventFile`.

    The sensor size is that of the DAVIS240C, 240x180, when neither width nor height is given.

    Raises:
        EventDataError: if the first event cannot be read, times are not in seconds, or only one of width and height is
            given.
    """

    def _open(self) -> None:
        if not self.width and not self.height:
            for name, value in zip(("width", "height"), DAVIS240C_SIZE, strict=True):
                object.__setattr__(self, name, value)
        with self._stream() as stream, damage_reported(self.path):
            head = stream.read(_HEAD_BYTES)
        _check_head(head, self.path, Problems(str(self.path), strict=True))

    @contextmanager
    def _stream(self) -> Iterator[BufferedIOBase]:
        """The text, out of its archive where it lies in one."""
        if not is_zip(self.path):
            with self.path.open("rb") as stream:
                yield stream
            return
        with open_archive(self.path) as archive:
            member = text_member(archive)
            if member is None:
                raise EventDataError(f"'{self.path}' is a zip archive without a text file of events.")
            with damage_reported(self.path), cast(BufferedIOBase, archive.open(member)) as text:
                yield text

    def _read(self, max_events: int) -> Iterator[Columns]:
        line_number = 1
        with self._stream() as stream:
            for block in _blocks(stream, self.path):
                # One batch a block, however small the pieces were: those who cut windows pay for every batch.
                yield join(_parse(block, line_number, self.problems))
                line_number += block.count(b"\n")


def text_member(archive: zipfile.ZipFile) -> str | None:
    """The text file of an archive that holds the events: ``events.txt``, or the largest."""
    texts = [entry for entry in archive.infolist() if entry.filename.lower().endswith(".txt")]
    return max(texts, key=lambda entry: (Path(entry.filename).name == "events.txt", entry.file_size)).filename if texts else None


def looks_like_davis_text(head: bytes) -> bool:
    """Whether the beginning of a file reads as DAVIS text: its first line with content does (or there is none)."""
    try:
        for line in head.split(b"\n"):
            if _parse_line(line) is not None:
                return True
    except ValueError:
        return False
    return True


def _check_head(head: bytes, path: Path, problems: Problems) -> None:
    """Raise over a first line that is no event, and times that must be microseconds, without reading on."""
    times: list[bytes] = []
    for number, line in enumerate(head.split(b"\n"), start=1):
        if line.partition(b"#")[0].strip():
            if not times:
                _parse_line_of(line, number, problems)
            times.append(line.split()[0])
    whole = times[:-1]
    if len(set(whole)) > 1 and all(time.isdigit() for time in whole):
        raise EventDataError(
            f"{path}: times {whole[0].decode()}, {whole[1].decode()}, … have no decimals, but DAVIS text has seconds. Divide microseconds by 1e6."
        )


def _blocks(stream: BufferedIOBase, path: Path) -> Iterator[bytes]:
    """The text in blocks of whole lines, each ending with a newline."""
    rest = b""
    while data := stream.read(_BLOCK_BYTES):
        cut = data.rfind(b"\n") + 1
        if cut:
            yield rest + data[:cut]
            rest = data[cut:]
        else:
            rest += data
        if len(rest) > _BLOCK_BYTES:
            raise EventDataError(f"{path}: a line is longer than {_BLOCK_BYTES} bytes; this is not a text file of events.")
    if rest:
        yield rest + b"\n"


def _parse(block: bytes, line_number: int, problems: Problems) -> Iterator[Columns]:
    """Events of whole lines: at once if all are plain, else by halves, and line by line in the end."""
    columns = _parse_plain(block)
    if columns is not None:
        yield columns
    elif len(block) <= _FEW_BYTES or (middle := block.find(b"\n", len(block) // 2) + 1) in (0, len(block)):
        yield _parse_lines(block, line_number, problems)
    else:
        yield from _parse(block[:middle], line_number, problems)
        yield from _parse(block[middle:], line_number + block.count(b"\n", 0, middle), problems)


def _parse_plain(block: bytes) -> Columns | None:
    """Events of a block where every line is ``digits.digits digits digits 0|1``, or None if any is not."""
    # Padding: digits are looked up at fixed places, which may lie past the last line.
    data = np.frombuffer(block + b" " * (_FRACTION_DIGITS + 2), np.uint8)
    if not _IS_PLAIN[data].all():
        return None
    space = _IS_SPACE[data]
    borders = np.flatnonzero(space[1:] != space[:-1]) + 1
    if not space[0]:
        borders = np.concatenate([[0], borders])
    newlines = np.flatnonzero(data == _NEWLINE)
    if len(borders) != 8 * len(newlines):
        return None
    starts, ends = borders[0::2].reshape(-1, 4).T, borders[1::2].reshape(-1, 4).T
    dots = np.flatnonzero(data == _DOT)
    if not _is_regular(starts, ends, newlines, dots):
        return None
    polarity = data[starts[3]] - ord("0")
    if (polarity > 1).any():
        return None
    t_us = 1_000_000 * digits(data, starts[0], dots) + _microseconds(data, dots + 1, ends[0])
    return Columns(t_us, digits(data, starts[1], ends[1]), digits(data, starts[2], ends[2]), polarity)


def _is_regular(starts: np.ndarray, ends: np.ndarray, newlines: np.ndarray, dots: np.ndarray) -> bool:
    """Whether every line has its four words, the only dot in the first and within it, and no word too long."""
    return bool(
        len(dots) == len(newlines)
        and (starts[0, 1:] > newlines[:-1]).all()
        and (ends[3] <= newlines).all()
        and (dots > starts[0]).all()
        and (dots < ends[0]).all()
        and (ends[3] - starts[3] == 1).all()
        and (dots - starts[0]).max() <= _MOST_DIGITS["seconds"]
        and (ends[1:3] - starts[1:3]).max() <= _MOST_DIGITS["pixel"]
    )


def _microseconds(data: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Decimals of a second in µs, rounded by their seventh digit: whatever follows cannot change where it falls."""
    lengths = ends - starts
    value = np.zeros(len(starts), dtype=np.int64)
    for place in range(_FRACTION_DIGITS):
        digit = data[starts + place] - np.uint8(ord("0"))
        value = 10 * value + np.where(place < lengths, digit, 0)
    return value + ((lengths > _FRACTION_DIGITS) & (data[starts + _FRACTION_DIGITS] >= ord("5")))


def _parse_lines(block: bytes, line_number: int, problems: Problems) -> Columns:
    events = (_parse_line_of(line, number, problems) for number, line in enumerate(block.split(b"\n"), start=line_number))
    table = np.array([event for event in events if event is not None], dtype=np.int64).reshape(-1, 4)
    return Columns(*table.T)


def _parse_line_of(line: bytes, number: int, problems: Problems) -> tuple[int, int, int, int] | None:
    try:
        return _parse_line(line)
    except ValueError as error:
        shown = line[:80].decode("utf-8", errors="replace").strip()
        problems.found(Problem.MALFORMED, 1, f"line {number}: {_EXPECTED}, got '{shown}': {error}.")
        return None


def _parse_line(line: bytes) -> tuple[int, int, int, int] | None:
    """``t_us, x, y, polarity`` of one line; None if it holds nothing but a comment; ValueError if it is malformed."""
    words = line.partition(b"#")[0].decode("ascii", errors="replace").split()
    if not words:
        return None
    if len(words) != 4:
        raise ValueError(f"it has {len(words)} columns")
    if b"_" in line:
        raise ValueError("numbers hold no underscores")
    t_us, x, y, polarity = parse_seconds(words[0]), _whole(words[1]), _whole(words[2]), _whole(words[3])
    if polarity not in (-1, 0, 1):
        raise ValueError(f"polarity {polarity} is none of 0, 1 and -1")
    return t_us, x, y, polarity


def _whole(word: str) -> int:
    """A pixel coordinate or polarity; ``162.0`` counts as whole, ``162.5`` does not."""
    value = float(word)
    if not value.is_integer() or abs(value) >= 2**31:
        raise ValueError(f"'{word}' is not a whole number of pixels or a polarity")
    return int(value)
