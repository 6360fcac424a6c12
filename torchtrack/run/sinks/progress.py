"""A progress bar with event rate and real-time factor."""

import time

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from torchtrack.run.stepping import Step


class _Rates(ProgressColumn):
    """Events and stream time handled per second of wall time."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.fields['events_per_s'] / 1e6:.2f} Mev/s  {task.fields['real_time']:.2f}x real time")


class ProgressBar:
    """Shows how far a run is; ``duration_s`` is the length of the stream, None where it is not known."""

    def __init__(self, console: Console, name: str, duration_s: float | None = None) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), _Rates())
        self._progress = Progress(*columns, console=console, transient=True)
        self._task = self._progress.add_task(name, total=duration_s, events_per_s=0.0, real_time=0.0)
        self._begun: float | None = None
        self._events = 0
        self._first_us = 0

    def add(self, step: Step) -> None:
        """Take one step."""
        if self._begun is None:
            self._progress.start()
            self._begun, self._first_us = time.perf_counter() - step.seconds, step.window.t_start_us
        self._events += len(step.window.events)
        wall_s, stream_s = time.perf_counter() - self._begun, 1e-6 * (step.window.t_end_us - self._first_us)
        self._progress.update(self._task, completed=stream_s, events_per_s=self._events / wall_s, real_time=stream_s / wall_s)

    def close(self) -> None:
        """Take the bar away."""
        self._progress.stop()
