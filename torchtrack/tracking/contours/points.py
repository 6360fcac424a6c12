"""Contour points of each object at a pose, with image positions and normals.

:mod:`torchtrack.tracking.contours.sampling` chooses them on a model; here they are put together, and seen from elsewhere.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core.camera import MIN_DEPTH_M, project
from torchtrack.core.dispatch import accelerable
from torchtrack.core.field_values import field_values
from torchtrack.core.lie import affine, transform_points

# Tangents that the image shows shorter than this (px/m) have no direction in it.
MIN_PX_PER_M = 1e-3


@dataclass(frozen=True)
class Contours:
    """Contour points of each object at a pose, padded.

    Args:
        points_obj: the points in the object's frame (m).
        tangents_obj: unit directions of the contour there, in the object's frame.
        kind: :class:`ContourKind` of each point.
        mask: which entries are visible contour points.
        points_cam: the points in the camera's frame (m).
        pixels: ideal pixels.
        normals: unit normals of the projected contour.
        resolved: how far an event there tells which side is the darker one, 0 to 1: less where an edge of the opposite contrast is close.
    """

    points_obj: Float[Tensor, "b m 3"]
    tangents_obj: Float[Tensor, "b m 3"]
    kind: Int[Tensor, "b m"]
    mask: Bool[Tensor, "b m"]
    points_cam: Float[Tensor, "b m 3"]
    pixels: Float[Tensor, "b m 2"]
    normals: Float[Tensor, "b m 2"]
    resolved: Float[Tensor, "b m"]

    def of_object(self, number: int) -> "Contours":
        """Those of one object."""
        return Contours(*(value[number : number + 1] for value in field_values(self).values()))

    def rows(self, chosen: Int[Tensor, "k"]) -> "Contours":
        """Those of some objects."""
        return Contours(*(value.index_select(0, chosen) for value in field_values(self).values()))

    def widened(self, count: int) -> "Contours":
        """The same with at least ``count`` places for the points of each object."""
        return Contours(*(widened(value, count) for value in field_values(self).values()))


def image_normals(
    points_cam: Float[Tensor, "b m 3"], tangents_cam: Float[Tensor, "b m 3"], intrinsics: Float[Tensor, "b 4"]
) -> tuple[Float[Tensor, "b m 2"], Bool[Tensor, "b m"]]:
    """Unit normals of projected tangents, and where they exist (not along the line of sight)."""
    depth = points_cam[..., 2:].clamp(min=MIN_DEPTH_M)
    along = torch.addcmul(tangents_cam[..., :2], points_cam[..., :2] / depth, tangents_cam[..., 2:], value=-1) / depth * intrinsics[:, None, :2]
    u, v = along.unbind(-1)
    # Clamped before the root, which has no slope at zero: padding must not spoil gradients.
    length = (u * u + v * v).clamp(min=1e-18).sqrt()
    normals = torch.stack([-v, u], 1) / length[:, None]
    return normals.transpose(1, 2), length > MIN_PX_PER_M


def reproject(contours: Contours, T_cam_obj: Float[Tensor, "b 4 4"], intrinsics: Float[Tensor, "b 4"]) -> Contours:
    """The same contour points seen from a pose nearby: normals are kept, which turn far less than points move."""
    points_cam, pixels = projected(contours.points_obj, T_cam_obj, intrinsics)
    return replace(contours, points_cam=points_cam, pixels=pixels)


@accelerable
def projected(
    points_obj: Float[Tensor, "b m 3"], T_cam_obj: Float[Tensor, "b 4 4"], intrinsics: Float[Tensor, "b 4"]
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 2"]]:
    """Points in the camera's frame, and their pixels."""
    points_cam = transform_points(T_cam_obj, points_obj)
    return points_cam, project(points_cam, intrinsics)


def joined(first: Contours, second: Contours) -> Contours:
    """Contours of both, for each object."""
    return Contours(*(torch.cat([getattr(first, name), getattr(second, name)], 1) for name in field_values(first)))


def widened(values: Tensor, count: int) -> Tensor:
    """Padded with zeros to at least ``count`` places."""
    missing = max(count - values.shape[1], 0)
    return torch.cat([values, values.new_zeros(len(values), missing, *values.shape[2:])], 1) if missing else values


@accelerable
def assemble(
    points_obj: Float[Tensor, "b m 3"],
    tangents_obj: Float[Tensor, "b m 3"],
    kind: Int[Tensor, "b m"],
    mask: Bool[Tensor, "b m"],
    T_cam_obj: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 4"],
) -> Contours:
    """Contours from points in the object's frame, all resolved in full; those behind the camera or without a normal are masked."""
    points_cam = transform_points(T_cam_obj, points_obj)
    tangents_cam = affine(T_cam_obj[:, :3, :3], tangents_obj.transpose(1, 2)).transpose(1, 2)
    normals, has_normal = image_normals(points_cam, tangents_cam, intrinsics)
    mask = mask & has_normal & (points_cam[..., 2] > MIN_DEPTH_M)
    resolved = torch.ones_like(points_obj[..., 0])
    return Contours(points_obj, tangents_obj, kind, mask, points_cam, project(points_cam, intrinsics), normals, resolved)
