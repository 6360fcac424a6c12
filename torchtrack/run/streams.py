"""Many sessions at once, as the streams of one tracker: their windows are one batch.

Each stream has its own camera, objects, clock and end. One that ends or fails leaves, and the others go on as they were.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import accumulate
from typing import Generic, Protocol, TypeVar, runtime_checkable

import torch

from torchtrack.baselines import tracker_class
from torchtrack.config.run import TrackingConfig
from torchtrack.config.tracker import WindowConfig
from torchtrack.core.events import concatenate
from torchtrack.core.windows import EventWindow
from torchtrack.errors import ConfigError, TorchtrackError
from torchtrack.run.haste import Pace
from torchtrack.run.lost_search import LostSearch
from torchtrack.run.refine import Refinement
from torchtrack.run.session import Session
from torchtrack.run.smooth import SmoothedObjects
from torchtrack.run.stepping import Step, passed_over, timed_between, timed_step
from torchtrack.tracking.state import StepResult, TrackerState, joined, take_part
from torchtrack.tracking.tracker import Tracker

R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)


@runtime_checkable
class Follower(Protocol[R_co]):
    """Who takes the steps of one session, and says what came of them."""

    @property
    def session(self) -> Session:
        """What is tracked."""
        ...

    def windows(self, config: WindowConfig) -> Iterator[EventWindow]:
        """The windows of the session."""
        ...

    def add(self, step: Step) -> None:
        """Take one step."""
        ...

    def finish(self) -> R_co:
        """What came of all steps: called once, after the last."""
        ...

    def close(self, error: BaseException | None = None) -> None:
        """Called when ``error`` has ended the tracking of the session, and in any case at the very end."""
        ...


def follow(
    followers: Sequence[Callable[[], Follower[R]]], config: TrackingConfig, stopped: Callable[[], bool] = lambda: False
) -> list[R | TorchtrackError | OSError]:
    """Track many sessions at once; returns what came of each, or the error that ended it, which ends no other.

    Any other exception ends all of them, and is raised again.

    Args:
        followers: each is called once, and opens its session.
        config: how all of them are tracked.
        stopped: asked after each step; all are finished with what they have once it says so.
    """
    outcomes: dict[int, R | TorchtrackError | OSError] = {}
    opened: dict[int, Follower[R]] = {}
    with ExitStack() as stack:
        for number, opening in enumerate(followers):
            try:
                opened[number] = _entered(stack, _refined(opening(), config))
            except (TorchtrackError, OSError) as error:
                outcomes[number] = error
        for number, step in _steps(opened, config):
            if number not in outcomes:
                _take(number, step, opened[number], outcomes)
            if stopped():
                break
        for number in opened.keys() - outcomes.keys():
            _take(number, Ended(), opened[number], outcomes)
    return [outcomes[number] for number in range(len(followers))]


def _entered(stack: ExitStack, follower: Follower[R]) -> Follower[R]:
    """The follower, closed at the end with what has ended the tracking of all."""
    stack.push(lambda kind, error, trace: follower.close(error))
    return follower


class _Refined(Generic[R]):
    """A follower that is given steps once they are refined."""

    def __init__(self, follower: Follower[R], refinement: Refinement) -> None:
        self._follower, self._refinement = follower, refinement
        self._due = deque[Step]()
        self.session, self.windows = follower.session, follower.windows

    def add(self, step: Step) -> None:
        """Take one step, and give on those that are due."""
        self._due.extend(self._refinement.add(step))
        while self._due:
            self._follower.add(self._due.popleft())

    def finish(self) -> R:
        """Give on what was held back."""
        self._due.extend(self._refinement.rest())
        while self._due:
            self._follower.add(self._due.popleft())
        return self._follower.finish()

    def close(self, error: BaseException | None = None) -> None:
        """Where an error has ended it, give on what was held back, to whoever takes it."""
        try:
            # A second Ctrl-C is of somebody who does not want to wait.
            if isinstance(error, Exception):
                self._due.extend(self._refinement.rest())
                while self._due:
                    with suppress(TorchtrackError, OSError):
                        self._follower.add(self._due.popleft())
        finally:
            self._follower.close(error)


def _refined(follower: Follower[R], config: TrackingConfig) -> Follower[R]:
    """The follower, of refined steps where the settings ask for them; poses of a live source are not held back."""
    session = follower.session
    if not config.tracker.smoothing.holds_back or not session.models or session.live is not None:
        return follower

    def alone(number: int) -> Tracker:
        # Compiling would take longer than it saves.
        return build_tracker([session.with_objects([number])], config.model_copy(update={"compiled": False}))

    return _Refined(follower, Refinement(SmoothedObjects.from_models(session.models, session.camera), config.tracker, alone))


def _take(number: int, step: "Step | Ended", follower: Follower[R], outcomes: dict[int, R | TorchtrackError | OSError]) -> None:
    """Hand a step on; at the end of a stream, note what came of it."""
    try:
        if isinstance(step, Step):
            follower.add(step)
        elif step.error is not None:
            raise step.error
        else:
            outcomes[number] = follower.finish()
    except (TorchtrackError, OSError) as error:
        outcomes[number] = error
        follower.close(error)


def build_tracker(sessions: Sequence[Session], config: TrackingConfig) -> Tracker:
    """The tracker of the objects of some sessions, a stream each, of the kind that the preset is for, on the configured device.

    Raises:
        ConfigError: if the device is not there.
        ModelError: if the method cannot track one of the objects.
    """
    if config.device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device: '{config.device}' was asked for, but PyTorch sees no CUDA device. Use cpu, or a CUDA build of torch.")
    models = [model for session in sessions for model in session.models]
    cameras = [session.camera for session in sessions]
    stream_index = [stream for stream, session in enumerate(sessions) for _ in session.models]
    kind, dtype = tracker_class(config.preset), getattr(torch, config.dtype)
    if not config.compiled:
        return kind(models, cameras, config.tracker, stream_index, dtype, kernels=config.kernels).to(config.device)
    if kind is not Tracker:
        raise ConfigError(f"compiled: the method '{config.preset}' cannot be compiled. Leave it out, or use the preset default, guided or nns.")
    return Tracker(models, cameras, config.tracker, stream_index, dtype, compiled=config.compiled, kernels=config.kernels).to(config.device)


@dataclass(frozen=True)
class Ended:
    """A stream gives no more steps: it came to its end, or failed."""

    error: TorchtrackError | OSError | None = None


@dataclass
class _Stream:
    """One session on its way: what is left of it, and its state."""

    number: int
    session: Session
    windows: Iterator[EventWindow]
    state: TrackerState


def _steps(followers: Mapping[int, Follower[R]], config: TrackingConfig) -> Iterator[tuple[int, Step | Ended]]:
    """Steps of each session from its initial poses on, with its number, and at last that it has ended.

    Sessions whose images have the same size are tracked as one batch, one batch after the other: the images of a
    tracker are taken to be of one size.
    """
    batches: dict[tuple[int, int], list[_Stream]] = {}
    for number, follower in followers.items():
        session = follower.session
        if not session.models:
            yield number, Ended()
            continue
        try:
            # Each alone: one that cannot be tracked does not stop the others.
            state = build_tracker([session], config).init(session.T_cam_obj.to(config.device), session.start_us)
        except TorchtrackError as error:
            yield number, Ended(error)
        else:
            size = session.camera.width, session.camera.height
            batches.setdefault(size, []).append(_Stream(number, session, follower.windows(config.tracker.window), state))
    for streams in batches.values():
        yield from _one_batch(streams, config)


def _one_batch(streams: Sequence[_Stream], config: TrackingConfig) -> Iterator[tuple[int, Step | Ended]]:
    """The steps of streams whose windows are one batch, as long as there are any."""
    tracker, state, rows = _together(streams, config)
    searches = [LostSearch(tracker, place) for place in range(len(streams))]
    # Before the first window is asked for: a live camera does not wait.
    tracker.prepare(state)
    pace = Pace(tracker)
    result: StepResult | None = None
    while True:
        windows = [(stream, _next_window(stream)) for stream in streams]
        yield from ((stream.number, window) for stream, window in windows if isinstance(window, Ended))
        due = [(stream, window) for stream, window in windows if not isinstance(window, Ended)]
        if not due:
            return
        if len(due) < len(streams):
            streams = [stream for stream, _ in due]
            tracker, state, rows = _together(streams, config)
            pace, result = Pace(tracker), None
            searches = [LostSearch(tracker, place) for place in range(len(streams))]
        events = concatenate(window.events.of_stream(place) for place, (_, window) in enumerate(due))
        t_end_us = torch.tensor([window.t_end_us for _, window in due], device=config.device)
        if any(window.after_gap for _, window in due):
            starts_us = [window.t_start_us if window.after_gap else 0 for _, window in due]
            state = passed_over(tracker, state, torch.tensor(starts_us, device=config.device))
        taker = pace.tracker([window for _, window in due], result)
        state, result, spent = timed_step(taker, state, events, t_end_us)
        share, taken = spent.part(len(due)), []
        for (stream, window), own, search in zip(due, rows, searches, strict=True):
            own_state, own_result = take_part(state, *own), take_part(result, *own)
            stream.state, more_seconds = timed_between(search, window, own_state)
            taken.append((stream, Step(window, own_state, own_result, share.seconds + more_seconds, share.stages)))
        if any(stream.state is not step.state for stream, step in taken):
            state = joined([stream.state for stream, _ in taken])
        yield from ((stream.number, step) for stream, step in taken)


def _together(streams: Sequence[_Stream], config: TrackingConfig) -> tuple[Tracker, TrackerState, list[tuple[slice, slice]]]:
    """A tracker of all the streams, their state as one, and the rows of each."""
    tracker = build_tracker([stream.session for stream in streams], config)
    return tracker, joined([stream.state for stream in streams]), _rows([len(stream.session.models) for stream in streams])


def _next_window(stream: _Stream) -> EventWindow | Ended:
    try:
        window = next(stream.windows, None)
    except (TorchtrackError, OSError) as error:
        return Ended(error)
    return Ended() if window is None else window


def _rows(objects: Sequence[int]) -> list[tuple[slice, slice]]:
    """The rows of each stream's objects, given how many they are, and its own."""
    ends = list(accumulate(objects))
    return [(slice(end - count, end), slice(place, place + 1)) for place, (end, count) in enumerate(zip(ends, objects, strict=True))]
