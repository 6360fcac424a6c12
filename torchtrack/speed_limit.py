"""How fast an object can be that has not been found yet: few events before it, and it cannot have moved far."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.core.camera import project
from torchtrack.core.lie import transform_points
from torchtrack.state import TrackerState
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.frontend.window_events import WindowEvents

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
    """
    scale = limit_m_s.double() / unknown_speed(covariance, diameter_m)
    along = scale * 2 * depth_m / diameter_m
    both = torch.stack([torch.ones_like(scale)] * 6 + [scale] * 5 + [along], -1).clamp(max=1)
    return covariance * both[:, :, None] * both[:, None]


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
    return replace(state, covariance=limit_speed(state.covariance, limit_m_s, objects.diameter_m, objects.depth_m(T_cam_obj)))
