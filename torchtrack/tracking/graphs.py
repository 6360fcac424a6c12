"""Steady windows as one graph: on a GPU a recording of some three thousand small operations; compiled, fused kernels in their place.

What a step of one object costs is the calls of operations, not what they compute. On a GPU, the part of it in which nothing
has to be decided is recorded once, and then started as a whole (:mod:`torchtrack.tracking.cuda_graphs`). ``torch.compile`` turns it into
fewer and larger kernels, there and on a CPU. Shapes are those of a GPU (:mod:`torchtrack.core.host_sync`), and the number of events
is left open.

Where a window turns out not to be steady, as an object is to be searched for, or is very uncertain, what the graph gave is
dropped. On a GPU, another graph takes it then, and those after it, until all objects are certain again: one that holds however uncertain or lost
objects are, as it does for all what these need (:func:`torchtrack.tracking.step.steady_lane`). Objects that are to be searched for are, after
it, from what it has computed of the window; the others are as it left them. A window in parts is taken as without a graph; so is every one that a
compiled graph does not hold for, and on a CPU those that contours are learned from. Poses are the same, to rounding.
"""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from inspect import signature
from typing import Any, Concatenate, ParamSpec, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn.functional import pad

from torchtrack.core import host_sync
from torchtrack.core.constants import cells_within
from torchtrack.core.events import EventBatch, check_on_sensor, pad_streams
from torchtrack.errors import ConfigError
from torchtrack.tracking.adapt import learns_next
from torchtrack.tracking.cuda_graphs import CudaGraphs
from torchtrack.tracking.expectation import near_tiles
from torchtrack.tracking.frontend.bursts import update_bursts
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.state import S, StepResult, TrackerState, each_tensor
from torchtrack.tracking.step import looked_for, opened, steady_advance, steady_lane

P, R = ParamSpec("P"), TypeVar("R")
_Graph = Callable[[TrackerState, NearbyEvents, Tensor], tuple[TrackerState, StepResult, Tensor]]
_Lane = Callable[[TrackerState, NearbyEvents, Tensor], tuple[Any, ...]]
# At a start, it is looked at more than later on which contours a model lacks.
_FIRST_WINDOWS = 5
# Of more events than this, those that are near no object are left out first.
_MANY = 16_384
# Events are filled up to numbers of this many binary digits, so that a GPU needs few graphs, and to multiples of this: loops
# of a compiled kernel take several at once.
_DIGITS, _MULTIPLE = 3, 64


