"""The time of each stage of a tracker's step, where somebody asks for it.

The functions of each stage are replaced by ones that note the time while it is measured, where the pipeline looks them up:
the pipeline itself has no clock in it, and a run that asks for none is as fast as ever. A stage's time is its own: without that
of the stages that it calls. A window that a CUDA graph takes is one stage, ``rest``: its functions were called when it was made.
"""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from importlib import import_module
from typing import Any

import torch

STAGES: dict[str, tuple[str, ...]] = {
    "prediction": ("tracking.expectation:predicted_after",),
    "contours": ("tracking.contours.objects:mesh_contours", "tracking.contours.objects:splat_contours"),
    "visibility": ("tracking.contours.objects:remove_hidden",),
    "surface": ("tracking.step:update_last_event", "tracking.frontend.sensors:time_surface"),
    "corners": ("tracking.frontend.sensors:Sensors.corners", "tracking.frontend.sensors:detect_corners"),
    "flow": ("tracking.step:estimate_flow", "tracking.step:guided_by_flow"),
    "index": ("tracking.step:index_for", "tracking.estimation.rounds:index_for"),
    "window's events": ("tracking.frontend.sensors:Sensors.seen",),
    "selection": ("tracking.step:select_events", "tracking.step:corner_observations"),
    "association": ("tracking.estimation.rounds:match_nearest", "tracking.estimation.rounds:match_along_flow"),
    "problem": ("tracking.estimation.rounds:_believed", "tracking.estimation.rounds:_problem", "tracking.estimation.rounds:prior_information"),
    "solver": ("tracking.estimation.rounds:solve_pose",),
    "rounds": ("tracking.estimation.rounds:align_rounds",),
    "reprojection": ("tracking.estimation.rounds:reproject", "tracking.update:reproject"),
    "alignment, rest": ("tracking.step:align",),
    "validation": ("tracking.step:score_fit",),
    "relocalization": ("tracking.step:triggered", "tracking.step:relocalize"),
    "conclusion": ("tracking.step:conclude",),
    "adaptation": ("tracking.step:learned_after",),
    "rest": ("tracking.tracker:Tracker.step",),
}
"""Functions of each stage, by the module of the package that looks them up."""


@dataclass
class StageTimes:
    """Own time (s) of each stage since it was made, while :func:`timed` is open.

    Args:
        now: the time (s), once all is done that was asked of the device.
    """

    now: Callable[[], float]
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    # Time of the calls within each of those that are open.
    _inner: list[float] = field(default_factory=list)
    # A search that goes on beside the windows is no part of them.
    _thread: int = field(default_factory=threading.get_ident)

    def timing(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, whose time is added to that of ``stage``."""

        @wraps(function)
        def timed_function(*args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != self._thread:
                return function(*args, **kwargs)
            self._inner.append(0.0)
            begun = self.now()
            try:
                return function(*args, **kwargs)
            finally:
                whole = self.now() - begun
                self.seconds[stage] += whole - self._inner.pop()
                if self._inner:
                    self._inner[-1] += whole

        return timed_function


@contextmanager
def timed(times: StageTimes) -> Iterator[None]:
    """Note the time of each stage while it is open; afterwards all is as it was."""
    replaced: list[tuple[Any, str, Any]] = []
    try:
        for stage, places in STAGES.items():
            for place in places:
                owner, name = owner_of(place)
                function = getattr(owner, name)
                replaced.append((owner, name, function))
                setattr(owner, name, times.timing(stage, function))
        yield
    finally:
        for owner, name, function in reversed(replaced):
            setattr(owner, name, function)


def owner_of(place: str) -> tuple[Any, str]:
    """What holds a function, and its name there."""
    module, _, path = place.partition(":")
    owner: Any = import_module(f"torchtrack.{module}")
    *outer, name = path.split(".")
    for part in outer:
        owner = getattr(owner, part)
    return owner, name


# Those of the steps of a run, where they are asked for.
_OF_STEPS: ContextVar[StageTimes | None] = ContextVar("stages of steps are timed", default=None)


@contextmanager
def stages_timed(device: torch.device) -> Iterator[None]:
    """Within it, each step of a run says how long its stages took: time that passes, as that of the whole step."""

    def now() -> float:
        # While a graph is made, nothing can be waited for.
        if device.type == "cuda" and not torch.cuda.is_current_stream_capturing():
            torch.cuda.synchronize(device)
        return time.perf_counter()

    times = StageTimes(now)
    token = _OF_STEPS.set(times)
    try:
        with timed(times):
            yield
    finally:
        _OF_STEPS.reset(token)


@contextmanager
def stages_of_step() -> Iterator[dict[str, float]]:
    """What is filled, once the step within it is done, with the time (s) of each of its stages; empty where nobody asks for them."""
    noted: dict[str, float] = {}
    times = _OF_STEPS.get()
    if times is None:
        yield noted
        return
    times.seconds.clear()
    yield noted
    noted.update(times.seconds)
