"""The steps of a run, held back until it is known what is found after them, and given on with objects followed back in time."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from torchtrack.config.tracker import TrackerConfig
from torchtrack.run.retracing import Gap, retraced
from torchtrack.run.smooth import SmoothedObjects, filtered_of
from torchtrack.run.stepping import Step
from torchtrack.tracking.motion.smoother import goes_on
from torchtrack.tracking.tracker import Tracker
from torchtrack.tracking.validation.status import Status

# Where objects were lost and found is looked at for so many windows at a time.
_AT_ONCE = 10
# Poses of what was hidden, and can't be followed any farther, are known from before that if it was for no longer (s).
HIDDEN_FOR_S = 0.5
# In the first windows in which it is seen well, an object still comes to where it is: from so many on it is followed back.
_SEEN_WINDOWS = 4


@dataclass
class _Lost:
    """Since when an object is lost, or was found in another place than was to be expected: the first step of it that is held.

    Args:
        first: number of the step.
        seen: in how many windows it was seen well since it was lost last.
    """

    first: int
    seen: int = 0


class Retracer:
    """Takes the steps of a run as they come, and gives each on once nothing that is found later changes it.

    In memory are the events and results of ``smoothing.retrace_s`` and :data:`HIDDEN_FOR_S`; states have no maps of events, which take far more.

    Args:
        objects: what is tracked.
        config: of the run.
        alone: a tracker of one of the objects alone, by its number; asked for when it is first needed.
    """

    def __init__(self, objects: SmoothedObjects, config: TrackerConfig, alone: Callable[[int], Tracker]) -> None:
        self._objects, self._config, self._alone = objects, config, alone
        self._trackers: dict[int, Tracker] = {}
        self._held: list[Step] = []
        # How many of the held steps were looked at; the first of a run has none before it.
        self._looked_at = 1
        self._lost: dict[int, _Lost] = {}

    def add(self, step: Step) -> list[Step]:
        """Take one step; returns those that are due, in order."""
        self._held.append(replace(step, state=step.state.without_maps()))
        if len(self._held) >= self._looked_at + _AT_ONCE:
            self._look()
        due_us = step.window.t_end_us - 1e6 * (self._config.smoothing.retrace_s + HIDDEN_FOR_S)
        # With one that was looked at, the next ones begin.
        return self._given_on(min(sum(held.window.t_end_us <= due_us for held in self._held), self._looked_at - 1))

    def rest(self) -> list[Step]:
        """Those that are still held back, when no more come."""
        self._look()
        return self._given_on(len(self._held))

    def _given_on(self, count: int) -> list[Step]:
        given, self._held = self._held[:count], self._held[count:]
        self._looked_at = max(self._looked_at - count, 1)
        self._lost = {number: replace(lost, first=max(lost.first - count, 0)) for number, lost in self._lost.items()}
        return given

    @torch.inference_mode()
    def _look(self) -> None:
        """See which objects were lost in the newest steps, and follow back those that are seen well again."""
        newest, begun = self._held[self._looked_at - 1 :], time.perf_counter()
        if len(newest) > 1:
            objects, states = self._objects, [step.state for step in newest]
            is_continuous = goes_on(filtered_of(states), objects.centre_obj, objects.diameter_m, self._config.motion)
            status = torch.stack([step.result.status for step in newest[1:]]).cpu()
            lost = ~is_continuous | (status >= int(Status.LOST))
            seen = torch.stack([state.health.time_since_validated_s == 0 for state in states[1:]]).cpu() & ~lost
            for at, (lost_now, seen_now) in enumerate(zip(lost.tolist(), seen.tolist(), strict=True), self._looked_at):
                self._note(at, lost_now, seen_now)
            seconds = (time.perf_counter() - begun) / (len(newest) - 1)
            self._held[self._looked_at :] = [replace(step, seconds=step.seconds + seconds) for step in self._held[self._looked_at :]]
        self._looked_at = max(len(self._held), 1)

    def _note(self, at: int, lost: list[bool], seen: list[bool]) -> None:
        """Take note of which objects were lost, and which are seen well, in a step."""
        for number, (is_lost, is_seen) in enumerate(zip(lost, seen, strict=True)):
            if is_lost:
                self._lost.setdefault(number, _Lost(at)).seen = 0
            elif is_seen and number in self._lost:
                self._lost[number].seen += 1
                if self._lost[number].seen == _SEEN_WINDOWS:
                    gap = Gap(self._lost.pop(number).first, at, self._farthest(at))
                    self._held = retraced(self._held, number, gap, self._tracker(number))

    def _farthest(self, at: int) -> int:
        """The step that is followed back to from one, at most."""
        since_us = self._held[at].window.t_end_us - 1e6 * self._config.smoothing.retrace_s
        return sum(step.window.t_end_us < since_us for step in self._held)

    def _tracker(self, number: int) -> Tracker:
        if number not in self._trackers:
            self._trackers[number] = self._alone(number)
        return self._trackers[number]
