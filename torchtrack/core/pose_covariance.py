"""Covariances of poses, from one point that a pose turns about to another."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.lie import hat


def left_covariance(covariance: Float[Tensor, "b 6 6"], centre_cam: Float[Tensor, "b 3"]) -> Float[Tensor, "b 6 6"]:
    """Covariance of the left perturbation ``[φ, ρ]`` of a pose, from that of a turn about its centre: ``ρ_left = ρ - φ × c``."""
    # A sum is finite only where every entry is.
    unknown = ~(covariance.sum((1, 2)).abs() < torch.inf)[:, None, None]
    to_left = torch.eye(6, dtype=covariance.dtype, device=covariance.device).repeat(len(covariance), 1, 1)
    to_left[:, 3:, :3] = hat(centre_cam)
    known = to_left @ torch.where(unknown, 0.0, covariance) @ to_left.transpose(1, 2)
    return torch.where(unknown, covariance, known)


def origin_covariance(covariance: Float[Tensor, "b 6 6"], T_cam_obj: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 6 6"]:
    """Covariance of the rotation about, and the position of, the object's origin, from that of the left perturbation.

    The perturbation turns about the camera's own origin, which also moves the object's: by ``φ × t + ρ``.
    """
    return left_covariance(covariance, -T_cam_obj[:, :3, 3].to(covariance.dtype))
