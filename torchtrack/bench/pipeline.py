"""How long a step of the tracker takes, with the preset ``default`` and its windows: few and many objects, many events."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from torchtrack.bench.results import Report, Result, time_result
from torchtrack.bench.scene import HD, SHAPES, Scene, read, shapes_of, simulated, started, with_events_outside
from torchtrack.bench.setup import Setup
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.core.dispatch import backend_is_installed
from torchtrack.core.events import EventBatch
from torchtrack.run.stepping import cut_windows, steps

# Targets (ms) of the median, and of the step that 95 % are faster than, on one thread of a CPU and on a large GPU.
ONE_OBJECT_MS: dict[str, tuple[float | None, float | None]] = {"cpu": (4.0, 6.0), "cuda": (1.5, None)}
# Objects of each further scene, columns of their cells, streams that all have this scene, the target of the median (ms), and whether lost objects
# are searched for: of many at their start, some are in every window, and a GPU's steps are those of its searches.
MANY = {
    "cpu": ((8, 4, 1, 15.0, True), (64, 8, 1, 100.0, True)),
    "cuda": ((64, 8, 4, 4.0, False), (64, 8, 64, 25.0, False), (64, 8, 4, None, True)),
}
# Of so many objects, poses are confirmed one after the other: for so many windows after the warm-up, which are measured by themselves.
MANY_OBJECTS, CONFIRMED_AFTER, MANY_DURATION_S = 64, 32, 0.4
OUTSIDE_MEV_S = (5.0, 20.0)
HD_MEV_S = 20.0
# Events outside of all objects may cost what it takes to look at each of them once.
_MOST_FOR_OUTSIDE = 1.1
# A camera or a file gives events in chunks of about this many.
_CHUNK = 100_000

_Part = tuple[list[Result], str]


@dataclass(frozen=True)
class _Case:
    """A scene whose steps are timed, and how it is tracked.

    Args:
        name: of the scene.
        median_ms, p95_ms: targets of the median, and of the step that 95 % are faster than; none where not given.
        streams: that all have this scene.
        confirmed_after: windows that poses are confirmed in, which are measured by themselves.
    """

    name: str
    scene: Scene
    median_ms: float | None = None
    p95_ms: float | None = None
    streams: int = 1
    compiled: bool = False
    kernels: bool = True
    searches: bool = True
    confirmed_after: int = 0

    @property
    def full_name(self) -> str:
        """With how it is tracked."""
        name = self.name if self.searches else f"{self.name}, nobody searched for"
        return _named(name, self.compiled) if self.kernels else f"{name}, without kernels"


def measure(setup: Setup) -> Report:
    """Time of a step, and what it depends on.

    Raises:
        MissingExtraError: if scenes are to be simulated, and the simulator's libraries are not installed.
    """
    parts = list(_of_sequence(setup) if setup.sequence is not None else _of_scenes(setup))
    title = f"One step of the tracker, preset default, windows of 5 ms; {setup.clock.meaning}"
    return Report("pipeline", title, tuple(result for results, _ in parts for result in results), tuple(note for _, note in parts))


def _of_sequence(setup: Setup) -> Iterator[_Part]:
    if setup.sequence is not None:
        scene = read(setup.sequence)
        for compiled in setup.ways:
            yield _latency(setup, _Case(f"{setup.sequence.stem}, {len(scene.models)} objects", scene, compiled=compiled))


def _of_scenes(setup: Setup) -> Iterator[_Part]:
    kind = setup.device.type
    for shape in SHAPES:
        for compiled in setup.ways:
            yield _latency(setup, _Case(f"1 object ({shape})", simulated((shape,)), *ONE_OBJECT_MS[kind], compiled=compiled))
    for many in MANY[kind]:
        # On a CPU, graphs gain little where kernels work on many objects.
        for compiled in setup.ways if kind == "cuda" else (False,):
            yield _latency(setup, replace(_of_many(*many), compiled=compiled))
    if backend_is_installed(kind):
        yield _latency(setup, _Case(f"1 object ({SHAPES[0]})", simulated(SHAPES[:1]), kernels=False))
        yield _latency(setup, replace(_of_many(*MANY[kind][0]), kernels=False, median_ms=None))
    yield _outside(setup)
    for compiled in setup.ways:
        yield _real_time(setup, compiled)


def _latency(setup: Setup, case: _Case) -> _Part:
    """Median and 95 % of the time of a step, each once per repeat, and how well it tracked."""
    name = case.full_name
    setup.show(name)
    search = None if case.searches else RelocalizationConfig(hypotheses=0)
    run = started([case.scene] * case.streams, setup.device, compiled=case.compiled, kernels=case.kernels, search=search)
    quality = run.quality(setup.clock)
    times = np.array([run.latencies(setup.clock) for _ in range(setup.repeats)])
    first = case.confirmed_after
    results = _quantiles(f"{name}, while poses are confirmed", times[:, :first], None, None) if first else []
    results += _quantiles(name, times[:, first:], case.median_ms, case.p95_ms)
    return results, f"{name}: {case.scene.mev_per_s:.1f} Mev/s, {quality}"


def _quantiles(name: str, times: np.ndarray, median_ms: float | None, p95_ms: float | None) -> list[Result]:
    """Median and 95 % of the times ``[repeats, windows]`` of steps (s), with their targets (ms)."""
    median, p95 = ([float(value) for value in np.quantile(times, share, axis=1)] for share in (0.5, 0.95))
    return [time_result(f"{name}, median", median, median_ms), time_result(f"{name}, 95 %", p95, p95_ms)]


def _of_many(count: int, columns: int, streams: int, median_ms: float | None, searches: bool) -> _Case:
    """So many objects in each of some streams."""
    name = f"{count * streams} objects" + (f" in {streams} streams" if streams > 1 else "")
    if count < MANY_OBJECTS or not searches:
        return _Case(name, simulated(shapes_of(count), columns), median_ms, streams=streams, searches=searches)
    scene = simulated(shapes_of(count), columns, duration_s=MANY_DURATION_S)
    return _Case(name, scene, median_ms, streams=streams, confirmed_after=CONFIRMED_AFTER)


def _named(name: str, compiled: bool) -> str:
    """The name of what is measured one way or the other."""
    return f"{name}, compiled" if compiled else name


def _outside(setup: Setup) -> _Part:
    """How many times longer a step takes with events that are near no object."""
    scene = simulated(SHAPES[:1])
    setup.show("events outside the object")
    runs = [started([with_events_outside(scene, rate)], setup.device) for rate in (0.0, *OUTSIDE_MEV_S)]
    # Turn by turn, so that a machine that gets slower does so for all.
    medians = np.array([[np.median(run.latencies(setup.clock)) for run in runs] for _ in range(setup.repeats)])
    ratios = medians[:, 1:] / medians[:, :1]
    name, most = "1 object with {:g} Mev/s outside it over none", _MOST_FOR_OUTSIDE
    results = [Result(name.format(rate), "times", tuple(ratios[:, number].tolist()), most, True) for number, rate in enumerate(OUTSIDE_MEV_S)]
    return results, "Events outside an object keep away from its bounding box at all times."


def _real_time(setup: Setup, compiled: bool) -> _Part:
    """Seconds of an HD stream per second of work, with one object in it."""
    name = _named(f"1 object in {HD[0]}x{HD[1]} at {HD_MEV_S:g} Mev/s", compiled)
    setup.show(name)
    scene = simulated(SHAPES[:1], size=HD)
    scene = with_events_outside(scene, max(HD_MEV_S - scene.mev_per_s, 0))
    run = started([scene], setup.device, compiled=compiled)
    start_us = int(run.state.t_us[0])
    stream = scene.events.slice_time(start_us, scene.end_us)
    factors = []
    for _ in range(setup.repeats):
        begun = setup.clock.now()
        for _ in steps(cut_windows(_chunks(stream), start_us, run.tracker.config.window), run.tracker, run.state):
            pass
        factors.append(1e-6 * (scene.end_us - start_us) / (setup.clock.now() - begun))
    return [Result(f"{name}, stream over work", "times", tuple(factors), 1.0)], f"{name}: {scene.mev_per_s:.1f} Mev/s, {run.quality(setup.clock)}"


def _chunks(events: EventBatch) -> Iterator[EventBatch]:
    for first in range(0, len(events), _CHUNK):
        yield events[first : first + _CHUNK]