class CompiledStep:
    """Takes steady windows by graphs, made when they are first needed: compiled for a minute or more, and for seconds from a cache on disk.

    Args:
        tracker: whose windows they are.
        compiles: whether they are compiled; else there are graphs on a GPU alone.

    Raises:
        ConfigError: if this version of PyTorch cannot.
    """

    def __init__(self, tracker: TrackedObjects, *, compiles: bool = True) -> None:
        if compiles and "isolate_recompiles" not in signature(torch.compile).parameters:
            raise ConfigError(f"compiled: PyTorch {torch.__version__} cannot compile a tracker. Update it to 2.13 or later, or go without.")
        self._tracker, self._compiles = tracker, compiles
        # By how many events a stream has at most, where there are several, and by what is learned.
        self._graphs: dict[tuple[int | None, bool], _Graph] = {}
        self._lanes: dict[tuple[int | None, bool], _Lane] = {}
        # What the last window was like: whichever graph is tried first, the result is the same.
        self._expects_uncertain = False
        self._near_tiles: Callable[[TrackerState, Tensor], Tensor] | None = None

    def __call__(self, state: TrackerState, events: EventBatch, t_us: Int[Tensor, "s"]) -> tuple[TrackerState, StepResult] | None:
        """State and result of a window, not counted yet; None where there is no graph, it is not steady, or there is hardly any event in it."""
        if not self._are_for(t_us):
            return None
        learned = state.appearance.learned
        starts = learned is not None and learned.windows < _FIRST_WINDOWS
        learns = learns_next(state, self._tracker.on_surfaces, self._tracker.config)
        if starts or (learns and not host_sync.on_gpu(t_us)):
            return None
        with torch.inference_mode():
            # CUDA graphs copy whatever they are given.
            plain = state if host_sync.on_gpu(t_us) else each_tensor(_plain, state)
            nearby = self._near(plain, events, t_us) if len(events) > _MANY else NearbyEvents(events)
            if len(nearby.events) < 2:
                return None
            done = self._by_lanes(opened(self._tracker, plain, events), nearby, t_us, learns)
        return None if done is None else (_own(done[0]).numbered(state), _own(done[1]))

    def _by_lanes(self, before: TrackerState, nearby: NearbyEvents, t_us: Tensor, learns: bool) -> tuple[TrackerState, StepResult] | None:
        """State and result by the graph for objects that are all certain, or else by the one for others; None where neither holds."""
        if not self._expects_uncertain:
            next_state, result, wrong = self._taken(before, nearby, t_us, learns)
            if not host_sync.AsyncValue.to(wrong[None]).any():
                return next_state, result
            if self._compiles:
                return None
        filled = _filled(nearby, len(t_us))
        next_state, result, stated, in_place = self._lane(filled, learns)(before, filled, t_us)
        is_wrong, searches, self._expects_uncertain = host_sync.AsyncValue.to(stated).numbers()
        if is_wrong:
            return None
        return looked_for(self._tracker, before, in_place.window(), filled, t_us, learns=learns) if searches else (next_state, result)

    def _lane(self, filled: NearbyEvents, learns: bool) -> _Lane:
        """The graph that holds however uncertain objects are."""
        kind = filled.events.most_of_one, learns
        if kind not in self._lanes:
            self._lanes[kind] = CudaGraphs(partial(steady_lane, self._tracker, learns=learns))
        return self._lanes[kind]

    def __getstate__(self) -> dict[str, Any]:
        """Of a copy, which has no graphs yet: these are of this tracker's tensors where they are now, and of this process."""
        return {**vars(self), "_graphs": {}, "_lanes": {}, "_near_tiles": None}

    def _are_for(self, t_us: Tensor) -> bool:
        """Whether there are graphs for windows of that device. For a weighting network of one's own they have to be asked for."""
        return self._compiles or (host_sync.on_gpu(t_us) and not self._tracker.shows_all)

    def __len__(self) -> int:
        """How many graphs there are."""
        return len(self._graphs) + len(self._lanes)

    @torch.inference_mode()
    def prepare(self, state: TrackerState) -> None:
        """Compile the graphs of one stream, from the state that it begins with; with several, more than that would have to be known."""
        if len(state.t_us) > 1 or not self._are_for(state.t_us):
            return
        t_us, nothing = state.t_us + 1, torch.zeros_like(state.t_us).expand(2)
        events = EventBatch(nothing.int(), nothing.int(), t_us.expand(2), nothing > 0, nothing)
        plain = each_tensor(_plain, state.numbered(state, _FIRST_WINDOWS))
        self._near(plain, events, t_us)
        self._taken(plain, NearbyEvents(events), t_us)

    def _near(self, state: TrackerState, events: EventBatch, t_us: Tensor) -> NearbyEvents:
        """The events that can have to do with the objects; all of several streams, and on a GPU, which would have to be waited for."""
        if len(t_us) > 1 or self._tracker.shows_all or t_us.device.type != "cpu":
            return NearbyEvents(events)
        if self._near_tiles is None:
            self._near_tiles = _compiled(self._tiles_near, t_us.device)
            near = _for_the_first_time(self._near_tiles, state, t_us)
        else:
            near = self._near_tiles(state, t_us)
        return self._tracker.tiles.keep(events, near)

    def _tiles_near(self, state: TrackerState, t_us: Tensor) -> Tensor:
        return near_tiles(self._tracker, state, t_us)

    def _steady(self, state: TrackerState, events: NearbyEvents, t_us: Tensor) -> tuple[TrackerState, StepResult, Tensor]:
        return steady_advance(self._tracker, state, events, t_us)

    def _taken(self, before: TrackerState, nearby: NearbyEvents, t_us: Tensor, learns: bool = False) -> tuple[TrackerState, StepResult, Tensor]:
        """What the graph makes of a window, and whether that does not hold."""
        filled = _filled(nearby, len(t_us))
        if t_us.device.type == "cpu":
            before, filled = _in_bursts(before, filled, t_us)
        kind = filled.events.most_of_one, learns
        if kind not in self._graphs:
            self._graphs[kind] = self._graph(t_us.device, learns=learns)
            if self._compiles:
                return _for_the_first_time(self._graphs[kind], before, _of_any_number(filled), t_us)
        return self._graphs[kind](before, filled, t_us)

    def _graph(self, device: torch.device, *, learns: bool) -> _Graph:
        """A graph, made when it is first called. Few windows are learned from: to compile theirs, too, would take longer than it saves."""
        advance: _Graph = partial(steady_advance, self._tracker, learns=learns)
        if self._compiles and not learns:
            advance = _compiled(self._steady, device)
            if device.type == "cuda":
                # What is recorded, and compiled for that, are copies.
                return CudaGraphs(lambda before, filled, t_us: advance(before, _of_any_number(filled), t_us))
        return CudaGraphs(advance) if device.type == "cuda" else advance


