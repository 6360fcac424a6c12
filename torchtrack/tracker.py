"""The tracker: events in, poses out (Algorithm 1 of the paper, for many objects and streams at once).

The only state is an immutable :class:`TrackerState`; ``step`` is pure: the same state and events give the same result.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchtrack import lie, quality, readback
from torchtrack.alignment import align, gate_widening, index_for, index_radius, usual_index_radius
from torchtrack.bursts import no_bursts, update_bursts
from torchtrack.camera import MIN_DEPTH_M, Camera, distortion_table, stack_tables, undistortion_table
from torchtrack.conclusion import conclude
from torchtrack.config.tracker import TrackerConfig
from torchtrack.constants import constant
from torchtrack.contours import ContourModel, Contours, group_by_model
from torchtrack.corners import Corners, detect_corners, no_corners
from torchtrack.errors import ModelError, PoseError
from torchtrack.events import EventBatch, PaddedEvents, pad_streams, stream_bounds
from torchtrack.evidence import AgeAt, Evidence, judged
from torchtrack.flow import estimate_flow
from torchtrack.learned_contours import LearnedContours
from torchtrack.motion import initial_covariance, predict_covariance, with_dropped
from torchtrack.object_batch import ObjectBatch
from torchtrack.object_model import ObjectModel
from torchtrack.observations import WindowEvents, corner_observations, join, select_events
from torchtrack.prediction import Prediction
from torchtrack.search import Doubt, judge_fit, may_be_wanted, search_wanted
from torchtrack.sensor_tiles import SensorTiles
from torchtrack.speed_limit import largest_speed, limit_speed, unknown_speed
from torchtrack.state import StepResult, TrackerState, choose_rows
from torchtrack.surface_learning import Surroundings, learn_after
from torchtrack.time_surface import at_pixels, empty_last_event, object_regions, time_surface, update_last_event
from torchtrack.trust import TrustNetwork

# Contours this far outside the image still find their place on a distorted sensor (px).
_BORDER_PX = 64
# Nothing that is tracked is farther away (m).
_MAX_DEPTH_M = 1e4
# Poses that a search draws lie within this many of its least standard deviations.
_DRAWN_SIGMAS = 4.0
# Fewer events than this do not make a part of a window.
_EVENTS_OF_A_PART = 400
_QUESTIONS = readback.Questions()


class Tracker(nn.Module):
    """Tracks known rigid objects in one or more event streams.

    Args:
        objects: models of the objects; the same model object may appear many times.
        camera: one camera, or one per stream.
        config: settings; the ``default`` preset when not given.
        stream_index: the stream each object is seen in; the first for all when not given.
        dtype: precision of the pipeline; poses are kept in float64.
        weigher: judges every window's :class:`torchtrack.evidence.Evidence`: how far each observation is to be believed,
            ``[b, n]``, 0 to 1, which multiplies into its weight. Gradients of poses reach it. When not given, the one that
            comes with the package where ``matching.learned_trust`` is on, and none otherwise. Other poses that a search
            tries are aligned without it.
    """

    intrinsics: Tensor
    ideal_pixels: Tensor
    sensor_pixels: Tensor
    stream_index: Tensor
    centre_obj: Tensor
    diameter_m: Tensor
    far_pose: Tensor

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        camera: Camera | Sequence[Camera],
        config: TrackerConfig | None = None,
        stream_index: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float32,
        weigher: nn.Module | None = None,
    ) -> None:
        super().__init__()
        cameras = [camera] if isinstance(camera, Camera) else list(camera)
        self.config = config or TrackerConfig()
        self.object_names = tuple(model.name for model in objects)
        streams = list(stream_index) if stream_index is not None else [0] * len(objects)
        _check_setup(objects, cameras, streams, self.config)
        self._shared = len(set(streams)) < len(streams)
        self.image_size = (max(c.height for c in cameras), max(c.width for c in cameras))
        self.groups = nn.ModuleList(group_by_model(objects, self.config.contours))
        self.register_buffer("stream_index", torch.tensor(streams))
        self.register_buffer("intrinsics", torch.stack([cameras[s].intrinsics() for s in streams]))
        self.register_buffer("ideal_pixels", stack_tables([undistortion_table(c) for c in cameras]))
        self.register_buffer("sensor_pixels", stack_tables([distortion_table(c, _BORDER_PX) for c in cameras]))
        self.tiles = SensorTiles(self.ideal_pixels[0]) if len(cameras) == 1 else None
        self.register_buffer("centre_obj", torch.stack([model.centre for model in objects]))
        self.register_buffer("diameter_m", torch.tensor([model.diameter_m for model in objects]))
        self.register_buffer("far_pose", _far_pose(self.centre_obj))
        self.weigher = TrustNetwork.shipped() if weigher is None and self.config.matching.learned_trust else weigher
        # On dense meshes no line of sight is followed.
        self._learns = any(len(model.triangles) for model in self.models)
        self.to(dtype)

    @property
    def models(self) -> list[ContourModel]:
        """The distinct models, with the objects that have each."""
        return [group for group in self.groups if isinstance(group, ContourModel)]

    @property
    def objects(self) -> ObjectBatch:
        """The objects as one batch."""
        shape = (self.streams, *self.image_size)
        return ObjectBatch(self.models, self.intrinsics, self.centre_obj, self.diameter_m, self.stream_index, shape, self._shared)

    @property
    def _looks_back(self) -> bool:
        """Whether anything needs the events of earlier windows: they are not kept for nothing."""
        return self.config.corners.max_corners > 0 or self.weigher is not None

    @property
    def streams(self) -> int:
        """Number of event streams."""
        return len(self.ideal_pixels)

    def init(self, T_cam_obj: Tensor, t_us: int | Int[Tensor, "s"]) -> TrackerState:
        """The state before the first window, from each object's pose at ``t_us``.

        Raises:
            PoseError: if a pose is not a rigid motion, or an object is behind the camera.
        """
        T_cam_obj = torch.as_tensor(T_cam_obj, dtype=torch.float64, device=self.intrinsics.device)
        lie.check_pose(T_cam_obj.detach())
        if T_cam_obj.shape != (len(self.centre_obj), 4, 4):
            raise PoseError(f"expected one initial pose per object, shape {[len(self.centre_obj), 4, 4]}, got {list(T_cam_obj.shape)}.")
        depth = lie.transform_points(T_cam_obj.detach(), self.centre_obj.double()[:, None])[:, 0, 2]
        for name, z in zip(self.object_names, depth.tolist(), strict=True):
            if z < MIN_DEPTH_M:
                raise PoseError(f"object '{name}' is behind the camera (depth {z:.3f} m): the z axis must point from the camera to the scene.")
        times = torch.as_tensor(t_us, dtype=torch.int64, device=T_cam_obj.device).expand(self.streams).clone()
        velocity = torch.zeros(len(T_cam_obj), 6, dtype=self.intrinsics.dtype, device=T_cam_obj.device)
        covariance = initial_covariance(self.diameter_m, self.config.motion)
        nothing = torch.zeros_like(self.diameter_m)
        last_event_us, burst_age_us = (empty(self.streams, *self.image_size, T_cam_obj.device) for empty in (empty_last_event, no_bursts))
        learning = self.config.learning
        learned = LearnedContours.none(len(velocity), learning, velocity) if learning.points and self.config.contours.source == "mesh" else None
        return TrackerState(T_cam_obj.clone(), velocity, covariance, nothing, nothing, times, last_event_us, burst_age_us, learned)

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
        """
        t_us = self._window_end(state, events, t_end_us)
        with torch.autocast(t_us.device.type, enabled=False):
            in_parts = self._to_be_parted(state, events, t_us)
            parted = readback.Answer.to(in_parts)
            if readback.read_at_once(in_parts) and bool(in_parts.all()):
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
        t_us, assumptions = self._window_end(state, events, t_end_us), readback.Assumptions()
        with torch.autocast(t_us.device.type, enabled=False):
            assumptions.ask(self._to_be_parted(state, events, t_us), False)
            done = _counted(self._advance(state, events, t_us, questions=assumptions))
        return *done, assumptions.wrong()

    def _to_be_parted(self, state: TrackerState, events: EventBatch, t_us: Tensor) -> Tensor:
        """Objects whose window is taken in parts: while a large part of their motion within it is not known.

        An object that has just been found may move by more than any gate in a window. Its velocity is learned in short
        steps first, where there are events enough for them. Each object is asked for itself: its neighbours do not matter.
        """
        window = self.config.window
        if window.parts == 1 or not self.config.solver.prior or len(events) < window.parts * _EVENTS_OF_A_PART:
            return torch.zeros_like(self.stream_index, dtype=torch.bool)
        unknown_m_s = unknown_speed(state.covariance, self.diameter_m).to(self.intrinsics.dtype)
        depth_m = lie.transform_points(state.T_cam_obj.to(unknown_m_s.dtype), self.centre_obj[:, None])[:, 0, 2].clamp(min=MIN_DEPTH_M)
        window_s = ((t_us - state.t_us) * 1e-6)[self.stream_index]
        unknown_px = unknown_m_s * window_s * self.intrinsics[:, 0] / depth_m
        unknown = unknown_px > window.max_unknown_px
        if self.streams == 1:
            return unknown
        count = torch.diff(stream_bounds(events, self.streams))[self.stream_index]
        return unknown & (count >= window.parts * _EVENTS_OF_A_PART)

    def _advance_in_parts(self, state: TrackerState, events: EventBatch, t_us: Tensor, starting: Tensor) -> tuple[TrackerState, StepResult]:
        """The window as several short ones, with a search for objects that are ``starting``."""
        for left in range(self.config.window.parts, 1, -1):
            until_us = state.t_us + (t_us - state.t_us) // left
            early = events.t_us <= until_us[events.stream_index]
            state, _ = self._advance(state, events[early], until_us, starting)
            events = events[~early]
        return self._advance(state, events, t_us, starting)

    def _advance(
        self,
        state: TrackerState,
        events: EventBatch,
        t_us: Tensor,
        starting: Tensor | None = None,
        questions: readback.Questions = _QUESTIONS,
    ) -> tuple[TrackerState, StepResult]:
        """One window, or one part of it."""
        config = self.config
        window_s = (t_us - state.t_us).to(self.intrinsics.dtype) * 1e-6
        dt_s = window_s[self.stream_index]
        last_event_us = update_last_event(state.last_event_us, events) if self._looks_back else state.last_event_us
        recorded = self._predict(self._held_back(state, events, t_us, dt_s), dt_s)
        prediction = recorded.detached()
        nearby, number = self._near_objects(events, prediction, dt_s)
        window = pad_streams(nearby, self.streams, t_us)
        burst_age_us, into_burst_us = update_bursts(state.burst_age_us, t_us - state.t_us, window, config.matching.burst_us)
        seen = self._seen(window, into_burst_us, number)
        contours = prediction.objects.contours(prediction.T_cam_obj, config.contours)
        sigma_px = prediction.sigma_px(contours) if config.solver.prior else torch.zeros_like(self.diameter_m)
        widening = gate_widening(sigma_px, config)
        radius_px = questions.ask(index_radius(widening, config), usual_index_radius(config))
        doubt = Doubt(
            sigma_px, state.share, state.usual_share, torch.zeros_like(self.stream_index, dtype=torch.bool) if starting is None else starting
        )
        in_doubt = questions.ask(may_be_wanted(doubt, config), False)
        corners = self._corners(contours, last_event_us, t_us, window_s)
        index = index_for(contours, self.image_size, config, widening, radius_px)
        observations = corner_observations(corners)
        if config.matching.max_events:
            near = select_events(seen, index, prediction.plane_velocity(seen.pixels), config.matching.max_events)
            observations = join(observations, near)
        if self.weigher is not None:
            evidence = Evidence(observations, seen, prediction, contours, index, self._event_history(last_event_us, t_us))
            observations = judged(evidence, self.weigher)
        found = judge_fit(prediction, align(recorded, contours, index, widening, observations, config), config)
        if in_doubt.any():
            found = search_wanted(recorded, doubt, seen, found, config)
        next_state, result = conclude(state, recorded, widening, found, corners, dt_s, config)
        if state.learned is not None and self._learns:
            trusted = (result.status <= int(quality.Status.UNCERTAIN)) & (sigma_px < config.learning.max_sigma_px)
            around = Surroundings(prediction.objects, next_state.T_cam_obj.to(sigma_px.dtype), next_state.velocity, dt_s, result.contours, trusted)
            next_state = replace(next_state, learned=learn_after(state.learned, around, found, seen, config))
        return replace(next_state, t_us=t_us, last_event_us=last_event_us, burst_age_us=burst_age_us), replace(result, t_us=t_us)

    def _window_end(self, state: TrackerState, events: EventBatch, t_end_us: int | Tensor | None) -> Tensor:
        """End of the window of each stream (µs)."""
        if t_end_us is None:
            return state.t_us.scatter_reduce(0, events.stream_index, events.t_us, "amax")
        if isinstance(t_end_us, int):
            return torch.full_like(state.t_us, t_end_us)
        return torch.as_tensor(t_end_us, dtype=torch.int64, device=state.t_us.device).expand(self.streams).clone()

    def _predict(self, state: TrackerState, dt_s: Tensor) -> Prediction:
        """Predicted pose and motion, and how certain they are."""
        velocity, covariance = state.velocity, state.covariance
        if self.config.motion.model == "hold":
            velocity, covariance = torch.zeros_like(velocity), with_dropped(covariance, velocity)
        moved = velocity * dt_s[:, None]
        T_prior = lie.move_about(state.T_cam_obj.to(velocity.dtype), lie.cayley(moved[:, :3]), moved[:, 3:], self.centre_obj)
        covariance = predict_covariance(covariance.detach(), velocity.detach(), dt_s, self.diameter_m, self.config.motion)
        T_prior, usable = self._before_camera(T_prior)
        return Prediction(self._objects_with(state.learned), T_prior, usable, torch.where(usable[:, None], velocity, 0), covariance)

    def _objects_with(self, learned: LearnedContours | None) -> ObjectBatch:
        """The objects, with the contours learned on them that count by now."""
        if learned is None or not self._learns:
            return self.objects
        counting = learned.that_count(self.config.learning)
        if readback.read_at_once(counting.mask) and not bool(counting.mask.any()):
            return self.objects
        return replace(self.objects, learned=counting)

    @torch.no_grad()
    def _held_back(self, state: TrackerState, events: EventBatch, t_us: Tensor, dt_s: Tensor) -> TrackerState:
        """The state, with the speed of objects that were never found yet limited by the events before them."""
        # Most windows are of objects that were found long ago: their events need not be counted, where that is known at once.
        found = state.usual_share > 0
        if not self.config.motion.speed_from_events or (readback.read_at_once(found) and bool(found.all())):
            return state
        T_cam_obj = state.T_cam_obj.detach().to(self.intrinsics.dtype)
        limit_m_s = largest_speed(self.objects, T_cam_obj, self._seen(pad_streams(events, self.streams, t_us)), dt_s)
        limit_m_s = torch.where(found, torch.inf, limit_m_s)
        depth_m = lie.transform_points(T_cam_obj, self.centre_obj[:, None])[:, 0, 2].clamp(min=MIN_DEPTH_M)
        return replace(state, covariance=limit_speed(state.covariance, limit_m_s, self.diameter_m, depth_m))

    def _before_camera(self, T_cam_obj: Tensor) -> tuple[Tensor, Tensor]:
        """The poses with a harmless one in the place of those that are not finite or not before the camera, and which are."""
        depth = lie.transform_points(T_cam_obj, self.centre_obj[:, None])[:, 0, 2]
        # A sum is finite only where every entry is.
        usable = (T_cam_obj.sum((1, 2)).abs() < torch.inf) & (depth > MIN_DEPTH_M) & (depth < _MAX_DEPTH_M)
        return torch.where(usable[:, None, None], T_cam_obj, self.far_pose), usable

    def _corners(self, contours: Contours, last_event_us: Tensor, t_us: Tensor, window_s: Tensor) -> Corners:
        """Corners of each object's region and their flow."""
        config = self.config
        if config.corners.max_corners == 0:
            return no_corners(contours.pixels)
        sensor = self._on_sensor(contours.pixels)
        margin_px, largest_px = config.surface.margin_px, config.surface.max_region_px
        regions = object_regions(sensor, contours.mask, self.stream_index, self.image_size, margin_px, largest_px)
        surface = time_surface(last_event_us, t_us, regions, config.surface.tau_s, self.intrinsics.dtype)
        corners = detect_corners(surface, regions, last_event_us, t_us, window_s, self.ideal_pixels, config.surface, config.corners)
        return estimate_flow(corners, last_event_us, t_us, self.stream_index, self.ideal_pixels, config.flow)

    def _on_sensor(self, pixels: Tensor) -> Tensor:
        """Where the lens puts ideal pixels."""
        height, width = self.sensor_pixels.shape[1:3]
        # Clamped before the conversion: a far-off pixel does not fit an integer.
        limit = constant((width - 1, height - 1), self.intrinsics.dtype, self.intrinsics.device)
        u, v = torch.minimum((pixels + _BORDER_PX).clamp(min=0), limit).round().long().unbind(-1)
        return at_pixels(self.sensor_pixels, self.stream_index[:, None], u, v)

    def _event_history(self, last_event_us: Tensor, t_us: Tensor) -> AgeAt:
        """How long ago anything happened at a pixel, for a weigher."""

        def age_s(pixels: Tensor) -> Tensor:
            limit = constant((self.image_size[1] - 1, self.image_size[0] - 1), pixels.dtype, pixels.device)
            u, v = torch.minimum(self._on_sensor(pixels).round().clamp(min=0), limit).long().unbind(-1)
            age_us = t_us[self.stream_index, None] - at_pixels(last_event_us, self.stream_index[:, None], u, v)
            return age_us.to(pixels.dtype) * 1e-6

        return age_s

    def _near_objects(self, events: EventBatch, prediction: Prediction, dt_s: Tensor) -> tuple[EventBatch, Tensor | None]:
        """The events that can have to do with any object, and their numbers, where others were left out.

        A weigher is shown all of them, and a GPU would have to be waited for.
        """
        if self.tiles is None or self.weigher is not None or not readback.read_at_once(dt_s):
            return events, None
        margin_px = max(self.config.matching.max_gate_px, *self.config.matching.gates_px) + _DRAWN_SIGMAS * self.config.search.least_sigma_px
        return self.tiles.keep(events, self.tiles.near(prediction, dt_s, margin_px))

    def _seen(self, window: PaddedEvents, into_burst_us: Tensor | None = None, number: Tensor | None = None) -> WindowEvents:
        """The window's events as each object's camera saw them."""
        stream = torch.arange(self.streams, device=window.x.device)[:, None]
        pixels = at_pixels(self.ideal_pixels, stream, window.x, window.y).transpose(1, 2).contiguous().transpose(1, 2)
        age_s = window.age_us.to(pixels.dtype) * 1e-6
        into_burst_s = torch.zeros_like(age_s) if into_burst_us is None else into_burst_us.to(pixels.dtype) * 1e-6
        values = (pixels, age_s, into_burst_s, 2 * window.polarity.to(pixels.dtype) - 1, window.mask)
        # Of one stream without a copy for every object.
        each = [value.expand(len(self.stream_index), *value.shape[1:]) if self.streams == 1 else value[self.stream_index] for value in values]
        return WindowEvents(each[0], each[1], each[2], each[3], each[4], number)


