"""The steps of a run, refined by what came after them as the settings say: objects are followed back in time, and poses smoothed."""

from collections.abc import Callable, Iterator
from typing import Protocol, runtime_checkable

from torchtrack.config.tracker import TrackerConfig
from torchtrack.run.retrace import Retracer
from torchtrack.run.smooth import SmoothedObjects, Smoother
from torchtrack.run.stepping import Step
from torchtrack.tracking.tracker import Tracker


@runtime_checkable
class Stage(Protocol):
    """Takes steps as they come, and gives each on later."""

    def add(self, step: Step) -> list[Step]:
        """Take one step; returns those that are due, in order."""
        ...

    def rest(self) -> list[Step]:
        """Those that are still held back, when no more come."""
        ...


class Refinement:
    """One stage after the other.

    Args:
        objects: what is tracked.
        config: of the run; with neither retracing nor smoothing, steps are given on as they come.
        alone: a tracker of one of the objects alone, by its number.
    """

    def __init__(self, objects: SmoothedObjects, config: TrackerConfig, alone: Callable[[int], Tracker]) -> None:
        self._stages: list[Stage] = []
        if config.smoothing.retrace_s:
            self._stages.append(Retracer(objects, config, alone))
        if config.smoothing.lag_s:
            self._stages.append(Smoother(objects, config))

    def add(self, step: Step) -> list[Step]:
        """Take one step; returns those that are due, in order."""
        # What came after a gap tells nothing of the motion before it.
        before_gap = self.rest() if step.window.after_gap else []
        return before_gap + _through(self._stages, [step])

    def rest(self) -> list[Step]:
        """Those that are still held back, when no more come."""
        due: list[Step] = []
        for stage in self._stages:
            due = [later for step in due for later in stage.add(step)] + stage.rest()
        return due


def refined_steps(steps: Iterator[Step], refinement: Refinement) -> Iterator[Step]:
    """The same steps with refined poses, some time later."""
    for step in steps:
        yield from refinement.add(step)
    yield from refinement.rest()


def _through(stages: list[Stage], steps: list[Step]) -> list[Step]:
    for stage in stages:
        steps = [due for step in steps for due in stage.add(step)]
    return steps
