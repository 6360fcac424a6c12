"""Facts about a stream of events, gathered in one pass and constant memory."""

from dataclasses import dataclass, field
from typing import Any

import torch

from torchtrack.core.events import EventBatch
from torchtrack.io.event_source import EventSource
from torchtrack.io.reading import Progress, Reading

_PEAK_SPAN_US = 10_000
_GAP_US = 10_000
_MOST_GAPS = 5


@dataclass(frozen=True)
class Gap:
    """A time without events: from the event before it, for so long (µs)."""

    start_us: int
    duration_us: int


@dataclass(frozen=True)
class EventInfo:
    """Facts about a stream.

    Args:
        width, height: sensor size (px).
        count: events read, or, where ``complete`` is False, an estimate for all of the stream (None if there is none).
        complete: whether all of the stream was read.
        first_us, last_us: times of the first and last event read; None without events.
        mean_rate, peak_rate: events per second, over all that was read and in the busiest 10 ms, or in all where that is less.
        brighter_share: share of events where it got brighter.
        gaps: the longest times without events, of more than 10 ms.
        gap_count: how many of these there are.
        problems: what was wrong, by kind.
    """

    width: int
    height: int
    count: int | None
    complete: bool
    first_us: int | None
    last_us: int | None
    mean_rate: float
    peak_rate: float
    brighter_share: float
    gaps: tuple[Gap, ...] = ()
    gap_count: int = 0
    problems: dict[str, int] = field(default_factory=dict)

    @property
    def duration_us(self) -> int:
        """From the first to the last event."""
        return self.last_us - self.first_us if self.first_us is not None and self.last_us is not None else 0


def summarise(source: EventSource, max_events: int | None = None, progress: Progress | None = None) -> EventInfo:
    """Read a stream, or its first ``max_events`` events, and say what is in it; ``progress`` is called where it is known."""
    tally = _Tally()
    reading: Reading | None = getattr(source, "reading", None)
    complete = True
    for chunk in source.chunks():
        if max_events is not None and tally.count + len(chunk) > max_events:
            chunk, complete = chunk[: max_events - tally.count], False
        if len(chunk):
            tally.add(chunk)
        if progress is not None and reading is not None and reading.share is not None:
            progress(max(reading.share, tally.count / max_events if max_events else 0.0))
        if not complete:
            break
    problems = getattr(source, "problems", None)
    return EventInfo(
        width=source.width,
        height=source.height,
        count=tally.count if complete else getattr(source, "known_count", None),
        complete=complete,
        first_us=tally.first_us,
        last_us=tally.last_us,
        mean_rate=tally.mean_rate,
        # Where all is shorter than a span, or the last one is cut off, no span is full.
        peak_rate=max(tally.peak.count / (1e-6 * _PEAK_SPAN_US), tally.mean_rate),
        brighter_share=tally.brighter / max(tally.count, 1),
        gaps=tuple(sorted(tally.gaps, key=lambda gap: gap.start_us)),
        gap_count=tally.gap_count,
        problems={problem.value: number for problem, number in problems.counts.items()} if problems is not None else {},
    )


@dataclass
class _Tally:
    """What was seen so far."""

    count: int = 0
    brighter: int = 0
    first_us: int | None = None
    last_us: int | None = None
    gap_count: int = 0
    gaps: list[Gap] = field(default_factory=list)
    peak: "_Peak" = field(default_factory=lambda: _Peak())

    def add(self, chunk: EventBatch) -> None:
        t_us = chunk.t_us
        self.first_us = int(t_us[0]) if self.first_us is None else self.first_us
        before = self.first_us if self.last_us is None else self.last_us
        steps = torch.diff(t_us, prepend=torch.tensor([before]))
        at = torch.nonzero(steps > _GAP_US)[:, 0]
        self.gap_count += len(at)
        self.gaps = sorted([*self.gaps, *_longest(t_us, steps, at)], key=lambda gap: -gap.duration_us)[:_MOST_GAPS]
        self.peak.add(t_us)
        self.last_us = int(t_us[-1])
        self.count += len(chunk)
        self.brighter += int(chunk.polarity.sum())

    @property
    def mean_rate(self) -> float:
        if self.first_us is None or self.last_us is None or self.count < 2:
            return 0.0
        return self.count / (1e-6 * max(self.last_us - self.first_us, 1))


def _longest(t_us: torch.Tensor, steps: torch.Tensor, at: torch.Tensor) -> list[Gap]:
    longest = at[torch.argsort(steps[at], descending=True)[:_MOST_GAPS]]
    return [Gap(int(t_us[i]) - int(steps[i]), int(steps[i])) for i in longest.tolist()]


@dataclass
class _Peak:
    """Events in the busiest span, counted in spans that start at multiples of their length."""

    count: int = 0
    _open: tuple[int, int] = (0, 0)

    def add(self, t_us: torch.Tensor) -> None:
        spans, counts = torch.unique_consecutive(torch.div(t_us, _PEAK_SPAN_US, rounding_mode="floor"), return_counts=True)
        if int(spans[0]) == self._open[0]:
            counts[0] += self._open[1]
        self.count = max(self.count, int(counts.max()))
        self._open = int(spans[-1]), int(counts[-1])


def as_plain(info: EventInfo) -> dict[str, Any]:
    """The facts as plain values, for JSON and tables."""
    plain: dict[str, Any] = {name: value for name, value in vars(info).items() if name != "gaps"}
    return plain | {"duration_us": info.duration_us, "gaps": [vars(gap) for gap in info.gaps]}
