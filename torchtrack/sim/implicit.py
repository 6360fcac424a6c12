"""Closed surfaces from signed distance fields: where a field of numbers is zero.

The surface is found by naive surface nets (Gibson 1998, *Constrained elastic surface nets*) in the place of marching cubes:
one vertex per cell that the surface crosses, one quad per grid edge that it crosses. The triangles come out more even, and no
table of cases is needed. Every vertex is then pulled onto the surface by Newton steps along the field's gradient.
"""

from collections.abc import Callable

import numpy as np
import trimesh
from jaxtyping import Float, Int
from numpy import ndarray

Points = Float[ndarray, "*b 3"]
Field = Callable[[Points], Float[ndarray, "*b"]]
"""Signed distance of points from a surface, m; negative inside."""

# Corners of a cell in the order of their bits (x: 1, y: 2, z: 4).
_CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
_NEWTON_STEPS = 6
# Largest way of a vertex along each axis, in cells.
_WITHIN_CELL = 0.49


def sphere(centre: tuple[float, float, float], radius: float) -> Field:
    """A ball."""
    return lambda points: np.linalg.norm(points - np.array(centre), axis=-1) - radius


def capsule(start: tuple[float, float, float], end: tuple[float, float, float], radius: float, end_radius: float | None = None) -> Field:
    """A rod with round ends; its radius may run from one value to another."""
    base, axis = np.array(start), np.array(end) - np.array(start)
    change = (radius if end_radius is None else end_radius) - radius

    def distance(points: Points) -> Float[ndarray, "*b"]:
        along = np.clip((points - base) @ axis / (axis @ axis), 0, 1)
        return np.linalg.norm(points - base - along[..., None] * axis, axis=-1) - radius - change * along

    return distance


def ellipsoid(centre: tuple[float, float, float], radii: tuple[float, float, float]) -> Field:
    """An ellipsoid; the distance is that of first order (Quilez), which is exact on the surface."""

    def distance(points: Points) -> Float[ndarray, "*b"]:
        scaled = (points - np.array(centre)) / np.array(radii)
        length = np.linalg.norm(scaled, axis=-1)
        return length * (length - 1) / np.maximum(np.linalg.norm(scaled / np.array(radii), axis=-1), 1e-9)

    return distance


def rounded_cylinder(radius: float, bottom: float, top: float, rounding: float) -> Field:
    """A cylinder about the y axis between two heights, with rounded rims."""
    middle, half = 0.5 * (bottom + top), 0.5 * (top - bottom)

    def distance(points: Points) -> Float[ndarray, "*b"]:
        across = np.hypot(points[..., 0], points[..., 2]) - radius + rounding
        along = np.abs(points[..., 1] - middle) - half + rounding
        outside = np.hypot(np.maximum(across, 0), np.maximum(along, 0))
        return outside + np.minimum(np.maximum(across, along), 0) - rounding

    return distance


def ring(centre: tuple[float, float, float], radius: float, thickness: float) -> Field:
    """A torus about the z axis."""

    def distance(points: Points) -> Float[ndarray, "*b"]:
        local = points - np.array(centre)
        return np.hypot(np.hypot(local[..., 0], local[..., 1]) - radius, local[..., 2]) - thickness

    return distance


def union(*fields: Field, blend: float = 0.0) -> Field:
    """All of the fields, melted into one another over a length ``blend`` (polynomial smooth minimum, Quilez 2013)."""

    def distance(points: Points) -> Float[ndarray, "*b"]:
        total = fields[0](points)
        for field in fields[1:]:
            other = field(points)
            near = np.maximum(blend - np.abs(total - other), 0) / blend if blend else 0.0
            total = np.minimum(total, other) - near * near * blend / 4
        return total

    return distance


def without(field: Field, cut: Field, blend: float = 0.0) -> Field:
    """A field less another, with an edge rounded over ``blend``."""
    rest = union(lambda points: -field(points), cut, blend=blend)
    return lambda points: -rest(points)


def surface(field: Field, low: tuple[float, float, float], high: tuple[float, float, float], cell_m: float) -> trimesh.Trimesh:
    """The zero surface of a field within a box that it does not touch.

    Args:
        field: signed distance, m.
        low, high: corners of the box, m.
        cell_m: edge of a grid cell; triangles are about this large.
    """
    axes = [np.arange(start - cell_m, end + 2 * cell_m, cell_m) for start, end in zip(low, high, strict=True)]
    values = field(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    inside = values < 0
    number = np.full([n - 1 for n in values.shape], -1)
    crossed = _crossed_cells(inside)
    number[tuple(crossed.T)] = np.arange(len(crossed))
    vertices = _on_surface(field, np.array([axis[0] for axis in axes]) + cell_m * (crossed + 0.5), cell_m)
    return trimesh.Trimesh(vertices, _quads(inside, number), process=False)


def _crossed_cells(inside: ndarray) -> Int[ndarray, "n 3"]:
    """Cells with corners on both sides."""
    shape = [n - 1 for n in inside.shape]
    count = sum(inside[x : x + shape[0], y : y + shape[1], z : z + shape[2]].astype(int) for x, y, z in _CORNERS)
    return np.argwhere((count > 0) & (count < 8))


def _on_surface(field: Field, points: Float[ndarray, "n 3"], cell_m: float) -> Float[ndarray, "n 3"]:
    """Points, first in the middle of their cells, moved along the field's gradient to where it is zero."""
    start, step = points, 1e-3 * cell_m
    for _ in range(_NEWTON_STEPS):
        offsets = step * np.eye(3)
        gradient = np.stack([field(points + offset) - field(points - offset) for offset in offsets], -1) / (2 * step)
        points = points - field(points)[:, None] * gradient / np.maximum((gradient**2).sum(-1, keepdims=True), 1e-3)
        # Every vertex stays in its cell, so that no two meet.
        points = start + np.clip(points - start, -_WITHIN_CELL * cell_m, _WITHIN_CELL * cell_m)
    return points


def _quads(inside: ndarray, number: Int[ndarray, "x y z"]) -> Int[ndarray, "f 3"]:
    """Two triangles around every grid edge that the surface crosses, wound outwards."""
    faces = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        starts = np.argwhere(np.take(inside, range(inside.shape[axis] - 1), axis) != np.take(inside, range(1, inside.shape[axis]), axis))
        is_inside = inside[tuple(starts.T)]
        a, b = np.eye(3, dtype=int)[first], np.eye(3, dtype=int)[second]
        around = np.stack([number[tuple((starts - shift).T)] for shift in (a + b, b, np.zeros(3, int), a)], 1)
        # The four cells go round the edge counterclockwise, seen against it; that is outwards where its start is inside.
        around = np.where(is_inside[:, None], around, around[:, ::-1])
        faces += [around[:, [0, 1, 2]], around[:, [0, 2, 3]]]
    return np.concatenate(faces)
