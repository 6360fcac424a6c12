"""The summary of a run: what ran on what, how fast, how well."""

import json
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

import torchtrack
from torchtrack.core.atomic import writing
from torchtrack.core.machine import describe_machine
from torchtrack.io.problems import ClockChange, Problems
from torchtrack.run.metrics import Metrics, summarise
from torchtrack.run.sinks.record import ObjectRecord, Record
from torchtrack.run.sinks.silences import Silence
from torchtrack.tracking.validation.status import Status

# For what may come into a summary at its end: why it ended, gaps, changes of the clock.
_ROOM_BYTES = 8192
# An object that is tracked in a smaller share of the windows was not tracked; fewer windows tell nothing.
LEAST_TRACKED, FEW_WINDOWS = 0.1, 10

Ended = Literal["running", "completed", "interrupted", "failed"]


@dataclass(frozen=True)
class ObjectSummary:
    """How one object fared.

    Args:
        status: windows by status.
        mean_quality: mean over all windows that had enough events to judge by, 0 to 1; NaN where none had.
        angular_velocity_rad_s: mean over the run, camera axes.
        errors: against ground truth; None where it is not known.
        start_supported: whether the events of its first windows support the pose that it started from; None where too few windows tell.
        unseen_turns: whether the object is a surface of revolution, whose turns about its axis are no errors.
        more: what other sinks have to say, by name.
    """

    status: dict[str, int]
    mean_quality: float
    angular_velocity_rad_s: tuple[float, ...]
    errors: Metrics | None
    start_supported: bool | None = None
    unseen_turns: bool = False
    more: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RunSummary:
    """One run.

    Args:
        source: name of what was tracked.
        ended: ``completed``; ``interrupted`` or ``failed`` before the stream's end; ``running`` while it goes on, and after a process was killed.
        message: why it ended early.
        interrupted: whether ``ended`` is ``interrupted``.
        device, threads: where the tracker ran.
        versions: of torchtrack and what it stands on.
        machine: its system, processor and cores.
        windows, events: how many.
        duration_s: stream time tracked.
        event_rate_per_s: events by stream time.
        wall_s: time that it took, with reading and writing.
        real_time_factor: stream time by wall time.
        tracking_real_time_factor: stream time by the time of the tracker alone, without reading, drawing and writing.
        step_median_ms, step_p95_ms: time of one tracker step.
        objects: by label.
        joined_windows: of a live source, those that came too fast, and were tracked as one with the next.
        dropped_windows, dropped_events: of a live source, what came too fast to be tracked; events of joined windows among them.
        problems: what was wrong with the events, and how often: what was left out, and what was mended.
        clock_changes: where the clock wrapped or jumped back, and time went on: poses have the time that went on.
        gaps: the longest times of 50 ms and more without events.
        gap_count: how many of these there are.
        resumed_us: where a run that had ended early was taken up last (µs); windows, stream time and objects are of all of it, events, rates and
            times of what came after.
    """

    source: str
    ended: Ended
    message: str
    interrupted: bool
    device: str
    threads: int
    versions: dict[str, str]
    windows: int
    events: int
    duration_s: float
    event_rate_per_s: float
    wall_s: float
    real_time_factor: float
    tracking_real_time_factor: float
    step_median_ms: float
    step_p95_ms: float
    objects: dict[str, ObjectSummary]
    machine: dict[str, str | int] = field(default_factory=dict)
    joined_windows: int = 0
    dropped_windows: int = 0
    dropped_events: int = 0
    problems: dict[str, int] = field(default_factory=dict)
    clock_changes: tuple[ClockChange, ...] = ()
    gaps: tuple[Silence, ...] = ()
    gap_count: int = 0
    resumed_us: int | None = None

    @property
    def not_tracked(self) -> dict[str, float]:
        """Objects that were tracked in less than a tenth of the windows, and in which share of them."""
        if self.windows < FEW_WINDOWS:
            return {}
        shares = {label: of_object.status.get(Status.TRACKING.name, 0) / self.windows for label, of_object in self.objects.items()}
        return {label: share for label, share in shares.items() if share < LEAST_TRACKED}

    def as_json(self) -> dict[str, Any]:
        """Plain values; numbers that are not finite become None, as JSON has none."""
        return finite(asdict(self))

    def with_problems(self, problems: Problems | None) -> "RunSummary":
        """The same with what was wrong with the events, where that is counted."""
        if problems is None:
            return self
        counts = {problem.value: number for problem, number in problems.counts.items()}
        return replace(self, problems=counts, clock_changes=tuple(problems.clock_changes))


