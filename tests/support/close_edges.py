"""Shared by several tests: two_depths."""

from helpers import IMAGE_SIZE, contours_at, upright_line

from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.contours.points import joined


def two_depths(apart_px, kind=ContourKind.CREASE, depth_m=1.05):
    """Two upright lines, the second at another depth than the first, and a point whose depth makes the object 0.1 m deep."""
    far = upright_line(80.0 + apart_px, kind=kind)
    far.points_cam[..., 2] = depth_m
    corner = contours_at([[[20.0, 20.0]]], kind=kind)
    corner.points_cam[..., 2] = 1.1
    contours = joined(joined(upright_line(80.0, kind=kind), far), corner)
    return contours, index_contours(contours, IMAGE_SIZE, 8, 1)
