"""Whole windows as one graph: on a GPU a recording of some thousand small operations; compiled, fused kernels in their place.

What a step of one object costs is the calls of operations, not what they compute. On a GPU, they are recorded once, and then started as a whole
(:mod:`torchtrack.tracking.cuda_graphs`). ``torch.compile`` turns them into fewer and larger kernels, there and on a CPU. Shapes are those of a
GPU (:mod:`torchtrack.core.host_sync`), and the number of events is left open.

On a GPU, the graph holds however uncertain or lost objects are, as it does for all what these need
(:func:`torchtrack.tracking.step.steady_lane`). Objects that are to be searched for are, after it, from what it has computed of the window; the
others are as it left them. On a CPU, where an uncertain object costs what it needs and no more, the compiled graph is of windows in which all are
certain: where one turns out not to be, what the graph gave is dropped. Windows in parts are taken as without a graph, and on a CPU so are those
that contours are learned from. Poses are the same, to rounding.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn.functional import pad

from torchtrack.core import host_sync
from torchtrack.core.events import EventBatch, check_on_sensor, pad_streams
from torchtrack.tracking.adapt import learns_next
from torchtrack.tracking.compiling import Lane, check_version, compiled, compiled_or_as_it_is, for_the_first_time, of_any_number
from torchtrack.tracking.cuda_graphs import CudaGraphs
from torchtrack.tracking.expectation import near_tiles
from torchtrack.tracking.frontend.bursts import update_bursts
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.state import S, StepResult, TrackerState, each_tensor
from torchtrack.tracking.step import SteadyWindow, looked_for, opened, steady_advance, steady_lane

_Graph = Callable[[TrackerState, NearbyEvents, Tensor], tuple[TrackerState, StepResult, Tensor]]
# At a start, it is looked at more than later on which contours a model lacks.
_FIRST_WINDOWS = 5
# Of more events than this, those that are near no object are left out first.
_MANY = 16_384
# Events are filled up to numbers of this many binary digits, so that a GPU needs few graphs, and to multiples of this: loops
# of a compiled kernel take several at once.
_DIGITS, _MULTIPLE = 3, 64


class InPlace:
    """A window that stays where a graph has computed it, until the graph is started again: no dataclass, so that its tensors are not copied."""

    def __init__(self, window: SteadyWindow) -> None:
        self._window = window

    def window(self) -> SteadyWindow:
        """The window as it is now. What was computed from it another time is not in it."""
        return each_tensor(lambda tensor: tensor, self._window)


class CompiledStep:
    """Takes windows by graphs, made when they are first needed: compiled for a minute or more, and for seconds from a cache on disk.

    Args:
        tracker: whose windows they are.
        compiles: whether they are compiled; else there are graphs on a GPU alone.

    Raises:
        ConfigError: if this version of PyTorch cannot.
    """

    def __init__(self, tracker: TrackedObjects, *, compiles: bool = True) -> None:
        if compiles:
            check_version()
        self._tracker, self._compiles = tracker, compiles
        # By how many events a stream has at most, where there are several: on a CPU of steady windows, on a GPU of all, and by what is learned.
        self._steady: dict[int | None, _Graph] = {}
        self._lanes: dict[tuple[int | None, bool], Lane] = {}
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
            before, filled = opened(self._tracker, plain, events), _filled(nearby, len(t_us))
            done = self._by_lane(before, filled, t_us, learns) if host_sync.on_gpu(t_us) else self._if_steady(before, filled, t_us)
        return None if done is None else (_own(done[0]).numbered(state), _own(done[1]))

    def _by_lane(self, before: TrackerState, filled: NearbyEvents, t_us: Tensor, learns: bool) -> tuple[TrackerState, StepResult] | None:
        """State and result of a window, by the graph that holds however uncertain objects are; None where the window is to be taken in parts."""
        next_state, result, stated, in_place = self._lane(filled, learns)(before, filled, t_us)
        is_wrong, searches = host_sync.AsyncValue.to(stated).numbers()
        if is_wrong:
            return None
        return looked_for(self._tracker, before, in_place.window(), filled, t_us, learns=learns) if searches else (next_state, result)

    def _if_steady(self, before: TrackerState, filled: NearbyEvents, t_us: Tensor) -> tuple[TrackerState, StepResult] | None:
        """State and result of a window in which all objects are certain; None for another."""
        next_state, result, wrong = self._taken(before, filled, t_us)
        return None if bool(wrong) else (next_state, result)

    def _lane(self, filled: NearbyEvents, learns: bool) -> Lane:
        """The graph of a GPU. Few windows are learned from: to compile theirs, too, would take longer than it saves."""
        kind = filled.events.most_of_one, learns
        if kind not in self._lanes:
            lane: Lane = partial(steady_lane, self._tracker, learns=learns)
            if self._compiles and not learns:
                lane = compiled_or_as_it_is(lane, filled.events.x.device)
            self._lanes[kind] = CudaGraphs(lambda before, filled, t_us: _in_place(*lane(before, filled, t_us)))
        return self._lanes[kind]

    def __getstate__(self) -> dict[str, Any]:
        """Of a copy, which has no graphs yet: these are of this tracker's tensors where they are now, and of this process."""
        return {**vars(self), "_steady": {}, "_lanes": {}, "_near_tiles": None}

    def _are_for(self, t_us: Tensor) -> bool:
        """Whether there are graphs for windows of that device. For a weighting network of one's own they have to be asked for."""
        return self._compiles or (host_sync.on_gpu(t_us) and not self._tracker.shows_all)

    def __len__(self) -> int:
        """How many graphs there are."""
        return len(self._steady) + len(self._lanes)

    @torch.inference_mode()
    def prepare(self, state: TrackerState) -> None:
        """Compile the graphs of one stream, from the state that it begins with; with several, more than that would have to be known."""
        if len(state.t_us) > 1 or not self._are_for(state.t_us):
            return
        t_us, nothing = state.t_us + 1, torch.zeros_like(state.t_us).expand(2)
        events = EventBatch(nothing.int(), nothing.int(), t_us.expand(2), nothing > 0, nothing)
        plain = each_tensor(_plain, state.numbered(state, _FIRST_WINDOWS))
        filled = _filled(NearbyEvents(events), 1)
        if host_sync.on_gpu(t_us):
            self._lane(filled, learns=False)(plain, filled, t_us)
        else:
            self._near(plain, events, t_us)
            self._taken(plain, filled, t_us)

    def _near(self, state: TrackerState, events: EventBatch, t_us: Tensor) -> NearbyEvents:
        """The events that can have to do with the objects; all of several streams, and on a GPU, which would have to be waited for."""
        if len(t_us) > 1 or self._tracker.shows_all or t_us.device.type != "cpu":
            return NearbyEvents(events)
        if self._near_tiles is None:
            self._near_tiles = compiled(self._tiles_near, t_us.device)
            near = for_the_first_time(self._near_tiles, state, t_us)
        else:
            near = self._near_tiles(state, t_us)
        return self._tracker.tiles.keep(events, near)

    def _tiles_near(self, state: TrackerState, t_us: Tensor) -> Tensor:
        return near_tiles(self._tracker, state, t_us)

    def _advance_steady(self, state: TrackerState, events: NearbyEvents, t_us: Tensor) -> tuple[TrackerState, StepResult, Tensor]:
        return steady_advance(self._tracker, state, events, t_us)

    def _taken(self, before: TrackerState, filled: NearbyEvents, t_us: Tensor) -> tuple[TrackerState, StepResult, Tensor]:
        """What a CPU's graph makes of a window, and whether that does not hold."""
        before, filled = _in_bursts(before, filled, t_us)
        most = filled.events.most_of_one
        if most not in self._steady:
            self._steady[most] = compiled(self._advance_steady, t_us.device)
            return for_the_first_time(self._steady[most], before, of_any_number(filled), t_us)
        return self._steady[most](before, filled, t_us)


def _in_place(state: TrackerState, result: StepResult, stated: Tensor, window: SteadyWindow) -> tuple[TrackerState, StepResult, Tensor, InPlace]:
    return state, result, stated, InPlace(window)


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


def _rounded_up(count: int) -> int:
    """The next larger number of few binary digits."""
    step = max(1 << max(count.bit_length() - _DIGITS, 0), _MULTIPLE)
    return -(-count // step) * step
