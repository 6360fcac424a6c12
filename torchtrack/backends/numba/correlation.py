"""The shifts of outlines that have most events on them, each added up: :func:`torchtrack.tracking.relocalization.correlation.highest`."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.relocalization import correlation
from torchtrack.tracking.relocalization.correlation import Square

# Cells that are added up together: a sum is then read and written once for all of them.
_TOGETHER = 4
# Columns of shifts that are added up at once.
_COLUMNS = 8


@kernel()
def highest(pixels: Array, mask: Array, middle: Array, cell_px: Array, denser: Array, allowed: Array, apart: int, best: Array, place: Array) -> None:
    """The highest fits of each outline, and the shifts that they are of.

    Args:
        pixels, mask: ``[n, m, 2]`` and ``[n, m]`` of the outlines.
        middle, cell_px: ``[2]`` and ``[1]`` of the square.
        denser: ``[2 h, 2 w]``, how much denser events are in each cell than around it, with what wraps around.
        allowed: ``[h, w]``, shifts that count.
        apart: how far around a shift others are lower (cells).
        best, place: ``[n, k]``; filled. ``best`` holds what is no shift at all when given.
    """
    side = len(allowed)
    rows, begins, ends = _extent(allowed)
    points, fit = np.zeros(2 * side * side, np.int64), np.zeros(allowed.shape, denser.dtype)
    cells, times = np.zeros(mask.shape[1] + _TOGETHER, np.int64), np.zeros(mask.shape[1] + _TOGETHER, denser.dtype)
    for n in range(len(mask)):
        used, total = _count(pixels[n], mask[n], middle, cell_px[0], side, points, cells)
        for k in range(used):
            times[k], points[cells[k]] = points[cells[k]] / total, 0
        # Up to a whole number of cells that are taken together: what counts for nothing.
        times[used : used + _TOGETHER] = 0
        _add_up(used, cells, times, denser.ravel(), rows, begins, ends, fit)
        place[n] = 0
        _peaks(fit, allowed, rows, begins, ends, apart, best[n], place[n])


@kernel()
def _extent(allowed: Array) -> tuple[tuple[int, int], Array, Array]:
    """The rows with anything allowed: the first one, and the one after the last; and of each row, the first column, and the one after the last."""
    begins, ends, first, last = np.full(len(allowed), len(allowed)), np.zeros(len(allowed), np.int64), len(allowed), 0
    for i in range(len(allowed)):
        for j in range(allowed.shape[1]):
            if allowed[i, j]:
                begins[i], ends[i], first, last = min(begins[i], j), j + 1, min(first, i), i + 1
    return (first, last), begins, ends


@kernel()
def _count(pixels: Array, mask: Array, middle: Array, cell_px: float, side: int, points: Array, cells: Array) -> tuple[int, int]:
    """Count the points of an outline in each cell; how many cells have any, first in ``cells``, and how many points these are.

    Rows of cells are twice as long as the square: cells are numbered as those of what wraps around.
    """
    used, total = 0, 0
    for i in range(len(mask)):
        u, v = np.rint((pixels[i, 0] - middle[0]) / cell_px + side // 2), np.rint((pixels[i, 1] - middle[1]) / cell_px + side // 2)
        # What is not a number is not inside.
        if mask[i] and u >= 0 and v >= 0 and u < side and v < side:
            cell = int(v) * 2 * side + int(u)
            if points[cell] == 0:
                cells[used] = cell
                used += 1
            points[cell] += 1
            total += 1
    return used, total


@kernel(fastmath=FAST)
def _add_up(used: int, cells: Array, times: Array, denser: Array, rows: tuple[int, int], begins: Array, ends: Array, fit: Array) -> None:
    """For each shift that may count, the sum over an outline's cells of how much denser events are there."""
    side = len(fit)
    for i in range(rows[0], rows[1]):
        # Whole groups of columns, as a processor takes them at once.
        count = min(max(-(-(ends[i] - begins[i]) // _COLUMNS) * _COLUMNS, 0), side)
        begin = min(begins[i], side - count)
        # The square lies in the middle of what wraps around, and a shift of none at all in the middle of the square.
        shift = i * 2 * side + begin
        into = fit[i, begin : begin + count]
        into[:] = 0.0
        for k in range(0, used, _TOGETHER):
            a, b, c, d = shift + cells[k], shift + cells[k + 1], shift + cells[k + 2], shift + cells[k + 3]
            first, second, third, fourth = denser[a : a + count], denser[b : b + count], denser[c : c + count], denser[d : d + count]
            times_a, times_b, times_c, times_d = times[k], times[k + 1], times[k + 2], times[k + 3]
            for j in range(count):
                into[j] += times_a * first[j] + times_b * second[j] + times_c * third[j] + times_d * fourth[j]


@kernel()
def _peaks(fit: Array, allowed: Array, rows: tuple[int, int], begins: Array, ends: Array, apart: int, best: Array, place: Array) -> None:
    """The highest peaks, the highest first: shifts than which none of those around is higher."""
    most = len(best) - 1
    for i in range(rows[0], rows[1]):
        for j in range(begins[i], ends[i]):
            # Hardly any is as high as the peaks that are known already.
            if fit[i, j] > best[most] and allowed[i, j] and _is_peak(fit, allowed, i, j, apart):
                rank = most
                while rank > 0 and fit[i, j] > best[rank - 1]:
                    best[rank], place[rank] = best[rank - 1], place[rank - 1]
                    rank -= 1
                best[rank], place[rank] = fit[i, j], i * fit.shape[1] + j


@kernel()
def _is_peak(fit: Array, allowed: Array, row: int, column: int, apart: int) -> bool:
    """Whether no shift that counts and is so close by is higher."""
    for i in range(max(row - apart, 0), min(row + apart + 1, fit.shape[0])):
        for j in range(max(column - apart, 0), min(column + apart + 1, fit.shape[1])):
            if fit[i, j] > fit[row, column] and allowed[i, j]:
                return False
    return np.isfinite(fit[row, column])


@accelerates(correlation.highest)
def highest_numba(
    denser: Float[Tensor, "h w"], pixels: Float[Tensor, "n m 2"], mask: Bool[Tensor, "n m"], square: Square, allowed: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Outline by outline, and cell by cell of each."""
    count = len(mask)
    best, place = denser.new_full((count, correlation.SHIFTS), correlation.NONE), torch.empty(count, correlation.SHIFTS, dtype=torch.int64)
    around = np.pad(denser.numpy(), correlation.SIDE // 2, mode="wrap")
    of_square = as_arrays(square.middle[0], square.cell_px)
    highest(*as_arrays(pixels, mask), *of_square, around, *as_arrays(allowed), correlation.APART, *as_arrays(best, place))
    return best, place
