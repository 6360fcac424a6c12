"""The loop itself: a stream cut into windows, one tracker step each, in constant memory."""

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from torchtrack.config.tracker import WindowConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.windows import CountWindows, EventWindow, TimeWindows, cut
from torchtrack.run.stage_times import stages_of_step
from torchtrack.tracking.frontend.bursts import LONG_AGO_US
from torchtrack.tracking.motion.model import initial_covariance
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.tracker import Tracker

# In mode 'count', a window is closed after this long with fewer events (µs): four times a window of mode 'time'. Not measured.
_MAX_AGE_US = 20_000


@dataclass(frozen=True)
class Step:
    """One window, what the tracker made of it, and how long that took (s); of streams that are tracked together, an equal part.

    States of smoothed steps have no maps of events. ``stages``: how long each stage took (s), where :func:`stages_timed` asks for it.
    """

    window: EventWindow
    state: TrackerState
    result: StepResult
    seconds: float
    stages: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class StepTime:
    """How long a tracker's step took (s), and each of its stages, where that is asked for."""

    seconds: float
    stages: Mapping[str, float]

    def part(self, streams: int) -> "StepTime":
        """That of one of so many streams."""
        return StepTime(self.seconds / streams, {name: seconds / streams for name, seconds in self.stages.items()})


def cut_windows(chunks: Iterable[EventBatch], t_start_us: int, config: WindowConfig) -> Iterator[EventWindow]:
    """The windows of a stream, by count or by time."""
    return cut(chunks, window_cutter(t_start_us, config))


def window_cutter(t_start_us: int, config: WindowConfig) -> TimeWindows | CountWindows:
    """What cuts a stream into windows from ``t_start_us`` on, by count or by time."""
    if config.mode == "count":
        return CountWindows(config.count, _MAX_AGE_US, t_start_us)
    return TimeWindows(config.duration_us, t_start_us)


@runtime_checkable
class Between(Protocol):
    """What is done between the windows of a stream."""

    def after(self, window: EventWindow, state: TrackerState) -> TrackerState:
        """The state to go on from after a window."""
        ...


def steps(windows: Iterable[EventWindow], tracker: Tracker, state: TrackerState, between: Between | None = None) -> Iterator[Step]:
    """One step per window, and what is done ``between`` them; nothing is recorded for gradients."""
    for window in windows:
        if window.after_gap:
            state = passed_over(tracker, state, torch.full_like(state.t_us, window.t_start_us))
        state, result, taken = timed_step(tracker, state, window.events, window.t_end_us)
        onward, more_seconds = (state, 0.0) if between is None else timed_between(between, window, state)
        yield Step(window, state, result, taken.seconds + more_seconds, taken.stages)
        state = onward


def timed_between(between: Between, window: EventWindow, state: TrackerState) -> tuple[TrackerState, float]:
    """The state to go on from after a window, and how long it took to come by it (s)."""
    begun = time.perf_counter()
    state = between.after(window, state)
    return state, time.perf_counter() - begun


def passed_over(tracker: Tracker, state: TrackerState, t_us: Int[Tensor, "s"]) -> TrackerState:
    """The state after times without events, up to ``t_us`` of those streams that it is later for.

    Objects are where they were, as far as is known: how they moved since is as unknown as at the start.
    """
    passed = t_us > state.t_us
    objects = passed[tracker.stream_index]
    unknown = initial_covariance(tracker.diameter_m, tracker.config.motion)
    return replace(
        state,
        motion=state.motion.at_rest(objects, state.T_cam_obj, unknown),
        maps=replace(state.maps, burst_age_us=torch.where(passed[:, None, None, None], LONG_AGO_US, state.maps.burst_age_us)),
        t_us=torch.maximum(t_us, state.t_us),
        search=None,
    )


def timed_step(
    tracker: Tracker, state: TrackerState, events: EventBatch, t_end_us: int | Int[Tensor, "s"]
) -> tuple[TrackerState, StepResult, StepTime]:
    """State and result of one window, and how long that took."""
    device = state.T_cam_obj.device
    begun = time.perf_counter()
    with stages_of_step() as stages, torch.inference_mode():
        next_state, result = tracker.step(state, events.to(device), t_end_us)
        if device.type == "cuda":
            # Work on the GPU is queued: without waiting, the time measured is that of queueing.
            torch.cuda.synchronize(device)
    return next_state, result, StepTime(time.perf_counter() - begun, stages)
