"""Keeping up with a live stream: windows wait in a bounded queue, and whole ones are dropped, never a part of one, never silently."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator

from torchtrack.events import EventWindow

_WAIT_S = 0.05


class KeepUp:
    """Takes windows as they come, and hands them to someone who may be slower.

    Where more than ``capacity`` windows wait, the oldest is dropped: what is tracked stays near the present.

    Args:
        windows: the windows; they are taken from a thread of its own.
        capacity: how many may wait.
        stop_source: called once when the consumer has finished, so that ``windows`` ends.

    Attributes:
        dropped_windows, dropped_events: what was dropped so far.
    """

    def __init__(self, windows: Iterable[EventWindow], capacity: int, stop_source: Callable[[], None] = lambda: None) -> None:
        self.dropped_windows = self.dropped_events = 0
        self._windows, self._capacity, self._stop_source = windows, capacity, stop_source
        self._queue: deque[EventWindow] = deque()
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
                    if self._ended and not self._queue:
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
        """The window that waits longest, or None if there is none after a short wait."""
        with self._changed:
            if not self._queue and not self._ended:
                self._changed.wait(_WAIT_S)
            return self._queue.popleft() if self._queue else None

    def _take(self) -> None:
        try:
            for window in self._windows:
                with self._changed:
                    self._queue.append(window)
                    if len(self._queue) > self._capacity:
                        dropped = self._queue.popleft()
                        self.dropped_windows += 1
                        self.dropped_events += len(dropped.events)
                    self._changed.notify()
                if self._closed:
                    break
        except Exception as error:  # noqa: BLE001 - it is raised again where the windows are used
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()
