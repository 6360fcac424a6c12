"""Poses as other libraries hold them, as matrices: none of these libraries is needed.

| library | pose |
|---|---|
| scipy | ``RigidTransform`` of one or many poses; ``(Rotation, translation_m)`` |
| kornia | ``Se3`` |
| pypose | ``LieTensor`` of SE(3) or se(3) |
| jaxlie, Sophus | ``SE3`` |

What counts is the method: ``as_matrix()`` or ``matrix()``, which gives ``[..., 4, 4]``. So no order of quaternions or twists can be
mistaken: each library turns its own into a matrix.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.errors import PoseError

_METHODS = ("as_matrix", "matrix")


def as_pose_matrices(poses: Any) -> Float[Tensor, "*b 4 4"]:
    """Poses as matrices (float64), whether they are rigid motions or not; gradients of tensors stay.

    Args:
        poses: a tensor, array or nested list ``[..., 4, 4]``; a pose of another library; a pair of a rotation (of another library, or
            ``[..., 3, 3]``) and a translation ``[..., 3]`` in metres; or a list of poses, one per object.

    Raises:
        PoseError: if they are none of these.
    """
    matrix = _of_library(poses)
    if matrix is None and _is_pair(poses):
        matrix = _joined(_matrix_of(poses[0]), _tensor(poses[1], "the translation"))
    if matrix is None and isinstance(poses, Sequence) and poses and all(_is_pose(pose) for pose in poses):
        matrix = torch.stack([as_pose_matrices(pose) for pose in poses])
    if matrix is None:
        matrix = _tensor(poses, "poses")
    if matrix.shape[-2:] == (3, 3):
        raise PoseError("a rotation alone is no pose. Give a pair: (rotation, translation in metres).")
    if matrix.dim() < 2 or matrix.shape[-2:] != (4, 4):
        raise PoseError(f"expected poses of shape [..., 4, 4], got {list(matrix.shape)}.")
    return matrix


def _of_library(pose: Any) -> Tensor | None:
    """What the object's own method gives; None where it has none."""
    method = next((getattr(pose, name) for name in _METHODS if callable(getattr(pose, name, None))), None)
    return None if method is None else _tensor(method(), "the matrix of the pose")


def _matrix_of(rotation: Any) -> Tensor:
    """A rotation ``[..., 3, 3]``."""
    matrix = _of_library(rotation)
    matrix = _tensor(rotation, "the rotation") if matrix is None else matrix
    if matrix.shape[-2:] != (3, 3):
        raise PoseError(f"a pair of rotation and translation needs a rotation of shape [..., 3, 3], got {list(matrix.shape)}.")
    return matrix


def _joined(rotation: Tensor, translation: Tensor) -> Tensor:
    """Poses of rotations ``[..., 3, 3]`` and translations ``[..., 3]``."""
    if translation.shape[-1:] != (3,):
        raise PoseError(f"a pair of rotation and translation needs a translation of shape [..., 3], got {list(translation.shape)}.")
    batch = torch.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    top = torch.cat([rotation.expand(*batch, 3, 3), translation.expand(*batch, 3)[..., None]], -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device=top.device).expand(*batch, 1, 4)
    return torch.cat([top, bottom], -2)


def _is_pair(poses: Any) -> bool:
    """Whether it is a rotation and a translation, not two poses."""
    if not isinstance(poses, tuple | list) or len(poses) != 2 or _is_pose(poses[1]):
        return False
    rotation = _of_library(poses[0])
    try:
        return (np.shape(poses[0]) if rotation is None else tuple(rotation.shape))[-2:] == (3, 3)
    except ValueError:
        # Rows of different lengths have no shape.
        return False


def _is_pose(pose: Any) -> bool:
    """Whether it is a pose of its own: of a library, a matrix, or a pair."""
    if any(callable(getattr(pose, name, None)) for name in _METHODS):
        return True
    if isinstance(pose, Tensor | np.ndarray):
        return pose.shape[-2:] == (4, 4)
    return isinstance(pose, tuple | list) and _is_pair(pose)


def _tensor(values: Any, name: str) -> Tensor:
    """Numbers as a tensor (float64)."""
    try:
        # A LieTensor of pypose would go on counting as one.
        plain = values.as_subclass(Tensor) if isinstance(values, Tensor) else torch.as_tensor(np.asarray(values, dtype=np.float64))
        return plain.to(torch.float64)
    except (TypeError, ValueError) as error:
        raise PoseError(f"{name} cannot be made a tensor of numbers: {error}.") from error
