"""The tracker: events in, poses out (Algorithm 1 of the paper, for many objects and streams at once).

The only state is an immutable :class:`TrackerState`; ``step`` is pure: the same state and events give the same result.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchtrack import lie, quality
from torchtrack.alignment import Alignment, AlignmentResult, align, gate_scale, index_for
from torchtrack.camera import MIN_DEPTH_M, Camera, distortion_table, stack_tables, undistortion_table
from torchtrack.config.tracker import TrackerConfig
from torchtrack.contour_index import ContourIndex
from torchtrack.contours import ContourModel, Contours, group_by_model, mesh_contours, reproject
from torchtrack.corners import Corners, detect_corners, no_corners
from torchtrack.motion import initial_covariance, predict_covariance
from torchtrack.errors import ModelError, PoseError
from torchtrack.events import EventBatch, pad_streams
from torchtrack.flow import estimate_flow
from torchtrack.object_model import ObjectModel
from torchtrack.observations import Observations, corner_observations, join, select_events
from torchtrack.pose_solver import Linearisation
from torchtrack.search import search
from torchtrack.splat import splat_contours
from torchtrack.time_surface import at_pixels, empty_last_event, object_regions, time_surface, update_last_event
from torchtrack.visibility import Scene, remove_hidden

# Contours this far outside the image still find their place on a distorted sensor (px).
_BORDER_PX = 64
# Nothing that is tracked is farther away (m).
_MAX_DEPTH_M = 1e4


@dataclass(frozen=True)
class TrackerState:
    """Everything the tracker remembers between windows.

    Args:
        T_cam_obj: pose of each object at its stream's ``t_us`` (float64).
        velocity: rotation of each object and velocity of its centre, in the camera's axes (rad/s, m/s).
        t_us: end of the last window of each stream (µs).
        last_event_us: time of the newest event of every sensor pixel (µs).
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    velocity: Float[Tensor, "b 6"]
    covariance: Float[Tensor, "b 12 12"]
    usual_share: Float[Tensor, "b"]
    t_us: Int[Tensor, "s"]
    last_event_us: Int[Tensor, "s h w"]


@dataclass(frozen=True)
class StepResult:
    """What one window gave.

    Args:
        t_us: end of the window of each stream (µs).
        T_cam_obj: pose of each object at that time (float64).
        status: :class:`torchtrack.quality.Status` of each object.
        quality: share of the moving contour that events explain.
        contours: visible contours at the pose.
        corners: corners and their flow.
        observation_count: matched observations of each object.
        solution: the solver's last linearisation.
        centre_obj: centre of each object, about which the solver turns it (m).
    """

    t_us: Int[Tensor, "s"]
    T_cam_obj: Float[Tensor, "b 4 4"]
    status: Int[Tensor, "b"]
    quality: Float[Tensor, "b"]
    contours: Contours
    corners: Corners
    observation_count: Int[Tensor, "b"]
    solution: Linearisation
    centre_obj: Float[Tensor, "b 3"]

    @property
    def covariance(self) -> Float[Tensor, "b 6 6"]:
        """Covariance of the left perturbation ``[φ, ρ]`` of each pose (rad, m); infinite where unknown."""
        centre_cam = lie.transform_points(self.T_cam_obj.to(self.centre_obj.dtype), self.centre_obj[:, None])[:, 0]
        return quality.pose_covariance(self.solution, self.observation_count, centre_cam)


