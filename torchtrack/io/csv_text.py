"""Events as comma-separated text, one a line; times in whole microseconds, or in seconds with decimals.

A first line of names (``t,x,y,p``; also ``timestamp``, ``polarity`` and the like) says what the columns are. Without one
there are two customs: ``x,y,p,t`` (Prophesee) and ``t,x,y,p``; the third column tells, as a polarity is 0, 1 or -1 throughout.
``# width=640 height=480`` says the sensor size, as our own files do.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns
from torchtrack.io.digits import whole_numbers
from torchtrack.io.event_file import EventFile
from torchtrack.io.problems import Problem
from torchtrack.io.seconds import parse_seconds

_HEAD_BYTES = 1 << 16
_BLOCK_BYTES = 2 << 20
_NAMES = {
    "t": ("t", "ts", "time", "timestamp", "timestamps", "t_us", "time_us", "timestamp_us"),
    "x": ("x", "xs", "col", "x_px"),
    "y": ("y", "ys", "row", "y_px"),
    "p": ("p", "ps", "pol", "polarity", "on"),
}
_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?")
_WIDTH, _HEIGHT = (re.compile(rf"{name}[ \t]{{0,20}}=[ \t]{{0,20}}(\d{{1,5}})") for name in ("width", "height"))


@dataclass(frozen=True)
class CsvFile(EventFile):
    """Events of a CSV file; see :class:`torchtrack.io.event_file.EventFile`.

    Raises:
        EventDataError: if its columns cannot be told, or the sensor size is unknown.
    """

    order: tuple[int, ...] = field(init=False, default=(0, 1, 2, 3))

    def _open(self) -> None:
        with self.path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
        order = column_order(head)
        if order is None:
            raise EventDataError(f"'{self.path}': expected lines 't,x,y,p' or 'x,y,p,t' of numbers, or a first line that names t, x, y and p.")
        object.__setattr__(self, "order", order)
        self._settle_size(*_size(head.decode("ascii", errors="replace")))

    def _read(self, max_events: int) -> Iterator[Columns]:
        rest, line_number = b"", 1
        with self.path.open("rb") as stream:
            while data := stream.read(_BLOCK_BYTES):
                cut = data.rfind(b"\n") + 1
                block, rest = (rest + data[:cut], data[cut:]) if cut else (b"", rest + data)
                if len(rest) > _BLOCK_BYTES:
                    raise EventDataError(f"{self.path}: a line is longer than {_BLOCK_BYTES} bytes; this is not a text file of events.")
                if block:
                    yield self._parse(block, line_number)
                    line_number += block.count(b"\n")
        if rest:
            yield self._parse(rest, line_number)

    def _parse(self, block: bytes, line_number: int) -> Columns:
        """Events of whole lines: at once if all are whole numbers, else line by line."""
        head = b""
        # What says the size and the names stands before the numbers.
        while line_number == 1 and (block[:1].isalpha() or block[:1] in (b"#", b'"')):
            line, newline, block = block.partition(b"\n")
            head += line + newline
        table = whole_numbers(block, len(self.order)) if block else []
        if table is None:
            table = self._lines(head + block, line_number)
        return Columns(*(table[column] for column in self.order)) if len(table) else Columns.empty()

    def _lines(self, block: bytes, line_number: int) -> list[np.ndarray]:
        rows: list[list[int]] = []
        for number, line in enumerate(block.decode("utf-8", errors="replace").splitlines(), start=line_number):
            words = line.partition("#")[0].replace(";", ",").split(",")
            if not "".join(words).strip() or _named(words) is not None:
                continue
            try:
                rows.append(_row([word.strip() for word in words], self.order))
            except (ValueError, IndexError) as error:
                self.problems.found(Problem.MALFORMED, 1, f"line {number}: expected t, x, y and polarity, got '{line[:80]}': {error}.")
        table = np.array(rows, dtype=np.int64).reshape(-1, 4)
        # The rows are in the order t, x, y, p; the caller expects that of the file.
        return list(table[:, np.argsort(self.order)].T)


def _size(head: str) -> tuple[int | None, int | None]:
    """Sensor size, from the first comment that says both."""
    for line in head.splitlines():
        comment = line.partition("#")[2]
        width, height = _WIDTH.search(comment), _HEIGHT.search(comment)
        if width and height:
            return int(width[1]), int(height[1])
    return None, None


def column_order(head: bytes) -> tuple[int, ...] | None:
    """Which columns are t, x, y and p, from the beginning of a file; None if it does not look like CSV."""
    lines = [line for line in head.decode("utf-8", errors="replace").splitlines()[:200] if line.partition("#")[0].strip()]
    if not lines or not any(separator in lines[0] for separator in ",;"):
        return None
    words = [line.partition("#")[0].replace(";", ",").split(",") for line in lines]
    named = _named(words[0])
    if named is not None:
        return named
    # The last line may be cut off.
    numbers = [row for row in words[:-1] or words if len(row) == 4 and all(_NUMBER.fullmatch(word.strip()) for word in row)]
    if not numbers or numbers[0] is not words[0]:
        return None
    third = {row[2].strip() for row in numbers}
    last = {row[3].strip() for row in numbers}
    return (3, 0, 1, 2) if third <= {"0", "1", "-1"} and not last <= {"0", "1", "-1"} else (0, 1, 2, 3)


def _named(words: list[str]) -> tuple[int, ...] | None:
    names = [word.strip().lower().strip('"') for word in words]
    found = [next((names.index(name) for name in _NAMES[key] if name in names), None) for key in "txyp"]
    return tuple(column for column in found if column is not None) if None not in found and len(names) == 4 else None


def _row(words: list[str], order: tuple[int, ...]) -> list[int]:
    if len(words) != 4:
        raise ValueError(f"it has {len(words)} columns")
    time, *rest = (words[column] for column in order)
    t_us = parse_seconds(time) if any(mark in time for mark in ".eE") else int(time)
    values = [t_us, *(int(word) for word in rest)]
    if any(abs(value) >= 2**63 for value in values):
        raise ValueError("a number does not fit 64 bits")
    return values
