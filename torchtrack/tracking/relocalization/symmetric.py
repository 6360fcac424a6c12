"""Poses in which an object looks about the same: mirrored in depth.

Seen from afar, all points of a body may be mirrored in the plane through its middle that faces the camera, and none moves in the
image. Mirrored in its own plane of symmetry as well, the body is as it was, but rotated: both poses have the same outline, and
where they meet, as the body rotates, a tracker may follow either. Perspective, and what is seen within the outline, tell them apart.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from torchtrack.tracking.motion.prediction import Prediction

# Planes of symmetry of an object, at most.
MOST_PLANES = 3


@dataclass(frozen=True)
class SymmetryPlanes:
    """Planes of symmetry of each object, padded.

    Args:
        points_obj: a point that all planes of the object go through (m).
        normals_obj: their unit normals.
        counts: how many there are.
    """

    points_obj: Float[Tensor, "b 3"]
    normals_obj: Float[Tensor, "b k 3"]
    counts: tuple[int, ...]

    def mirrored(self, number: int, plane: int, prediction: Prediction) -> Prediction | None:
        """The ``prediction`` of the object ``number`` alone, mirrored in one of its planes; none where it has fewer."""
        if plane >= self.counts[number]:
            return None
        return mirrored(prediction, self.points_obj[number], self.normals_obj[number, plane])


@dataclass(frozen=True)
class Ambiguities:
    """In which other poses each object looks about the same.

    Args:
        planes: of symmetry.
        has_symmetry: objects with a plane.
    """

    planes: SymmetryPlanes
    has_symmetry: Bool[Tensor, "b"]


def mirrored(prediction: Prediction, point_obj: Float[Tensor, "3"], normal_obj: Float[Tensor, "3"]) -> Prediction:
    """The prediction, of a single object, in the pose of the same outline; it rotates as it has to for that to stay so.

    With the reflections ``D``, in the plane that faces the camera, and ``S``, in that of symmetry, it is ``R' = D R S``: a
    rotation. Rates, which are axial vectors, become ``-D ω``, and the middle goes on as it did.

    Args:
        point_obj, normal_obj: of the plane of symmetry.
    """
    T_cam_obj = prediction.T_cam_obj[0]
    rotation = T_cam_obj[:3, :3]
    middle_cam = rotation @ point_obj + T_cam_obj[:3, 3]
    in_depth = _reflection(normalize(middle_cam, dim=0))
    other = T_cam_obj.clone()
    other[:3, :3] = in_depth @ rotation @ _reflection(normal_obj)
    other[:3, 3] = middle_cam - other[:3, :3] @ point_obj
    change = torch.block_diag(-in_depth, torch.eye(3, dtype=in_depth.dtype, device=in_depth.device))
    of_both = torch.block_diag(change, change).to(prediction.covariance.dtype)
    covariance = of_both @ prediction.covariance @ of_both.T
    return Prediction(prediction.objects, other[None], prediction.usable, prediction.velocity @ change.T, covariance)


def _reflection(normal: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The reflection in a plane with a unit normal (Householder)."""
    return torch.eye(3, dtype=normal.dtype, device=normal.device) - 2 * normal[:, None] * normal
