"""A search for an object everywhere, beside a tracker that goes on: in parts, of which each window takes one, or in a thread of its own.

Either ends with the state of the object alone after the newest window. A search in parts ends as soon as it is done. One in a thread ends at a time
that was fixed when it began, so that poses do not hang on how long it took, and is waited for then.
"""

import threading
import weakref
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from torchtrack.core.later import Ahead, Later
from torchtrack.core.windows import EventWindow
from torchtrack.errors import EventDataError, PoseError
from torchtrack.run.first_pose.parts import Parts
from torchtrack.run.first_pose.searching import poses_in_box
from torchtrack.run.first_pose.start import Box, Start
from torchtrack.run.first_pose.tracked import alone, followed_on
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.tracker import Tracker

# Windows that a pose is followed through at a time, so that it catches up with the tracker.
_CAUGHT_UP = 8


@dataclass(frozen=True)
class Candidate:
    """A pose that explains enough so far.

    Args:
        tracker: of the object alone.
        state: after the windows that the pose was followed through.
        scores: in each of these.
        wanted: how much it has to explain all the way.
    """

    tracker: Tracker
    state: TrackerState
    scores: tuple[Tensor, ...]
    wanted: float

    def is_behind(self, window: EventWindow) -> bool:
        """Whether it was not followed through the window yet."""
        return window.t_end_us > int(self.state.t_us[0])

    def followed(self, windows: Sequence[EventWindow]) -> "Candidate":
        """The same after the windows that it is behind."""
        candidate = self
        for window in filter(self.is_behind, windows):
            with torch.inference_mode():
                events = window.events.to("cpu").slice_time(int(candidate.state.t_us[0]), window.t_end_us)
                state, _ = self.tracker.step(candidate.state, events, window.t_end_us)
            candidate = replace(candidate, state=state, scores=(*candidate.scores, state.health.score))
        return candidate

    def accepted(self) -> TrackerState | None:
        """Its state, if it explains enough all the way."""
        return self.state if float(torch.cat(self.scores).mean()) >= self.wanted else None


def candidate_in_box(start: Start, box: Box, wanted: float) -> Parts[Candidate | None]:
    """The pose in a box that explains most, followed through the first windows; none if it is not as much as ``wanted``."""
    poses = yield from poses_in_box(start, box)
    best = yield from followed_on(start, poses)
    return Candidate(alone(start), best.state, (best.state.health.score,), wanted) if best.quality >= wanted else None


@dataclass(frozen=True)
class Ended:
    """What a search has come to: the state of the object alone, if there is one."""

    own: TrackerState | None


@runtime_checkable
class SearchEverywhere(Protocol):
    """A search that is under way."""

    def after(self, window: EventWindow) -> Ended | None:
        """Go on after a window; what the search has come to, once it has ended."""
        ...

    def drop(self) -> None:
        """Nobody waits for it any more."""
        ...


class SearchInParts:
    """Does a part of the search after each window.

    Args:
        candidate: the search.
        windows: that its events are of.
    """

    def __init__(self, candidate: Parts[Candidate | None], windows: Iterable[EventWindow]) -> None:
        self._windows, self._parts = list(windows), self._all_parts(candidate)

    def after(self, window: EventWindow) -> Ended | None:
        """Do one more part."""
        self._windows.append(window)
        try:
            next(self._parts)
        except StopIteration as done:
            return Ended(done.value)
        except (EventDataError, PoseError):
            # No such object there; that is not known before it is tried.
            return Ended(None)
        return None

    def drop(self) -> None:
        """What was done is forgotten."""

    def _all_parts(self, parts: Parts[Candidate | None]) -> Parts[TrackerState | None]:
        candidate = yield from parts
        if candidate is None:
            return None
        while pending := list(filter(candidate.is_behind, self._windows)):
            candidate = candidate.followed(pending[:_CAUGHT_UP])
            if len(pending) > _CAUGHT_UP:
                yield
        return candidate.accepted()


class SearchInThread:
    """Searches in another thread.

    Args:
        candidate: the search.
        windows: that its events are of.
        until_us: when it ends.
        ahead: the thread.
    """

    def __init__(self, candidate: Parts[Candidate | None], windows: Iterable[EventWindow], until_us: int, ahead: Ahead) -> None:
        self._until_us, self._ahead, self._is_over = until_us, ahead, threading.Event()
        self._candidate = Later(partial(_searched, candidate, tuple(windows), self._is_over))
        ahead.compute(self._candidate)
        # Whoever forgets it does not wait for it any more.
        weakref.finalize(self, self._is_over.set)

    def after(self, window: EventWindow) -> Ended | None:
        """Have what the search finds followed through one more window."""
        self._candidate = self._candidate.then(partial(_followed, window=window, is_over=self._is_over))
        self._ahead.compute(self._candidate)
        if window.t_end_us < self._until_us:
            return None
        candidate = self._candidate.value()
        return Ended(None if candidate is None else candidate.accepted())

    def drop(self) -> None:
        """The thread does not go on with it."""
        self._is_over.set()


def _searched(parts: Parts[Candidate | None], windows: Sequence[EventWindow], is_over: threading.Event) -> Candidate | None:
    while not is_over.is_set():
        try:
            next(parts)
        except StopIteration as done:
            candidate: Candidate | None = done.value
            return None if candidate is None else candidate.followed(windows)
        except (EventDataError, PoseError):
            break
    return None


def _followed(candidate: Candidate | None, window: EventWindow, is_over: threading.Event) -> Candidate | None:
    return None if candidate is None or is_over.is_set() else candidate.followed([window])
