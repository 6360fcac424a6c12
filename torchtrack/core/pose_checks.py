"""What is wrong with poses and quaternions that people, files or other tools give."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchtrack.errors import PoseError

# Text rounds quaternions; a norm further from 1 than this means that these are other numbers.
_QUATERNION_TOLERANCE = 0.01


def quaternion_problem(xyzw: Sequence[float | int]) -> str | None:
    """What is wrong with a quaternion ``x, y, z, w`` that people or tools wrote; None where its norm is 1 within 1 %."""
    norm = math.hypot(*xyzw)
    # Written so that NaN fails too.
    if abs(norm - 1) <= _QUATERNION_TOLERANCE:
        return None
    return (
        f"the quaternion qx qy qz qw has norm {norm:.4g}, expected 1. Check the order of the numbers (w is the last); "
        "Euler angles and rotation vectors, in degrees or radians, are no quaternion."
    )


def check_pose(T: Tensor, name: str = "T_cam_obj", tolerance: float = 1e-3) -> None:
    """Raise :class:`PoseError` unless ``T [..., 4, 4]`` holds finite rigid motions."""
    if T.shape[-2:] != (4, 4):
        raise PoseError(f"{name}: expected matrices of shape [..., 4, 4], got {list(T.shape)}.")
    if not bool(torch.isfinite(T).all()):
        raise PoseError(f"{name}: contains NaN or infinite entries. Check the file or the computation that made it.")
    rotation = T[..., :3, :3].double()
    eye = torch.eye(3, dtype=torch.float64, device=T.device)
    deviation = float((rotation @ rotation.transpose(-1, -2) - eye).abs().amax()) if T.numel() else 0.0
    if deviation > tolerance:
        raise PoseError(
            f"{name}: the upper left 3x3 block is not a rotation (R Rᵀ differs from the identity by {deviation:.3g}, "
            f"at most {tolerance:g} is allowed). Remove any scale, or check whether rows and columns are swapped."
        )
    if bool((torch.linalg.det(rotation) < 0).any()):
        raise PoseError(f"{name}: the upper left 3x3 block is a reflection (determinant -1). Check the axis conventions: x right, y down, z forward.")
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device=T.device)
    if T.numel() and float((T[..., 3, :].double() - bottom).abs().amax()) > tolerance:
        raise PoseError(f"{name}: the last row must be [0, 0, 0, 1]. Check whether the matrix is stored transposed.")
