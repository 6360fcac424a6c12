"""The paper's contours: the boundary of the projected point cloud, carried back to 3D (its Section 3.2)."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d, spatial_gradient
from torch import Tensor
from torch.nn.functional import normalize

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import MIN_DEPTH_M, project
from torchtrack.core.lie import transform_points
from torchtrack.core.neighbours import largest_around
from torchtrack.core.padded import select_ranked, take_points
from torchtrack.object_model.contour_source import ContourKind, ContourModel
from torchtrack.tracking.contours.points import Contours, assemble

# Closing radius of the splatted point cloud (px): 10,000 samples of a surface leave holes between them. Set with the first contours; not measured.
_CLOSING_RADIUS_PX = 3


def _close(occupied: Float[Tensor, "b h w"], radius: int) -> Float[Tensor, "b h w"]:
    """Morphological closing with a square of side ``2 radius + 1``."""
    return -largest_around(-largest_around(occupied, radius), radius)


def _silhouette(pixels: Tensor, valid: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Closed mask of the splatted pixels, and the flat cell of each pixel in it."""
    border = radius + 3
    low = torch.where(valid[..., None], pixels, torch.inf).amin(1, keepdim=True).floor() - border
    local = torch.where(valid[..., None], pixels - low, 0).round().long()
    width, height = (local.amax((0, 1)) + border + 1).tolist()
    cell = local[..., 1] * width + local[..., 0]
    occupied = torch.zeros(len(pixels), height * width, dtype=pixels.dtype, device=pixels.device).scatter(1, cell, valid.to(pixels.dtype))
    return _close(occupied.view(-1, height, width), radius), cell


def boundary_points(pixels: Float[Tensor, "b n 2"], valid: Bool[Tensor, "b n"], radius: int) -> tuple[Bool[Tensor, "b n"], Float[Tensor, "b n 2"]]:
    """Which projected points lie on the boundary of the closed point cloud, and the boundary's normal at each."""
    mask, cell = _silhouette(pixels, valid, radius)
    eroded = -largest_around(-mask, 1)
    near_boundary = largest_around(mask - eroded, 1)
    gradient = spatial_gradient(gaussian_blur2d(mask[:, None], (9, 9), (2.0, 2.0)))[:, 0]
    on_boundary = (near_boundary.flatten(1).gather(1, cell) > 0) & valid
    normals = torch.stack([gradient[:, axis].flatten(1).gather(1, cell) for axis in range(2)], -1)
    return on_boundary, normalize(normals, dim=-1)


def splat_contours(
    models: Sequence[ContourModel], T_cam_obj: Float[Tensor, "b 4 4"], intrinsics: Float[Tensor, "b 4"], config: ContourConfig
) -> Contours:
    """Boundary points of each object's splatted surface samples."""
    parts = [_model_boundary(model.surface_points, T_cam_obj[model.members], intrinsics[model.members], config) for model in models]
    order = torch.cat([model.members for model in models]).argsort()
    points, tangents, mask = (torch.cat(column)[order] for column in zip(*parts, strict=True))
    kind = torch.full(mask.shape, int(ContourKind.SPLAT), device=mask.device)
    return assemble(points, tangents, kind, mask, T_cam_obj, intrinsics)


def _model_boundary(surface_points: Tensor, T_cam_obj: Tensor, intrinsics: Tensor, config: ContourConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Boundary points, tangents (both object frame) and mask of the objects of one model."""
    points = surface_points.expand(len(T_cam_obj), -1, -1)
    points_cam = transform_points(T_cam_obj, points)
    pixels = project(points_cam, intrinsics)
    # Twice the image's half size about its centre: what lies beyond is no boundary in the image, and may be endless.
    principal = intrinsics[:, None, 2:]
    near_image = ((pixels - principal).abs() < 2 * principal.abs() + 1).all(-1)
    on_boundary, normals = boundary_points(pixels, near_image & (points_cam[..., 2] > MIN_DEPTH_M), _CLOSING_RADIUS_PX)
    index, mask = select_ranked(on_boundary, config.max_edge_points)
    normals = take_points(normals, index)
    # A tangent parallel to the image plane: only its projection matters.
    tangents_cam = torch.stack([normals[..., 1], -normals[..., 0], torch.zeros_like(normals[..., 0])], -1)
    return take_points(points, index), normalize(tangents_cam @ T_cam_obj[:, :3, :3], dim=-1), mask
