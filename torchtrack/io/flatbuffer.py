"""As much of flatbuffers as event packets need: tables with numbers and vectors, every offset checked.

Reference: flatbuffers.dev, internals.
"""

from torchtrack.errors import EventDataError


def whole(data: bytes, position: int | None, size: int, default: int = 0, signed: bool = True) -> int:
    """The number of ``size`` bytes at a position; ``default`` where the field is absent.

    Raises:
        EventDataError: if it is not within the data.
    """
    if position is None:
        return default
    if not 0 <= position <= len(data) - size:
        raise EventDataError(f"an offset points to byte {position} of {len(data)}")
    return int.from_bytes(data[position : position + size], "little", signed=signed)


def indirect(data: bytes, position: int) -> int:
    """Where the offset at a position points to."""
    return position + whole(data, position, 4, signed=False)


def root_table(data: bytes, prefixed: bool = False) -> int:
    """Position of the root table; ``prefixed``: the data begin with their size."""
    return indirect(data, 4 if prefixed else 0)


def field_offset(data: bytes, table: int, index: int) -> int | None:
    """Position of a table's field, or None where it is absent."""
    entries = table - whole(data, table, 4)
    place = 4 + 2 * index
    if place >= whole(data, entries, 2, signed=False):
        return None
    offset = whole(data, entries + place, 2, signed=False)
    return table + offset if offset else None


def vector(data: bytes, position: int | None, item_bytes: int = 1) -> tuple[int, int]:
    """Where a vector's items start, and how many there are; none where the field is absent.

    Raises:
        EventDataError: if they are not within the data.
    """
    if position is None:
        return 0, 0
    start = indirect(data, position)
    count = whole(data, start, 4, signed=False)
    if start + 4 + count * item_bytes > len(data):
        raise EventDataError(f"a vector of {count} items ends after byte {len(data)}")
    return start + 4, count
