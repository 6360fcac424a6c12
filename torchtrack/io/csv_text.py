"""Events as text, one a line, in columns: comma-separated, also by semicolons, tabs or blanks.

How a file is laid out is told from its beginning (:mod:`torchtrack.io.text_layout`). The unit of the times is the one that their
name says (``t_us``, ``time [ns]``) or the user; else whole numbers are µs and others seconds, where that is plausible.
``# width=640 height=480`` says the sensor size, as our own files do.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from torchtrack.config.events import TimeUnit
from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns
from torchtrack.io.digits import whole_numbers
from torchtrack.io.plausibility import settled_unit, whole_microseconds
from torchtrack.io.problems import Problem, Problems
from torchtrack.io.seconds import parse_time
from torchtrack.io.text_file import ENOUGH_LINES, TextFile, whole_lines
from torchtrack.io.text_layout import TextLayout, find_layout, is_names
from torchtrack.io.text_words import as_numbers, parse_polarity, parse_whole, settled_polarity

_BLOCK_BYTES = 2 << 20


@dataclass(frozen=True)
class CsvFile(TextFile):
    """Events of a CSV file; see :class:`torchtrack.io.event_file.EventFile`.

    Raises:
        EventDataError: if its columns or the unit of its times cannot be told, or the sensor size is unknown.
    """

    unit_is_open: ClassVar[bool] = True

    layout: TextLayout = field(init=False, default=TextLayout(",", (0, 1, 2, 3), 4, 0))
    unit: TimeUnit = field(init=False, default="us")

    def _open(self) -> None:
        head = whole_lines(self._head())
        source = f"'{self.path}'"
        layout = find_layout(head, source)
        if layout is None:
            raise EventDataError(f"{source}: expected lines 't,x,y,p' or 'x,y,p,t' of numbers, or a first line that names t, x, y and p.")
        object.__setattr__(self, "layout", layout)
        rows = [layout.words(line) for line in head.splitlines()[layout.skip : layout.skip + ENOUGH_LINES]]
        rows = [row for row in rows if len(row) == layout.width]
        times = [row[layout.columns[0]] for row in rows]
        custom: TimeUnit = "s" if any(mark in time for time in times for mark in ".eE") else "us"
        unit = settled_unit(as_numbers(times), custom, self.choices.time_unit or layout.unit, source)
        object.__setattr__(self, "unit", unit)
        settled_polarity([row[layout.columns[3]] for row in rows], self.choices.polarity, Problems(source, strict=False))
        self._settle_size(*(layout.size or (None, None)))

    def _read(self, max_events: int) -> Iterator[Columns]:
        rest, line_number = b"", 1
        with self._stream() as stream:
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
        if line_number == 1:
            for _ in range(self.layout.skip):
                block = block.partition(b"\n")[2]
            line_number += self.layout.skip
        if not block:
            return Columns.empty()
        # Carriage returns and commas are what the fast way knows.
        plain = block if self.layout.separator == "," else block.replace(self.layout.separator.encode(), b",")
        table = whole_numbers(plain, self.layout.width)
        if table is None:
            return self._lines(block, line_number)
        t, x, y, p = (table[column] for column in self.layout.columns)
        return Columns(whole_microseconds(t, self.unit, f"'{self.path}'"), x, y, p)

    def _lines(self, block: bytes, line_number: int) -> Columns:
        rows: list[tuple[int, int, int, int]] = []
        for number, line in enumerate(block.decode("utf-8", errors="replace").splitlines(), start=line_number):
            words = self.layout.words(line)
            if not words:
                continue
            try:
                rows.append(self._row(words))
            except ValueError as error:
                if not is_names(line):
                    self.problems.record(Problem.MALFORMED, 1, f"line {number}: expected t, x, y and polarity, got '{line[:80]}': {error}.")
        return Columns(*np.array(rows, dtype=np.int64).reshape(-1, 4).T)

    def _row(self, words: list[str]) -> tuple[int, int, int, int]:
        """``t_us, x, y, polarity`` of one line; ValueError if it is malformed."""
        if len(words) != self.layout.width:
            raise ValueError(f"it has {len(words)} columns")
        t, x, y, p = (words[column] for column in self.layout.columns)
        return parse_time(t, self.unit), parse_whole(x), parse_whole(y), parse_polarity(p)
