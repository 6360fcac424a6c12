"""Contour points by kernels: what :mod:`torchtrack.tracking.contours.points` samples from meshes, and shows at a pose."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.parameters import SamplingSettings
from torchtrack.object_model.contour_source import ContourModel

# What of a model its contour points are sampled from, beside the faces.
_SAMPLED_FROM = ("is_crease", "is_segment", "edges", "texture_points", "texture_tangents", "texture_normals")


def mesh_points(
    models: Sequence[ContourModel], T_cam_obj: Float[Tensor, "b 4 4"], intrinsics: Float[Tensor, "b 4"], settings: SamplingSettings
) -> tuple[Tensor, ...]:
    """Points and tangents ``[b, m, 3]``, kinds and mask of all objects' contours, before hidden parts are removed."""
    # Not at the top: Numba is an extra.
    from torchtrack.backends.numba import contours as kernels

    batch, room = len(T_cam_obj), settings.max_edge_points + max(len(model.texture_points) for model in models)
    sampled = T_cam_obj.new_empty(batch, kernels.SAMPLED, room).numpy()
    kind, counts = np.empty((batch, room), np.int64), np.zeros(batch, np.int64)
    seen = as_arrays(T_cam_obj, intrinsics)
    for model in models:
        of_edges = model.edge_ends, model.face_normals.movedim(0, -1), model.face_offsets.T
        of_model = as_arrays(model.members, *of_edges, *(getattr(model, name) for name in _SAMPLED_FROM))
        kernels.sample(*of_model, model.texture_spacing_m, *seen, settings, sampled, kind, counts)
    # One place at least: what selects from contours needs one to point at.
    width = max(int(counts.max()), 1)
    points, tangents = T_cam_obj.new_empty(2, batch, 3, width)
    kinds, mask = torch.empty(batch, width, dtype=torch.int64), torch.empty(batch, width, dtype=torch.bool)
    kernels.gather(sampled, kind, counts, *as_arrays(points, tangents, kinds, mask))
    return points.transpose(1, 2), tangents.transpose(1, 2), kinds, mask


def projected(
    points_obj: Float[Tensor, "b m 3"], T_cam_obj: Float[Tensor, "b 4 4"], intrinsics: Float[Tensor, "b 4"]
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m 2"]]:
    """Points in the camera's frame, and their pixels."""
    # Not at the top: Numba is an extra.
    from torchtrack.backends.numba.contours import project as by_kernel

    points = points_obj.transpose(1, 2)
    points_cam, pixels = points.new_empty(points.shape), points.new_empty(len(points), 2, points.shape[2])
    by_kernel(*as_arrays(points, T_cam_obj, intrinsics, points_cam, pixels))
    return points_cam.transpose(1, 2), pixels.transpose(1, 2)


def shown(
    points_obj: Float[Tensor, "b m 3"],
    tangents_obj: Float[Tensor, "b m 3"],
    mask: Bool[Tensor, "b m"],
    T_cam_obj: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 4"],
    settings: SamplingSettings,
) -> tuple[Tensor, ...]:
    """Which contour points show at a pose, and all of them in the camera's frame, their pixels, and their normals in the image."""
    # Not at the top: Numba is an extra.
    from torchtrack.backends.numba.contours import show

    points, tangents = points_obj.transpose(1, 2), tangents_obj.transpose(1, 2)
    points_cam, pixels, normals, is_shown = points.new_empty(points.shape), *points.new_empty(2, len(mask), 2, mask.shape[1]), torch.empty_like(mask)
    given = as_arrays(points, tangents, mask, T_cam_obj, intrinsics)
    show(*given, settings, *as_arrays(points_cam, pixels, normals, is_shown))
    return is_shown, *(value.transpose(1, 2) for value in (points_cam, pixels, normals))
