"""A stream whose events are pushed in: by the callback of a camera's driver, by a message, by a loop of one's own."""

from torchtrack.config.tracker import WindowConfig
from torchtrack.core.events import EventBatch, ForeignEvents, as_batch, check_events
from torchtrack.core.windows import CountWindows, EventWindow, TimeWindows
from torchtrack.errors import ConfigError, EventDataError
from torchtrack.run.lost_search import LostSearch
from torchtrack.run.stepping import steps, window_cutter
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.tracker import Tracker

_NAME = "the events pushed"


class Stream:
    """Tracks one stream whose events are pushed in, in the thread of the caller; nothing is held back to be refined.

    ::

        stream = torchtrack.Stream(tracker, tracker.init(T_cam_obj, t_us))
        for events in camera:
            for result in stream.push(events):
                ...

    Args:
        tracker: the tracker, of one stream; what it compiles is compiled here, before the first events.
        state: where it starts, from :meth:`Tracker.init`.
        window: how to cut the stream; as the tracker is configured when not given.

    Attributes:
        state: after the newest window.

    Raises:
        ConfigError: if the tracker is of several streams.
    """

    def __init__(self, tracker: Tracker, state: TrackerState, window: WindowConfig | None = None) -> None:
        if tracker.streams != 1:
            raise ConfigError(f"events are pushed into a tracker of one stream, but this one has {tracker.streams}. Make a tracker for each stream.")
        self.state, self._tracker = state, tracker
        self._start_us = self._newest_us = int(state.t_us[0])
        self._windows: TimeWindows | CountWindows = window_cutter(self._start_us, window or tracker.config.window)
        self._count, self._lost = 0, LostSearch(tracker)
        tracker.prepare(state)

    def push(self, events: EventBatch | ForeignEvents) -> list[StepResult]:
        """Track with further events; returns the result of each window that is complete with them, which may be none.

        A window is complete once an event after its end has come. Where an error is raised, none of the events are taken.

        Args:
            events: a batch, or events of another library (:meth:`EventBatch.from_library`), sorted by time, after all that were pushed.

        Raises:
            EventDataError: if they are not in time order, older than those pushed before, not after the start, or outside the sensor.
        """
        batch = as_batch(events)
        if len(batch) == 0:
            return []
        self._check(batch)
        self._newest_us = int(batch.t_us[-1])
        self._count += len(batch)
        return self._track(list(self._windows.add(batch)))

    def finish(self) -> list[StepResult]:
        """The result of the last window, which is not complete, once no more events come; none where no event is in it."""
        return self._track(list(self._windows.rest()))

    def _check(self, batch: EventBatch) -> None:
        first_us = int(batch.t_us[0])
        if self._count == 0 and first_us <= self._start_us:
            raise EventDataError(
                f"{_NAME}: the first is at {first_us} µs, but tracking starts at {self._start_us} µs, and takes what comes after. "
                "Leave out the events up to then, as EventBatch.slice_time does."
            )
        if bool((batch.stream_index != 0).any()):
            raise EventDataError(f"{_NAME}: there are some of other streams than the first. Push those of one stream: EventBatch.of_stream(0).")
        camera = self._tracker.cameras[0]
        check_events(batch, camera.width, camera.height, _NAME, self._newest_us if self._count else None, self._count)

    def _track(self, windows: list[EventWindow]) -> list[StepResult]:
        results = []
        for window in windows:
            (step,) = steps([window], self._tracker, self.state)
            self.state = self._lost.after(window, step.state)
            results.append(step.result)
        return results

    def __repr__(self) -> str:
        return f"Stream({self._tracker!r}, {self._count} events up to {self._newest_us} µs)"
