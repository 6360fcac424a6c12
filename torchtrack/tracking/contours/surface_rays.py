"""Where lines of sight meet an object's faces: from pixels to points on its visible surface.

For models of few faces, which are tested one by one; nothing is met on a dense mesh.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.core.lie import transform_points
from torchtrack.core.padded import take_points
from torchtrack.object_model.contour_source import ContourModel

# Nothing is met farther away than this (m).
_FARTHEST_M = 1e4


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the visible surface, one for each pixel.

    Args:
        points_cam: the points in the camera's frame (m); on the line of sight at 1 m where no surface is met.
        normals_cam: unit normals of the faces, of either sign; zero where none is met.
        mask: which pixels see the object.
    """

    points_cam: Float[Tensor, "b n 3"]
    normals_cam: Float[Tensor, "b n 3"]
    mask: Bool[Tensor, "b n"]

    def shifted_to(self, pixels: Float[Tensor, "b n 2"], intrinsics: Float[Tensor, "b 4"]) -> Float[Tensor, "b n 3"]:
        """Where other pixels nearby meet the planes of the same faces."""
        rays = rays_of(pixels, intrinsics)
        along = (self.normals_cam * rays).sum(-1, keepdim=True)
        depth_m = (self.normals_cam * self.points_cam).sum(-1, keepdim=True) / torch.where(along.abs() > 1e-6, along, 1.0)
        return rays * depth_m


def rays_of(pixels: Float[Tensor, "b n 2"], intrinsics: Float[Tensor, "b 4"]) -> Float[Tensor, "b n 3"]:
    """Lines of sight of ideal pixels, as far as a depth of 1 m."""
    return torch.nn.functional.pad((pixels - intrinsics[:, None, 2:]) / intrinsics[:, None, :2], (0, 1), value=1.0)


def surface_points(
    models: Sequence[ContourModel], T_cam_obj: Float[Tensor, "b 4 4"], pixels: Float[Tensor, "b n 2"], intrinsics: Float[Tensor, "b 4"]
) -> SurfacePoints:
    """What each object's camera sees of it at given pixels, whatever may stand before it.

    A line of sight crosses a triangle when it is on one side of the three planes through the camera and an edge, and it
    meets the nearest of those it crosses; the tests of all lines and triangles are one matrix product.
    """
    rays = rays_of(pixels, intrinsics)
    nearness, normals = torch.zeros_like(rays[..., 0]), torch.zeros_like(rays)
    for model in models:
        members = model.members
        if len(model.triangles):
            nearness[members], normals[members] = _first_met(model.triangles, T_cam_obj[members], rays[members])
    mask = nearness > 1 / _FARTHEST_M
    return SurfacePoints(rays / torch.where(mask, nearness, 1.0)[..., None], torch.where(mask[..., None], normals, 0.0), mask)


def _first_met(triangles: Tensor, T_cam_obj: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse depth of the nearest triangle on each line of sight, zero for none, and its normal."""
    corners = transform_points(T_cam_obj, triangles.flatten(0, 1).expand(len(T_cam_obj), -1, -1)).unflatten(1, (-1, 3)).unbind(2)
    sides = [torch.linalg.cross(corners[i], corners[(i + 1) % 3], dim=-1) for i in range(3)]
    turn = (sides[0] * corners[2]).sum(-1, keepdim=True).sign()
    normals = torch.nn.functional.normalize(torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0], dim=-1), dim=-1)
    offset = (normals * corners[0]).sum(-1, keepdim=True)
    # A face that is seen edge-on is not met.
    inverse_depth = torch.where(offset.abs() > 1e-6, normals / torch.where(offset.abs() > 1e-6, offset, 1.0), 0.0)
    tests = torch.cat([*(side * turn for side in sides), inverse_depth], 1).transpose(1, 2)
    first, second, third, nearness = (rays @ tests).chunk(4, -1)
    crossed = (first >= 0) & (second >= 0) & (third >= 0)
    nearest, face = torch.where(crossed, nearness, 0.0).max(-1)
    return nearest, take_points(normals, face)
