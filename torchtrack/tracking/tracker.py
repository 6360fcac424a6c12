"""The tracker: events in, poses out (Algorithm 1 of the paper, for many objects and streams at once).

The only state is an immutable :class:`TrackerState`; ``step`` is pure: the same state and events give the same result.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch, host_sync
from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch, pad_streams
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.adapt import Lesson, learned_after, objects_as_known
from torchtrack.tracking.adaptation.pixel_latency import LOOK_US, dated, late_share_after
from torchtrack.tracking.association.observations import Observations, corner_observations, join, select_events
from torchtrack.tracking.association.weighting_features import Evidence, judged
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.rounds import align, gate_widening, index_for, index_radius, usual_index_radius
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.frontend.history import History
from torchtrack.tracking.frontend.sensors import farthest_event_px
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.frontend.time_surface import update_last_event
from torchtrack.tracking.frontend.window_events import ObjectEvents
from torchtrack.tracking.graphs import CompiledStep
from torchtrack.tracking.initialization import check_poses, first_state, held_back, of_unknown_motion, to_be_parted
from torchtrack.tracking.motion.predict import forecast
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.relocalization.evidence import gather_evidence
from torchtrack.tracking.relocalization.last_seen import LastSeen, anywhere
from torchtrack.tracking.relocalization.lost_object import OtherPoses, Relocalized
from torchtrack.tracking.relocalization.relocalize import relocalize
from torchtrack.tracking.relocalization.sampling import rehearse
from torchtrack.tracking.relocalization.schedule import is_time, schedule
from torchtrack.tracking.relocalization.tentative import after_probation
from torchtrack.tracking.relocalization.triggers import (
    AROUND_LAST_SEEN,
    SEARCHED,
    Trigger,
    has,
    may_have_rotated,
    reference_where_known,
    searches,
    triggers,
)
from torchtrack.tracking.start_check import check_in_view
from torchtrack.tracking.state import StepResult, TrackerState, choose_rows
from torchtrack.tracking.step_check import check_step
from torchtrack.tracking.update import conclude
from torchtrack.tracking.validation.measures import asked_apart
from torchtrack.tracking.validation.scored_fit import explained_at_rest, judge_fit
from torchtrack.tracking.validation.status import Status

_QUESTIONS = host_sync.HostReads()


class Tracker(TrackedObjects):
    """Tracks known rigid objects in one or more event streams.

    Args:
        objects: models of the objects; the same model object may appear many times.
        camera: one camera, or one per stream.
        config: settings; the ``default`` preset when not given.
        stream_index: the stream each object is seen in; the first for all when not given.
        dtype: precision of the pipeline; poses are kept in float64.
        weigher: judges every window's :class:`tracking.association.weighting_features.Evidence`: how far each observation is to be believed,
            ``[b, n]``, 0 to 1, which multiplies into its weight. Gradients of poses reach it. When not given, the one that
            comes with the package, for what ``matching.learned_trust`` says. Other poses that a search tries are aligned
            without it.
        compiled: whether steady windows are taken by compiled graphs, see :mod:`torchtrack.tracking.graphs`.
        kernels: whether Numba's kernels are used where they apply, see :mod:`torchtrack.backends.numba`.

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
        weigher: nn.Module | None = None,
        *,
        compiled: bool = False,
        kernels: bool = True,
    ) -> None:
        super().__init__(objects, camera, config, stream_index, dtype, weigher)
        self.kernels = kernels
        self.graphs = CompiledStep(self, compiles=compiled)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Tracker":
        """All of the tracker elsewhere, or in another type, and without the graphs of where it was."""
        super()._apply(fn, recurse)
        # While it is made, and brought to its type, there are none yet.
        if hasattr(self, "graphs"):
            self.graphs = copy.copy(self.graphs)
        return self

    def alone(self, number: int) -> "Tracker":
        """A tracker of one of the objects alone, in its stream, with the same settings."""
        weigher, camera = self.weigher if self.has_own_weigher else None, self.cameras[int(self.stream_index[number])]
        alone = Tracker([self.object_models[number]], camera, self.config, dtype=self.intrinsics.dtype, weigher=weigher, kernels=self.kernels)
        return alone.to(self.intrinsics.device)

    def init(self, T_cam_obj: Tensor, t_us: int | Int[Tensor, "s"]) -> TrackerState:
        """The state before the first window, from each object's pose at ``t_us``.

        Raises:
            PoseError: if a pose is not a rigid motion, or an object is behind or around the camera, outside the image, or no pixel large.
        """
        T_cam_obj = torch.as_tensor(T_cam_obj, dtype=torch.float64, device=self.intrinsics.device)
        check_poses(T_cam_obj, self.centre_obj, self.object_names)
        check_in_view(T_cam_obj, self.object_models, [self.cameras[stream] for stream in self.stream_index.tolist()])
        return first_state(self, T_cam_obj, torch.as_tensor(t_us, dtype=torch.int64, device=T_cam_obj.device).expand(self.streams).clone())

    def forward(self, events: EventBatch, state: TrackerState, t_end_us: int | Int[Tensor, "s"] | None = None) -> tuple[TrackerState, StepResult]:
        """:meth:`step`, as a layer of a network: what comes in first."""
        return self.step(state, events, t_end_us)

    def step(self, state: TrackerState, events: EventBatch, t_end_us: int | Int[Tensor, "s"] | None = None) -> tuple[TrackerState, StepResult]:
        """Advance every object by one window of events.

        Where gradients are recorded, the new poses and velocities are differentiable by the old ones, by the weigher, and by
        whatever buffer requires it, such as ``intrinsics``; covariances are constants. Autocast leaves this alone: the
        solver needs the digits.

        Args:
            state: from :meth:`init` or the last step.
            events: of all streams, after ``state.t_us`` and up to ``t_end_us``.
            t_end_us: end of the window; the newest event of each stream when not given.

        Raises:
            EventDataError: if the events of a stream are not in time order, or not after ``state.t_us`` and up to ``t_end_us``,
                except on a GPU; if an event is outside the sensor, where kernels are used.
        """
        t_us = self._window_end(state, events, t_end_us)
        check_step(state.t_us, events, t_us)
        with torch.autocast(t_us.device.type, enabled=False), dispatch.backend(wanted=self.kernels):
            steady = self._steady(state, events, t_us)
            if steady is not None:
                return _counted(steady)
            in_parts = to_be_parted(state, events, t_us, self.objects, self.config)
            parted = host_sync.AsyncValue.to(in_parts)
            if host_sync.read_at_once(in_parts) and bool(in_parts.all()):
                return _counted(self._advance_in_parts(state, events, t_us, in_parts))
            done = self._advance(state, events, t_us)
            return _counted(choose_rows(in_parts, self._advance_in_parts(state, events, t_us, in_parts), done) if parted.any() else done)

    def steady_step(
        self, state: TrackerState, events: EventBatch, t_end_us: int | Int[Tensor, "s"]
    ) -> tuple[TrackerState, StepResult, Bool[Tensor, ""]]:
        """:meth:`step` where nothing has to be decided, so that a CUDA graph can hold it.

        No object is searched for or looked for farther away than as configured, and no window is taken in parts. A graph is of
        as many events as it is captured with, and learns contours or not as the window's number then says.

        Returns:
            State, result, and whether any of this was called for: then they do not hold, and :meth:`step` is to take the window.
        """
        t_us, assumptions = self._window_end(state, events, t_end_us), host_sync.SteadyState()
        with torch.autocast(t_us.device.type, enabled=False):
            assumptions.ask(to_be_parted(state, events, t_us, self.objects, self.config), False)
            done = _counted(self.advance(self.opened(state, events), NearbyEvents(events), t_us, questions=assumptions))
        return *done, assumptions.wrong()

    def prepare(self, state: TrackerState) -> None:
        """Compile what is compiled, before the first window: graphs take a minute or more, kernels half of that, and a live camera does not wait.

        Args:
            state: from :meth:`init`.
        """
        self.graphs.prepare(state)
        with torch.inference_mode(), dispatch.backend(wanted=self.kernels):
            if dispatch.may_accelerate(self.intrinsics):
                # Kernels are compiled, or read from the disk, when they are first called: for a window without events.
                self._advance(state, EventBatch.empty(), state.t_us + 1)
                if searches(self.config):
                    rehearse(self._predict(state, torch.full_like(self.diameter_m, 1e-6)), self.config)

    def _steady(self, state: TrackerState, events: EventBatch, t_us: Tensor) -> tuple[TrackerState, StepResult] | None:
        """A window by a graph, where there is one and it holds."""
        return None if torch.is_grad_enabled() else self.graphs(state, events, t_us)

    def near_tiles(self, state: TrackerState, t_us: Int[Tensor, "s"]) -> Bool[Tensor, "b t"] | None:
        """Tiles of the one sensor with events of the window after ``state`` that can have to do with each object; none of several sensors."""
        dt_s = self._window_s(state, t_us)[self.stream_index]
        return None if self.tiles is None else self.tiles.near(self._predict(state, dt_s), dt_s, farthest_event_px(self.config))

    def _near(self, events: NearbyEvents, prediction: Prediction, anew: Tensor, dt_s: Tensor) -> NearbyEvents:
        """Those of the events that can have to do with the objects: with those looked for ``anew``, any; a weigher of one's own is shown all."""
        if not host_sync.none_of(anew):
            prediction = replace(prediction, covariance=anywhere(prediction.covariance, anew))
        return events if self.shows_all else self.sensors.near_objects(events, prediction, dt_s, self.config)

    def _window_s(self, state: TrackerState, t_us: Tensor) -> Tensor:
        """Length of the window after ``state``, of each stream (s)."""
        return (t_us - state.t_us).to(self.intrinsics.dtype) * 1e-6

    def steady_advance(
        self, state: TrackerState, events: NearbyEvents, t_us: Int[Tensor, "s"], *, learns: bool = False
    ) -> tuple[TrackerState, StepResult, Bool[Tensor, ""]]:
        """:meth:`advance` with nothing to decide; and whether anything was, or windows in parts may be called for."""
        assumptions = host_sync.SteadyState()
        assumptions.ask(of_unknown_motion(state, t_us, self.objects, self.config), False)
        return *self.advance(state, events, t_us, questions=assumptions, learns=learns), assumptions.wrong()

    def _advance_in_parts(self, state: TrackerState, events: EventBatch, t_us: Tensor, starting: Tensor) -> tuple[TrackerState, StepResult]:
        """The window as several short ones, with a search for objects that are ``starting``."""
        for left in range(self.config.window.parts, 1, -1):
            until_us = state.t_us + (t_us - state.t_us) // left
            early = events.t_us <= until_us[events.stream_index]
            state, _ = self._advance(state, events[early], until_us, starting)
            events = events[~early]
        return self._advance(state, events, t_us, starting)

    def _advance(self, state: TrackerState, events: EventBatch, t_us: Tensor, starting: Tensor | None = None) -> tuple[TrackerState, StepResult]:
        """One window, or one part of it."""
        return self.advance(self.opened(state, events), NearbyEvents(events), t_us, starting)

    def opened(self, state: TrackerState, events: EventBatch) -> TrackerState:
        """The state with the newest events of a window in its map, where they are remembered."""
        return replace(state, last_event_us=update_last_event(state.last_event_us, events)) if self.looks_back else state

    def advance(
        self,
        state: TrackerState,
        events: NearbyEvents,
        t_us: Int[Tensor, "s"],
        starting: Tensor | None = None,
        questions: host_sync.HostReads = _QUESTIONS,
        *,
        learns: bool = True,
    ) -> tuple[TrackerState, StepResult]:
        """A window from its events to poses: contours where they are expected, corners and flow, matching and solving, conclusion.

        Args:
            state: from :meth:`opened`.
            events: of the window, as far as they can have to do with the objects.
            t_us: end of the window.
            starting: objects whose motion is not known yet.
            questions: asks for what has to be decided.
            learns: whether anything may be learned from the window.
        """
        config, sensors, last_event_us = self.config, self.sensors, state.last_event_us
        window_s = self._window_s(state, t_us)
        dt_s = window_s[self.stream_index]
        planned = schedule(state, self.objects, t_us, config)
        lost = has(planned.triggers, Trigger.LOST)
        recorded = self._predict(self._expected(state, lost, events.events, t_us, dt_s, questions), dt_s)
        prediction = recorded.detached()
        nearby = self._near(events, prediction, has(planned.triggers, AROUND_LAST_SEEN), dt_s)
        seen, burst_age_us = sensors.window_events(nearby, state.burst_age_us, t_us, t_us - state.t_us, config.matching.burst_us)
        contours = prediction.contours(dt_s, config.contours)
        sigma_px = prediction.sigma_px(contours).detach() if config.solver.prior else torch.zeros_like(self.diameter_m)
        starting = torch.zeros_like(self.stream_index, dtype=torch.bool) if starting is None else starting
        widening = gate_widening(sigma_px, config)
        # Asked for here: a GPU answers while corners are looked for.
        radius_px = questions.ask(index_radius(widening, config), usual_index_radius(config))
        corners = sensors.corners(contours, last_event_us, t_us, window_s, config)
        index = index_for(contours, self.image_size, config, widening, radius_px)
        observations = self._observed(corners, seen, prediction, contours, index, sensors.history(last_event_us, t_us))
        as_late = dated(observations, state.late_share, state.unseen_s, config.matching)
        fit = align(recorded, contours, index, widening, as_late, config)
        full_gathered = reference_where_known(sigma_px, state.full_gathered, config.search)
        apart = asked_apart(state.full_apart, state.unseen_s, config.quality)
        found = judge_fit(prediction, fit, config, explained_at_rest(widening), full_gathered, apart)
        if self.turns:
            found = replace(found, turn_unclear=may_have_rotated(self.has_turning_axis, state.unseen_s, config.search))
        evidence = gather_evidence(state, planned, found, sigma_px, starting, self.ambiguities)
        flags = triggers(evidence, config)
        # A GPU is waited for: a pose that begins to slip is farther off a window later.
        wanted = questions.ask(has(flags, SEARCHED), False)
        if wanted.any():
            others = OtherPoses(LastSeen.of(state, self.objects, t_us, config), self.ambiguities)
            relocalized = relocalize(Relocalized(found, recorded, widening), flags, evidence, seen, others, config)
            found, recorded, widening = relocalized.scored, relocalized.prediction, relocalized.gate_scale
            prediction = recorded.detached()
        next_state, result = conclude(state, recorded, widening, found, corners, dt_s, config)
        if config.search.probation:
            next_state, result = after_probation(state, next_state, result, prediction, widening, config)
        next_state = learned_after(next_state, result, prediction, found, Lesson(seen, dt_s, sigma_px, self.on_surfaces, learns), config)
        if config.matching.adaptive_bursts and not host_sync.none_of(due := is_time(state.t_us, t_us, LOOK_US)):
            sure = due[0, self.stream_index] & (result.status == int(Status.TRACKING)) & ~found.elsewhere
            late_share = late_share_after(state.late_share, observations, contours, fit.matches, prediction, sure, config.matching)
            next_state = replace(next_state, late_share=late_share)
        return replace(next_state, t_us=t_us, burst_age_us=burst_age_us), replace(result, t_us=t_us)

    def _observed(
        self, corners: Corners, seen: ObjectEvents, prediction: Prediction, contours: Contours, index: ContourIndex, history: History
    ) -> Observations:
        """What is matched with the contours: corners, and recent events near them, each with how far it is to be believed."""
        observations, most = corner_observations(corners), self.config.matching.max_events
        if most:
            observations = join(observations, select_events(seen, index, prediction.moving(compensated=True), most))
        if self.weigher is None:
            return observations
        return judged(Evidence(observations, seen, prediction, contours, index, history), self.weigher)

    def _window_end(self, state: TrackerState, events: EventBatch, t_end_us: int | Tensor | None) -> Tensor:
        """End of the window of each stream (µs)."""
        if t_end_us is None:
            return state.t_us.scatter_reduce(0, events.stream_index, events.t_us, "amax")
        if isinstance(t_end_us, int):
            return torch.full_like(state.t_us, t_end_us)
        return torch.as_tensor(t_end_us, dtype=torch.int64, device=state.t_us.device).expand(self.streams).clone()

    def _predict(self, state: TrackerState, dt_s: Tensor) -> Prediction:
        """Predicted pose and motion, and how certain they are."""
        objects = objects_as_known(self.objects, state, self.on_surfaces is not None, self.config)
        return forecast(
            state.motion, dt_s, objects, self.revolution_axes if self.revolves and self.config.motion.spin_fades else None, self.far_pose, self.config
        )

    def _expected(
        self, state: TrackerState, lost: Tensor, events: EventBatch, t_us: Tensor, dt_s: Tensor, questions: host_sync.HostReads
    ) -> TrackerState:
        """The state that a window is predicted from: of what is lost for long, where it was last seen well."""
        # Most windows are of objects that were found long ago: their events need not be counted, where that is known at once.
        unfound = ~(state.usual_score > 0)
        if self.config.motion.speed_from_events and not questions.none_of(unfound):
            state = held_back(state, unfound, self.objects, self.sensors.seen(pad_streams(events, self.streams, t_us)), dt_s)
        return state if questions.none_of(lost) else LastSeen.of(state, self.objects, t_us, self.config).in_place_of(state, lost)


def _counted(done: tuple[TrackerState, StepResult]) -> tuple[TrackerState, StepResult]:
    """A window more was taken, in parts or not."""
    state, result = done
    return state.numbered(state, 1), result
