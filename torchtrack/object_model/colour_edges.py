"""Edges of colour on a mesh without a texture image.

Colours of faces, or of vertices, change in two ways. Across a mesh edge whose two faces have colours of their own, the
change is a step, and the mesh edge is the contour. Where faces share their vertices' colours, the change is spread over
the faces between a dark and a bright vertex; if these are small, the contour runs through the middle of those faces.
"""

import numpy as np

from torchtrack.object_model.mesh_edges import EdgeTable, corners_at_ends
from torchtrack.object_model.surface import Surface
from torchtrack.object_model.surface_points import SurfacePoints, join_points, points_along

# A change that takes more than this fraction of the diameter is a shade, not an edge.
_WIDEST_FRACTION = 0.02


def colour_edges(surface: Surface, table: EdgeTable, contrast: float, spacing_m: float) -> SurfacePoints:
    """Points where the colour changes by at least ``contrast`` in log luminance, ``spacing_m`` apart."""
    return join_points([_steps(surface, table, contrast, spacing_m), _spread(surface, contrast, spacing_m)])


def _steps(surface: Surface, table: EdgeTable, contrast: float, spacing_m: float) -> SurfacePoints:
    """Points on mesh edges whose two faces differ in colour."""
    vertices, faces = table.vertices[table.paired], table.faces[table.paired]
    # [edge, face, end]: the luminance at both ends of the edge, as each of the two faces has it.
    luminance = surface.corner_luminance[faces[:, :, None], corners_at_ends(surface, vertices, faces)]
    brighter_by = (luminance[:, 1] - luminance[:, 0]).mean(1)
    normals = surface.normals[faces].sum(1)
    length = np.linalg.norm(normals, axis=1)
    # The two sides of a folded sheet have no mean normal; its fold is a crease anyway.
    strong = (np.abs(brighter_by) >= contrast) & (length > 1e-6)
    to_brighter = np.diff(surface.corners.mean(1)[faces], axis=1)[:, 0] * brighter_by[:, None]
    return points_along(surface.vertices[vertices[strong]], normals[strong] / length[strong, None], to_brighter[strong], spacing_m)


def _spread(surface: Surface, contrast: float, spacing_m: float) -> SurfacePoints:
    """Points inside small faces, between the middles of the two sides along which the colour changes most."""
    corners, luminance = surface.corners, surface.corner_luminance
    change = np.abs(luminance - np.roll(luminance, -1, 1))
    sides = np.linalg.norm(corners - np.roll(corners, -1, 1), axis=2)
    crossed = ((change >= contrast).sum(1) >= 2) & (sides.max(1) <= _WIDEST_FRACTION * surface.diameter)
    corners, luminance, change = corners[crossed], luminance[crossed], change[crossed]
    middles = (corners + np.roll(corners, -1, 1)) / 2
    strongest = np.argsort(-change, axis=1, kind="stable")[:, :2, None]
    darkest, brightest = (np.take_along_axis(corners, pick[:, None, None], 1)[:, 0] for pick in (luminance.argmin(1), luminance.argmax(1)))
    return points_along(np.take_along_axis(middles, strongest, 1), surface.normals[crossed], brightest - darkest, spacing_m)
