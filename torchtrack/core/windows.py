"""The windows that a stream is cut into: by time, or by count.

Windows are half open on the left, ``t_start_us < t <= t_end_us``: an event at a window's end belongs to it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError

# What nothing was seen of for so long may be anywhere: further windows without events would tell no more.
LONGEST_SILENCE_US = 500_000


@dataclass(frozen=True)
class EventWindow:
    """Events with ``t_start_us < t <= t_end_us``.

    ``after_gap``: between the window before it and this one, time was passed over in which nothing happened.
    """

    events: EventBatch
    t_start_us: int
    t_end_us: int
    after_gap: bool = False


def windows_by_time(chunks: Iterable[EventBatch], duration_us: int, t_start_us: int | None = None) -> Iterator[EventWindow]:
    """Cut a stream into windows of given durations, in constant memory; windows without events are yielded too.

    After :data:`LONGEST_SILENCE_US` without events, time is passed over up to the next one.

    Args:
        chunks: the events of one stream in time order, cut anywhere.
        duration_us: length of a window.
        t_start_us: where the first window starts; just before the first event when not given.
    """
    if duration_us < 1:
        raise EventDataError(f"a window must last at least 1 µs, got {duration_us}.")
    pending: list[EventBatch] = []
    end_us, heard_us, after_gap = None, None, False
    for chunk in chunks:
        if len(chunk) == 0:
            continue
        if t_start_us is None:
            t_start_us = int(chunk.t_us[0]) - 1
        if end_us is None:
            heard_us, end_us = t_start_us, t_start_us + duration_us
        newest_us = int(chunk.t_us[-1])
        # Only what is after the start counts; later on, nothing else is left.
        left = chunk[int(torch.searchsorted(chunk.t_us, t_start_us, right=True)) :]
        # A window is complete only once an event after its end has been seen.
        while end_us < newest_us:
            cut = int(torch.searchsorted(left.t_us, end_us, right=True))
            heard_us = end_us if cut or pending else heard_us
            yield EventWindow(concatenate([*pending, left[:cut]]) if pending else left[:cut], t_start_us, end_us, after_gap)
            pending, left, t_start_us = [], left[cut:], end_us
            t_start_us, after_gap = _after_silence(left, t_start_us, heard_us)
            end_us = t_start_us + duration_us
        pending += [left] if len(left) else []
    if pending and t_start_us is not None and end_us is not None:
        yield EventWindow(concatenate(pending) if len(pending) > 1 else pending[0], t_start_us, end_us, after_gap)


def _after_silence(left: EventBatch, t_start_us: int, heard_us: int | None) -> tuple[int, bool]:
    """Where the window from ``t_start_us`` on is to start instead, if nothing was heard for long and nothing will be soon; whether so."""
    if heard_us is None or t_start_us - heard_us < LONGEST_SILENCE_US or len(left) == 0:
        return t_start_us, False
    next_us = int(left.t_us[0])
    return (next_us - 1, True) if next_us - t_start_us > LONGEST_SILENCE_US else (t_start_us, False)


def windows_by_count(chunks: Iterable[EventBatch], count: int, max_age_us: int | None = None, t_start_us: int | None = None) -> Iterator[EventWindow]:
    """Cut a stream into windows of ``count`` events, closed early once ``max_age_us`` have passed.

    Events that share the time of a window's last event stay together with it, so windows may hold a few more.
    ``t_start_us`` is where the first window starts; just before the first event when not given. Windows in which
    ``max_age_us`` passed without an event are yielded too, and time without events is passed over as by
    :func:`windows_by_time`: no window reaches over more than :data:`LONGEST_SILENCE_US` of it.
    """
    if count < 1 or (max_age_us is not None and max_age_us < 1):
        raise EventDataError(f"a window needs a positive count and maximum age, got {count} and {max_age_us}.")
    pending, heard_us, after_gap = EventBatch.empty(), None, False
    for chunk in chunks:
        if len(chunk) == 0:
            continue
        if t_start_us is None:
            t_start_us = int(chunk.t_us[0]) - 1
        heard_us = t_start_us if heard_us is None else heard_us
        pending = concatenate([pending, chunk]) if len(pending) else chunk
        # Only what is after the start counts; later on, nothing else is left.
        pending = pending[int(torch.searchsorted(pending.t_us, t_start_us, right=True)) :]
        while True:
            if not after_gap:
                # Without a maximum age, no windows without events lead into the silence.
                waited_us = t_start_us - LONGEST_SILENCE_US if max_age_us is None else heard_us
                t_start_us, after_gap = _after_silence(pending, t_start_us, waited_us)
            if (end_us := _count_window_end(pending, count, max_age_us, t_start_us)) is None:
                break
            cut = int(torch.searchsorted(pending.t_us, end_us, right=True))
            heard_us = int(pending.t_us[cut - 1]) if cut else heard_us
            yield EventWindow(pending[:cut], t_start_us, end_us, after_gap)
            pending, t_start_us, after_gap = pending[cut:], end_us, False
    if len(pending) and t_start_us is not None:
        yield EventWindow(pending, t_start_us, int(pending.t_us[-1]), after_gap)


def _count_window_end(pending: EventBatch, count: int, max_age_us: int | None, t_start_us: int) -> int | None:
    """End of the first complete window of ``pending``, or None while an event after its end has not been seen."""
    if len(pending) == 0:
        return None
    ends = []
    if len(pending) > count:
        ends.append(int(pending.t_us[count - 1]))
    if max_age_us is not None:
        ends.append(t_start_us + max_age_us)
    if (silent_us := _before_silence(pending.t_us[: count + 1])) is not None:
        ends.append(silent_us)
    end_us = min(ends, default=None)
    return end_us if end_us is not None and int(pending.t_us[-1]) > end_us else None


def _before_silence(t_us: Int[Tensor, "e"]) -> int | None:
    """The last event before the first long silence; None where there is none."""
    if int(t_us[-1]) - int(t_us[0]) <= LONGEST_SILENCE_US:
        return None
    silent = torch.nonzero(torch.diff(t_us) > LONGEST_SILENCE_US)
    return int(t_us[int(silent[0])]) if len(silent) else None


def clipped(chunks: Iterable[EventBatch], start_us: int, end_us: int | None = None) -> Iterator[EventBatch]:
    """Events with ``start_us < t <= end_us`` of a stream, reading no further than needed."""
    for chunk in chunks:
        if len(chunk) == 0:
            continue
        newest_us = int(chunk.t_us[-1])
        inside = chunk.slice_time(start_us, newest_us if end_us is None else end_us)
        if len(inside):
            yield inside
        if end_us is not None and newest_us > end_us:
            return
