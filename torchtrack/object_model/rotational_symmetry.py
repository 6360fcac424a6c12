"""Rotations that bring an object onto itself: poses that differ by one of them look the same, and count once.

In goes a model, out come the rotations about the middle of its surface that leave the surface where it was. Those about the principal axes
of the surface and about the axes of the object's frame are tried, and all that follow from them.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from torchtrack.core.lie import so3_exp
from torchtrack.object_model.model import ObjectModel
from torchtrack.object_model.symmetry import revolution_axis

# Parts of a full rotation that are tried: smaller ones move any surface by little. So many stand for all of a surface of revolution.
_FOLDS, _ALL_AROUND = (2, 3, 4, 5, 6), 72
# A surface comes onto itself when all but a few of its rotated samples lie this near to it (diameters).
_SAME, _NEARLY_ALL = 0.025, 0.98
_SAMPLES = 2000
# Rotations are the same within this (rad), those of a surface of revolution within less; and there are no more of them than of one whose ends
# may be swapped.
_SAME_RAD, _SAME_AROUND_RAD, _MOST = 0.15, 0.04, 2 * _ALL_AROUND


@dataclass(frozen=True)
class RotationGroup:
    """Rotations that bring an object onto itself.

    Args:
        rotations: in the object's frame, the identity among them.
        point_obj: the point that they are about (m).
    """

    rotations: Float[Tensor, "g 3 3"]
    point_obj: Float[Tensor, "3"]

    def angles_deg(self, first: Float[Tensor, "n 3 3"], second: Float[Tensor, "m 3 3"]) -> Float[Tensor, "n m"]:
        """How far each of the first rotations is from each of the second ones (degrees), the object's own rotations left aside."""
        turned = torch.einsum("mij,gjk->gmik", second, self.rotations.to(second))
        cosines = (torch.einsum("nij,gmij->gnm", first, turned) - 1) / 2
        return torch.rad2deg(cosines.clamp(-1, 1).acos()).amin(0)


def rotation_group(model: ObjectModel) -> RotationGroup:
    """The rotations that bring a model onto itself; the identity alone of one with texture, of polylines, and of any other shape."""
    identity = torch.eye(3, dtype=torch.float64)
    points = model.surface_points.double()
    if len(points) == 0 or len(model.texture_points):
        return RotationGroup(identity[None], model.centre.double())
    middle, axes = _middle_and_axes(model)
    arms = points - middle
    surface, samples = cKDTree(arms.numpy()), arms[:: max(1, len(arms) // _SAMPLES)]
    revolution = revolution_axis(model)
    angles = torch.arange(_ALL_AROUND if revolution else 1, dtype=torch.float64) * (2 * math.pi / _ALL_AROUND)
    group = identity[None] if revolution is None else so3_exp(angles[:, None] * revolution.direction_obj)
    same_rad = _SAME_RAD if revolution is None else _SAME_AROUND_RAD
    for axis in torch.cat([identity, axes]):
        for fold in _FOLDS:
            rotation = so3_exp(2 * math.pi / fold * axis)
            apart_m = float(np.quantile(surface.query((samples @ rotation.mT).numpy())[0], _NEARLY_ALL))
            if apart_m < _SAME * model.diameter_m and not _is_among(rotation, group, same_rad) and len(group) < _MOST:
                group = _closed(torch.cat([group, rotation[None]]), same_rad)
    return RotationGroup(group, middle)


def _middle_and_axes(model: ObjectModel) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """The middle of a surface, and its principal axes, one a row: by the moments of its triangles."""
    corners = model.triangles.double()
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
    areas = areas / areas.sum()
    middle = areas @ corners.mean(1)
    arms = corners - middle
    sums = arms.sum(1)
    moments = torch.einsum("f,fki,fkj->ij", areas, arms, arms) + torch.einsum("f,fi,fj->ij", areas, sums, sums)
    return middle, torch.linalg.eigh(moments).eigenvectors.mT


def _is_among(rotation: Float[Tensor, "3 3"], group: Float[Tensor, "g 3 3"], same_rad: float) -> bool:
    return bool(((group - rotation).square().sum((1, 2)) < 2 * same_rad**2).any())


def _closed(group: Float[Tensor, "g 3 3"], same_rad: float) -> Float[Tensor, "h 3 3"]:
    """All products of some rotations, as far as there are not too many of them."""
    grown = True
    while grown and len(group) < _MOST:
        grown = False
        for product in torch.einsum("aij,bjk->abik", group, group).flatten(0, 1):
            if len(group) < _MOST and not _is_among(product, group, same_rad):
                group, grown = torch.cat([group, product[None]]), True
    return group
