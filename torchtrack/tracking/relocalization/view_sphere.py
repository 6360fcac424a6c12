"""The outlines of objects from all around: what contours of hundreds of poses are taken from, and moved to where these are."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.constants import constant
from torchtrack.core.padded import repeated, rows_in_all, select_ranked, take_points
from torchtrack.tracking.contours.points import Contours, assemble
from torchtrack.tracking.motion.prediction import Prediction

# So many views lie some fifteen degrees apart: contours of a smooth surface hardly wander farther over it between two of them.
_VIEWS = 200
# Contour points of an outline, at most.
_POINTS = 200
# Rotations about the line of sight have to begin somewhere: at this axis of the object, or the other one where it points along the line.
_UP, _OTHER_UP, _ALONG = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 0.9


def view_directions(count: int, device: torch.device | None = None) -> Float[Tensor, "v 3"]:
    """Unit vectors spread evenly over the sphere: a Fibonacci lattice (González, "Measurement of areas on a sphere", 2010)."""
    number = torch.arange(count, dtype=torch.float64, device=device) + 0.5
    z, angle = 1 - 2 * number / count, number * math.pi * (3 - 5**0.5)
    radius = (1 - z.square()).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)


def outlines_by_view(prediction: Prediction, T_cam_obj: Float[Tensor, "n 4 4"], config: TrackerConfig) -> Contours:
    """The contours of objects at each of some poses: those of the view from all around that is nearest to how it is seen there.

    Args:
        prediction: of the objects; views are taken from their depths.
        T_cam_obj: the poses, as many in turn of each object.
    """
    objects = prediction.objects
    towards = view_directions(_VIEWS, T_cam_obj.device).to(T_cam_obj.dtype)
    view = nearest_view(T_cam_obj, objects.centre_obj, towards)
    if host_sync.read_at_once(view):
        used, view = view.unique(return_inverse=True)
        towards = towards[used]
    outlines = outlines_from(prediction, towards, config)
    number = rows_in_all(view.unflatten(0, (len(objects.centre_obj), -1)), len(towards))
    return moved_to(outlines, number, T_cam_obj, objects.intrinsics)


def nearest_view(T_cam_obj: Float[Tensor, "n 4 4"], centre_obj: Float[Tensor, "k 3"], towards: Float[Tensor, "v 3"]) -> Int[Tensor, "n"]:
    """Which of some directions is nearest to the one that the camera is in, as the object at each pose has it."""
    camera_obj = -torch.bmm(T_cam_obj[:, :3, :3].transpose(1, 2), T_cam_obj[:, :3, 3:])[..., 0] - repeated(centre_obj, len(T_cam_obj))
    # The longer a vector, the larger its products, which changes nothing of which of them is the largest.
    return (camera_obj @ towards.T).argmax(1)


def thinned(contours: Contours) -> Contours:
    """Of each object's contour points as many as an outline has."""
    chosen, exists = select_ranked(contours.mask, _POINTS)
    kind, resolved = contours.kind.gather(1, chosen), contours.resolved.gather(1, chosen)
    points_obj, tangents_obj, points_cam, pixels, normals = (
        take_points(values, chosen) for values in (contours.points_obj, contours.tangents_obj, contours.points_cam, contours.pixels, contours.normals)
    )
    return Contours(points_obj, tangents_obj, kind, exists, points_cam, pixels, normals, resolved)


def outlines_at(prediction: Prediction, T_cam_obj: Float[Tensor, "n 4 4"], config: TrackerConfig) -> Contours:
    """The contours of objects as they are seen at each of some poses, as many in turn of each object."""
    objects = range(len(prediction.T_cam_obj))
    return thinned(prediction.objects.copies(objects, len(T_cam_obj) // len(objects)).contours(T_cam_obj, config.contours))


def rotations_from(towards: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3 3"]:
    """Rotations ``R_cam_obj`` of an object straight before the camera, which it sees from some directions."""
    up, other_up = (constant(axis, towards.dtype, towards.device) for axis in (_UP, _OTHER_UP))
    right = torch.linalg.cross(torch.where(towards[:, 2:].abs() < _ALONG, up, other_up), towards, dim=-1)
    right = torch.nn.functional.normalize(right, dim=-1)
    # The camera's axes, right, down and forward, as the object has them: a matrix that takes vectors to the camera.
    return torch.stack([right, torch.linalg.cross(right, towards, dim=-1), -towards], 1)


def outlines_from(prediction: Prediction, towards: Float[Tensor, "v 3"], config: TrackerConfig) -> Contours:
    """The outlines of objects straight before the camera, which it sees from some directions: all of each object in turn."""
    count = len(prediction.T_cam_obj) * len(towards)
    rotation = rotations_from(towards).repeat(len(prediction.T_cam_obj), 1, 1)
    ahead = torch.nn.functional.pad(repeated(prediction.centre_cam[:, 2:], count), (2, 0))
    translation = ahead - (rotation @ repeated(prediction.objects.centre_obj, count)[..., None])[..., 0]
    poses = torch.eye(4, dtype=towards.dtype, device=towards.device).repeat(count, 1, 1)
    poses[:, :3] = torch.cat([rotation, translation[..., None]], 2)
    return outlines_at(prediction, poses, config)


def moved_to(outlines: Contours, view: Int[Tensor, "n"], T_cam_obj: Float[Tensor, "n 4 4"], intrinsics: Float[Tensor, "k 4"]) -> Contours:
    """The contour points of a view each, seen from other poses."""
    of_views = (outlines.points_obj, outlines.tangents_obj, outlines.kind, outlines.mask)
    points, tangents, kind, mask = (values.index_select(0, view) for values in of_views)
    return assemble(points, tangents, kind, mask, T_cam_obj, repeated(intrinsics, len(view)))
