"""Names that people's tools give to the columns of events, with the unit that a name of times may say."""

import re
from typing import Literal

TimeUnit = Literal["s", "ms", "us", "ns"]
Column = Literal["t", "x", "y", "p"]
_NAMES: dict[Column, set[str]] = {
    "t": {"t", "ts", "time", "times", "timestamp", "timestamps", "stamp"},
    "x": {"x", "xs", "col", "column", "u"},
    "y": {"y", "ys", "row", "v"},
    "p": {"p", "ps", "pol", "pols", "polarity", "polarities", "on"},
}
_UNITS: dict[str, TimeUnit] = {
    "s": "s",
    "sec": "s",
    "secs": "s",
    "seconds": "s",
    "ms": "ms",
    "msec": "ms",
    "milliseconds": "ms",
    "us": "us",
    "usec": "us",
    "µs": "us",
    "μs": "us",
    "microseconds": "us",
    "ns": "ns",
    "nsec": "ns",
    "nanoseconds": "ns",
}
_WORDS = re.compile(r"[^\W_]+")


def column_of(name: str) -> tuple[Column, TimeUnit | None] | None:
    """Which column a name means, and the unit that it says; None where it means none. Case, brackets and spaces do not matter."""
    words = [word for word in _WORDS.findall(name.lower()) if word not in ("px", "pixel", "pixels", "event", "events")]
    if not words or len(words) > 2:
        return None
    column = next((column for column, names in _NAMES.items() if words[0] in names), None)
    if column is None or len(words) == 1:
        return None if column is None else (column, None)
    unit = unit_of(words[1])
    return (column, unit) if column == "t" and unit is not None else None


def unit_of(word: str) -> TimeUnit | None:
    """The unit of time that a word names, or None."""
    return _UNITS.get(word.strip().lower())