@dataclass(frozen=True)
class Facts:
    """What a summary says beside what was recorded: how the run ended, where, in what time, and more by label and name."""

    ended: Ended
    message: str
    wall_s: float
    device: str
    resumed_us: int | None = None
    more: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def summarise_run(source: str, labels: Sequence[str], record: Record, facts: Facts) -> RunSummary:
    """The summary of what ``record`` has seen; rates and means of nothing are NaN."""
    step_ms = 1e3 * np.frombuffer(record.step_seconds)
    duration_s = record.duration_s - record.earlier_s
    by_label = zip(labels, record.objects, strict=True)
    return RunSummary(
        source=source,
        ended=facts.ended,
        message=facts.message,
        interrupted=facts.ended == "interrupted",
        device=device_name(facts.device),
        threads=torch.get_num_threads(),
        versions=versions(),
        machine=describe_machine(),
        windows=record.windows,
        events=record.event_count,
        duration_s=record.duration_s,
        gaps=record.silences.longest,
        gap_count=record.silences.count,
        event_rate_per_s=_ratio(record.event_count, duration_s),
        wall_s=facts.wall_s,
        real_time_factor=_ratio(duration_s, facts.wall_s),
        tracking_real_time_factor=_ratio(duration_s, 1e-3 * float(step_ms.sum())),
        step_median_ms=float(np.median(step_ms)) if len(step_ms) else math.nan,
        step_p95_ms=float(np.percentile(step_ms, 95)) if len(step_ms) else math.nan,
        objects={
            label: _summarise_object(record_of_object, record.duration_s, dict(facts.more.get(label, {}))) for label, record_of_object in by_label
        },
        resumed_us=facts.resumed_us,
    )


def write_summary(path: Path, summary: RunSummary, *, room_for_end: bool = False) -> None:
    """Write ``summary.json``, over what is there.

    Args:
        path: of the file.
        summary: what it says.
        room_for_end: fill the file up with blanks to what the summary at the end may need: a disk that is full by then can still take it.

    Raises:
        OutputError: if it cannot be written.
    """
    text = json.dumps(summary.as_json(), indent=2, ensure_ascii=False, allow_nan=False)
    # A name that is no UTF-8 becomes what JSON calls an escape.
    data = text.encode("utf-8", "backslashreplace")
    if room_for_end:
        data = data.ljust(2 * len(data) + _ROOM_BYTES)
    with writing(path):
        path.touch()
        # Over what is there: to empty the file first would give the room away.
        with path.open("rb+", buffering=0) as file:
            file.write(data + b"\n")
            file.truncate(len(data) + 1)


def _ratio(value: float, by: float) -> float:
    return value / by if by else math.nan


def _summarise_object(record: ObjectRecord, duration_s: float, more: dict[str, Any]) -> ObjectSummary:
    return ObjectSummary(
        status={Status(status).name: count for status, count in sorted(record.statuses.items())},
        mean_quality=_ratio(record.quality_sum, record.judged_windows),
        angular_velocity_rad_s=tuple(_ratio(turned, duration_s) for turned in record.turned.tolist()),
        errors=summarise(record.errors) if record.errors is not None else None,
        start_supported=record.start.supported,
        unseen_turns=record.axis is not None,
        more=more,
    )


def versions() -> dict[str, str]:
    """Versions of torchtrack and of what decides its results."""
    return {"torchtrack": torchtrack.__version__, "python": platform.python_version(), "torch": str(torch.__version__), "kornia": version("kornia")}


def device_name(device: str) -> str:
    """``cpu``, or the name of the graphics card."""
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else device


def finite(value: Any) -> Any:
    """The same nested value with None in place of numbers that are not finite."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
