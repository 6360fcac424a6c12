"""Points on the edges of a texture or of colours, and how they are spread evenly."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from torchtrack.errors import ModelError

# Neighbours whose tangents differ by more than 60 degrees, or whose dark sides are opposite, lie on different edges.
_SAME_EDGE_COSINE = 0.5
# A model whose print has more points has far more area than an object of its size: they would fill the memory.
MOST_POINTS = 4_000_000


def check_point_count(count: int, most: int) -> None:
    """Refuse a print that cannot be of an object.

    Raises:
        ModelError: if there are more points than ``most``.
    """
    if count > most:
        raise ModelError(
            f"edges of the print would have about {count:,} points, expected at most {most:,}: the model has very many large faces one over another, "
            "or is damaged. Simplify it in a mesh editor, or set max_texture_points: 0."
        )


@dataclass(frozen=True)
class SurfacePoints:
    """Points on edges of brightness; the brighter side of each lies along ``cross(normal, tangent)``.

    Attributes:
        points: ``[n, 3]`` metres.
        tangents: ``[n, 3]`` unit, along the edge.
        normals: ``[n, 3]`` unit, outwards.
        length_m: length of all the edges together.
    """

    points: np.ndarray
    tangents: np.ndarray
    normals: np.ndarray
    length_m: float


NO_POINTS = SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), 0.0)


def oriented_points(points: np.ndarray, tangents: np.ndarray, normals: np.ndarray, to_brighter: np.ndarray, length_m: float) -> SurfacePoints:
    """Points whose tangents (of any length and sign) are made unit, and turned so that the brighter side is to their left."""
    wrong = (np.cross(normals, tangents) * to_brighter).sum(1) < 0
    tangents = np.where(wrong[:, None], -tangents, tangents)
    return SurfacePoints(points, tangents / np.linalg.norm(tangents, axis=1, keepdims=True), normals, length_m)


def points_along(segments: np.ndarray, normals: np.ndarray, to_brighter: np.ndarray, spacing_m: float) -> SurfacePoints:
    """Points on segments ``[n, 2, 3]``, at most ``spacing_m`` apart and at least one on each."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(along, axis=1)
    count = np.ceil(length / spacing_m).astype(np.int64).clip(min=1)
    check_point_count(int(count.sum()), MOST_POINTS)
    segment = np.repeat(np.arange(len(segments)), count)
    fraction = (np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[segment]
    return oriented_points(
        start[segment] + fraction[:, None] * along[segment], along[segment], normals[segment], to_brighter[segment], float(length.sum())
    )


def join_points(sets: Sequence[SurfacePoints]) -> SurfacePoints:
    """All points of several sets; of none, no points."""
    sets = [NO_POINTS, *sets]
    points, tangents, normals = (np.concatenate([getattr(s, field) for s in sets]) for field in ("points", "tangents", "normals"))
    return SurfacePoints(points, tangents, normals, sum(s.length_m for s in sets))


def thin_out(dense: SurfacePoints, spacing_m: float, max_points: int) -> SurfacePoints:
    """Points of the same edge kept ``spacing_m`` apart, or further where more than ``max_points`` would be left.

    Points are taken in their order, each removing those of its edge that are too near.
    """
    if len(dense.points) == 0 or max_points == 0:
        return _pick(dense, np.zeros(0, dtype=np.int64))
    kept = _keep_apart(dense, max(spacing_m, dense.length_m / max_points))
    if len(kept) > max_points:
        kept = kept[np.linspace(0, len(kept) - 1, max_points).round().astype(np.int64)]
    return _pick(dense, kept)


def _pick(dense: SurfacePoints, kept: np.ndarray) -> SurfacePoints:
    return SurfacePoints(dense.points[kept], dense.tangents[kept], dense.normals[kept], dense.length_m)


def _keep_apart(dense: SurfacePoints, spacing_m: float) -> np.ndarray:
    """Indices of points no two of which, on the same edge, are nearer than ``spacing_m``."""
    tree, alive = cKDTree(dense.points), np.ones(len(dense.points), dtype=bool)
    # Neighbours of the points that are kept alone: of a fine texture, the pairs of all points would not fit into memory.
    for point in range(len(dense.points)):
        if alive[point]:
            near = np.array(tree.query_ball_point(dense.points[point], spacing_m))
            near = near[near > point]
            alike = dense.tangents[near] @ dense.tangents[point] > _SAME_EDGE_COSINE
            alike &= dense.normals[near] @ dense.normals[point] > _SAME_EDGE_COSINE
            alive[near[alike]] = False
    return np.flatnonzero(alive)
