"""What share of a step each stage takes.

The functions of each stage are replaced by ones that note the time while it is measured, where the pipeline looks them up:
the pipeline itself has no clock in it. A stage's time is its own: without that of the stages that it calls.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from importlib import import_module
from typing import Any

from torchtrack.bench.clock import Clock
from torchtrack.bench.plots import Plot
from torchtrack.bench.results import Report, Result, time_result
from torchtrack.bench.scene import SHAPES, Run, read, shapes_of, simulated, started
from torchtrack.bench.setup import Setup

STAGES: dict[str, tuple[str, ...]] = {
    "prediction": ("tracking.expectation:predicted_after",),
    "contours": ("tracking.contours.objects:mesh_contours", "tracking.contours.objects:splat_contours"),
    "visibility": ("tracking.contours.objects:remove_hidden",),
    "surface": ("tracking.step:update_last_event", "tracking.frontend.sensors:time_surface"),
    "corners": ("tracking.frontend.sensors:Sensors.corners", "tracking.frontend.sensors:detect_corners"),
    "flow": ("tracking.frontend.sensors:estimate_flow",),
    "index": ("tracking.step:index_for", "tracking.estimation.rounds:index_for"),
    "window's events": ("tracking.frontend.sensors:Sensors.seen",),
    "selection": ("tracking.step:select_events", "tracking.step:corner_observations", "tracking.step:join"),
    "association": ("tracking.estimation.rounds:match_nearest", "tracking.estimation.rounds:match_along_flow"),
    "problem": ("tracking.estimation.rounds:_believed", "tracking.estimation.rounds:_problem", "tracking.estimation.rounds:_information"),
    "solver": ("tracking.estimation.rounds:solve_pose",),
    "rounds": ("tracking.estimation.rounds:align_rounds",),
    "reprojection": ("tracking.estimation.rounds:reproject", "tracking.update:reproject"),
    "alignment, rest": ("tracking.step:align",),
    "validation": ("tracking.step:score_fit",),
    "relocalization": ("tracking.step:triggers", "tracking.step:relocalize"),
    "conclusion": ("tracking.step:conclude",),
    "adaptation": ("tracking.step:learned_after",),
    "rest": ("tracking.tracker:Tracker.step",),
}
"""Functions of each stage, by the module of the package that looks them up."""
# Objects and columns of cells of the scenes.
MANY = ((8, 4), (64, 8))


@dataclass
class StageTimes:
    """Own time (s) of each stage since it was made, while :func:`timed` is open."""

    clock: Clock
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    # Time of the calls within each of those that are open.
    _inner: list[float] = field(default_factory=list)

    def timing(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, whose time is added to that of ``stage``."""

        @wraps(function)
        def timed_function(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            begun = self.clock.now()
            try:
                return function(*args, **kwargs)
            finally:
                whole = self.clock.now() - begun
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


def measure(setup: Setup) -> Report:
    """Time of each stage of a step.

    Raises:
        MissingExtraError: if scenes are to be simulated, and the simulator's libraries are not installed.
    """
    results: list[Result] = []
    shares: dict[str, list[Result]] = {}
    for name, run in _runs(setup):
        setup.show(name)
        shares[name] = _of_run(setup, name, run)
        results += shares[name]
    title = f"Stages of a step, preset default: mean over windows, without the stages that each calls; {setup.clock.meaning}"
    return Report("stages", title, tuple(results), plots=(_plot(shares),))


def _runs(setup: Setup) -> Iterator[tuple[str, Run]]:
    if setup.sequence is not None:
        yield setup.sequence.stem, started(read(setup.sequence), setup.device)
        return
    for shape in SHAPES:
        yield f"1 object ({shape})", started(simulated((shape,)), setup.device)
    for count, columns in MANY:
        yield f"{count} objects", started(simulated(shapes_of(count), columns), setup.device)


def _of_run(setup: Setup, name: str, run: Run) -> list[Result]:
    """A result per stage, the longest first."""
    run.latencies(setup.clock)
    repeats = []
    for _ in range(setup.repeats):
        times = StageTimes(setup.clock)
        with timed(times):
            run.latencies(setup.clock)
        repeats.append({stage: times.seconds[stage] / len(run.windows) for stage in STAGES})
    results = [time_result(f"{name}: {stage}", [repeat[stage] for repeat in repeats]) for stage in STAGES]
    return sorted(results, key=lambda result: -result.median)


def _plot(shares: dict[str, list[Result]]) -> Plot:
    """Stacked bars of the shares of a step."""
    medians = [{result.name.removeprefix(f"{name}: "): result.median for result in results} for name, results in shares.items()]
    series = {stage: tuple((float(place), 100 * of_run[stage] / sum(of_run.values())) for place, of_run in enumerate(medians)) for stage in STAGES}
    return Plot("shares", "Share of each stage of a step", "share of the step (%)", "", series, kind="bars", ticks=tuple(shares))
