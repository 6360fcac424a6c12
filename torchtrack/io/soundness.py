"""Which events of a stream can be used: inside the sensor, and in order of time."""

from collections.abc import Iterable, Iterator

import numpy as np

from torchtrack.io.columns import Columns, join
from torchtrack.io.problems import Problem, Problems


def sound(events: Columns, width: int, height: int, problems: Problems, last_us: int | None = None, first_index: int = 0) -> Columns:
    """Those events that lie inside the sensor and do not go back in time; the others are counted.

    Where times disagree, the fewer events are left out: those that are late for what came before, or those that are
    early for what comes after. A single wild time thus costs one event and not the rest of the stream.

    Args:
        events: the events, in the order of the file.
        width, height: sensor size (px).
        problems: where faults are counted.
        last_us: time of the event before the first one, where there is one.
        first_index: number of the first event in its stream, for messages.

    Raises:
        EventDataError: if there is a fault and ``problems`` is strict.
    """
    if len(events) == 0:
        return events
    if not _all_inside(events, width, height):
        inside = (events.x >= 0) & (events.x < width) & (events.y >= 0) & (events.y < height)
        at = int(np.argmin(inside))
        wrong = int((~inside).sum())
        problems.found(
            Problem.OUTSIDE,
            wrong,
            f"event {first_index + at} is at ({events.x[at]}, {events.y[at]}), outside the sensor of {width}x{height} pixels "
            f"({wrong} such events). Check the sensor size, or whether x and y are swapped.",
        )
        events = events[inside]
    if _is_sorted(events.t_us, last_us):
        return events
    at, before = _first_step_back(events.t_us, last_us)
    keep = _in_order(events.t_us, last_us)
    detail = f"time goes back from {before} to {events.t_us[at]} µs at event {first_index + at}. Sort the events by time."
    problems.found(Problem.BACK, int((~keep).sum()), detail)
    return events[keep]


def mended(parts: Iterable[Columns], most: int = 4) -> Iterator[Columns]:
    """Parts of a stream, joined with the next one (and up to ``most`` in all) where time goes back between them.

    Which side of such a step is wrong can be told from both together only.
    """
    waiting: list[Columns] = []
    for part in parts:
        if len(part) == 0:
            continue
        if waiting and (part.t_us[0] >= waiting[-1].t_us[-1] or len(waiting) == most):
            yield join(waiting)
            waiting = []
        waiting.append(part)
    if waiting:
        yield join(waiting)


def _all_inside(events: Columns, width: int, height: int) -> bool:
    for pixels, size in ((events.x, width), (events.y, height)):
        if pixels.max() >= size or (pixels.dtype.kind == "i" and pixels.min() < 0):
            return False
    return True


def _is_sorted(t_us: np.ndarray, last_us: int | None) -> bool:
    if len(t_us) == 0:
        return True
    return bool((last_us is None or t_us[0] >= last_us) and (t_us[1:] >= t_us[:-1]).all())


def _first_step_back(t_us: np.ndarray, last_us: int | None) -> tuple[int, int]:
    """Index of the first event that is earlier than the one before it, and the time of that."""
    if last_us is not None and t_us[0] < last_us:
        return 0, last_us
    at = int(np.argmax(t_us[1:] < t_us[:-1])) + 1
    return at, int(t_us[at - 1])


def _in_order(t_us: np.ndarray, last_us: int | None) -> np.ndarray:
    """Mask of events that are in order among themselves and not before ``last_us``, by the rule that keeps more."""
    late = t_us >= np.maximum.accumulate(t_us)
    early = t_us <= np.minimum.accumulate(t_us[::-1])[::-1]
    if last_us is not None:
        late &= t_us >= last_us
        early &= t_us >= last_us
    # In doubt the later ones stay: what follows goes on from them.
    return early if early.sum() >= late.sum() else late
