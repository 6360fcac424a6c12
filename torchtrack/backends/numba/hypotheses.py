"""Where contour points have most events along their normals, and peaks of correlations, point by point and cell by cell.

References are :mod:`torchtrack.tracking.relocalization.edge_search` and :mod:`torchtrack.tracking.relocalization.correlation`.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.outlines import at
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization import correlation, edge_search
from torchtrack.tracking.relocalization.event_image import BORDER_PX


@kernel(fastmath=FAST)
def look_along_normals(
    pixels: Array, normals: Array, mask: Array, image: Array, border_px: int, reach_px: float, looks: int, targets: Array, weights: Array
) -> None:
    """The place with most events along the normal of each contour point, rather near by, and how much that counts.

    Args:
        pixels, normals, mask: ``[k, 2, m]`` and ``[k, m]``.
        image: ``[h, w]``, with a border of ``border_px``.
        reach_px: how far each looks, at so many ``looks``.
        targets, weights: ``[k, m, 2]`` and ``[k, m]``, filled.
    """
    flat, height, width = image.ravel(), float(image.shape[0]), float(image.shape[1])
    step_px = np.linspace(-reach_px, reach_px, looks)
    near = 1.0 - np.abs(step_px) / (reach_px + 1.0)
    for k in range(len(mask)):
        for i in range(mask.shape[1]):
            u, v, nu, nv = pixels[k, 0, i], pixels[k, 1, i], normals[k, 0, i], normals[k, 1, i]
            most, place = 0.0, 0
            if mask[k, i]:
                for j in range(looks):
                    there = at(flat, width, height, u + step_px[j] * nu, v + step_px[j] * nv, border_px) * near[j]
                    place = j if there > most else place
                    most = max(there, most)
            targets[k, i, 0], targets[k, i, 1], weights[k, i] = u + step_px[place] * nu, v + step_px[place] * nv, most


@kernel()
def peaks(fit: Array, allowed: Array, apart: int, best: Array, place: Array) -> None:
    """The highest peaks of each map, the highest first; a peak is a cell than which none of those around it is higher.

    Args:
        fit: ``[n, h, w]``.
        allowed: ``[h, w]``, cells that count.
        apart: how far around a peak cells are lower (cells).
        best, place: ``[n, k]`` of the peaks, and which cells they are; filled. ``best`` holds what is no peak at all when given.
    """
    most = best.shape[1] - 1
    for n in range(len(fit)):
        place[n] = 0
        for i in range(fit.shape[1]):
            for j in range(fit.shape[2]):
                # Hardly any cell is as high as the peaks that are known already.
                if fit[n, i, j] > best[n, most] and allowed[i, j] and _is_peak(fit[n], allowed, i, j, apart):
                    rank = most
                    while rank > 0 and fit[n, i, j] > best[n, rank - 1]:
                        best[n, rank], place[n, rank] = best[n, rank - 1], place[n, rank - 1]
                        rank -= 1
                    best[n, rank], place[n, rank] = fit[n, i, j], i * fit.shape[2] + j


@kernel()
def _is_peak(fit: Array, allowed: Array, row: int, column: int, apart: int) -> bool:
    """Whether no cell that counts and is so close by is higher."""
    for i in range(max(row - apart, 0), min(row + apart + 1, fit.shape[0])):
        for j in range(max(column - apart, 0), min(column + apart + 1, fit.shape[1])):
            if fit[i, j] > fit[row, column] and allowed[i, j]:
                return False
    return np.isfinite(fit[row, column])


@accelerates(correlation.peaks)
def peaks_numba(fit: Float[Tensor, "n h w"], allowed: Bool[Tensor, "h w"]) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Cell by cell."""
    best, place = fit.new_full((len(fit), correlation.SHIFTS), correlation.NONE), torch.empty(len(fit), correlation.SHIFTS, dtype=torch.int64)
    peaks(*as_arrays(fit, allowed), correlation.APART, *as_arrays(best, place))
    return best, place


@accelerates(edge_search.strongest_along_normals)
def strongest_along_normals_numba(
    outlines: Contours, image: Float[Tensor, "h w"], reach_px: float
) -> tuple[Float[Tensor, "k m 2"], Float[Tensor, "k m"]]:
    """Point by point."""
    targets, weights = image.new_empty(*outlines.mask.shape, 2), image.new_empty(outlines.mask.shape)
    points = as_arrays(outlines.pixels.transpose(1, 2), outlines.normals.transpose(1, 2), outlines.mask)
    look_along_normals(*points, *as_arrays(image), BORDER_PX, reach_px, edge_search.LOOKS, *as_arrays(targets, weights))
    return targets, weights
