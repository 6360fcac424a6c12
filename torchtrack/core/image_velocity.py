"""How an object's motion moves its image: the place and velocity of its points, and of pixels at the object's depth."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.lie import affine, hat, transform_points


def pixel_velocity(
    points_cam: Float[Tensor, "b m 3"], velocity: Float[Tensor, "b 6"], centre_cam: Float[Tensor, "b 3"], intrinsics: Float[Tensor, "b 4"]
) -> Float[Tensor, "b m 2"]:
    """Image velocity (px/s) of points that turn about ``centre_cam`` and move with it: ``velocity`` is [rad/s, m/s]."""
    turning, drift = _turning_and_drift(velocity, centre_cam)
    depth = points_cam[..., 2].clamp(min=MIN_DEPTH_M)[:, None]
    points = points_cam.transpose(1, 2)
    return _across_the_ray(points[:, :2] / depth, affine(turning, points, drift) / depth, intrinsics)


def _turning_and_drift(velocity: Tensor, centre_cam: Tensor) -> tuple[Tensor, Tensor]:
    """The motion ``turning @ point + drift`` of an object's points, in the camera's frame."""
    turning = hat(velocity[:, :3])
    return turning, torch.baddbmm(velocity[:, 3:, None], turning, centre_cam[..., None], alpha=-1)


def _across_the_ray(ray: Float[Tensor, "b 2 n"], moving: Float[Tensor, "b 3 n"], intrinsics: Tensor) -> Float[Tensor, "b n 2"]:
    """Image velocity of points ``(x, y, 1)``, by their velocity over their depth: ``(X/Z)˙``."""
    across = torch.addcmul(moving[:, :2], ray, moving[:, 2:], value=-1)
    return (across * intrinsics[:, :2, None]).transpose(1, 2)


@dataclass(frozen=True)
class MovingObjects:
    """Objects at their poses, and how they move, each before its camera.

    Args:
        T_cam_obj: the poses.
        velocity: rotation and velocity of the centre (rad/s, m/s).
        centre_cam: centre of each object (m).
        intrinsics: ``[fx, fy, cx, cy]``.
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    velocity: Float[Tensor, "b 6"]
    centre_cam: Float[Tensor, "b 3"]
    intrinsics: Float[Tensor, "b 4"]

    def show(self, points_obj: Float[Tensor, "b n 3"]) -> tuple[Float[Tensor, "b n 2"], Float[Tensor, "b n 2"]]:
        """Pixels of points of the objects, and their velocities (px/s)."""
        turning, drift = _turning_and_drift(self.velocity, self.centre_cam)
        points_cam = transform_points(self.T_cam_obj, points_obj).transpose(1, 2)
        inverse_depth = points_cam[:, 2:].clamp(min=MIN_DEPTH_M).reciprocal()
        ray = points_cam[:, :2] * inverse_depth
        pixels = torch.addcmul(self.intrinsics[:, 2:, None], ray, self.intrinsics[:, :2, None])
        velocity = _across_the_ray(ray, affine(turning, points_cam, drift) * inverse_depth, self.intrinsics)
        return pixels.transpose(1, 2), velocity

    def plane_velocity(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
        """Image velocity of pixels at the depth of each object's centre (px/s)."""
        return object_plane_velocity(pixels, self.velocity, self.centre_cam, self.intrinsics)


def object_plane_velocity(
    pixels: Float[Tensor, "b n 2"], velocity: Float[Tensor, "b 6"], centre_cam: Float[Tensor, "b 3"], intrinsics: Float[Tensor, "b 4"]
) -> Float[Tensor, "b n 2"]:
    """Image velocity (px/s) that a pixel would have at the depth of the object's centre."""
    turning, drift = _turning_and_drift(velocity, centre_cam)
    ray = (pixels.transpose(1, 2) - intrinsics[:, 2:, None]) / intrinsics[:, :2, None]
    moving = torch.baddbmm(turning[:, :, 2:] + drift / centre_cam[:, 2:, None].clamp(min=MIN_DEPTH_M), turning[:, :, :2], ray)
    return _across_the_ray(ray, moving, intrinsics)


def pose_jacobian(arms: Float[Tensor, "b 3 n"], gradient: tuple[Float[Tensor, "b n"], ...]) -> Float[Tensor, "b 6 n"]:
    """Columns ``[(P - c) × g, g]`` with ``g = dπᵀ n``: the paper's Eq. 15 as one vector product, about the object's centre.

    Args:
        arms: from the centre to the points, in the camera's axes: ``P - c``.
        gradient: ``g``, by component.
    """
    # By component: the library's vector product takes five times as long.
    (ax, ay, az), (gx, gy, gz) = arms.unbind(1), gradient
    turning = (torch.addcmul(p * q, r, s, value=-1) for p, q, r, s in ((ay, gz, az, gy), (az, gx, ax, gz), (ax, gy, ay, gx)))
    return torch.stack([*turning, gx, gy, gz], 1)
