"""Contour points as lines: which of them follow each other along a contour.

The tracker's contours are points, as far apart as edges and faces of the mesh are; drawn one by one, those of a coarse mesh are scattered
dots. Each point is linked to the nearest one before and behind it along its tangent, where that is not across a gap.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

# So many neighbours are looked at.
_NEIGHBOURS = 12
# A link lies along the tangents of both its ends, within about 37 and 45 degrees.
_ALONG, _PARALLEL = 0.8, 0.7
# A link is at most so many times as long as the shorter one of its point; shorter ones than the first of these (px) are no gap, longer ones
# than the second are never drawn.
_GAP, _NO_GAP_PX, _LONGEST_PX = 4.0, 4.0, 80.0
# Closer points are one.
_SAME_PX = 1e-3


def contour_links(pixels: Float[np.ndarray, "m 2"], normals: Float[np.ndarray, "m 2"]) -> Int[np.ndarray, "l 2"]:
    """Pairs of points that follow each other along a contour, each pair once.

    Args:
        pixels: the points in the image.
        normals: unit normals of the contour there.
    """
    count = len(pixels)
    if count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    distance, neighbour = cKDTree(pixels).query(pixels, k=min(_NEIGHBOURS + 1, count), distance_upper_bound=_LONGEST_PX)
    is_near = np.isfinite(distance) & (distance > _SAME_PX)
    neighbour = np.where(is_near, neighbour, 0)
    tangents = np.stack([normals[:, 1], -normals[:, 0]], 1)
    along = ((pixels[neighbour] - pixels[:, None]) * tangents[:, None]).sum(-1)
    parallel = np.abs((tangents[neighbour] * tangents[:, None]).sum(-1)) >= _PARALLEL
    fits = is_near & parallel & (np.abs(along) >= _ALONG * np.where(is_near, distance, np.inf))
    links = _nearest_on_both_sides(np.where(fits, distance, np.inf), along > 0, neighbour)
    return np.unique(np.sort(links, axis=1), axis=0)


def _nearest_on_both_sides(distance: Float[np.ndarray, "m k"], ahead: np.ndarray, neighbour: np.ndarray) -> Int[np.ndarray, "l 2"]:
    """Each point with its nearest neighbours ahead and behind, without those across a gap."""
    sides = [np.where(side, distance, np.inf) for side in (ahead, ~ahead)]
    nearest = np.stack([side.min(1) for side in sides], 1)
    chosen = np.stack([np.take_along_axis(neighbour, side.argmin(1)[:, None], 1)[:, 0] for side in sides], 1)
    limit = np.maximum(_GAP * nearest.min(1, keepdims=True), _NO_GAP_PX)
    linked = np.isfinite(nearest) & (nearest <= limit)
    first = np.broadcast_to(np.arange(len(distance))[:, None], linked.shape)
    return np.stack([first[linked], chosen[linked]], 1)
