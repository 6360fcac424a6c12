"""What somebody clicked on: the line of sight of a click, and where it meets the image or the model."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from torchtrack.core.camera import Camera
from torchtrack.core.lie import se3_inverse, transform_points
from torchtrack.object_model import ObjectModel

# Of a model of lines, a click this near to one counts for it, of the diameter.
_NEAR_LINE = 0.05


@dataclass(frozen=True)
class Ray:
    """A line of sight in the camera's frame; the eye need not be the camera.

    Args:
        origin: of the eye (m).
        direction: away from it, of any length.
    """

    origin: Float[ndarray, "3"]
    direction: Float[ndarray, "3"]

    def in_object(self, T_cam_obj: Float[Tensor, "4 4"]) -> "Ray":
        """The same line in the frame of an object."""
        T_obj_cam = se3_inverse(T_cam_obj.double())
        origin = transform_points(T_obj_cam, torch.from_numpy(self.origin)[None])[0]
        return Ray(origin.numpy(), T_obj_cam[:3, :3].numpy() @ self.direction)


def clicked_pixel(ray: Ray, camera: Camera, depth_m: float) -> Float[ndarray, "2"] | None:
    """The ideal pixel that a click meets, where the image is shown at some depth before the camera; None beside the image."""
    if abs(ray.direction[2]) < 1e-9:
        return None
    along = (depth_m - ray.origin[2]) / ray.direction[2]
    point = ray.origin + along * ray.direction
    pixel = camera.matrix[:2, :2] @ point[:2] / depth_m + camera.matrix[:2, 2]
    inside = (pixel > -0.5).all() and (pixel < np.array([camera.width, camera.height]) - 0.5).all()
    return pixel if along > 0 and inside else None


def clicked_point(ray: Ray, model: ObjectModel) -> Float[ndarray, "3"] | None:
    """The point (m) of the model that a line of sight in the object's frame meets first; None where it goes past.

    Of a model of lines it is the point of a line that is nearest to the line of sight, if it is near.
    """
    if len(model.triangles):
        return _first_met(ray, model.triangles.double().numpy())
    return _nearest_on_lines(ray, model.segments.double().numpy(), _NEAR_LINE * model.diameter_m)


def _first_met(ray: Ray, triangles: Float[ndarray, "f 3 3"]) -> Float[ndarray, "3"] | None:
    """Möller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997."""
    corner, first, second = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(ray.direction, second)
    volume = (first * across).sum(1)
    scale = 1 / np.where(np.abs(volume) > 1e-15, volume, np.inf)
    arm = ray.origin - corner
    upright = np.cross(arm, first)
    u, v, along = (arm * across).sum(1) * scale, (ray.direction * upright).sum(1) * scale, (second * upright).sum(1) * scale
    met = (scale != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (along > 0)
    return ray.origin + along[met].min() * ray.direction if met.any() else None


def _nearest_on_lines(ray: Ray, segments: Float[ndarray, "l 2 3"], near_m: float) -> Float[ndarray, "3"] | None:
    towards = ray.direction / np.linalg.norm(ray.direction)
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    # Seen along the line of sight, it is a point and segments are segments of a plane.
    flat, offset = (values - (values @ towards)[:, None] * towards for values in (along, ray.origin - start))
    share = ((flat * offset).sum(1) / np.maximum((flat**2).sum(1), 1e-18)).clip(0, 1)
    points = start + share[:, None] * along
    arms = points - ray.origin
    distance = np.linalg.norm(arms - (arms @ towards)[:, None] * towards, axis=1)
    nearest = int(distance.argmin())
    return points[nearest] if distance[nearest] <= near_m else None
