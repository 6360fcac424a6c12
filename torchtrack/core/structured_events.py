"""Events as other libraries give them: which field is the time, x, y and the polarity. None of these libraries is needed.

| library | events |
|---|---|
| faery, neuromorphic-drivers, aedat | structured arrays, fields ``t x y on`` |
| dv-processing | ``EventStore``, or its structured array, fields ``timestamp x y polarity`` |
| Metavision, tonic | structured arrays, fields ``x y p t`` |
| evt3 | ``Events``, attributes ``t x y p`` |
| any | a mapping of arrays |
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from torchtrack.core.column_names import Column, TimeUnit, column_of
from torchtrack.errors import EventDataError

_ORDER: tuple[Column, ...] = ("t", "x", "y", "p")
# Microseconds, as a fraction of whole numbers: times stay exact.
_US: dict[TimeUnit, tuple[int, int]] = {"s": (1_000_000, 1), "ms": (1000, 1), "us": (1, 1), "ns": (1, 1000)}


class EventFields(NamedTuple):
    """The columns of events.

    Args:
        x, y: sensor pixels.
        t_us: times (µs); of another unit where the name of the field says it, converted.
        polarity: as the library codes it.
    """

    x: np.ndarray
    y: np.ndarray
    t_us: np.ndarray
    polarity: np.ndarray


def fields_of(events: Any) -> EventFields:
    """The fields of events of another library, whatever their names and order; other fields are ignored.

    Args:
        events: a structured array ``[e]``, an object that gives one by ``numpy()``, a mapping of arrays, or an object with arrays ``t x y p``.

    Raises:
        EventDataError: if it is none of these, or a field is missing or there twice.
    """
    columns = _columns_of(events)
    by_column: dict[Column, str] = {}
    unit: TimeUnit | None = None
    for name in columns:
        parsed = column_of(name)
        if parsed is None:
            continue
        if parsed[0] in by_column:
            raise EventDataError(f"the fields '{by_column[parsed[0]]}' and '{name}' of the events both mean {parsed[0]}. Leave one out.")
        by_column[parsed[0]] = name
        unit = parsed[1] if parsed[0] == "t" else unit
    if len(by_column) < 4:
        missing = [column for column in ("t", "x", "y", "p") if column not in by_column]
        raise EventDataError(f"the events have the fields {', '.join(columns)}; {', '.join(missing)} missing. Rename them to t, x, y and p.")
    t, x, y, p = (columns[by_column[column]] for column in _ORDER)
    return EventFields(x, y, _in_us(t, unit), p)


def _columns_of(events: Any) -> dict[str, np.ndarray]:
    """The arrays that there are, by their names."""
    if not isinstance(events, np.ndarray) and callable(getattr(events, "numpy", None)):
        events = events.numpy()
    if isinstance(events, np.ndarray):
        names = events.dtype.names
        if names is None or events.ndim != 1:
            raise EventDataError(
                f"expected a structured array of events of one axis, with fields t, x, y and p, got an array of {events.dtype} of shape "
                f"{list(events.shape)}. Give EventBatch.from_numpy(x, y, t_us, polarity) the columns."
            )
        return {name: events[name] for name in names}
    if isinstance(events, Mapping):
        return {str(name): np.asarray(values) for name, values in events.items()}
    if all(hasattr(events, name) for name in _ORDER):
        return {name: np.asarray(getattr(events, name)) for name in _ORDER}
    raise EventDataError(
        f"expected events as an EventBatch, a structured array, or arrays named t, x, y and p, got {type(events).__name__}. "
        "EventBatch.from_numpy(x, y, t_us, polarity) takes the columns."
    )


def _in_us(times: np.ndarray, unit: TimeUnit | None) -> np.ndarray:
    """Times in microseconds; those whose unit nobody says as they are."""
    if unit is None or unit == "us":
        return times
    times_by, divided_by = _US[unit]
    if times.dtype.kind == "f":
        rounded: np.ndarray = np.rint(times * (times_by / divided_by)).astype(np.int64)
        return rounded
    scaled: np.ndarray = (times.astype(np.int64) * times_by + divided_by // 2) // divided_by
    return scaled
