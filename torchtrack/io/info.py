"""Facts about a stream of events, gathered in one pass and constant memory."""

from dataclasses import dataclass, field
from typing import Any

import torch

from torchtrack.io.event_source import EventSource

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
        mean_rate, peak_rate: events per second, over all that was read and in the busiest 10 ms.
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


def summarise(source: EventSource, max_events: int | None = None) -> EventInfo:
    """Read a stream, or its first ``max_events`` events, and say what is in it."""
    first_us: int | None = None
    last_us: int | None = None
    count = brighter = gap_count = 0
    gaps: list[Gap] = []
    peak = _Peak()
    complete = True
    for chunk in source.chunks():
        if max_events is not None and count + len(chunk) > max_events:
            chunk, complete = chunk[: max_events - count], False
            if len(chunk) == 0:
                break
        t_us = chunk.t_us
        before = t_us[:1] if last_us is None else torch.tensor([last_us])
        steps = torch.diff(t_us, prepend=before)
        at = torch.nonzero(steps > _GAP_US)[:, 0]
        gap_count += len(at)
        gaps = sorted([*gaps, *_longest(t_us, steps, at)], key=lambda gap: -gap.duration_us)[:_MOST_GAPS]
        peak.add(t_us)
        first_us = int(t_us[0]) if first_us is None else first_us
        last_us = int(t_us[-1])
        count += len(chunk)
        brighter += int(chunk.polarity.sum())
        if not complete:
            break
    problems = getattr(source, "problems", None)
    duration_s = 1e-6 * max((last_us or 0) - (first_us or 0), 1)
    return EventInfo(
        width=source.width,
        height=source.height,
        count=count if complete else getattr(source, "known_count", None),
        complete=complete,
        first_us=first_us,
        last_us=last_us,
        mean_rate=count / duration_s if count > 1 else 0.0,
        peak_rate=peak.count / (1e-6 * _PEAK_SPAN_US),
        brighter_share=brighter / count if count else 0.0,
        gaps=tuple(sorted(gaps, key=lambda gap: gap.start_us)),
        gap_count=gap_count,
        problems={problem.value: number for problem, number in problems.counts.items()} if problems is not None else {},
    )


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
