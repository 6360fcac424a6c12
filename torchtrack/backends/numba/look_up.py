"""Looking up the nearest contour point in an index: :meth:`torchtrack.tracking.contours.index.ContourIndex.look_up`, one place at a time."""

import numpy as np

from torchtrack.backends.numba.arrays import IndexArrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel

_NOWHERE = 1e30


@kernel()
def index_of(index: IndexArrays, b: int) -> IndexArrays:
    """The index of one object: ``nearest [p]``, and ``first [2]``."""
    nearest_of_cell, first, cells = index
    return IndexArrays(nearest_of_cell[b], first[b], cells)


@kernel(fastmath=FAST)
def nearest(index: IndexArrays, u: float, v: float) -> int:
    """The contour point that the cell around a place knows, by an object's index; -1 for none."""
    first, cells = index.first, index.cells
    half = 0.5 * cells.side_px + cells.aside_px
    column = np.floor((u + half) / cells.side_px) - first[0]
    row = np.floor((v + half) / cells.side_px) - first[1]
    # The region's border is empty: what lies outside finds nothing there, nor does what is not a number. No branch, of which a
    # processor would guess many wrong: twice as fast.
    column = min(column if column >= 0 else 0.0, cells.columns - 1.0)
    row = min(row if row >= 0 else 0.0, cells.rows - 1.0)
    return index.nearest[np.uint64(row) * np.uint64(cells.columns) + np.uint64(column)]


# Called for each observation: a twentieth of all rounds' time.
@kernel(fastmath=FAST, forceinline=True)
def nearest_of_four(index: IndexArrays, pixels: Array, u: float, v: float) -> int:
    """Of the contour points that the four cells around a place know, the one nearest to it; -1 for none.

    Args:
        pixels: ``[m, 2]``, the places of contour points when they were indexed.
    """
    first, cells = index.first, index.cells
    column = np.floor((u + cells.aside_px) / cells.side_px) - first[0]
    row = np.floor((v + cells.aside_px) / cells.side_px) - first[1]
    if not (column >= 0 and row >= 0 and column < cells.columns - 1 and row < cells.rows - 1):
        return -1
    begin = int(row) * cells.columns + int(column)
    best, least = -1, _NOWHERE
    for step in (0, 1, cells.columns, cells.columns + 1):
        known = index.nearest[begin + step]
        if known >= 0:
            du, dv = pixels[known, 0] - u, pixels[known, 1] - v
            away = du * du + dv * dv
            if away < least:
                best, least = known, away
    return best
