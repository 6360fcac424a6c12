"""What share of a step each stage takes; how stages are timed, :mod:`torchtrack.run.stage_times` says."""

from collections.abc import Iterator

from torchtrack.bench.plots import Plot
from torchtrack.bench.results import Report, Result, time_result
from torchtrack.bench.scene import SHAPES, Run, read, shapes_of, simulated, started
from torchtrack.bench.setup import Setup
from torchtrack.run.stage_times import STAGES, StageTimes, timed

# Objects and columns of cells of the scenes.
MANY = ((8, 4), (64, 8))


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
        yield setup.sequence.stem, started([read(setup.sequence)], setup.device)
        return
    for shape in SHAPES:
        yield f"1 object ({shape})", started([simulated((shape,))], setup.device)
    for count, columns in MANY:
        yield f"{count} objects", started([simulated(shapes_of(count), columns)], setup.device)


def _of_run(setup: Setup, name: str, run: Run) -> list[Result]:
    """A result per stage, the longest first."""
    run.latencies(setup.clock)
    repeats = []
    for _ in range(setup.repeats):
        times = StageTimes(setup.clock.now)
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