class Tracker(nn.Module):
    """Tracks known rigid objects in one or more event streams.

    Args:
        objects: models of the objects; the same model object may appear many times.
        camera: one camera, or one per stream.
        config: settings; the ``default`` preset when not given.
        stream_index: the stream each object is seen in; the first for all when not given.
        dtype: precision of the pipeline; poses are kept in float64.
    """

    intrinsics: Tensor
    ideal_pixels: Tensor
    sensor_pixels: Tensor
    stream_index: Tensor
    centre_obj: Tensor
    diameter_m: Tensor

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        camera: Camera | Sequence[Camera],
        config: TrackerConfig | None = None,
        stream_index: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float32,
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
        self.register_buffer("centre_obj", torch.stack([model.centre for model in objects]))
        self.register_buffer("diameter_m", torch.tensor([model.diameter_m for model in objects]))
        self.to(dtype)

    @property
    def models(self) -> list[ContourModel]:
        """The distinct models, with the objects that have each."""
        return [group for group in self.groups if isinstance(group, ContourModel)]

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
        lie.check_pose(T_cam_obj)
        if T_cam_obj.shape != (len(self.centre_obj), 4, 4):
            raise PoseError(f"expected one initial pose per object, shape {[len(self.centre_obj), 4, 4]}, got {list(T_cam_obj.shape)}.")
        depth = lie.transform_points(T_cam_obj, self.centre_obj.double()[:, None])[:, 0, 2]
        for name, z in zip(self.object_names, depth.tolist(), strict=True):
            if z < MIN_DEPTH_M:
                raise PoseError(f"object '{name}' is behind the camera (depth {z:.3f} m): the z axis must point from the camera to the scene.")
        times = torch.as_tensor(t_us, dtype=torch.int64, device=T_cam_obj.device).expand(self.streams).clone()
        velocity = torch.zeros(len(T_cam_obj), 6, dtype=self.intrinsics.dtype, device=T_cam_obj.device)
        return TrackerState(T_cam_obj.clone(), velocity, initial_covariance(self.diameter_m, self.config.motion), torch.zeros_like(velocity[:, 0]), times, empty_last_event(self.streams, *self.image_size, device=T_cam_obj.device))

    def forward(self, state: TrackerState, events: EventBatch, t_end_us: int | Int[Tensor, "s"] | None = None) -> tuple[TrackerState, StepResult]:
        """The same as :meth:`step`."""
        return self.step(state, events, t_end_us)

    def step(self, state: TrackerState, events: EventBatch, t_end_us: int | Int[Tensor, "s"] | None = None) -> tuple[TrackerState, StepResult]:
        """Advance every object by one window of events.

        Args:
            state: from :meth:`init` or the last step.
            events: of all streams, after ``state.t_us`` and up to ``t_end_us``.
            t_end_us: end of the window; the newest event of each stream when not given.
        """
        t_us = self._window_end(state, events, t_end_us)
        window_s = (t_us - state.t_us).to(self.intrinsics.dtype) * 1e-6
        last_event_us = update_last_event(state.last_event_us, events)
        start = self._predict(state, window_s)
        contours = self._extract(start.T_prior)
        corners = self._corners(contours, last_event_us, t_us, window_s)
        scale = gate_scale(start, contours, self.config)
        index = index_for(contours, self.image_size, self.config, float(scale.max()))
        observations = self._observe(start, index, events, corners, t_us)
        aligned = align(start, contours, index, scale, observations, self._extract, self.config)
        aligned, share, count = self._search(state, start, aligned, events, t_us, scale)
        return self._conclude(scale, share, count, state, start, aligned, corners, last_event_us, t_us, window_s)

    def _window_end(self, state: TrackerState, events: EventBatch, t_end_us: int | Tensor | None) -> Tensor:
        """End of the window of each stream (µs)."""
        if t_end_us is None:
            return state.t_us.scatter_reduce(0, events.stream_index, events.t_us, "amax")
        return torch.as_tensor(t_end_us, dtype=torch.int64, device=state.t_us.device).expand(self.streams).clone()

    def _predict(self, state: TrackerState, window_s: Tensor) -> Alignment:
        """Predicted pose, and how strongly it holds."""
        velocity = state.velocity
        if self.config.motion.model == "hold":
            velocity = torch.zeros_like(velocity)
        T_start = state.T_cam_obj.to(velocity.dtype)
        T_prior = lie.retract_about(T_start, velocity * window_s[self.stream_index, None], self.centre_obj)
        solver = self.config.solver
        covariance = predict_covariance(state.covariance, velocity, window_s[self.stream_index], self.diameter_m, self.config.motion)
        information = torch.zeros(len(covariance), 13, 13, dtype=torch.float64)
        information[:, :12, :12] = torch.linalg.inv(covariance)
        information[:, 12, 12] = solver.swelling_px ** -2
        information = (solver.observation_px**2 * information).to(velocity.dtype)
        T_prior, usable = self._before_camera(T_prior)
        return Alignment(T_prior, usable, information, covariance[:, :6, :6].to(velocity.dtype), torch.where(usable[:, None], velocity, 0), self.centre_obj, self.intrinsics, self.image_size)

    def _before_camera(self, T_cam_obj: Tensor) -> tuple[Tensor, Tensor]:
        """The poses with a harmless one in the place of those that are not finite or not before the camera, and which are."""
        depth = lie.transform_points(T_cam_obj, self.centre_obj[:, None])[:, 0, 2]
        usable = torch.isfinite(T_cam_obj).flatten(1).all(-1) & (depth > MIN_DEPTH_M) & (depth < _MAX_DEPTH_M)
        harmless = torch.eye(4, dtype=T_cam_obj.dtype, device=T_cam_obj.device).repeat(len(T_cam_obj), 1, 1)
        harmless[:, :3, 3] = -self.centre_obj
        harmless[:, 2, 3] += _MAX_DEPTH_M
        return torch.where(usable[:, None, None], T_cam_obj, harmless), usable

    def _extract(self, T_cam_obj: Tensor) -> Contours:
        """Visible contours at a pose."""
        config = self.config.contours
        if config.source == "splat":
            return splat_contours(self.models, T_cam_obj, self.intrinsics, config)
        contours = mesh_contours(self.models, T_cam_obj, self.intrinsics, config)
        if not config.remove_hidden:
            return contours
        shape = (self.streams, *self.image_size)
        scene = Scene(self.models, T_cam_obj, self.intrinsics, self.stream_index, self.diameter_m, shape, self._shared)
        return remove_hidden(contours, scene, config)

    def _corners(self, contours: Contours, last_event_us: Tensor, t_us: Tensor, window_s: Tensor) -> Corners:
        """Corners of each object's region and their flow."""
        config = self.config
        if config.corners.max_corners == 0:
            return no_corners(contours.pixels)
        height, width = self.sensor_pixels.shape[1:3]
        # Clamped before the conversion: a far-off pixel does not fit an integer.
        limit = self.intrinsics.new_tensor([width - 1, height - 1])
        u, v = torch.minimum((contours.pixels + _BORDER_PX).clamp(min=0), limit).round().long().unbind(-1)
        sensor = at_pixels(self.sensor_pixels, self.stream_index[:, None], u, v)
        regions = object_regions(sensor, contours.mask, self.stream_index, self.image_size, config.surface.margin_px)
        surface = time_surface(last_event_us, t_us, regions, config.surface.tau_s, self.intrinsics.dtype)
        corners = detect_corners(surface, regions, last_event_us, t_us, window_s, self.ideal_pixels, config.surface, config.corners)
        return estimate_flow(corners, last_event_us, t_us, self.stream_index, self.ideal_pixels, config.flow)

    def _observe(self, start: Alignment, index: ContourIndex, events: EventBatch, corners: Corners, t_us: Tensor) -> Observations:
        """Corners and recent events near each object's contours."""
        seen, count = corner_observations(corners), self.config.matching.max_events
        if count == 0:
            return seen
        window = pad_streams(events, self.streams, t_us)
        stream = torch.arange(self.streams, device=t_us.device)[:, None]
        pixels = at_pixels(self.ideal_pixels, stream, window.x, window.y)[self.stream_index]
        age_s = window.age_us[self.stream_index].to(pixels.dtype) * 1e-6
        polarity = 2.0 * window.polarity[self.stream_index].to(pixels.dtype) - 1.0
        mask = window.mask[self.stream_index]
        return join(seen, select_events(pixels, age_s, polarity, mask, index, start.plane_velocity(pixels), count))

    def _search(self, state, start, aligned, events, t_us, scale):
        velocity = start.contour_velocity(aligned.contours)
        share = quality.explained_share(aligned.contours, aligned.matches, velocity, self.image_size, self.config.quality.min_speed_px_s)
        count = aligned.matches.mask.sum(-1)
        wanted = (share < self.config.search.dropped_to * state.usual_share) | (scale >= self.config.search.from_sigma_px * self.config.matching.gate_sigmas / self.config.matching.gates_px[0]) | (share < self.config.search.below_share) & (scale>1)
        for k in wanted.nonzero()[:, 0].tolist() if self.config.search.hypotheses else []:
            window = pad_streams(events, self.streams, t_us)
            stream = torch.arange(self.streams, device=t_us.device)[:, None]
            pixels = at_pixels(self.ideal_pixels, stream, window.x, window.y)[self.stream_index]
            age_s = window.age_us[self.stream_index].to(pixels.dtype) * 1e-6
            polarity = 2.0 * window.polarity[self.stream_index].to(pixels.dtype) - 1.0
            covariance = torch.linalg.inv(start.prior_information[k].double())[:12, :12] * self.config.solver.observation_px**2
            covariance = covariance * (self.config.search.least_sigma_px / (float(scale[k]) * self.config.matching.gates_px[0] / self.config.matching.gate_sigmas)) ** 2 if scale[k] * self.config.matching.gates_px[0] / self.config.matching.gate_sigmas < self.config.search.least_sigma_px else covariance
            shares, numbers, many = search(self, start, k, covariance, pixels, age_s, polarity, window.mask[self.stream_index], self.config.search.hypotheses, aligned.contours)
            best = int(shares.argmax())
            mine = float(share[k]) if count[k] >= self.config.quality.min_observations else 0.0
            if float(shares[best]) > mine + 0.1:
                put = lambda a, b: torch.cat([a[:k], b[best : best + 1], a[k + 1 :]])
                s, m = aligned.solution, many.solution
                solution = Linearisation(*(put(getattr(s, f), getattr(m, f)) for f in vars(s)))
                pad = lambda t, n: torch.cat([t, t.new_zeros(t.shape[0], n - t.shape[1], *t.shape[2:])], 1)
                contours = Contours(*(put(getattr(aligned.contours, f), pad(getattr(many.contours, f), aligned.contours.mask.shape[1])) for f in vars(aligned.contours)))
                aligned = AlignmentResult(solution, contours, aligned.matches)
                share, count = put(share, shares), put(count, numbers)
        return aligned, share, count

    def _conclude(
        self, scale, share, count, state: TrackerState, start: Alignment, aligned: AlignmentResult, corners: Corners, last_event_us: Tensor, t_us: Tensor, window_s: Tensor
    ) -> tuple[TrackerState, StepResult]:
        """Judge every object, hold those that failed, and make the next state."""
        config, solution, contours = self.config, aligned.solution, aligned.contours
        velocity = start.velocity
        T_found = lie.orthonormalise(solution.T_cam_obj.double())
        step = lie.small_difference_about(start.T_prior.double(), T_found, self.centre_obj.double()).to(velocity.dtype)
        status = quality.judge(share, count, quality.visible_share(contours, self.image_size), step, self.diameter_m, config.quality)
        status = torch.where(start.usable, status, int(quality.Status.DIVERGED))
        q = config.quality
        needed = q.lost_below + (q.caught_above - q.lost_below) * (scale - 1).clamp(0, 1)
        status = torch.where((share < needed) & (status < 2), int(quality.Status.LOST), status)
        failed = (status >= int(quality.Status.LOST))[:, None]
        T_held = state.T_cam_obj
        if config.motion.without_events == "predict":
            T_held = torch.where(start.usable[:, None, None], lie.orthonormalise(start.T_prior.double()), T_held)
        T_cam_obj = torch.where(failed[..., None], T_held, T_found)
        usual = torch.where(failed[:, 0], state.usual_share, state.usual_share + 0.1 * (share - state.usual_share))
        next_velocity, covariance = self._next_velocity(state, start, solution, failed, share, needed, window_s)
        contours = reproject(contours, T_cam_obj.to(velocity.dtype), self.intrinsics)
        result = StepResult(t_us, T_cam_obj, status, share, contours, corners, count, solution, self.centre_obj)
        return TrackerState(T_cam_obj, next_velocity, covariance, usual, t_us, last_event_us), result

    def _next_velocity(self, state: TrackerState, start: Alignment, solution: Linearisation, failed: Tensor, share: Tensor, needed: Tensor, window_s: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity after a window: a running mean of what the poses moved, as far as events explain it."""
        duration_s = window_s[self.stream_index, None].clamp(min=1e-6)
        px = self.config.solver.observation_px
        predicted = torch.linalg.inv(start.prior_information.double()) * px**2
        posterior = torch.linalg.inv(solution.hessian.double())[:, :12, :12] * px**2
        predicted = predicted[:, :12, :12]
        trust = torch.where(failed, 0, ((share - self.config.quality.lost_below)[:, None] / 0.2).clamp(0, 1))
        found = state.velocity + trust * solution.from_prior[:, 6:12]
        fading = torch.exp(-duration_s / self.config.motion.coast_s)
        mixed = predicted + trust[..., None] * (posterior - predicted)
        return torch.where(failed, state.velocity * fading, found), mixed


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
