"""What a step is given is checked before anything is computed: events in time order, after the state and up to the window's end."""

from itertools import pairwise

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.events import EventBatch, stream_bounds
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
    # Rows of NumPy look at the same memory, and take a fraction of the time that as many tensor operations do.
    bounds_us, times_us = zip(state_us.tolist(), t_end_us.tolist(), strict=True), events.t_us.numpy()
    for stream, (part, (start_us, end_us)) in enumerate(zip(_parts(events, len(state_us)), bounds_us, strict=True)):
        if (of_stream_us := times_us[part]).size:
            _check_stream(f"stream {stream}", of_stream_us, (start_us, end_us), part.start)


def _parts(events: EventBatch, streams: int) -> list[slice]:
    """Where the events of each stream are; those of no stream lie after them."""
    if streams == 1 and len(events) and events.stream_index.numpy()[-1] == 0:
        return [slice(0, len(events))]
    return [slice(first, last) for first, last in pairwise(stream_bounds(events, streams).tolist())]


def _check_stream(stream: str, t_us: NDArray[np.int64], window_us: tuple[int, int], first: int) -> None:
    (start_us, end_us), back = window_us, t_us[1:] < t_us[:-1]
    if back.any():
        at = int(back.argmax())
        raise EventDataError(
            f"{stream}: time goes back from {t_us[at]} to {t_us[at + 1]} µs at event {first + at + 1}. Sort the events of each stream by time."
        )
    if t_us[0] < start_us:
        raise EventDataError(
            f"{stream}: an event of {t_us[0]} µs is older than the state, which is of {start_us} µs. "
            "Give each event once, in time order; leave out what comes late."
        )
    if t_us[-1] > end_us:
        raise EventDataError(
            f"{stream}: an event of {t_us[-1]} µs is after the window's end at {end_us} µs. Cut the events with slice_time, or leave out t_end_us."
        )
