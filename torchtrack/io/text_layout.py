"""How a text file of events is laid out: what stands between numbers, which column is what, and in which unit times are.

Told from the beginning of the file. Columns are named by a first line, which may be a comment (``# t x y p``, ``timestamp_ns;x;y;pol``);
other columns may stand between them. Without names there are four, and two customs: ``x,y,p,t`` (Prophesee) and ``t,x,y,p``: the one
whose times and polarities can be such is taken; another order is told where only one column never decreases.
"""

import re
import warnings
from dataclasses import dataclass

import numpy as np

from torchtrack.config.events import TimeUnit
from torchtrack.core.column_names import Column, column_of
from torchtrack.errors import EventDataError, TorchtrackWarning

_COMMENT = re.compile(r"#|%|//")
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?")
_SIZE = re.compile(r"(?i)width\W{1,5}(\d{1,5})\D.{0,40}height\W{1,5}(\d{1,5})")
_SWITCH = {"true", "false", "on", "off"}
# In the order in which they are tried: a comma may also be the mark of decimals.
_SEPARATORS = (";", "\t", ",", " ")
_POLARITIES = {"0", "1", "-1", "+1"} | _SWITCH
_TXYP, _XYPT = (0, 1, 2, 3), (3, 0, 1, 2)
# Of fewer lines, the order of columns is not told from their numbers.
_FEWEST_LINES = 20
# No more of them are looked at.
_MOST_ROWS = 1000


@dataclass(frozen=True)
class TextLayout:
    """How a text file of events is laid out.

    Args:
        separator: what stands between numbers: ``,``, ``;``, a tab, or a blank for any white space.
        columns: where t, x, y and p are in a line.
        width: how many columns a line has.
        skip: lines before the first event.
        unit: of the times, where their name says it.
        size: width and height of the sensor, where a line says them.
    """

    separator: str
    columns: tuple[int, int, int, int]
    width: int
    skip: int
    unit: TimeUnit | None = None
    size: tuple[int, int] | None = None

    def words(self, line: str) -> list[str]:
        """The words of a line without its comment; decimal commas are points."""
        words = split(_COMMENT.split(line, maxsplit=1)[0], self.separator)
        return words if self.separator == "," else [word.replace(",", ".") for word in words]


def split(line: str, separator: str) -> list[str]:
    """The words of a line, without blanks and quotes around them; none of a line that is empty."""
    if separator == " ":
        return line.split()
    return [word.strip().strip("\"'").strip() for word in line.split(separator)] if line.strip() else []


def find_layout(head: str, source: str) -> TextLayout | None:
    """The layout of the file that begins with ``head``, of whole lines; None if no line looks like one of events.

    Raises:
        EventDataError: if lines are of numbers or names, but which columns are events cannot be told.
    """
    lines = head.splitlines()
    first = _first_event(lines)
    if not looks_like_events(head):
        return None
    before = lines[:first]
    separator = (_separator(lines[first]) if first is not None else None) or ","
    rows = [words for line in lines[len(before) : len(before) + _MOST_ROWS] if (words := split(_COMMENT.split(line, maxsplit=1)[0], separator))]
    names = next((parsed for line in reversed(before) if (parsed := _names(line, separator)) is not None), None)
    width = len(rows[0]) if rows else len(names or ())
    size, skip = _size(before), len(before)
    if names is not None:
        if len(names) != width:
            raise EventDataError(
                f"{source}: line {skip + 1} has {width} columns, but {len(names)} are named: {', '.join(names)}. "
                "Where commas separate columns, decimals need points, and thousands nothing between them."
            )
        columns, unit = _named_columns(names, source)
        return TextLayout(separator, columns, width, skip, unit, size)
    if width != 4:
        raise EventDataError(f"{source}: line {skip + 1} has {width} columns and no names. Expected four, or a first line that names t, x, y and p.")
    return TextLayout(separator, _unnamed_columns(rows, source), width, skip, None, size)


def looks_like_events(head: str) -> bool:
    """Whether the first line with content looks like one of events, or of what may come before them; names alone are a file without events."""
    lines = head.splitlines()
    first = _first_event(lines)
    if first is None:
        return any(is_names(line) and any(separator in line for separator in _SEPARATORS[:3]) for line in lines)
    return all(map(_may_come_before, lines[:first]))