def _far_pose(centre_obj: Float[Tensor, "b 3"]) -> Float[Tensor, "b 4 4"]:
    """A pose of each object with its centre far before the camera."""
    poses = torch.eye(4, dtype=centre_obj.dtype).repeat(len(centre_obj), 1, 1)
    poses[:, :3, 3] = torch.tensor([0, 0, _MAX_DEPTH_M], dtype=centre_obj.dtype) - centre_obj
    return poses


def _counted(done: tuple[TrackerState, StepResult]) -> tuple[TrackerState, StepResult]:
    """A window more was taken, in parts or not."""
    state, result = done
    learned = None if state.learned is None else replace(state.learned, windows=state.learned.windows + 1)
    return replace(state, learned=learned), result


def _check_setup(objects: Sequence[ObjectModel], cameras: list[Camera], streams: list[int], config: TrackerConfig) -> None:
    """Raise ``ValueError`` unless objects, cameras and streams fit together, and ``ModelError`` for a model without contours."""
    if not objects:
        raise ValueError("a tracker needs at least one object.")
    if len(streams) != len(objects):
        raise ValueError(f"stream_index needs one entry per object: got {len(streams)} for {len(objects)} objects.")
    if not all(0 <= s < len(cameras) for s in streams):
        raise ValueError(f"stream_index must be within the {len(cameras)} cameras given (one per stream), got {streams}.")
    for model in objects:
        if config.contours.source == "splat" and len(model.surface_points) == 0:
            raise ModelError(
                f"'{model.name}' has no surface to take splatted contours from: give a mesh, or set contours.source to 'mesh', which takes polylines."
            )
