"""Events in the text format of the DAVIS data sets: a line ``t x y p`` each, ``t`` in seconds, polarity 1 = brighter.

The file may lie in a zip archive. Lines that begin with ``#`` and blank lines are skipped. Times are parsed as decimals,
never through binary floats, and rounded to the nearest microsecond, halves up: ``2.097134001`` is 2097134 µs.

The file is read in blocks of a few MB. A block of plain lines is parsed with whole-array operations on its bytes; one
that holds anything else (a comment, an exponent, a sign) is halved until the odd lines stand alone, and those are read
one by one.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from torchtrack.config.events import ReadingConfig, TimeUnit
from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns, join
from torchtrack.io.digits import digits, whole_numbers
from torchtrack.io.plausibility import EVENTS, settled_unit, whole_microseconds
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.seconds import parse_time
from torchtrack.io.text_file import ENOUGH_LINES, Readable, TextFile, whole_lines
from torchtrack.io.text_words import as_numbers, parse_whole, settled_polarity

DAVIS240C_SIZE = (240, 180)
_BLOCK_BYTES = 2 << 20
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
class DavisTextEvents(TextFile):
    """Events of a DAVIS text file; see :class:`torchtrack.io.event_file.EventFile`.

    The sensor size is that of the DAVIS240C, 240x180, when neither width nor height is given.

    Raises:
        EventDataError: if the first event cannot be read, times are not in seconds, or only one of width and height is
            given.
    """

    unit_is_open: ClassVar[bool] = True

    unit: TimeUnit = field(init=False, default="s")

    def _open(self) -> None:
        if not self.width and not self.height:
            for name, value in zip(("width", "height"), DAVIS240C_SIZE, strict=True):
                object.__setattr__(self, name, value)
        head = self._head()
        rows = [words for line in whole_lines(head).splitlines()[:ENOUGH_LINES] if len(words := line.partition("#")[0].split()) == 4]
        settled_polarity([words[3] for words in rows], self.choices.polarity, Problems(str(self.path), strict=False))
        object.__setattr__(self, "unit", _unit(head, self.choices, Problems(str(self.path), strict=True)))

    def _read(self, max_events: int) -> Iterator[Columns]:
        line_number = 1
        words = _Words.from_choices(self.choices, self.unit)
        with self._stream() as stream:
            for block in _blocks(stream, self.path):
                # One batch a block, however small the pieces were: those who cut windows pay for every batch.
                yield join(_parse(block, line_number, words, self.problems))
                line_number += block.count(b"\n")


@dataclass(frozen=True)
class _Words:
    """What the words of a line mean: the unit of its time, and whether its polarity may be any number, as the user says what it means."""

    unit: TimeUnit = "s"
    any_polarity: bool = False

    @classmethod
    def from_choices(cls, choices: ReadingConfig, unit: TimeUnit) -> "_Words":
        """As the user chooses."""
        return cls(unit, isinstance(choices.polarity, int))


def looks_like_davis_text(head: bytes) -> bool:
    """Whether the beginning of a file reads as DAVIS text: its first line with content does (or there is none)."""
    try:
        for line in head.split(b"\n"):
            if _parse_line(line, _Words(any_polarity=True)) is not None:
                return True
    except ValueError:
        return False
    return True


def _unit(head: bytes, choices: ReadingConfig, problems: Problems) -> TimeUnit:
    """The unit of the times: seconds, where nobody says another and they can be. Raises over a first line that is no event."""
    times: list[str] = []
    for number, line in enumerate(whole_lines(head).encode().split(b"\n")[:ENOUGH_LINES], start=1):
        words = line.partition(b"#")[0].split()
        if words:
            if not times:
                _parse_line_of(line, number, _Words.from_choices(choices, choices.time_unit or "s"), problems)
            times.append(words[0].decode("ascii", errors="replace"))
    whole = sorted(set(times), key=times.index)
    if choices.time_unit is None and len(whole) > 1 and all(time.isdigit() for time in whole):
        raise EventDataError(
            f"{problems.source}: times {whole[0]}, {whole[1]}, … have no decimals, but DAVIS text has seconds. "
            f"Divide microseconds by 1e6, or set {EVENTS.setting} to us (or s, ms or ns)."
        )
    return settled_unit(as_numbers(times), "s", choices.time_unit, problems.source)


def _blocks(stream: Readable, path: Path) -> Iterator[bytes]:
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


def _parse(block: bytes, line_number: int, words: _Words, problems: Problems) -> Iterator[Columns]:
    """Events of whole lines: at once if all are plain, else by halves, and line by line in the end."""
    columns = _parse_plain(block, words)
    if columns is not None:
        yield columns
    elif len(block) <= _FEW_BYTES or (middle := block.find(b"\n", len(block) // 2) + 1) in (0, len(block)):
        yield _parse_lines(block, line_number, words, problems)
    else:
        yield from _parse(block[:middle], line_number, words, problems)
        yield from _parse(block[middle:], line_number + block.count(b"\n", 0, middle), words, problems)


def _parse_plain(block: bytes, words: _Words) -> Columns | None:
    """Events of a block where every line is ``digits.digits digits digits 0|1`` (no decimals but of seconds), or None if any is not."""
    if words.unit != "s":
        table = whole_numbers(block.replace(b"\t", b",").replace(b" ", b","), 4)
        return None if table is None else Columns(whole_microseconds(table[0], words.unit, "events"), *table[1:])
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
    if (polarity > 1).any() and not words.any_polarity:
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


def _parse_lines(block: bytes, line_number: int, words: _Words, problems: Problems) -> Columns:
    events = (_parse_line_of(line, number, words, problems) for number, line in enumerate(block.split(b"\n"), start=line_number))
    table = np.array([event for event in events if event is not None], dtype=np.int64).reshape(-1, 4)
    return Columns(*table.T)


def _parse_line_of(line: bytes, number: int, meant: _Words, problems: Problems) -> tuple[int, int, int, int] | None:
    try:
        return _parse_line(line, meant)
    except ValueError as error:
        shown = line[:80].decode("utf-8", errors="replace").strip()
        problems.record(Problem.MALFORMED, 1, f"line {number}: {_EXPECTED}, got '{shown}': {error}.")
        return None


def _parse_line(line: bytes, meant: _Words) -> tuple[int, int, int, int] | None:
    """``t_us, x, y, polarity`` of one line; None if it holds nothing but a comment; ValueError if it is malformed."""
    words = line.partition(b"#")[0].decode("ascii", errors="replace").split()
    if not words:
        return None
    if len(words) != 4:
        raise ValueError(f"it has {len(words)} columns")
    if b"_" in line:
        raise ValueError("numbers hold no underscores")
    t_us, x, y, polarity = parse_time(words[0], meant.unit), parse_whole(words[1]), parse_whole(words[2]), parse_whole(words[3])
    if polarity not in (-1, 0, 1) and not meant.any_polarity:
        raise ValueError(f"polarity {polarity} is none of 0, 1 and -1")
    return t_us, x, y, polarity
