"""What the methods on events and straight lines share: which events are near which projected line, and how a window ends.

A projected line is the straight contour points of a model (:mod:`torchtrack.baselines.straight_edges`) with their
normals: the distance of an event from the line is that from its nearest point, along the normal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.baselines.straight_edges import straight_edges_only, too_curved
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import lie
from torchtrack.core.camera import MIN_DEPTH_M, Camera
from torchtrack.core.events import EventBatch, pad_streams
from torchtrack.core.image_velocity import object_plane_velocity, pixel_velocity
from torchtrack.core.padded import select_ranked, take_points
from torchtrack.core.pose_covariance import left_covariance
from torchtrack.errors import ModelError
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.association.matches import Matches
from torchtrack.tracking.contours.index import INDEX_CELL_PX, index_contours
from torchtrack.tracking.contours.points import Contours, reproject
from torchtrack.tracking.estimation.levenberg_marquardt import solve_pose
from torchtrack.tracking.estimation.terms import CostTerm, Linearisation, PoseProblem
from torchtrack.tracking.frontend.corners import no_corners
from torchtrack.tracking.frontend.time_surface import update_last_event
from torchtrack.tracking.state import StepResult, TrackerState
from torchtrack.tracking.tracker import Tracker
from torchtrack.tracking.validation.measures import explained_ratio, visible_ratio
from torchtrack.tracking.validation.status import Status
from torchtrack.tracking.validation.verdict import Limits, Measured, judge

# Contour points lie so far apart at most that an event on a line is within this of one of its points (px).
_POINT_SPACING_PX = 6.0
# A contour point farther than this beside a line is on another one (px).
_OFF_LINE_PX = 1.5


@dataclass(frozen=True)
class LineEvents:
    """Events near each object's lines, padded.

    Args:
        pixels: ideal pixels.
        age_s: time from the event to the window's end (s).
        mask: which entries exist.
    """

    pixels: Float[Tensor, "b n 2"]
    age_s: Float[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]


@dataclass(frozen=True)
class Window:
    """Where a window begins.

    Args:
        t_us: end of the window of each stream (µs).
        duration_s: its length for each object (s).
        last_event_us: newest event time of every pixel (µs).
        T_start: predicted pose of each object.
        velocity: predicted rotation and velocity of the centre (rad/s, m/s), zero where it led nowhere.
    """

    t_us: Int[Tensor, "s"]
    duration_s: Float[Tensor, "b"]
    last_event_us: Int[Tensor, "s h w"]
    T_start: Float[Tensor, "b 4 4"]
    velocity: Float[Tensor, "b 6"]


@dataclass(frozen=True)
class LineFit:
    """The poses after the last round.

    Args:
        solution: the solver's last linearisation.
        contours: at the poses.
        matches: of the last round.
    """

    solution: Linearisation
    contours: Contours
    matches: Matches


@dataclass(frozen=True)
class Judged:
    """What each object's pose is worth.

    Args:
        status: as :class:`torchtrack.tracking.validation.status.Status`.
        quality: share of the moving contour that events explain.
        is_taken: poses that are taken; the others go on as predicted.
    """

    status: Int[Tensor, "b"]
    quality: Float[Tensor, "b"]
    is_taken: Bool[Tensor, "b"]


def nearest_lines(
    pixels: Float[Tensor, "b n 2"], contours: Contours, gate_px: float, apart_px: float = 0.0
) -> tuple[Int[Tensor, "b n"], Bool[Tensor, "b n"]]:
    """The nearest visible contour point of each event, and whether the event belongs to its line.

    It does where it lies within ``gate_px`` of the line, and no other line is within ``apart_px`` of it: an event
    between two lines may be of either.
    """
    distance = torch.cdist(pixels, contours.pixels).masked_fill(~contours.mask[:, None], torch.inf)
    nearest_px, point = distance.min(-1)
    normals = take_points(contours.normals, point)
    offset = ((take_points(contours.pixels, point) - pixels) * normals).sum(-1)
    belongs = (offset.abs() < gate_px) & (nearest_px < gate_px + _POINT_SPACING_PX)
    if apart_px > 0:
        place = ((pixels * normals).sum(-1) + offset)[..., None]
        across = torch.baddbmm(-place, normals, contours.pixels.transpose(1, 2)).abs()
        other = torch.where(across > _OFF_LINE_PX, distance, torch.inf).amin(-1)
        belongs = belongs & (other > apart_px)
    return point, belongs


class EventLineTracker(Tracker):
    """Base of the methods that align events with straight model lines; a subclass says how in ``step``.

    Raises:
        ModelError: if a model is curved.
    """

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        camera: Camera | Sequence[Camera],
        config: TrackerConfig | None = None,
        stream_index: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float32,
        *,
        kernels: bool = True,
    ) -> None:
        distinct = {id(model): model for model in objects}
        for model in distinct.values():
            if reason := too_curved(model):
                raise ModelError(f"{reason}. A method that tracks straight lines alone cannot follow it: use the preset default, guided or nns.")
        # Objects with one model go on having one: they are handled together.
        straight = {key: straight_edges_only(model) for key, model in distinct.items()}
        super().__init__([straight[id(model)] for model in objects], camera, config, stream_index, dtype, kernels=kernels)

    def prepare(self, state: TrackerState) -> None:
        """Nothing is to be compiled."""

    def _open(self, state: TrackerState, events: EventBatch, t_us: Int[Tensor, "s"], velocity: Float[Tensor, "b 6"]) -> Window:
        """The window's times, and each object carried on with ``velocity``."""
        duration_s = ((t_us - state.t_us).to(velocity.dtype) * 1e-6)[self.stream_index]
        T_last = state.T_cam_obj.to(velocity.dtype)
        T_start = lie.retract_about(T_last, velocity * duration_s[:, None], self.centre_obj)
        usable = torch.isfinite(T_start).flatten(1).all(-1) & (self._centre_cam(T_start)[:, 2] > MIN_DEPTH_M)
        T_start = torch.where(usable[:, None, None], T_start, T_last)
        return Window(t_us, duration_s, update_last_event(state.maps.last_event_us, events), T_start, torch.where(usable[:, None], velocity, 0))

    def _centre_cam(self, T_cam_obj: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 3"]:
        """Centre of each object in the camera's frame (m)."""
        return lie.transform_points(T_cam_obj, self.centre_obj[:, None])[:, 0]

    def _contour_velocity(self, window: Window, contours: Contours) -> Float[Tensor, "b m 2"]:
        """Image velocity of contour points as predicted (px/s)."""
        return pixel_velocity(contours.points_cam, window.velocity, self._centre_cam(window.T_start), self.intrinsics)

    def _events_near(self, window: Window, events: EventBatch, contours: Contours) -> LineEvents:
        """Events that lie near each object's lines once moved to the window's end, spread evenly in time."""
        seen = self.sensors.seen(pad_streams(events, self.streams, window.t_us))
        pixels, age_s = seen.pixels, seen.age_s
        velocity = object_plane_velocity(pixels, window.velocity, self._centre_cam(window.T_start), self.intrinsics)
        matching = self.config.association
        index = index_contours(contours, self.image_size, int(max(matching.gates_px)) + 1, INDEX_CELL_PX)
        near = seen.mask & (index.look_up(torch.addcmul(pixels, velocity, age_s[..., None])) >= 0)
        chosen, exists = select_ranked(near, matching.max_events)
        taken = take_points(torch.cat([pixels, age_s[..., None]], -1), chosen)
        return LineEvents(taken[..., :2], taken[..., 2], exists)

    def _solve_rounds(
        self,
        window: Window,
        events: EventBatch,
        information: Float[Tensor, "b 6 6"],
        weight: float,
        apart_px: float,
        extra_terms: tuple[CostTerm, ...] = (),
    ) -> LineFit:
        """Associate and solve, one round per gate, with the lines extracted anew for the second.

        Args:
            information: of the prediction, in the solver's chart.
            weight: information of one event's distance (1/px²).
            apart_px: events with two lines as near as this are left out.
            extra_terms: of the cost, beside distances and prediction.
        """
        T_cam_obj, contours = window.T_start, self.objects.contours(window.T_start, self.config.contours)
        near = self._events_near(window, events, contours)
        plane = object_plane_velocity(near.pixels, window.velocity, self._centre_cam(window.T_start), self.intrinsics)
        targets = torch.addcmul(near.pixels, plane, near.age_s[..., None])
        for number, gate_px in enumerate(self.config.association.gates_px):
            if number == 1:
                contours = self.objects.contours(T_cam_obj, self.config.contours)
            point, belongs = nearest_lines(targets, contours, gate_px, apart_px)
            motion = take_points(self._contour_velocity(window, contours), point)
            targets = torch.addcmul(near.pixels, motion, near.age_s[..., None])
            matched = near.mask & belongs
            matched = matched & (matched.sum(-1, keepdim=True) >= self.config.validation.min_observations)
            matches = Matches(
                contour=point,
                mask=matched,
                weights=matched * weight,
                age_s=near.age_s,
                points_obj=take_points(contours.points_obj, point),
                targets=targets,
                directions=take_points(contours.normals, point),
                offsets=((take_points(contours.pixels, point) - targets) * take_points(contours.normals, point)).sum(-1),
                near=near.mask & belongs,
                as_expected=torch.ones_like(near.age_s),
            )
            solution = solve_pose(self._problem(window, matches, information, gate_px, extra_terms), T_cam_obj, self.config.solver)
            T_cam_obj = solution.T_cam_obj
            contours = reproject(contours, T_cam_obj, self.intrinsics)
        return LineFit(solution, contours, matches)

    def _problem(self, window: Window, matches: Matches, information: Tensor, gate_px: float, extra_terms: tuple[CostTerm, ...]) -> PoseProblem:
        """Distances of events from their lines, and the prediction; objects without a match stay where they are."""
        idle = ~matches.mask.any(-1)
        return PoseProblem(
            points_obj=matches.points_obj,
            targets=matches.targets,
            directions=matches.directions,
            weights=matches.weights,
            intrinsics=self.intrinsics,
            centre_obj=self.centre_obj,
            scale_px=torch.full_like(self.centre_obj[:, 0], gate_px),
            T_prior=window.T_start,
            prior_information=torch.where(idle[:, None, None], torch.zeros_like(information), information),
            extra_terms=extra_terms,
        )

    def _judge(self, window: Window, fit: LineFit) -> Judged:
        """What each object's pose is worth."""
        contours, matches = fit.contours, fit.matches
        share = explained_ratio(contours, matches, self._contour_velocity(window, contours), self.image_sizes, self.config)
        step = lie.small_difference_about(window.T_start, fit.solution.T_cam_obj, self.centre_obj)
        in_view = visible_ratio(contours, self.image_sizes)
        rotated_rad, moved_m = step.unflatten(1, (2, 3)).norm(dim=-1).unbind(1)
        scale, yes, no = torch.ones_like(share), torch.ones_like(share, dtype=torch.bool), torch.zeros_like(share, dtype=torch.bool)
        measured = Measured(
            *(share, share, scale, scale, torch.full_like(share, torch.nan)),
            *(in_view, scale, rotated_rad, moved_m / self.diameter_m, matches.mask.sum(-1), matches.near.sum(-1)),
            is_moving=yes,
            is_usable=yes,
            is_relocalized=no,
        )
        status = judge(measured, torch.zeros_like(share), Limits.from_config(self.config))
        return Judged(status, share, status < int(Status.TOO_FEW_EVENTS))

    def _close(
        self,
        state: TrackerState,
        window: Window,
        fit: LineFit,
        judged: Judged,
        velocity: Float[Tensor, "b 6"],
        covariance: Float[Tensor, "b 6 6"],
    ) -> tuple[TrackerState, StepResult]:
        """The next state, and what the window gave; a pose that is not taken is the predicted one.

        Args:
            covariance: of each pose, turned about its centre (float64).
        """
        T_cam_obj = lie.orthonormalise(torch.where(judged.is_taken[:, None, None], fit.solution.T_cam_obj, window.T_start).double())
        contours = reproject(fit.contours, T_cam_obj.to(velocity.dtype), self.intrinsics)
        centre_cam = lie.transform_points(T_cam_obj, self.centre_obj[:, None].double())[:, 0]
        result = StepResult(
            t_us=window.t_us,
            T_cam_obj=T_cam_obj,
            covariance=left_covariance(covariance, centre_cam),
            status=judged.status,
            quality=judged.quality,
            contours=contours,
            corners=no_corners(contours.pixels),
            observation_count=fit.matches.mask.sum(-1),
        )
        motion = replace(state.motion, T_cam_obj=T_cam_obj, velocity=velocity)
        return replace(state, t_us=window.t_us, motion=motion, maps=replace(state.maps, last_event_us=window.last_event_us)), result