def has_named_columns(head: str) -> bool:
    """Whether a line before the first event names its columns."""
    lines = head.splitlines()
    first = _first_event(lines)
    return first is not None and any(map(is_names, lines[:first]))


def _first_event(lines: list[str]) -> int | None:
    """Where the first line is that looks like one of events."""
    return next((at for at, line in enumerate(lines) if _is_events(line)), None)


def _may_come_before(line: str) -> bool:
    """Whether a line may stand before the first event: nothing, a comment, names, or the size."""
    return not line.strip() or _COMMENT.match(line.lstrip()) is not None or is_names(line) or _size([line]) is not None


def is_names(line: str) -> bool:
    """Whether a line names columns of events."""
    return _names(line, ",") is not None


def _is_number(word: str) -> bool:
    return _NUMBER.fullmatch(word) is not None


def _separator(line: str) -> str | None:
    """What separates the numbers of a line, if it has four or more and nothing else."""
    for separator in _SEPARATORS:
        words = split(_COMMENT.split(line, maxsplit=1)[0], separator)
        if len(words) < 4 or sum(map(_is_number, words)) < 3:
            continue
        # An index, a name or a switch may be among them.
        if separator != "," or not any("," in word for word in words):
            return separator
    return None


def _is_events(line: str) -> bool:
    return not _COMMENT.match(line.lstrip()) and _separator(line) is not None


def _names(line: str, separator: str) -> list[str] | None:
    """The names of columns that a line holds, which may be a comment; None if it names no t."""
    text = line.strip()
    mark = _COMMENT.match(text)
    text = text[mark.end() :] if mark else text
    for candidate in dict.fromkeys((separator, *_SEPARATORS)):
        words = split(text, candidate)
        if len(words) >= 4 and len({column[0] for word in words if (column := column_of(word)) is not None}) >= 3:
            return words
    return None


def _named_columns(names: list[str], source: str) -> tuple[tuple[int, int, int, int], TimeUnit | None]:
    places: dict[Column, int] = {}
    unit = None
    for place, name in enumerate(names):
        column = column_of(name)
        if column is not None and column[0] not in places:
            places[column[0]] = place
            unit = column[1] or unit
    if len(places) < 4:
        missing = ", ".join(sorted(set("txyp") - set(places)))
        raise EventDataError(f"{source}: its columns are named {', '.join(names)}; which of them is {missing} is not said. Name them t, x, y and p.")
    return (places["t"], places["x"], places["y"], places["p"]), unit


def _unnamed_columns(rows: list[list[str]], source: str) -> tuple[int, int, int, int]:
    rows = [row for row in rows if len(row) == 4]
    third, last = ({row[place].lower() for row in rows} for place in (2, 3))
    custom = _XYPT if third <= _POLARITIES and not last <= _POLARITIES else _TXYP
    likely = _by_numbers(rows)
    if likely is None or likely == custom or len(rows) < _FEWEST_LINES:
        return custom
    order = ", ".join(name for _, name in sorted(zip(likely, "txyp", strict=True)))
    warnings.warn(
        f"{source}: columns are taken as {order}: only one never decreases, and one holds polarities. Name them in a first line to be sure.",
        TorchtrackWarning,
        stacklevel=2,
    )
    return likely


def _by_numbers(rows: list[list[str]]) -> tuple[int, int, int, int] | None:
    """Which columns are t, x, y and p, where just one never decreases and just one of the others holds polarities."""
    polarities = [place for place in range(4) if {row[place].lower() for row in rows} <= _POLARITIES]
    if len(polarities) != 1:
        return None
    others = [place for place in range(4) if place not in polarities]
    if not all(_is_number(row[place]) for row in rows for place in others):
        return None
    values = {place: np.array([float(row[place].replace(",", ".")) for row in rows]) for place in others}
    rising = [place for place in others if (np.diff(values[place]) >= 0).all() and values[place][0] < values[place][-1]]
    if len(rising) != 1:
        return None
    x, y = (place for place in others if place != rising[0])
    return rising[0], x, y, polarities[0]


def _size(lines: list[str]) -> tuple[int, int] | None:
    """Width and height, as a comment says them, or a line of two numbers."""
    for line in lines:
        if match := _SIZE.search(line):
            return int(match[1]), int(match[2])
        words = line.split()
        if len(words) == 2 and all(word.isdigit() and 0 < int(word) <= 1 << 16 for word in words):
            return int(words[0]), int(words[1])
    return None
