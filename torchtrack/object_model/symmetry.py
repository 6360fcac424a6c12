"""Surfaces of revolution, such as bottles and bowls, which turned about their axis look the same, or nearly so; and planes of symmetry."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from torchtrack.core.lie import quaternion_from_rotation, so3_exp
from torchtrack.object_model.model import ObjectModel

# A turn by one radian may move the surface along its normals by this share of its distance from the axis: what a circle
# of 24 corners does. All but this share of the surface has to keep to it: a small handle makes a turn visible.
_SLIP, _KEEPING = 0.14, 0.995
# A ball, which can be turned about every axis, has none: any other turn moves a surface of unit diameter by this much more (squared).
_DISTINCT = 1e-4
# Of what can be turned about an axis nearly unseen, such as a can with a handle, this share of what faces away from the axis keeps to
# it, and that is at least so much of the surface. What does not counts less and less, in so many rounds.
_NEARLY_KEEPING, _FACING_AWAY, _ROUNDS = 0.7, 0.2, 15
# And other turns move it by so much more (squared, of unit diameter): what is nearly a ball turns about every axis.
_CLEARLY_DISTINCT = 2e-3
# Of meshes with fewer triangles, these are looked at within, too; of those with more, as many are looked at.
_TRIANGLES = 5000
# A surface is its own mirror image when samples of the image lie this near to it, in the mean (diameters).
_MIRRORED = 0.02


@dataclass(frozen=True)
class RevolutionAxis:
    """The axis of a surface of revolution.

    Args:
        point_obj: a point on it (m).
        direction_obj: its unit direction.
    """

    point_obj: Float[Tensor, "3"]
    direction_obj: Float[Tensor, "3"]

    def turned_to_match(self, T_cam_obj: Float[Tensor, "*b 4 4"], T_true: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
        """The poses turned about the axis so that their rotations come nearest to the true ones."""
        quaternion = quaternion_from_rotation(T_cam_obj[..., :3, :3].mT @ T_true[..., :3, :3])
        # The twist of swing and twist.
        angle = 2 * torch.atan2(quaternion[..., :3] @ self.direction_obj, quaternion[..., 3])
        turn = torch.eye(4, dtype=T_cam_obj.dtype).expand(T_cam_obj.shape).clone()
        turn[..., :3, :3] = so3_exp(angle[..., None] * self.direction_obj)
        turn[..., :3, 3] = self.point_obj - turn[..., :3, :3] @ self.point_obj
        return T_cam_obj @ turn


def revolution_axis(model: ObjectModel) -> RevolutionAxis | None:
    """The axis that the object can be turned about unseen; None for any other shape, for printed ones, polylines and balls.

    The axis goes through the middle of the surface. A turn about it moves every point along the surface, ``n · (a × p) = 0``:
    ``a`` is the smallest eigenvector of these normal equations (Gelfand and Guibas, "Shape segmentation using local slippage
    analysis", 2004).
    """
    if len(model.triangles) == 0 or len(model.texture_points):
        return None
    corners, normals, area = _corners(model.triangles.double())
    middle = area @ corners
    points = (corners - middle) / model.diameter_m
    slips = torch.linalg.cross(points, normals)
    values, axes = torch.linalg.eigh(slips.mT @ (area[:, None] * slips))
    direction = axes[:, 0]
    arm = torch.linalg.cross(direction.expand_as(points), points).norm(dim=-1)
    keeps = (slips @ direction).abs() <= _SLIP * arm + 1e-6
    if values[1] < values[0] + _DISTINCT or (area * keeps).sum() < _KEEPING:
        return None
    return RevolutionAxis(middle, direction)


def turning_axis(model: ObjectModel) -> RevolutionAxis | None:
    """The axis that most of an object can be turned about unseen, and not all: of a can with a handle, or with print; None for any other shape.

    As :func:`revolution_axis` finds it, but of any axis, not through the middle alone, and robustly: the handle counts for nothing.
    """
    if len(model.triangles) == 0 or revolution_axis(model) is not None:
        return None
    triangles = model.triangles[:: len(model.triangles) // _TRIANGLES + 1].double()
    corners, normals, area = _corners(_quartered(triangles) if len(model.triangles) < _TRIANGLES else triangles)
    middle = area @ corners
    points = (corners - middle) / model.diameter_m
    turns, weights = torch.linalg.cross(points, normals), area
    for _ in range(_ROUNDS):
        values, direction, shift = _least_slip(turns, normals, weights)
        arm = torch.linalg.cross(direction.expand_as(points), points).add(shift).norm(dim=-1)
        slip = (turns @ direction + normals @ shift).abs() / (_SLIP * arm + 1e-3)
        weights = area / (1 + slip.square()).square()
    # Flat ends keep to every axis across them.
    away = area * (1 - (normals @ direction).square())
    keeps = away.sum() >= _FACING_AWAY and (away * (slip <= 1)).sum() >= _NEARLY_KEEPING * away.sum()
    if not keeps or values[1] < values[0] + _CLEARLY_DISTINCT:
        return None
    return RevolutionAxis(middle + model.diameter_m * torch.linalg.cross(direction, shift), direction)


def _least_slip(
    turns: Float[Tensor, "p 3"], normals: Float[Tensor, "p 3"], weights: Float[Tensor, "p"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], Float[Tensor, "3"]]:
    """How far turns move points along their normals, ``a · (p × n) + b · n``; the one that does so least, and the shift that goes with it."""
    weighted = weights[:, None] * normals
    of_shifts, of_both = weighted.mT @ normals + 1e-9 * torch.eye(3, dtype=normals.dtype), turns.mT @ weighted
    values, axes = torch.linalg.eigh((weights[:, None] * turns).mT @ turns - of_both @ torch.linalg.solve(of_shifts, of_both.mT))
    direction = axes[:, 0]
    shift = -torch.linalg.solve(of_shifts, of_both.mT @ direction)
    return values, direction, shift - (shift @ direction) * direction


def symmetry_planes(model: ObjectModel) -> tuple[Float[Tensor, "3"], Float[Tensor, "k 3"]]:
    """The middle of the surface, and unit normals of the planes through it that mirror the surface onto itself, or nearly so (float64).

    Planes across a principal axis are looked at: every plane of symmetry is one, unless axes are not distinct, as a cube's.
    """
    points = model.surface_points.double()
    if len(points) == 0:
        return torch.zeros(3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)
    arms = points - points.mean(0)
    return points.mean(0), mirrored_across(model, torch.linalg.eigh(arms.mT @ arms).eigenvectors.mT)


def mirrored_across(model: ObjectModel, axes: Float[Tensor, "k 3"]) -> Float[Tensor, "m 3"]:
    """Those of some unit normals (float64) whose planes through the middle of the surface mirror it onto itself, or nearly so."""
    points = model.surface_points.double()
    if len(points) == 0:
        return axes[:0]
    arms = points - points.mean(0)
    surface = cKDTree(arms.numpy())
    images = (arms - 2 * (arms @ axis)[:, None] * axis for axis in axes)
    apart_m = torch.tensor([surface.query(image.numpy())[0].mean() for image in images])
    return axes[apart_m < _MIRRORED * model.diameter_m]


def _quartered(triangles: Float[Tensor, "f 3 3"]) -> Float[Tensor, "q 3 3"]:
    """Triangles divided at the middles of their sides."""
    middles = 0.5 * (triangles + triangles.roll(-1, 1))
    at_corners = torch.stack([triangles, middles, middles.roll(1, 1)], 2)
    return torch.cat([at_corners.flatten(0, 1), middles])


def _corners(triangles: Float[Tensor, "f 3 3"]) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3"], Float[Tensor, "p"]]:
    """Corners of triangles, the unit normals there, and the share of the area that each stands for."""
    cross = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    twice_area = cross.norm(dim=-1)
    normals, area = cross / twice_area[:, None].clamp(min=1e-30), twice_area / (3 * twice_area.sum())
    return triangles.flatten(0, 1), normals.repeat_interleave(3, 0), area.repeat_interleave(3)
