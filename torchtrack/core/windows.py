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


class TimeWindows:
    """Cuts a stream into windows of a duration while its events come; windows without events are yielded too.

    After :data:`LONGEST_SILENCE_US` without events, time is passed over up to the next one.

    Args:
        duration_us: length of a window.
        t_start_us: where the first window starts; just before the first event when not given.

    Raises:
        EventDataError: if a window would not last.
    """

    def __init__(self, duration_us: int, t_start_us: int | None = None) -> None:
        if duration_us < 1:
            raise EventDataError(f"a window must last at least 1 µs, got {duration_us}.")
        self._duration_us, self._start_us = duration_us, t_start_us
        self._end_us: int | None = None
        self._heard_us: int | None = None
        self._pending: list[EventBatch] = []
        self._after_gap = False

    def add(self, chunk: EventBatch) -> Iterator[EventWindow]:
        """The windows that are complete with these events, which come after all before: an event after their end has been seen."""
        if len(chunk) == 0:
            return
        start_us = int(chunk.t_us[0]) - 1 if self._start_us is None else self._start_us
        if self._end_us is None:
            self._heard_us, self._end_us = start_us, start_us + self._duration_us
        newest_us = int(chunk.t_us[-1])
        # Only what is after the start counts; later on, nothing else is left.
        left = chunk[int(torch.searchsorted(chunk.t_us, start_us, right=True)) :]
        while self._end_us < newest_us:
            cut = int(torch.searchsorted(left.t_us, self._end_us, right=True))
            self._heard_us = self._end_us if cut or self._pending else self._heard_us
            window = EventWindow(concatenate([*self._pending, left[:cut]]) if self._pending else left[:cut], start_us, self._end_us, self._after_gap)
            self._pending, left = [], left[cut:]
            start_us, self._after_gap = _after_silence(left, self._end_us, self._heard_us)
            self._start_us, self._end_us = start_us, start_us + self._duration_us
            yield window
        self._start_us = start_us
        self._pending += [left] if len(left) else []

    def rest(self) -> Iterator[EventWindow]:
        """The window that is not complete, once no more events come; none where nothing is in it."""
        if self._pending and self._start_us is not None and self._end_us is not None:
            events = concatenate(self._pending) if len(self._pending) > 1 else self._pending[0]
            yield EventWindow(events, self._start_us, self._end_us, self._after_gap)


class CountWindows:
    """Cuts a stream into windows of ``count`` events while they come, closed early once ``max_age_us`` have passed.

    Events that share the time of a window's last event stay together with it, so windows may hold a few more.
    Windows in which ``max_age_us`` passed without an event are yielded too, and time without events is passed over as by
    :class:`TimeWindows`: no window reaches over more than :data:`LONGEST_SILENCE_US` of it.

    Args:
        count: events of a window.
        max_age_us: how long a window lasts at most.
        t_start_us: where the first window starts; just before the first event when not given.

    Raises:
        EventDataError: if count or age are not positive.
    """

    def __init__(self, count: int, max_age_us: int | None = None, t_start_us: int | None = None) -> None:
        if count < 1 or (max_age_us is not None and max_age_us < 1):
            raise EventDataError(f"a window needs a positive count and maximum age, got {count} and {max_age_us}.")
        self._count, self._max_age_us, self._start_us = count, max_age_us, t_start_us
        self._heard_us: int | None = None
        self._pending, self._after_gap = EventBatch.empty(), False

    def add(self, chunk: EventBatch) -> Iterator[EventWindow]:
        """The windows that are complete with these events, which come after all before."""
        if len(chunk) == 0:
            return
        start_us = int(chunk.t_us[0]) - 1 if self._start_us is None else self._start_us
        self._heard_us = start_us if self._heard_us is None else self._heard_us
        pending = concatenate([self._pending, chunk]) if len(self._pending) else chunk
        # Only what is after the start counts; later on, nothing else is left.
        self._pending = pending[int(torch.searchsorted(pending.t_us, start_us, right=True)) :]
        while True:
            if not self._after_gap:
                # Without a maximum age, no windows without events lead into the silence.
                waited_us = start_us - LONGEST_SILENCE_US if self._max_age_us is None else self._heard_us
                start_us, self._after_gap = _after_silence(self._pending, start_us, waited_us)
            self._start_us = start_us
            if (end_us := _count_window_end(self._pending, self._count, self._max_age_us, start_us)) is None:
                break
            cut = int(torch.searchsorted(self._pending.t_us, end_us, right=True))
            self._heard_us = int(self._pending.t_us[cut - 1]) if cut else self._heard_us
            window = EventWindow(self._pending[:cut], start_us, end_us, self._after_gap)
            self._pending, start_us, self._after_gap = self._pending[cut:], end_us, False
            self._start_us = start_us
            yield window

    def rest(self) -> Iterator[EventWindow]:
        """The window that is not complete, once no more events come; none where nothing is in it."""
        if len(self._pending) and self._start_us is not None:
            yield EventWindow(self._pending, self._start_us, int(self._pending.t_us[-1]), self._after_gap)


def windows_by_time(chunks: Iterable[EventBatch], duration_us: int, t_start_us: int | None = None) -> Iterator[EventWindow]:
    """The windows of a stream in time order that is cut into chunks anywhere, as :class:`TimeWindows` cuts them, in constant memory."""
    yield from cut(chunks, TimeWindows(duration_us, t_start_us))


def windows_by_count(chunks: Iterable[EventBatch], count: int, max_age_us: int | None = None, t_start_us: int | None = None) -> Iterator[EventWindow]:
    """The windows of a stream in time order that is cut into chunks anywhere, as :class:`CountWindows` cuts them, in constant memory."""
    yield from cut(chunks, CountWindows(count, max_age_us, t_start_us))


def cut(chunks: Iterable[EventBatch], windows: TimeWindows | CountWindows) -> Iterator[EventWindow]:
    """All windows of a stream."""
    for chunk in chunks:
        yield from windows.add(chunk)
    yield from windows.rest()


def _after_silence(left: EventBatch, t_start_us: int, heard_us: int | None) -> tuple[int, bool]:
    """Where the window from ``t_start_us`` on is to start instead, if nothing was heard for long and nothing will be soon; whether so."""
    if heard_us is None or t_start_us - heard_us < LONGEST_SILENCE_US or len(left) == 0:
        return t_start_us, False
    next_us = int(left.t_us[0])
    return (next_us - 1, True) if next_us - t_start_us > LONGEST_SILENCE_US else (t_start_us, False)


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
