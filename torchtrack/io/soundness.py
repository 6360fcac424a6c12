"""Which events lie inside the sensor, and whether they are in order of time."""

import numpy as np

from torchtrack.errors import EventDataError
from torchtrack.io.columns import Columns
from torchtrack.io.problems import Problem, Problems


def inside(events: Columns, width: int, height: int, problems: Problems, first_index: int = 0) -> Columns:
    """Those events that lie inside the sensor; the others are counted.

    Args:
        events: the events, in the order of the file.
        width, height: sensor size (px).
        problems: where faults are counted.
        first_index: number of the first event in its stream, for messages.

    Raises:
        EventDataError: if there is a fault and ``problems`` is strict.
    """
    if len(events) == 0 or _all_inside(events, width, height):
        return events
    on_sensor = (events.x >= 0) & (events.x < width) & (events.y >= 0) & (events.y < height)
    at = int(np.argmin(on_sensor))
    wrong = int((~on_sensor).sum())
    problems.record(
        Problem.OUTSIDE,
        wrong,
        f"event {first_index + at} is at ({events.x[at]}, {events.y[at]}), outside the sensor of {width}x{height} pixels "
        f"({wrong} such events). Check the sensor size, or whether x and y are swapped.",
    )
    return events[on_sensor]


def check_order(t_us: np.ndarray, source: str, last_us: int | None = None, first_index: int = 0) -> None:
    """Raise :class:`EventDataError` unless times do not go back, from ``last_us`` on where there was an event before."""
    if in_order(t_us, last_us):
        return
    at = 0 if last_us is not None and t_us[0] < last_us else int(np.argmax(t_us[1:] < t_us[:-1])) + 1
    raise EventDataError(f"{source}: time goes back from {last_us if at == 0 else t_us[at - 1]} to {t_us[at]} µs at event {first_index + at}.")


def in_order(t_us: np.ndarray, last_us: int | None) -> bool:
    """Whether times do not go back, from ``last_us`` on where there was an event before."""
    if len(t_us) == 0:
        return True
    return bool((last_us is None or t_us[0] >= last_us) and (t_us[1:] >= t_us[:-1]).all())


def _all_inside(events: Columns, width: int, height: int) -> bool:
    for pixels, size in ((events.x, width), (events.y, height)):
        if pixels.max() >= size or (pixels.dtype.kind == "i" and pixels.min() < 0):
            return False
    return True
