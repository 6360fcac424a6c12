"""The tracker: events in, poses out (Algorithm 1 of the paper, for many objects and streams at once).

The only state is an immutable :class:`TrackerState`; ``step`` is pure: the same state and events give the same result.
"""

import copy
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor, nn

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch, host_sync
from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch, ForeignEvents, as_batch
from torchtrack.core.later import Ahead
from torchtrack.core.pose_types import as_pose_matrices
from torchtrack.errors import TorchtrackWarning
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.deferred_search import followed, may_search_later, with_search
from torchtrack.tracking.estimation.terms import CostTerm
from torchtrack.tracking.expectation import predicted_after
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.graphs import CompiledStep
from torchtrack.tracking.initialization import PARTS, check_poses, first_state, to_be_parted
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.relocalization.sampling import rehearse
from torchtrack.tracking.start_check import check_in_view
from torchtrack.tracking.state import Search, StepResult, TrackerState, choose_rows
from torchtrack.tracking.step import StepInput, advance, opened
from torchtrack.tracking.step_check import check_step


class Tracker(TrackedObjects):
    """Tracks known rigid objects in one or more event streams.

    Args:
        objects: models of the objects; the same model object may appear many times.
        camera: one camera, or one per stream.
        config: settings; the ``default`` preset when not given.
        stream_index: the stream each object is seen in; the first for all when not given.
        dtype: precision of the pipeline; poses are kept in float64.
        weighting_network: judges every window's :class:`tracking.association.weighting_features.WeightingInputs`: how far to believe each,
            ``[b, n]``, 0 to 1, which multiplies into its weight. Gradients of poses reach it. When not given, the one that
            comes with the package, for what ``association.weighting_network`` says. Other poses that a search tries are aligned
            without it.
        compiled: whether windows are taken by compiled graphs, on a CPU steady ones, see :mod:`torchtrack.tracking.graphs`.
        kernels: whether kernels of Numba, and on a GPU of Triton, are used where they apply: :mod:`torchtrack.core.dispatch`.

    Raises:
        ConfigError: if graphs are asked for, and this version of PyTorch cannot make them.
    """

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        camera: Camera | Sequence[Camera],
        config: TrackerConfig | None = None,
        stream_index: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float32,
        weighting_network: nn.Module | None = None,
        *,
        compiled: bool = False,
        kernels: bool = True,
    ) -> None:
        super().__init__(objects, camera, config, stream_index, dtype, weighting_network)
        self.kernels = kernels
        self.graphs = CompiledStep(self, compiles=compiled)
        self._ahead = Ahead()
        # Those of objects that a search has found, by number.
        self._alone: dict[int, Tracker] = {}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Tracker":
        """All of the tracker elsewhere, or in another type, and without the graphs of where it was."""
        super()._apply(fn, recurse)
        # While it is made, and brought to its type, there are none yet.
        if hasattr(self, "graphs"):
            self.graphs = copy.copy(self.graphs)
            self._alone = {}
        return self

    def __repr__(self) -> str:
        names, sizes = ", ".join(self.object_names[:4]), ", ".join(sorted({f"{camera.width}x{camera.height}" for camera in self.cameras}))
        shown = f"{names}, …" if len(self.object_names) > 4 else names
        objects = f"{len(self.object_names)} object{'s' * (len(self.object_names) > 1)} ({shown})"
        streams = f"{self.streams} stream{'s' * (self.streams > 1)} of {sizes} pixels"
        return f"{type(self).__name__}({objects}, {streams}, {self.intrinsics.device}, {str(self.intrinsics.dtype).removeprefix('torch.')})"

    def alone(self, number: int, config: TrackerConfig | None = None) -> "Tracker":
        """A tracker of one of the objects alone, in its stream; with the same settings where no others are given."""
        weighting_network, camera = self.weighting_network if self.has_own_network else None, self.cameras[int(self.stream_index[number])]
        alone = Tracker(
            [self.object_models[number]],
            camera,
            config or self.config,
            dtype=self.intrinsics.dtype,
            weighting_network=weighting_network,
            kernels=self.kernels,
        )
        return alone.to(self.intrinsics.device)

    def init(self, T_cam_obj: Any, t_us: int | Int[Tensor, "s"]) -> TrackerState:
        """The state before the first window, from each object's pose at ``t_us``.

        Args:
            T_cam_obj: ``[b, 4, 4]`` poses (m), or poses of another library, see :mod:`torchtrack.core.pose_types`; of one object also
                without the first axis.
            t_us: their time (µs), one or one per stream.

        Raises:
            PoseError: if a pose is not a rigid motion, or an object is behind or around the camera, outside the image, or no pixel large.
        """
        T_cam_obj = as_pose_matrices(T_cam_obj).to(self.intrinsics.device)
        if T_cam_obj.dim() == 2 and len(self.object_names) == 1:
            T_cam_obj = T_cam_obj[None]
        check_poses(T_cam_obj, self.centre_obj, self.object_names)
        check_in_view(T_cam_obj, self.object_models, [self.cameras[stream] for stream in self.stream_index.tolist()])
        return first_state(self, T_cam_obj, torch.as_tensor(t_us, dtype=torch.int64, device=T_cam_obj.device).expand(self.streams).clone())

    def forward(
        self, events: EventBatch | ForeignEvents, state: TrackerState, t_end_us: int | Int[Tensor, "s"] | None = None
    ) -> tuple[TrackerState, StepResult]:
        """:meth:`step`, as a layer of a network: what comes in first.

        Warns (:class:`~torchtrack.errors.TorchtrackWarning`) under ``torch.compile``, which leaves a tracker as it is.
        """
        if torch.compiler.is_compiling():
            return torch.compiler.disable(_step_uncompiled)(self, events, state, t_end_us)
        return self.step(state, events, t_end_us)

    def step(
        self,
        state: TrackerState,
        events: EventBatch | ForeignEvents,
        t_end_us: int | Int[Tensor, "s"] | None = None,
        extra_terms: tuple[CostTerm, ...] = (),
    ) -> tuple[TrackerState, StepResult]:
        """Advance every object by one window of events.

        Where gradients are recorded, the new poses and velocities are differentiable by the old ones, by the weighting network, and by
        whatever buffer requires it, such as ``intrinsics``; covariances are constants. Autocast leaves this alone: the
        solver needs the digits.

        Args:
            state: from :meth:`init` or the last step.
            events: of all streams, after ``state.t_us`` and up to ``t_end_us``; of one stream also events of another library.
            t_end_us: end of the window; the newest event of each stream when not given.
            extra_terms: of the cost of the poses at the window's end, beside contours and prediction; in the tracker's precision. A window
                with them is not taken by a graph, and other poses that a search tries are aligned without them.

        Raises:
            EventDataError: if the events of a stream are not in time order, or not after ``state.t_us`` and up to ``t_end_us``,
                except on a GPU; if an event is outside the sensor, where kernels are used.
        """
        events = as_batch(events)
        t_us = self._window_end(state, events, t_end_us)
        check_step(state.t_us, events, t_us)
        with torch.autocast(t_us.device.type, enabled=False), dispatch.backend(wanted=self.kernels, values=self.intrinsics):
            return self._tracked(state, StepInput(NearbyEvents(events), t_us, extra_terms=extra_terms))

    def prepare(self, state: TrackerState) -> None:
        """Compile what is compiled, before the first window: graphs take a minute or more, kernels half of that, and a live camera does not wait.

        Args:
            state: from :meth:`init`.
        """
        with torch.inference_mode(), dispatch.backend(wanted=self.kernels, values=self.intrinsics):
            self.graphs.prepare(state)
            if host_sync.read_at_once(self.intrinsics) and dispatch.may_accelerate(self.intrinsics):
                # Kernels are compiled, or read from the disk, when they are first called: for a window without events.
                self._advance(state, StepInput(NearbyEvents(EventBatch.empty()), state.t_us + 1))
                if self.config.searches:
                    rehearse(predicted_after(self, state, torch.full_like(self.diameter_m, 1e-6)), self.config)

    def _tracked(self, state: TrackerState, given: StepInput) -> tuple[TrackerState, StepResult]:
        """The state and result after a window whose events are checked."""
        under_way, is_later = state.search, may_search_later(state, self.config)
        if under_way is None and not is_later:
            return self._taken(state, given)
        last = under_way or Search(state.t_us, torch.zeros_like(self.stream_index))
        if under_way is not None:
            # Before the window is taken: what was found is followed through it meanwhile.
            under_way = followed(under_way, given, self._followed_alone, self._ahead)
        taken = self._taken(replace(state, search=None), replace(given, search=last if is_later else None))
        return with_search(taken, under_way, self.config, self._ahead)

    def _followed_alone(self, number: int, state: TrackerState, events: EventBatch, t_us: Int[Tensor, "s"]) -> tuple[TrackerState, StepResult]:
        """A window of one of the objects alone, of which no other poses are tried."""
        if number not in self._alone:
            self._alone[number] = self.alone(number, self.config.without_searches())
        stream = int(self.stream_index[number])
        own = events if self.streams == 1 else events[events.stream_index == stream].of_stream(0)
        return self._alone[number].step(state, own, t_us[stream : stream + 1])

    def _taken(self, state: TrackerState, given: StepInput) -> tuple[TrackerState, StepResult]:
        """The state and result after a window, whatever search goes on beside it."""
        steady = None if given.extra_terms else self._steady(state, given)
        if steady is not None:
            return _counted(steady)
        in_parts = to_be_parted(state, given.events.events, given.t_us, self.objects, self.config)
        parted = host_sync.AsyncValue.to(in_parts)
        if host_sync.read_at_once(in_parts) and bool(in_parts.all()):
            return _counted(self._advance_in_parts(state, given, in_parts))
        if given.search is not None and parted.any():
            # In each part, searches are waited for.
            given = replace(given, search=None)
        done = self._advance(state, given)
        if not parted.any():
            return _counted(done)
        return _counted(choose_rows(in_parts, self._advance_in_parts(state, given, in_parts), done))

    def _steady(self, state: TrackerState, given: StepInput) -> tuple[TrackerState, StepResult] | None:
        """A window by a graph, where there is one and it holds."""
        return None if torch.is_grad_enabled() else self.graphs(state, given.events.events, given.t_us)

    def _advance_in_parts(self, state: TrackerState, given: StepInput, starting: Tensor) -> tuple[TrackerState, StepResult]:
        """The window as several short ones, with a search for objects that are ``starting``; further terms hold at the end of the last."""
        events, t_us = given.events.events, given.t_us
        for left in range(PARTS, 1, -1):
            until_us = state.t_us + (t_us - state.t_us) // left
            early = events.t_us <= until_us[events.stream_index]
            state, _ = self._advance(state, StepInput(NearbyEvents(events[early]), until_us, starting))
            events = events[~early]
        return self._advance(state, StepInput(NearbyEvents(events), t_us, starting, extra_terms=given.extra_terms))

    def _advance(self, state: TrackerState, given: StepInput) -> tuple[TrackerState, StepResult]:
        """One window, or one part of it."""
        return advance(self, opened(self, state, given.events.events), given)

    def _window_end(self, state: TrackerState, events: EventBatch, t_end_us: int | Tensor | None) -> Tensor:
        """End of the window of each stream (µs)."""
        if t_end_us is None:
            return state.t_us.scatter_reduce(0, events.stream_index, events.t_us, "amax")
        if isinstance(t_end_us, int):
            return torch.full_like(state.t_us, t_end_us)
        return torch.as_tensor(t_end_us, dtype=torch.int64, device=state.t_us.device).expand(self.streams).clone()


def _step_uncompiled(
    tracker: Tracker, events: EventBatch | ForeignEvents, state: TrackerState, t_end_us: int | Int[Tensor, "s"] | None
) -> tuple[TrackerState, StepResult]:
    """A step without the compiler, which would take many minutes for many small parts, and again for other numbers of events."""
    warnings.warn(
        "torch.compile leaves a tracker as it is: numbers of events, searches and windows in parts change from window to window. For compiled "
        "steady windows use Tracker(..., compiled=True); of a weighting network of your own, compile the network.",
        TorchtrackWarning,
        stacklevel=3,
    )
    return tracker.step(state, events, t_end_us)


def _counted(done: tuple[TrackerState, StepResult]) -> tuple[TrackerState, StepResult]:
    """A window more was taken, in parts or not."""
    state, result = done
    return state.numbered(state, 1), result
