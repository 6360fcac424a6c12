"""Where contour points show at a pose: :mod:`torchtrack.tracking.contours.points`, point by point."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, entries, inverse_depth, lens, placed, turned
from torchtrack.backends.numba.parameters import ShowingSettings
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours import points
from torchtrack.tracking.contours.points import MIN_PX_PER_M, Contours

SHOWING = ShowingSettings(MIN_DEPTH_M, MIN_PX_PER_M)
_LEAST_LENGTH2 = 1e-18


class ModelPoints(NamedTuple):
    """Contour points in their objects' frames, with the contour's direction: ``[b, 3, m]``, of which ``mask [b, m]`` count."""

    points_obj: Array
    tangents_obj: Array
    mask: Array


class Shown(NamedTuple):
    """Contour points before the camera: ``[b, 3, m]``, ``[b, 2, m]`` with their normals, and which are shown, ``[b, m]``."""

    points_cam: Array
    pixels: Array
    normals: Array
    mask: Array


@kernel(fastmath=FAST)
def show(given: ModelPoints, T_cam_obj: Array, intrinsics: Array, settings: ShowingSettings, shown: Shown) -> None:
    """Contour points at a pose, with their normals in the image; those behind the camera or without a normal are not shown."""
    (points_obj, tangents_obj, mask), (points_cam, pixels, normals, is_shown) = given, shown
    for b in range(len(mask)):
        pose, of_lens = entries(T_cam_obj[b]), lens(intrinsics[b])
        fx, fy, cx, cy = of_lens
        for i in range(mask.shape[1]):
            x, y, z = placed(pose, points_obj[b, 0, i], points_obj[b, 1, i], points_obj[b, 2, i])
            points_cam[b, 0, i], points_cam[b, 1, i], points_cam[b, 2, i] = x, y, z
            inverse = inverse_depth(z)
            pixels[b, 0, i], pixels[b, 1, i] = x * inverse * fx + cx, y * inverse * fy + cy
            ax, ay, az = turned(pose, tangents_obj[b, 0, i], tangents_obj[b, 1, i], tangents_obj[b, 2, i])
            u, v, length = normal_of(ax - x * inverse * az, ay - y * inverse * az, inverse, of_lens)
            normals[b, 0, i], normals[b, 1, i] = u, v
            is_shown[b, i] = mask[b, i] and length > settings.least_px_per_m and z > settings.least_depth_m


@kernel(fastmath=FAST)
def normal_of(across_x: float, across_y: float, inverse: float, of_lens: Numbers) -> tuple[float, float, float]:
    """Unit normal of a projected tangent, and how long the tangent is there (px/m): :func:`torchtrack.tracking.contours.points.image_normals`.

    Args:
        across_x, across_y: the tangent across the line of sight.
        inverse: one over the depth.
    """
    u, v = across_x * inverse * of_lens[0], across_y * inverse * of_lens[1]
    length = np.sqrt(max(u * u + v * v, _LEAST_LENGTH2))
    return -v / length, u / length, length


@kernel(fastmath=FAST)
def project(points_obj: Array, T_cam_obj: Array, intrinsics: Array, points_cam: Array, pixels: Array) -> None:
    """Points in the camera's frame, and their pixels: ``[b, 3, m]`` and ``[b, 2, m]``, filled."""
    for b in range(len(points_obj)):
        pose, (fx, fy, cx, cy) = entries(T_cam_obj[b]), lens(intrinsics[b])
        for i in range(points_obj.shape[2]):
            x, y, z = placed(pose, points_obj[b, 0, i], points_obj[b, 1, i], points_obj[b, 2, i])
            inverse = inverse_depth(z)
            points_cam[b, 0, i], points_cam[b, 1, i], points_cam[b, 2, i] = x, y, z
            pixels[b, 0, i], pixels[b, 1, i] = x * inverse * fx + cx, y * inverse * fy + cy


@accelerates(points.projected)
def projected_numba(
    points_obj: Float[Tensor, "b m 3"], T_cam_obj: Float[Tensor, "b 4 4"], intrinsics: Float[Tensor, "b 4"]
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 2"]]:
    """Point by point."""
    rows = points_obj.transpose(1, 2)
    points_cam, pixels = rows.new_empty(rows.shape), rows.new_empty(len(rows), 2, rows.shape[2])
    project(*as_arrays(rows, T_cam_obj, intrinsics, points_cam, pixels))
    return points_cam.transpose(1, 2), pixels.transpose(1, 2)


@accelerates(points.assemble)
def assemble_numba(
    points_obj: Float[Tensor, "b m 3"],
    tangents_obj: Float[Tensor, "b m 3"],
    kind: Int[Tensor, "b m"],
    mask: Bool[Tensor, "b m"],
    T_cam_obj: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 4"],
) -> Contours:
    """Point by point."""
    rows, tangents = points_obj.transpose(1, 2), tangents_obj.transpose(1, 2)
    points_cam, pixels, normals, is_shown = rows.new_empty(rows.shape), *rows.new_empty(2, len(mask), 2, mask.shape[1]), torch.empty_like(mask)
    shown = as_arrays(points_cam, pixels, normals, is_shown)
    show(as_arrays(rows, tangents, mask), *as_arrays(T_cam_obj, intrinsics), SHOWING, shown)
    points_cam, pixels, normals = (value.transpose(1, 2) for value in (points_cam, pixels, normals))
    return Contours(points_obj, tangents_obj, kind, is_shown, points_cam, pixels, normals, torch.ones_like(mask, dtype=points_obj.dtype))
