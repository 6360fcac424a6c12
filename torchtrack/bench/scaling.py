"""How the time of a step grows: with objects in one stream, and with streams side by side."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from torchtrack.bench.plots import Plot
from torchtrack.bench.results import Report, Result, time_result
from torchtrack.bench.scene import HD, Scene, shapes_of, simulated, started
from torchtrack.bench.setup import Setup

OBJECTS = (1, 2, 4, 8, 16, 32, 64, 128)
COLUMNS = 16
STREAMS = (1, 2, 4, 8, 16, 32)
STREAM_SHAPES = ("lbracket",)
# Steps of many objects are long: so many are enough.
_WINDOWS = 12


def measure(setup: Setup) -> Report:
    """Time of a step by the number of objects and of streams.

    Raises:
        MissingExtraError: if the simulator's libraries are not installed.
    """
    many, single = simulated(shapes_of(OBJECTS[-1]), COLUMNS, HD), simulated(STREAM_SHAPES)
    objects = [_of_run(setup, f"{count} objects in one stream", many.first(count), 1) for count in OBJECTS]
    streams = [_of_run(setup, f"{count} streams of one object", single, count) for count in STREAMS]
    results = [result for result, _ in (*objects, *streams)]
    growth = [_growth(name, counts, runs) for name, counts, runs in (("objects", OBJECTS, objects), ("streams", STREAMS, streams))]
    title = f"Growth of a step with objects ({HD[0]}x{HD[1]}) and with streams (640x480), preset default; {setup.clock.meaning}"
    return Report("scaling", title, (*results, *growth), tuple(note for _, note in (*objects, *streams)), tuple(_plots(objects, streams)))


def _of_run(setup: Setup, name: str, scene: Scene, streams: int) -> tuple[Result, str]:
    """Median time of a step, once per repeat, and how well it tracked."""
    setup.show(name)
    run = started([scene] * streams, setup.device)
    run = replace(run, windows=run.windows[:_WINDOWS])
    quality = run.quality(setup.clock)
    medians = [float(np.median(run.latencies(setup.clock))) for _ in range(setup.repeats)]
    return time_result(name, medians), f"{name}: {quality}"


def _growth(name: str, counts: tuple[int, ...], runs: list[tuple[Result, str]]) -> Result:
    """What the last doubling costs over what one object costs alone, each: at most 1 where the cost is linear at most."""
    first, half, all_of_them = (np.array(runs[place][0].figures) for place in (0, -2, -1))
    ratios = (all_of_them - half) / (counts[-1] - counts[-2]) / (first / counts[0])
    return Result(f"a further one of {counts[-1]} {name} over the first", "times", tuple(ratios.tolist()), 1.0, lower_is_better=True)


def _plots(objects: list[tuple[Result, str]], streams: list[tuple[Result, str]]) -> Iterator[Plot]:
    series = {"objects in one stream": (OBJECTS, objects), "streams of one object": (STREAMS, streams)}
    medians = {name: [(float(count), result.median) for count, (result, _) in zip(*pair, strict=True)] for name, pair in series.items()}
    latency = {name: tuple(points) for name, points in medians.items()}
    throughput = {name: tuple((count, 1e3 * count / value) for count, value in points) for name, points in medians.items()}
    yield Plot("latency", "One step", "objects", "ms", latency)
    yield Plot("throughput", "Poses per second", "objects", "poses/s", throughput)
