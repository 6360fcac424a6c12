"""How an object's motion moves its image: the velocity of contour points, and of pixels at the object's depth."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.camera import MIN_DEPTH_M


def pixel_velocity(
    points_cam: Float[Tensor, "b m 3"], velocity: Float[Tensor, "b 6"], centre_cam: Float[Tensor, "b 3"], intrinsics: Float[Tensor, "b 4"]
) -> Float[Tensor, "b m 2"]:
    """Image velocity (px/s) of points that turn about ``centre_cam`` and move with it: ``velocity`` is [rad/s, m/s]."""
    rotating = torch.linalg.cross(velocity[:, None, :3].expand_as(points_cam), points_cam - centre_cam[:, None], dim=-1)
    moving = rotating + velocity[:, None, 3:]
    inverse_depth = points_cam[..., 2:].clamp(min=MIN_DEPTH_M).reciprocal()
    return (moving[..., :2] - points_cam[..., :2] * inverse_depth * moving[..., 2:]) * inverse_depth * intrinsics[:, None, :2]


def object_plane_velocity(
    pixels: Float[Tensor, "b n 2"], velocity: Float[Tensor, "b 6"], centre_cam: Float[Tensor, "b 3"], intrinsics: Float[Tensor, "b 4"]
) -> Float[Tensor, "b n 2"]:
    """Image velocity (px/s) that a pixel would have at the depth of the object's centre."""
    x, y = ((pixels - intrinsics[:, None, 2:]) / intrinsics[:, None, :2]).unbind(-1)
    # The velocity that the camera's origin would have, were it part of the object.
    drift = velocity[:, 3:] - torch.linalg.cross(velocity[:, :3], centre_cam)
    vx, vy, vz = (drift / centre_cam[:, 2:].clamp(min=MIN_DEPTH_M)).unsqueeze(1).unbind(-1)
    wx, wy, wz = velocity[:, None, :3].unbind(-1)
    # (ẋ, ẏ) = (X/Z)˙ for a point that turns with ω and drifts with v: the motion field of a plane at one depth.
    tilt = vz + wx * y - wy * x
    return torch.stack([vx + wy - wz * y - x * tilt, vy + wz * x - wx - y * tilt], -1) * intrinsics[:, None, :2]
