"""The shifts of outlines that have most events on them, each added up: :func:`torchtrack.tracking.relocalization.correlation.highest`."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.relocalization import correlation

# Cells that are added up together: a sum is then read and written once for all of them.
_TOGETHER = 4
# Columns of shifts that are added up at once.
_COLUMNS = 8


class Outlines(NamedTuple):
    """Points of outlines: pixels ``[n, m, 2]``, and which exist, ``[n, m]``."""

    pixels: Array
    mask: Array


class Square(NamedTuple):
    """The square that shifts are looked for in: its middle (px), the side of a cell (px), and how many cells it has a side."""

    middle_u: float
    middle_v: float
    cell_px: float
    side: int


class Peaks(NamedTuple):
    """The highest fits of each outline, and numbers of the shifts that they are of: ``[n, k]``; or of one."""

    best: Array
    place: Array


class Allowed(NamedTuple):
    """Shifts that count: ``[h, w]``; the rows with any, from the first one to the one before the last; and so of each row its columns."""

    shifts: Array
    rows: tuple[int, int]
    begins: Array
    ends: Array


class FilledCells(NamedTuple):
    """The cells of the square that an outline has points in, first of many, and the share of its points in each."""

    numbers: Array
    shares: Array


@kernel()
def highest(outlines: Outlines, square: Square, denser: Array, shifts: Array, apart: int, peaks: Peaks) -> None:
    """The highest fits of each outline, and the shifts that they are of.

    Args:
        denser: ``[2 h, 2 w]``, how much denser events are in each cell than around it, with what wraps around.
        shifts: ``[h, w]``, those that count.
        apart: how far around a shift others are lower (cells).
        peaks: filled; they hold what is no shift at all when given.
    """
    (pixels, mask), peaks, square, allowed = outlines, Peaks(*peaks), Square(*square), _extent(shifts)
    points, fit = np.zeros(2 * square.side**2, np.int64), np.zeros(shifts.shape, denser.dtype)
    cells = FilledCells(np.zeros(mask.shape[1] + _TOGETHER, np.int64), np.zeros(mask.shape[1] + _TOGETHER, denser.dtype))
    for n in range(len(mask)):
        used, total = _count(pixels[n], mask[n], square, points, cells.numbers)
        for k in range(used):
            cells.shares[k], points[cells.numbers[k]] = points[cells.numbers[k]] / total, 0
        # Up to a whole number of cells that are taken together: what counts for nothing.
        cells.shares[used : used + _TOGETHER] = 0
        _add_up(used, cells, denser.ravel(), allowed, fit)
        peaks.place[n] = 0
        _find_peaks(fit, allowed, apart, Peaks(peaks.best[n], peaks.place[n]))


@kernel()
def _extent(shifts: Array) -> Allowed:
    """Where shifts count."""
    begins, ends, first, last = np.full(len(shifts), len(shifts)), np.zeros(len(shifts), np.int64), len(shifts), 0
    for i in range(len(shifts)):
        for j in range(shifts.shape[1]):
            if shifts[i, j]:
                begins[i], ends[i], first, last = min(begins[i], j), j + 1, min(first, i), i + 1
    return Allowed(shifts, (first, last), begins, ends)


@kernel()
def _count(pixels: Array, mask: Array, square: Square, points: Array, cells: Array) -> tuple[int, int]:
    """Count the points of an outline in each cell; how many cells have any, first in ``cells``, and how many points these are.

    Rows of cells are twice as long as the square: cells are numbered as those of what wraps around.
    """
    middle_u, middle_v, cell_px, side = square
    used, total = 0, 0
    for i in range(len(mask)):
        u, v = np.rint((pixels[i, 0] - middle_u) / cell_px + side // 2), np.rint((pixels[i, 1] - middle_v) / cell_px + side // 2)
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
def _add_up(used: int, cells: FilledCells, denser: Array, allowed: Allowed, fit: Array) -> None:
    """For each shift that may count, the sum over an outline's cells of how much denser events are there."""
    side, (numbers, shares), begins, ends = len(fit), cells, allowed.begins, allowed.ends
    for i in range(allowed.rows[0], allowed.rows[1]):
        # Whole groups of columns, as a processor takes them at once.
        count = min(max(-(-(ends[i] - begins[i]) // _COLUMNS) * _COLUMNS, 0), side)
        begin = min(begins[i], side - count)
        # The square lies in the middle of what wraps around, and a shift of none at all in the middle of the square.
        shift = i * 2 * side + begin
        into = fit[i, begin : begin + count]
        into[:] = 0.0
        for k in range(0, used, _TOGETHER):
            a, b, c, d = shift + numbers[k], shift + numbers[k + 1], shift + numbers[k + 2], shift + numbers[k + 3]
            first, second, third, fourth = denser[a : a + count], denser[b : b + count], denser[c : c + count], denser[d : d + count]
            of_first, of_second, of_third, of_fourth = shares[k], shares[k + 1], shares[k + 2], shares[k + 3]
            for j in range(count):
                into[j] += of_first * first[j] + of_second * second[j] + of_third * third[j] + of_fourth * fourth[j]


@kernel()
def _find_peaks(fit: Array, allowed: Allowed, apart: int, peaks: Peaks) -> None:
    """The highest peaks of an outline, the highest first: shifts than which none of those around is higher."""
    (best, place), shifts, most = peaks, allowed.shifts, len(peaks.best) - 1
    for i in range(allowed.rows[0], allowed.rows[1]):
        for j in range(allowed.begins[i], allowed.ends[i]):
            # Hardly any is as high as the peaks that are known already.
            if fit[i, j] > best[most] and shifts[i, j] and _is_peak(fit, shifts, i, j, apart):
                rank = most
                while rank > 0 and fit[i, j] > best[rank - 1]:
                    best[rank], place[rank] = best[rank - 1], place[rank - 1]
                    rank -= 1
                best[rank], place[rank] = fit[i, j], i * fit.shape[1] + j


@kernel()
def _is_peak(fit: Array, shifts: Array, row: int, column: int, apart: int) -> bool:
    """Whether no shift that counts and is so close by is higher."""
    for i in range(max(row - apart, 0), min(row + apart + 1, fit.shape[0])):
        for j in range(max(column - apart, 0), min(column + apart + 1, fit.shape[1])):
            if fit[i, j] > fit[row, column] and shifts[i, j]:
                return False
    return np.isfinite(fit[row, column])


@accelerates(correlation.highest)
def highest_numba(
    denser: Float[Tensor, "h w"], pixels: Float[Tensor, "n m 2"], mask: Bool[Tensor, "n m"], square: correlation.Square, allowed: Bool[Tensor, "h w"]
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Outline by outline, and cell by cell of each."""
    count = len(mask)
    best, place = denser.new_full((count, correlation.SHIFTS), correlation.NONE), torch.empty(count, correlation.SHIFTS, dtype=torch.int64)
    around = np.pad(denser.numpy(), correlation.SIDE // 2, mode="wrap")
    (middle_u, middle_v), (cell_px,) = square.middle[0].numpy(), square.cell_px.numpy()
    of_square = middle_u, middle_v, cell_px, len(allowed)
    highest(as_arrays(pixels, mask), of_square, around, *as_arrays(allowed), correlation.APART, as_arrays(best, place))
    return best, place
