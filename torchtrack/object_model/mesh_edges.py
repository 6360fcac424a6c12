"""The mesh edges that can ever be a contour.

A contour of a closed surface runs along edges between a face that is turned to the camera and one that is turned away.
So an edge between two coplanar faces is never one, and neither is a hollow (concave) edge: where it separates front
from back, the back face hides it. Both are dropped, unless the edge is a crease, which shows by its shading.
"""

from dataclasses import dataclass

import numpy as np

from torchtrack.object_model.surface import Surface

# Faces bent by less than this are coplanar: the edge is a contour from almost nowhere, and its side of it is rounding.
_COPLANAR_RAD = 1e-3


@dataclass(frozen=True)
class EdgeTable:
    """Every edge of a surface, once.

    Attributes:
        vertices: ``[E, 2]`` vertex indices.
        faces: ``[E, 2]`` the two faces beside it; the second is -1 for a border, or where more than two faces meet.
        consistent: ``[E]`` the two faces run along the edge in opposite directions, as they do when both show the same side.
    """

    vertices: np.ndarray
    faces: np.ndarray
    consistent: np.ndarray

    @property
    def paired(self) -> np.ndarray:
        """``[E]`` true where exactly two faces meet."""
        return self.faces[:, 1] >= 0


def edge_table(surface: Surface) -> EdgeTable:
    """The edges of a surface with the faces beside them."""
    start, end = surface.faces.reshape(-1), np.roll(surface.faces, -1, 1).reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.argsort(low * len(surface.vertices) + high, kind="stable")
    low, high, forward, face = low[order], high[order], (start < end)[order], order // 3
    first = np.flatnonzero(np.r_[True, (low[1:] != low[:-1]) | (high[1:] != high[:-1])])
    count = np.diff(np.r_[first, len(low)])
    second = np.minimum(first + 1, len(low) - 1)
    pair = count == 2
    keep = ~_flat_overlap(surface.normals[face], first, count)
    table = EdgeTable(
        vertices=np.stack([low[first], high[first]], 1),
        faces=np.stack([face[first], np.where(pair, face[second], -1)], 1),
        consistent=~pair | (forward[first] != forward[second]),
    )
    return EdgeTable(table.vertices[keep], table.faces[keep], table.consistent[keep])


def corners_at_ends(surface: Surface, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which corner ``[e, 2 faces, 2 ends]`` of the faces ``[e, 2]`` lies at each end of the edges ``vertices [e, 2]``."""
    return (surface.faces[faces][:, :, None, :] == vertices[:, None, :, None]).argmax(-1)


def _flat_overlap(normals: np.ndarray, first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Edges inside a sheet that has faces on both sides: an even number, above two, of parallel faces."""
    reference = np.repeat(normals[first], count, axis=0)
    parallel = np.linalg.norm(np.cross(normals, reference), axis=1) < _COPLANAR_RAD
    return (count > 2) & (count % 2 == 0) & np.logical_and.reduceat(parallel, first)


@dataclass(frozen=True)
class MeshEdges:
    """Edges that can be a contour: ``points [E, 2, 3]``, ``normals [E, 2, 3]`` of the faces beside them, ``is_crease [E]``."""

    points: np.ndarray
    normals: np.ndarray
    is_crease: np.ndarray


def contour_edges(surface: Surface, table: EdgeTable, crease_angle_deg: float, drop_concave: bool) -> MeshEdges:
    """The edges of ``table`` that can be a contour or are a crease.

    A border gets the normals ``(n, -n)``: one side of it always faces the camera. ``drop_concave`` needs a surface whose
    normals are known to point outwards.
    """
    points = surface.vertices[table.vertices]
    normals = _side_normals(surface, table)
    sine = np.linalg.norm(np.cross(normals[:, 0], normals[:, 1]), axis=1)
    angle = np.arctan2(sine, (normals[:, 0] * normals[:, 1]).sum(1))
    is_crease = angle > np.deg2rad(crease_angle_deg)
    keep = is_crease | ((angle > _COPLANAR_RAD) & ~(drop_concave & _is_concave(surface, table, points[:, 0], normals)))
    return MeshEdges(points[keep], normals[keep], is_crease[keep])


def _side_normals(surface: Surface, table: EdgeTable) -> np.ndarray:
    """Normals ``[E, 2, 3]`` of the faces beside each edge, the second turned so that both show the same side."""
    normals = surface.normals
    first, second = normals[table.faces[:, 0]], normals[table.faces[:, 1]]
    second = np.where(table.paired[:, None], np.where(table.consistent[:, None], second, -second), -first)
    return np.stack([first, second], 1)


def _is_concave(surface: Surface, table: EdgeTable, on_edge: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Where each face lies in front of the other's plane."""
    to_centre = surface.corners.mean(1)[table.faces] - on_edge[:, None]
    return table.paired & ((to_centre * normals[:, ::-1]).sum((1, 2)) > 0)
