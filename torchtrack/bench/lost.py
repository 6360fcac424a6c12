"""What an object that is lost all the time costs the others: the same objects with all their events, and without those of some.

Of an object that is to be lost, no event is left after the warm-up, and the tracker looks for it ever after, but the rarer the longer it is
lost. Windows are measured once it is known to be lost: those of the first second, and those that come later. No shape is there twice in a
stream, so that none is found where another one is.

On a CPU, also with searches that go on beside the windows, on another core. Of these it is the time that passes that counts: windows may wait for
an answer, and for Python, which both threads need.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from torchtrack.bench.clock import Clock
from torchtrack.bench.results import Report, Result, time_result
from torchtrack.bench.scene import Run, Scene, simulated, started
from torchtrack.bench.setup import Setup
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.tracking.validation.status import Status

SHAPES = ("lbracket", "cube", "satellite", "robot", "book", "wedge", "mug", "animal")
COLUMNS = 4
LOST = ("lbracket", "robot")
"""A mesh of few faces, and a dense one: each is lost in a case of its own."""
# Streams, and in how many of them the object is lost: one of 8 objects, and on a GPU 2 % of 256.
STREAMS = {"cpu": (1, 1), "cuda": (32, 5)}
DURATION_S = 2.0
# When its events end (µs), how many windows after the warm-up it is surely known to be lost, and how many of the next are the first second's.
HIDDEN_FROM_US, KNOWN_AFTER, SOON = 50_000, 40, 160
# When answers come of searches beside the windows (µs).
ANSWER_AFTER_US = 100_000
# How much longer a step may take than with none lost: the median, and the step that 95 % are faster than.
MOST_OVER_NONE = (1.5, 2.0)


def measure(setup: Setup) -> Report:
    """Time of a step with none lost and with one, and the ratios of the two.

    Raises:
        MissingExtraError: if the simulator's libraries are not installed.
    """
    scene = simulated(SHAPES, COLUMNS, duration_s=DURATION_S)
    waits = (0, ANSWER_AFTER_US) if setup.device.type == "cpu" else (0,)
    cases = [_case(setup, scene, shape, answer_after_us) for answer_after_us in waits for shape in LOST]
    title = f"Steps with an object lost all the time, preset default, windows of 5 ms; {setup.clock.meaning}"
    return Report("lost", title, tuple(result for results, _ in cases for result in results), tuple(note for _, note in cases))


def _case(setup: Setup, scene: Scene, shape: str, answer_after_us: int) -> tuple[list[Result], str]:
    """Times with none lost and with one, turn by turn, so that a machine that gets slower does so for both."""
    streams, lost_in = STREAMS[setup.device.type]
    count = len(SHAPES) * streams
    name = f"{count} objects, {shape} lost" + (f" in {lost_in} of {streams} streams" if streams > 1 else "")
    if answer_after_us:
        name += f", searched for beside, answers after {answer_after_us // 1000} ms"
    setup.show(name)
    number, search = SHAPES.index(shape), RelocalizationConfig(answer_after_us=answer_after_us)
    clock = Clock(setup.device, threads=2) if answer_after_us else setup.clock
    with_lost = [_without(scene, number)] * lost_in + [scene] * (streams - lost_in)
    runs = [started(scenes, setup.device, search=search).after(KNOWN_AFTER) for scenes in ([scene] * streams, with_lost)]
    times = np.array([[run.latencies(clock) for run in runs] for _ in range(setup.repeats)])
    parts = {"in the first second": times[..., :SOON], "later": times[..., SOON:]}
    none = name.replace(f"{shape} lost", f"none lost (beside {shape})")
    results = [result for when, part in parts.items() for result in _results(none, name, when, part)]
    return results, f"{name}: in {_lost_ratio(runs[1], number):.0%} of its windows"


def _results(none: str, lost: str, when: str, times: np.ndarray) -> Iterator[Result]:
    """Results of times ``[repeats, 2, windows]`` (s) with none lost and with one."""
    for what, share, most in zip(("median", "95 %"), (0.5, 0.95), MOST_OVER_NONE, strict=True):
        without, with_lost = np.quantile(times, share, axis=2).T.tolist()
        yield time_result(f"{none}, {when}, {what}", without)
        yield time_result(f"{lost}, {when}, {what}", with_lost)
        ratios = tuple(longer / shorter for longer, shorter in zip(with_lost, without, strict=True))
        yield Result(f"{lost}, {when}, {what} over none lost", "times", ratios, most, lower_is_better=True)


def _without(scene: Scene, number: int) -> Scene:
    """The scene without the events of an object from :data:`HIDDEN_FROM_US` on."""
    if scene.source is None:
        raise ValueError("of a scene that was read, it is not known which object an event is of.")
    kept = (scene.source != number) | (scene.events.t_us <= HIDDEN_FROM_US)
    return replace(scene, events=scene.events[kept], source=scene.source[kept])


def _lost_ratio(run: Run, number: int) -> float:
    """In how many of its windows the object of the first stream is lost."""
    state, lost = run.state, []
    with torch.inference_mode():
        for events, end_us in run.windows:
            state, result = run.tracker.step(state, events, end_us)
            lost.append(bool(result.status[number] >= int(Status.LOST)))
    return float(np.mean(lost))
