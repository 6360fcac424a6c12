"""The state of a tracker before its first window: poses, and nothing learned yet."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import lie
from torchtrack.core.camera import MIN_DEPTH_M, project
from torchtrack.core.dispatch import accelerable
from torchtrack.core.events import EventBatch, stream_bounds
from torchtrack.core.lie import transform_points
from torchtrack.core.pose_checks import check_pose
from torchtrack.errors import PoseError
from torchtrack.tracking.adaptation.appearance import Appearance
from torchtrack.tracking.adaptation.learned_contours import LearnedContours
from torchtrack.tracking.association.polarity import nothing_remembered
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.window_events import WindowEvents
from torchtrack.tracking.motion.model import MotionState, initial_covariance, rim_and_centre
from torchtrack.tracking.objects import TrackedObjects
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.validation.health import TrackHealth


def first_state(tracked: TrackedObjects, T_cam_obj: Float[Tensor, "b 4 4"], t_us: Int[Tensor, "s"]) -> TrackerState:
    """The state at ``t_us``, with the objects at these poses (float64) and at rest, as far as is known."""
    config = tracked.config
    at_rest = torch.zeros(len(T_cam_obj), 6, dtype=tracked.intrinsics.dtype, device=T_cam_obj.device)
    covariance = initial_covariance(tracked.diameter_m, config.motion)
    learns = config.adaptation.learned_points and config.contours.source == "mesh"
    learned = LearnedContours.none(len(at_rest), config.adaptation.learned_points, at_rest) if learns else None
    return TrackerState(
        t_us=t_us,
        motion=MotionState(T_cam_obj.clone(), velocity=at_rest, covariance=covariance),
        health=TrackHealth.unknown(T_cam_obj, at_rest.dtype),
        appearance=Appearance(nothing_remembered(at_rest), learned),
        maps=SensorMaps.empty(tracked.streams, tracked.image_size, T_cam_obj.device),
    )


# A shorter way need not show at all: a pixel fires only once an edge has passed far enough over it (px).
_LEAST_WAY_PX = 0.6


def unknown_speed(covariance: Float[Tensor, "b 12 12"], diameter_m: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """Standard deviation of the speed of an object's rim along one axis (m/s)."""
    turning, moving = covariance.diagonal(dim1=-2, dim2=-1)[:, 6:].unflatten(-1, (2, 3)).mean(-1).unbind(-1)
    return (moving + turning * (0.5 * diameter_m).square()).sqrt()


def limit_speed(
    covariance: Float[Tensor, "b 12 12"], limit_m_s: Float[Tensor, "b"], diameter_m: Float[Tensor, "b"], depth_m: Float[Tensor, "b"]
) -> Float[Tensor, "b 12 12"]:
    """Covariance where the speed of an object's rim across the image is known to be no larger than a limit (float64).

    A motion along the line of sight moves the rim in the image by so much less as the object is farther away than wide.
    Each direction is limited by itself: what is within the limit stays as it is, however often it is said.
    """
    # As much by turning as by moving.
    most = rim_and_centre(limit_m_s.double()[:, None] / 2**0.5, diameter_m.double()[:, None])
    most[:, 5] *= 2 * depth_m / diameter_m
    scale = torch.nn.functional.pad(most / covariance.diagonal(dim1=-2, dim2=-1)[:, 6:].sqrt(), (6, 0), value=1.0).clamp(max=1)
    return covariance * scale[:, :, None] * scale[:, None]


