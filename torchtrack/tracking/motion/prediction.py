"""Where objects are expected at a window's end, how they move, and how certain that is."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.constants import once
from torchtrack.core.dispatch import accelerable
from torchtrack.core.image_velocity import MovingObjects, pixel_velocity, pose_jacobian
from torchtrack.core.lie import retract_about, transform_points
from torchtrack.core.linalg import inverse
from torchtrack.core.padded import put_rows, repeated, select_ranked, take_points
from torchtrack.tracking.contours.objects import ObjectBatch, copied_rows
from torchtrack.tracking.contours.points import Contours

# Nothing that is tracked is farther away (m).
MAX_DEPTH_M = 1e4
# Contour points that the uncertainty is looked at, at most.
LOOKED_AT = 64


@dataclass(frozen=True)
class Prediction:
    """Predicted pose and motion of each object at the window's end.

    Args:
        objects: the objects.
        T_cam_obj: predicted pose; some pose in view where the predicted one is not usable.
        usable: which predictions are finite poses before the camera.
        velocity: rotation and velocity of the centre (rad/s, m/s).
        covariance: of pose and velocity (float64), in the chart of :mod:`torchtrack.tracking.motion.model`.
    """

    objects: ObjectBatch
    T_cam_obj: Float[Tensor, "b 4 4"]
    usable: Bool[Tensor, "b"]
    velocity: Float[Tensor, "b 6"]
    covariance: Float[Tensor, "b 12 12"]

    @once
    def centre_cam(self) -> Float[Tensor, "b 3"]:
        """Centre of each object in the camera's frame (m)."""
        return transform_points(self.T_cam_obj, self.objects.centre_obj[:, None])[:, 0]

    def detached(self) -> "Prediction":
        """The same prediction as a constant, to look for matches from; itself where no gradients are recorded."""
        if not torch.is_grad_enabled():
            return self
        return Prediction(self.objects, self.T_cam_obj.detach(), self.usable, self.velocity.detach(), self.covariance.detach())

    @once
    def information(self) -> Float[Tensor, "b 12 12"]:
        """Inverse of the covariance."""
        return inverse(self.covariance)

    def moving(self, *, compensated: bool) -> MovingObjects:
        """The objects as predicted; standing still where their motion is not to be compensated for."""
        velocity = self.velocity if compensated else torch.zeros_like(self.velocity)
        return MovingObjects(self.T_cam_obj, velocity, self.centre_cam, self.objects.intrinsics)

    def plane_velocity(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
        """Image velocity of pixels at the depth of the object's centre (px/s)."""
        return self.moving(compensated=True).plane_velocity(pixels)

    def carried(self, pixels: Float[Tensor, "b n 2"], age_s: Float[Tensor, "b n"]) -> Float[Tensor, "b n 2"]:
        """Where pixels that were seen some time ago have come by the window's end, at the depth of the object's centre."""
        return torch.addcmul(pixels, self.plane_velocity(pixels), age_s[..., None])

    def contour_velocity(self, contours: Contours) -> Float[Tensor, "b m 2"]:
        """Image velocity of contour points (px/s)."""
        return pixel_velocity(contours.points_cam, self.velocity, self.centre_cam, self.objects.intrinsics)

    def moved(self, offset: Float[Tensor, "b k"]) -> "Prediction":
        """The prediction with its pose and velocity moved; the covariance stays."""
        return self.at(retract_about(self.T_cam_obj, offset[:, :6], self.objects.centre_obj), offset)

    def at(self, T_cam_obj: Float[Tensor, "b 4 4"], offset: Float[Tensor, "b k"]) -> "Prediction":
        """The prediction with another pose, and its velocity moved by what ``offset`` has beside the pose's part."""
        velocity = self.velocity + offset[:, 6:] if offset.shape[1] > 6 else self.velocity
        return Prediction(self.objects, T_cam_obj, self.usable, velocity, self.covariance)

    def poses_at(self, offsets: Float[Tensor, "n 6"]) -> Float[Tensor, "n 4 4"]:
        """Poses some way from the predicted ones: as many in turn of each object."""
        count = len(offsets)
        return retract_about(repeated(self.T_cam_obj, count), offsets, repeated(self.objects.centre_obj, count))

    def copies(self, numbers: Sequence[int], count: int = 1) -> "Prediction":
        """The predictions of some objects, each ``count`` times in turn and in a stream of its own."""
        T_cam_obj, usable, velocity, covariance = (
            copied_rows(value, numbers, count) for value in (self.T_cam_obj, self.usable, self.velocity, self.covariance)
        )
        return Prediction(self.objects.copies(numbers, count), T_cam_obj, usable, velocity, covariance)

    def exchanged(self, rows: Int[Tensor, "k"], other: "Prediction", taken: Bool[Tensor, "k"]) -> "Prediction":
        """The prediction with those of some objects, ``other``, in the place of their own, where that is ``taken``."""
        names = ("T_cam_obj", "velocity", "covariance")
        T_cam_obj, velocity, covariance = (put_rows(getattr(self, name), rows, getattr(other, name), taken) for name in names)
        return Prediction(self.objects, T_cam_obj, self.usable, velocity, covariance)

    @accelerable
    def sigma_px(self, contours: Contours) -> Float[Tensor, "b"]:
        """Standard deviation of the contours across themselves in the image (px), in the mean over them."""
        # Of the visible points, not of all places: how many there are depends on the other objects.
        chosen, mask = select_ranked(contours.mask, LOOKED_AT)
        points, normals = take_points(contours.points_cam, chosen), take_points(contours.normals, chosen)
        inverse_depth = points[..., 2].clamp(min=MIN_DEPTH_M).reciprocal()
        slope = normals * self.objects.intrinsics[:, None, :2] * inverse_depth[..., None]
        along = -(slope * points[..., :2]).sum(-1) * inverse_depth
        jacobian = pose_jacobian((points - self.centre_cam[:, None]).transpose(1, 2), (*slope.unbind(-1), along))
        variance = (jacobian * (self.covariance[:, :6, :6].to(jacobian.dtype) @ jacobian)).sum(1)
        return ((variance * mask).sum(-1) / mask.sum(-1).clamp(min=1)).sqrt()


def far_pose(centre_obj: Float[Tensor, "b 3"]) -> Float[Tensor, "b 4 4"]:
    """A pose of each object with its centre far before the camera."""
    poses = torch.eye(4, dtype=centre_obj.dtype).repeat(len(centre_obj), 1, 1)
    poses[:, :3, 3] = torch.tensor([0, 0, MAX_DEPTH_M], dtype=centre_obj.dtype) - centre_obj
    return poses


def before_camera(
    T_cam_obj: Float[Tensor, "b 4 4"], centre_obj: Float[Tensor, "b 3"], harmless: Float[Tensor, "b 4 4"]
) -> tuple[Float[Tensor, "b 4 4"], Bool[Tensor, "b"]]:
    """The poses with a harmless one in the place of those that are not finite or not before the camera, and which are."""
    depth = transform_points(T_cam_obj, centre_obj[:, None])[:, 0, 2]
    # A sum is finite only where every entry is.
    usable = (T_cam_obj.sum((1, 2)).abs() < torch.inf) & (depth > MIN_DEPTH_M) & (depth < MAX_DEPTH_M)
    return torch.where(usable[:, None, None], T_cam_obj, harmless), usable
