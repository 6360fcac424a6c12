"""A task of a progress bar that follows a run: how far it is, events and stream time for a second of wall time."""

import time

from rich.progress import Progress

from torchtrack.run.session import Session
from torchtrack.run.stepping import Step


class ProgressBar:
    """Shows how far a run is, by stream time: up to its end, or where the file will end by what was read of it.

    Args:
        progress: where the task is shown.
        session: what is tracked.
    """

    def __init__(self, progress: Progress, session: Session) -> None:
        self._progress, self._session = progress, session
        self._task = progress.add_task(f"starting {session.name}", total=None)
        self._begun: float | None = None
        self._events = 0
        self._first_us = 0

    def add(self, step: Step) -> None:
        """Take one step."""
        is_first = self._begun is None
        if self._begun is None:
            self._progress.reset(self._task, description=self._session.name)
            self._begun, self._first_us = time.perf_counter() - step.seconds, step.window.t_start_us
        self._events += len(step.window.events)
        wall_s, stream_s = time.perf_counter() - self._begun, 1e-6 * (step.window.t_end_us - self._first_us)
        end_us = self._session.expected_end_us
        total_s = None if end_us is None else max(1e-6 * (end_us - self._first_us), stream_s)
        rates = f"{1e-6 * self._events / wall_s:.2f} Mev/s  {stream_s / wall_s:.2f}x real time"
        self._progress.update(self._task, total=total_s, completed=stream_s, rates=rates, refresh=is_first)

    def close(self) -> None:
        """Take the task away."""
        self._progress.remove_task(self._task)