def largest_speed(objects: ObjectBatch, T_cam_obj: Float[Tensor, "b 4 4"], events: WindowEvents, window_s: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """Speed of an object's rim (m/s) for which a window's events before it would just do.

    An outline that moves fires in every pixel it passes, and it is at least twice as long as the object is wide.
    """
    centre_cam = transform_points(T_cam_obj, objects.centre_obj[:, None])
    diameter_px = objects.size_px(T_cam_obj)
    x, y = (events.pixels - project(centre_cam, objects.intrinsics)).unbind(-1)
    before_it = events.mask & (x * x + y * y < (0.5 * diameter_px[:, None]).square())
    way_px = (before_it.sum(-1) / (2 * diameter_px)).clamp(min=_LEAST_WAY_PX)
    return way_px / diameter_px * objects.diameter_m / window_s


@torch.no_grad()
def held_back(
    state: TrackerState, unfound: Bool[Tensor, "b"], objects: ObjectBatch, events: WindowEvents, window_s: Float[Tensor, "b"]
) -> TrackerState:
    """The state, with the speed of objects that are ``unfound`` yet limited by a window's events before them."""
    T_cam_obj = state.T_cam_obj.detach().to(objects.intrinsics.dtype)
    limit_m_s = torch.where(unfound, largest_speed(objects, T_cam_obj, events, window_s), torch.inf)
    covariance = limit_speed(state.motion.covariance, limit_m_s, objects.diameter_m, objects.depth_m(T_cam_obj))
    return replace(state, motion=replace(state.motion, covariance=covariance))


# While an object's motion is not known, a window is taken in so many parts, where more than this of the motion in it is not known (px); fewer events
# than this do not make a part. Taken whole, 12.6 instead of 9.7 % of the windows of 62 objects were lost (docs/results.md); the numbers were not
# measured alone.
PARTS, MAX_UNKNOWN_PX, _EVENTS_OF_A_PART = 4, 2.0, 400


def to_be_parted(state: TrackerState, events: EventBatch, t_us: Int[Tensor, "s"], objects: ObjectBatch, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Objects whose window is taken in parts: of unknown motion, and with events enough for each part.

    Each object is asked for itself: its neighbours do not matter.

    Args:
        state: before the window.
        events: of the window.
        t_us: its end.
    """
    streams, fewest = objects.image_shape[0], PARTS * _EVENTS_OF_A_PART
    if len(events) < fewest:
        return torch.zeros_like(objects.stream_index, dtype=torch.bool)
    unknown = of_unknown_motion(state, t_us, objects, config)
    if streams == 1:
        return unknown
    return unknown & (torch.diff(stream_bounds(events, streams))[objects.stream_index] >= fewest)


def of_unknown_motion(state: TrackerState, t_us: Int[Tensor, "s"], objects: ObjectBatch, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Objects of which a large part of their motion within a window is not known; none, where no window is to be taken in parts.

    Args:
        state: before the window.
        t_us: its end.
    """
    if not (config.uses(Component.WINDOW_PARTS) and config.solver.prior):
        return torch.zeros_like(objects.stream_index, dtype=torch.bool)
    return moves_unknown(state, t_us, objects, config)


@accelerable
def moves_unknown(state: TrackerState, t_us: Int[Tensor, "s"], objects: ObjectBatch, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """:func:`of_unknown_motion` where windows are taken in parts."""
    window_s = ((t_us - state.t_us) * 1e-6)[objects.stream_index]
    unknown_m_s = unknown_speed(state.motion.covariance, objects.diameter_m).to(objects.intrinsics.dtype)
    px_per_m = objects.px_per_m(state.T_cam_obj.to(unknown_m_s.dtype))
    sigma_m = state.motion.covariance.diagonal(dim1=1, dim2=2)[:, 3:5].mean(1).sqrt().to(px_per_m.dtype)
    # What is not known to be anywhere is looked for by all events of a window, and with the motion that leads to each place.
    return (unknown_m_s * window_s * px_per_m > MAX_UNKNOWN_PX) & (px_per_m * sigma_m <= config.relocalization.wide_sigma_px)


def check_poses(T_cam_obj: Tensor, centre_obj: Float[Tensor, "b 3"], names: Sequence[str]) -> None:
    """Raise ``PoseError`` unless there is a rigid motion for every object that puts it before the camera.

    Args:
        T_cam_obj: initial poses, or what was given for them.
        centre_obj: centre of each object (m).
        names: of the objects.
    """
    T_cam_obj = T_cam_obj.detach()
    check_pose(T_cam_obj)
    if T_cam_obj.shape != (len(centre_obj), 4, 4):
        raise PoseError(f"expected one initial pose per object, shape {[len(centre_obj), 4, 4]}, got {list(T_cam_obj.shape)}.")
    depth = lie.transform_points(T_cam_obj, centre_obj.to(T_cam_obj.dtype)[:, None])[:, 0, 2]
    for name, z in zip(names, depth.tolist(), strict=True):
        if z < MIN_DEPTH_M:
            raise PoseError(f"object '{name}' is behind the camera (depth {z:.3f} m): the z axis must point from the camera to the scene.")
