"""Which of the arrays of a file are events: by their names, with what stands before them where there are several sets."""

from collections.abc import Iterable
from dataclasses import dataclass

from torchtrack.config.events import TimeUnit
from torchtrack.core.column_names import Column, column_of

_SEPARATORS = "/_."


@dataclass(frozen=True)
class EventArrays:
    """Names of the arrays of one stream, in the order t, x, y, p, and the unit that the name of the times says."""

    names: tuple[str, ...]
    unit: TimeUnit | None


def event_sets(names: Iterable[str]) -> dict[str, EventArrays]:
    """The complete sets among named arrays, by what stands before their names: "" for ``t x y p``, "left" for ``left_t left_x …``."""
    columns_by_prefix: dict[str, dict[Column, str]] = {}
    units: dict[str, TimeUnit | None] = {}
    # Of several names for one thing, the shortest is the plain one.
    for name in sorted(names, key=lambda name: (len(name), name)):
        parsed = _parsed(name)
        if parsed is None or parsed[1] in columns_by_prefix.setdefault(parsed[0], {}):
            continue
        prefix, column, unit = parsed
        columns_by_prefix[prefix][column] = name
        units[prefix] = unit if column == "t" else units.get(prefix)
    complete = {prefix: columns for prefix, columns in columns_by_prefix.items() if len(columns) == 4}
    return {
        prefix: EventArrays((columns["t"], columns["x"], columns["y"], columns["p"]), units[prefix]) for prefix, columns in sorted(complete.items())
    }


def _parsed(name: str) -> tuple[str, Column, TimeUnit | None] | None:
    """What stands before, which column it is, and the unit; the shortest beginning that leaves the name of a column."""
    starts = [0, *(at + 1 for at, letter in enumerate(name) if letter in _SEPARATORS and at)]
    for start in starts:
        column = column_of(name[start:])
        if column is not None:
            return name[: max(start - 1, 0)], *column
    return None
