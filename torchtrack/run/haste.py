"""Which tracker takes a window of a live stream: the usual one, or while it is behind, one that does less."""

import copy
from collections.abc import Iterable

from torchtrack.config.haste import in_haste
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.windows import EventWindow
from torchtrack.io.keep_up import HastyWindow
from torchtrack.tracking.state import StepResult
from torchtrack.tracking.tracker import Tracker
from torchtrack.tracking.validation.status import Status

# A tracker in haste searches for what is lost once in so long (µs).
_SEARCH_US = 500_000


class Pace:
    """Chooses the tracker of each window.

    Args:
        tracker: the usual one.
    """

    def __init__(self, tracker: Tracker) -> None:
        self._usual = tracker
        self._hasty, self._searching = (_with(tracker, in_haste(tracker.config, searches=searches)) for searches in (False, True))
        self._searched_us: int | None = None

    def tracker(self, windows: Iterable[EventWindow], before: StepResult | None) -> Tracker:
        """The tracker of the windows of its streams, after one that gave ``before``; a search for what is lost is noted."""
        hasty = [window for window in windows if isinstance(window, HastyWindow)]
        if not hasty:
            return self._usual
        end_us = hasty[0].t_end_us
        due = self._searched_us is None or end_us - self._searched_us >= _SEARCH_US
        if before is None or not due or not bool((before.status >= int(Status.LOST)).any()):
            return self._hasty
        self._searched_us = end_us
        return self._searching


def _with(tracker: Tracker, config: TrackerConfig) -> Tracker:
    """The tracker with other settings of windows and search, and all else in common."""
    other = copy.copy(tracker)
    other.config = config
    return other
