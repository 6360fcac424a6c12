"""Keeping up with a live stream: windows wait in a bounded queue, and where they come too fast, several are tracked as one, with fewer events.

As many are joined as came during the step before, and an eighth of those that wait beside them: at a constant speed the
windows stay as short as it allows, and after a pause they are caught up with little by little, as a prediction over a
long window is too uncertain to be followed. A joined window has about as many events as one of those that it is made of,
evenly left out, and the newest of all is kept. All of the stream's time is tracked, and a pose comes late by the time of
``capacity`` windows and of one step at most. Joined windows are no longer than ``LONGEST_US``: what would make one longer
is dropped. All that is left out is counted.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import torch

from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.windows import EventWindow

MOST_JOINED = 12
"""So many windows are tracked as one at most, while fewer than may wait do."""
LONGEST_US = 1_000_000
"""Windows that wait are joined to no longer ones than this (µs); then the oldest is dropped."""
FEWEST_EVENTS = 20_000
"""No events are left out of joined windows that have fewer: a step with 20,000 takes 10 % longer than one with 2,000."""
_WAIT_S = 0.05
# Of the windows that wait beside those that came during the last step, one in so many is joined with these.
_CAUGHT_UP = 8
# So long after the last joined window a tracker is still in haste (µs): one more search, and it is behind again.
_CALM_US = 100_000


class HastyWindow(EventWindow):
    """A window for a tracker that is behind its stream, was just now, or begins: it has no time for what can wait."""


class WaitingWindows:
    """The windows that wait, in order; not for several threads.

    Args:
        capacity: how many may wait.

    Attributes:
        joined_windows: how many were joined with the one after them, so far.
        dropped_windows: how many were dropped.
        dropped_events: events that were left out, with those of dropped windows.
    """

    def __init__(self, capacity: int) -> None:
        self.joined_windows = self.dropped_windows = self.dropped_events = 0
        self._capacity, self._waiting = capacity, deque[EventWindow]()
        self._came = self._taken = 0
        self._haste_until_us: int | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, window: EventWindow) -> None:
        """A window has come; of too many, the two oldest become one."""
        self._waiting.append(window)
        self._came += 1
        if len(self._waiting) <= self._capacity:
            return
        oldest = self._waiting.popleft()
        if self._waiting and self._waiting[0].t_end_us - oldest.t_start_us <= LONGEST_US:
            self._waiting.appendleft(self._joined([oldest, self._waiting.popleft()]))
        else:
            self.dropped_windows += 1
            self.dropped_events += len(oldest.events)
            if oldest.after_gap and self._waiting:
                self._waiting.appendleft(replace(self._waiting.popleft(), after_gap=True))

    def take(self) -> EventWindow:
        """What is to be tracked next: the oldest window, or the oldest ones as one."""
        count, starts = self._due(), self._taken == 0
        taken = [self._waiting.popleft()]
        while len(taken) < count and not self._waiting[0].after_gap:
            taken.append(self._waiting.popleft())
        self._came, self._taken = 0, len(taken)
        window = self._joined(taken) if len(taken) > 1 else taken[0]
        # With all that is tried at a start, the first step would take as long as tens of windows.
        if len(taken) > 1 or starts:
            self._haste_until_us = window.t_end_us + _CALM_US
        in_haste = self._haste_until_us is not None and window.t_end_us <= self._haste_until_us
        return HastyWindow(window.events, window.t_start_us, window.t_end_us, window.after_gap) if in_haste else window

    def _due(self) -> int:
        """How many windows are to be taken as one: no more than twice as many as the last time."""
        waited = max(len(self._waiting) - self._came, 0)
        return min(len(self._waiting), self._came - (-waited // _CAUGHT_UP), max(2 * self._taken, 2), MOST_JOINED)

    def _joined(self, windows: list[EventWindow]) -> EventWindow:
        """Windows as one, with the events that one of them has in the mean, or ``FEWEST_EVENTS``."""
        events = concatenate(window.events for window in windows)
        kept = _thinned(events, max(len(events) // len(windows), FEWEST_EVENTS))
        self.joined_windows += len(windows) - 1
        self.dropped_events += len(events) - len(kept)
        return EventWindow(kept, windows[0].t_start_us, windows[-1].t_end_us, windows[0].after_gap)


class KeepUp:
    """Takes windows as they come, and hands them to someone who may be slower.

    Args:
        windows: the windows; they are taken from a thread of its own.
        capacity: how many may wait.
        stop_source: called once when the consumer has finished, so that ``windows`` ends.

    Attributes:
        waiting: the windows that wait, with counts of what was left out.
    """

    def __init__(self, windows: Iterable[EventWindow], capacity: int, stop_source: Callable[[], None] = lambda: None) -> None:
        self.waiting = WaitingWindows(capacity)
        self._windows, self._stop_source = windows, stop_source
        self._changed = threading.Condition()
        self._closed = self._ended = False
        self._error: BaseException | None = None

    def until(self, stopped: Callable[[], bool]) -> Iterator[EventWindow]:
        """The windows, in order, until they end or ``stopped`` says so.

        Raises:
            KeyboardInterrupt: if it is stopped before the first window.
        """
        thread = threading.Thread(target=self._take, name="torchtrack-live", daemon=True)
        thread.start()
        count = 0
        try:
            while not stopped():
                window = self._next()
                if window is None:
                    if self._ended and not self.waiting:
                        break
                    continue
                count += 1
                yield window
            if count == 0 and stopped():
                raise KeyboardInterrupt
            if self._error is not None:
                raise self._error
        finally:
            self._closed = True
            self._stop_source()
            thread.join()

    def _next(self) -> EventWindow | None:
        """What is to be tracked next, or None if there is nothing after a short wait."""
        with self._changed:
            if not self.waiting and not self._ended:
                self._changed.wait(_WAIT_S)
            return self.waiting.take() if self.waiting else None

    def _take(self) -> None:
        try:
            for window in self._windows:
                with self._changed:
                    self.waiting.put(window)
                    self._changed.notify()
                if self._closed:
                    break
        except Exception as error:  # noqa: BLE001 - it is raised again where the windows are used
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()


def _thinned(events: EventBatch, count: int) -> EventBatch:
    """So many of the events at most, spread evenly, with the newest."""
    if len(events) <= count:
        return events
    return events[torch.arange(1, count + 1) * len(events) // count - 1]
