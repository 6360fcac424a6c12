"""The shifts at which outlines fit best: of :mod:`torchtrack.tracking.relocalization.correlation`, cell by cell."""

import numpy as np

from torchtrack.kernels.compiler import Array, kernel


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
