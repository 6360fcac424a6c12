"""What a step is given is checked before anything is computed: events in time order, after the state and up to the window's end."""

from itertools import pairwise

from jaxtyping import Int
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.events import EventBatch, of_streams, stream_bounds
from torchtrack.errors import EventDataError


def check_step(state_us: Int[Tensor, "s"], events: EventBatch, t_end_us: Int[Tensor, "s"]) -> None:
    """Raise :class:`EventDataError` unless the window of each stream is after the state, and its events are in time order within it.

    It is not looked for on a GPU, which would have to be waited for. Events of several streams that are mixed up are told elsewhere.

    Args:
        state_us: where the window of each stream begins.
        t_end_us: where it ends.
    """
    if not host_sync.read_at_once(events.t_us):
        return
    for stream, (start_us, end_us) in enumerate(zip(state_us.tolist(), t_end_us.tolist(), strict=True)):
        if end_us < start_us:
            raise EventDataError(
                f"stream {stream}: the window ends at {end_us} µs, before the state, which is of {start_us} µs. Step on from where the state is, "
                "or make a new one with Tracker.init."
            )
    events = of_streams(events, len(state_us))
    if len(events) == 0:
        return
    bounds = [0, len(events)] if len(state_us) == 1 else stream_bounds(events, len(state_us)).tolist()
    back = events.t_us[1:] < events.t_us[:-1]
    if len(bounds) > 2:
        back = back & (events.stream_index[1:] == events.stream_index[:-1])
    if bool(back.any()):
        at = int(back.nonzero()[0])
        before, after = events.t_us[at : at + 2].tolist()
        raise EventDataError(
            f"stream {int(events.stream_index[at])}: time goes back from {before} to {after} µs at event {at + 1}. "
            "Sort the events of each stream by time."
        )
    _check_within(bounds, state_us, events, t_end_us)


def _check_within(bounds: list[int], state_us: Tensor, events: EventBatch, t_end_us: Tensor) -> None:
    """Sorted events lie within their windows where the first and the last one do."""
    for stream, (first, last) in enumerate(pairwise(bounds)):
        if first == last:
            continue
        (oldest, newest), start_us, end_us = events.t_us[[first, last - 1]].tolist(), int(state_us[stream]), int(t_end_us[stream])
        if oldest < start_us:
            raise EventDataError(
                f"stream {stream}: an event of {oldest} µs is older than the state, which is of {start_us} µs. "
                "Give each event once, in time order; leave out what comes late."
            )
        if newest > end_us:
            raise EventDataError(
                f"stream {stream}: an event of {newest} µs is after the window's end at {end_us} µs. "
                "Cut the events with slice_time, or leave out t_end_us."
            )