def _compiled(function: Callable[P, R], device: torch.device) -> Callable[P, R]:
    """The function as a graph of its own."""
    # All that it hangs on is fixed with the tracker: to look whether it is takes a tenth of a step.
    options = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe, "cpp_wrapper": device.type == "cpu"}
    # Not where it is defined: that would import the compiler, which takes as long as PyTorch itself, wherever a tracker is.
    torch.compiler.assume_constant_result(cells_within)
    # Without guards, no two functions may share what is compiled.
    how: dict[str, Any] = {"fullgraph": True, "dynamic": False, "options": options, "isolate_recompiles": True}
    graph: Callable[P, R] = torch.compile(function, **how)
    return graph


def _for_the_first_time(graph: Callable[Concatenate[TrackerState, P], R], state: TrackerState, *args: P.args, **kwargs: P.kwargs) -> R:
    """What a graph gives that is compiled for this.

    Raises:
        ConfigError: if it cannot be.
    """
    # A tensor that stands for two of the state's would be taken for both of them ever after.
    state = each_tensor(Tensor.clone, state)
    try:
        with _as_expected():
            return graph(state, *args, **kwargs)
    except RuntimeError as error:
        reason = str(error).partition("\n")[0]
        needed = "a C++ compiler (g++ or clang++), or on a GPU triton and a C compiler"
        raise ConfigError(f"compiled: the tracker could not be compiled: {reason}. It needs {needed}. Install that, or go without.") from error


@contextmanager
def _as_expected() -> Iterator[None]:
    """Within it, the compiler does not report which operations it leaves to PyTorch, nor what it will do otherwise one day."""
    logger = logging.getLogger("torch._inductor")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logger.setLevel(before)


def _plain(value: Tensor) -> Tensor:
    """The tensor as graphs are made for: row by row in memory, and of no use for gradients."""
    return value.contiguous() if value.is_inference() else value.clone(memory_format=torch.contiguous_format)


def _own(value: S) -> S:
    """The state or the result as the caller may use it, for gradients too."""
    return value if torch.is_inference_mode_enabled() else each_tensor(Tensor.clone, value)


def _filled(nearby: NearbyEvents, streams: int) -> NearbyEvents:
    """The events, with some of no stream after them."""
    events = nearby.events
    missing = _rounded_up(len(events)) - len(events)
    x, y, t_us, polarity = (pad(values, (0, missing)) for values in (events.x, events.y, events.t_us, events.polarity))
    most = None if streams == 1 else 1 << (events.most_of_one or len(events)).bit_length()
    filled = EventBatch(x, y, t_us, polarity, pad(events.stream_index, (0, missing), value=streams), most_of_one=most)
    if nearby.number is not None:
        return NearbyEvents(filled, pad(nearby.number, (0, missing)))
    # Where some may be left out another time, all are numbered. Of several streams none are, nor on a GPU.
    return NearbyEvents(filled, torch.arange(len(filled)) if streams == 1 and not host_sync.on_gpu(x) else None)


def _in_bursts(before: TrackerState, filled: NearbyEvents, t_us: Tensor) -> tuple[TrackerState, NearbyEvents]:
    """The state with its map of bursts brought up with the events.

    Not in the graph: where 16 bits are enough, a CPU's compiler takes one pixel at a time.
    """
    if host_sync.read_at_once(t_us):
        height, width = before.maps.burst_age_us.shape[-2:]
        check_on_sensor(filled.events, width, height)
    burst_age_us = update_bursts(before.maps.burst_age_us, t_us - before.t_us, pad_streams(filled.events, len(t_us), t_us))
    return replace(before, maps=replace(before.maps, burst_age_us=burst_age_us)), replace(filled, are_in_map=True)


def _of_any_number(filled: NearbyEvents) -> NearbyEvents:
    """The events, marked for the compiler: there may be another number of them another time."""
    events = filled.events
    for values in (events.x, events.y, events.t_us, events.polarity, events.stream_index, filled.number):
        if values is not None:
            torch._dynamo.mark_dynamic(values, 0)
    return filled


def _rounded_up(count: int) -> int:
    """The next larger number of few binary digits."""
    step = max(1 << max(count.bit_length() - _DIGITS, 0), _MULTIPLE)
    return -(-count // step) * step
