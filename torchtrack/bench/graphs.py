"""In how many windows something has to be decided, and the time of each stage and of the longest kernels.

What may have to be is what :func:`torchtrack.tracking.step.steady_advance` takes for granted, noted beside every window, without a graph: on a
CPU, compiled graphs hang on all of it; on a GPU, whoever is to be searched for is, after the graph. Stages and kernels are
those of :class:`torch.profiler.profile`, of windows without a graph, as a graph tells no stages; on a CPU, operations stand for kernels.
"""

import re
import traceback
from collections import Counter
from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile, record_function

from torchtrack.bench.results import Report, Result, time_result
from torchtrack.bench.scene import SHAPES, Run, shapes_of, simulated, started
from torchtrack.bench.setup import Setup
from torchtrack.core import dispatch
from torchtrack.core.events import EventBatch
from torchtrack.core.host_sync import AsyncValue, HostReads, SteadyState
from torchtrack.run.stage_times import STAGES, StageTimes, timed
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.step import StepInput, advance, opened

# Objects in a stream, columns of their cells, and streams.
SCENES = {"cpu": ((1, 1, 1), (8, 4, 1)), "cuda": ((1, 1, 1), (64, 8, 4), (64, 8, 64))}
# Windows that are profiled, and how many of the longest kernels are told.
WINDOWS, LONGEST = 8, 15


class NotedState(SteadyState):
    """Notes of each assumption whether it holds, by what is asked for where it is made."""

    def __init__(self) -> None:
        super().__init__()
        self.failed: list[tuple[str, Tensor]] = []

    def ask(self, values: Tensor, usual: int) -> AsyncValue:
        """As in a steady window."""
        self.failed.append((_asked_for(), (values != usual).any()))
        return super().ask(values, usual)

    def none_of(self, values: Tensor) -> bool:
        """As in a steady window."""
        self.failed.append((_asked_for(), values.any()))
        return super().none_of(values)


def _asked_for() -> str:
    """The value that a line of the pipeline asks for, as it is written there."""
    lines = (frame.line or "" for frame in reversed(traceback.extract_stack()) if not frame.filename.endswith(("graphs.py", "host_sync.py")))
    matches = (re.search(r"reads\.(?:ask|ask_within|none_of)\(([\w.]+(?:\([^()]*\))?)", line) for line in lines)
    return next((match[1] for match in matches if match), "something else")


class NamedStages(StageTimes):
    """The profiler sees the stages of the pipeline by their names."""

    def timing(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, under the name of ``stage``."""

        @wraps(function)
        def named(*args: Any, **kwargs: Any) -> Any:
            with record_function(stage):
                return function(*args, **kwargs)

        return named


def measure(setup: Setup) -> Report:
    """How often each assumption fails, and times of stages and kernels.

    Raises:
        MissingExtraError: if the simulator's libraries are not installed.
    """
    results: list[Result] = []
    notes: list[str] = []
    for count, columns, streams in SCENES[setup.device.type]:
        name = f"{count * streams} objects"
        setup.show(name)
        run = started([simulated(SHAPES[:1] if count == 1 else shapes_of(count), columns)] * streams, setup.device)
        results += [Result(f"{name}: windows in which there is any {what}", "%", (100 * share,)) for what, share in _failures(run).items()]
        stages, kernels, launched = _profiled(setup, run)
        results += [time_result(f"{name}: {stage}", [seconds]) for stage, seconds in stages]
        results += [time_result(f"{name}: kernel {kernel[:80]}", [seconds]) for kernel, seconds in kernels]
        notes.append(f"{name}: {launched:.0f} kernels a window")
    return Report(
        "graphs",
        "A window without a graph: what has to be decided, stages (with those within), longest kernels",
        tuple(results),
        tuple(notes),
    )


def _failures(run: Run) -> dict[str, float]:
    """Share of the windows in which each assumption fails."""
    state, failed = run.state, Counter[str]()
    for window in run.windows:
        noted = NotedState()
        _without_graph(run, state, window, noted)
        failed.update({what: int(has_failed) for what, has_failed in noted.failed})
        state = _without_graph(run, state, window, HostReads())
    return {what: count / len(run.windows) for what, count in failed.items()}


def _without_graph(run: Run, state: TrackerState, window: tuple[EventBatch, int], reads: HostReads) -> TrackerState:
    """The state after a window."""
    (events, end_us), tracker = window, run.tracker
    given = StepInput(NearbyEvents(events), torch.full_like(state.t_us, end_us), reads=reads)
    with torch.inference_mode(), dispatch.backend(wanted=tracker.kernels, values=tracker.intrinsics):
        return advance(tracker, opened(tracker, state, events), given)[0]


def _profiled(setup: Setup, run: Run) -> tuple[list[tuple[str, float]], list[tuple[str, float]], float]:
    """Time (s) a window of the stages and of the longest kernels, and how many kernels a window starts."""
    on_gpu, windows = run.state.t_us.is_cuda, run.windows[:WINDOWS]
    state = run.state
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]
    with timed(NamedStages(setup.clock.now)), profile(activities=activities) as seen:
        for window in windows:
            state = _without_graph(run, state, window, HostReads())
    rows, each = seen.key_averages(), 1e-6 / len(windows)
    stages = [(row.key, each * (row.device_time_total if on_gpu else row.cpu_time_total)) for row in rows if row.key in STAGES]
    of_device = DeviceType.CUDA if on_gpu else DeviceType.CPU
    work = [row for row in rows if row.device_type == of_device and row.key not in STAGES]
    kernels = [(row.key, each * (row.self_device_time_total if on_gpu else row.self_cpu_time_total)) for row in work]
    return _longest_first(stages), _longest_first(kernels)[:LONGEST], sum(row.count for row in work) / len(windows)


def _longest_first(times: list[tuple[str, float]]) -> list[tuple[str, float]]:
    return sorted(times, key=lambda named: -named[1])
