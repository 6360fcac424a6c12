"""Making an index of nearest contour points: :func:`torchtrack.tracking.contours.index.index_contours`, point by point."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.parameters import IndexSettings
from torchtrack.core import host_sync
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours.index import DISTANCE_STEPS, FAR_CELLS, HALF_DIAGONAL, ContourIndex, index_contours, radii, reach
from torchtrack.tracking.contours.points import Contours


class _Region(NamedTuple):
    """Where regions begin, ``[b, 2]`` (column, row), and how many columns each has."""

    first: Array
    columns: int


class _Room(NamedTuple):
    """Where cells are written: parts of squared distances along a row, the least in each cell, and the number of the point that it is of."""

    across: Array
    steps: Array
    number: Array


@kernel()
def extents(pixels: Array, mask: Array, radius_px: Array, settings: IndexSettings, is_inside: Array, first: Array) -> tuple[int, int]:
    """Rows and columns of regions that hold all objects' contour points, with a margin around them.

    Args:
        pixels, mask: ``[b, m, 2]`` and ``[b, m]``.
        radius_px: ``[b]``, how far contours are to be found.
        is_inside: ``[b, m]``, which points are in the image or as near to it; filled.
        first: ``[b, 2]``, the first cell (column, row) of each region; filled.
    """
    rows, columns = 0, 0
    for b in range(len(pixels)):
        low_u = low_v = np.inf
        high_u = high_v = -np.inf
        for i in range(pixels.shape[1]):
            u, v = pixels[b, i, 0], pixels[b, i, 1]
            inside = (
                mask[b, i]
                and abs(u - settings.middle_u) < settings.middle_u + radius_px[b]
                and abs(v - settings.middle_v) < settings.middle_v + radius_px[b]
            )
            is_inside[b, i] = inside
            if inside:
                column, row = np.rint(u / settings.side_px), np.rint(v / settings.side_px)
                low_u, low_v, high_u, high_v = min(low_u, column), min(low_v, row), max(high_u, column), max(high_v, row)
        if high_u < low_u:
            low_u = low_v = high_u = high_v = settings.far_cells
        first[b, 0], first[b, 1] = low_u - settings.margin, low_v - settings.margin
        rows, columns = max(rows, int(high_v - low_v)), max(columns, int(high_u - low_u))
    return rows + 2 * settings.margin + 1, columns + 2 * settings.margin + 1


@kernel()
def write(pixels: Array, is_inside: Array, radius_px: Array, region: _Region, settings: IndexSettings, nearest: Array) -> None:
    """Number of the point nearest to each cell, of those within the radius of its middle; -1 for none.

    Args:
        nearest: ``[b, p]``, filled.
    """
    (firsts, columns), cells = region, nearest.shape[1]
    steps, number = np.empty(cells, np.float32), np.empty(cells, np.int32)
    for b in range(len(pixels)):
        # Of an object that nothing is known of, this is no number to go by.
        if radius_px[b] < 0:
            nearest[b] = -1
            continue
        steps[:] = np.inf
        farthest = np.floor(settings.distance_steps * radius_px[b] ** 2)
        # A square of cells that may lie within the radius: what is farther is no match.
        reach = int(radius_px[b] / settings.side_px + settings.half_diagonal)
        of_object, room = _Region(firsts[b], columns), _Room(np.empty(2 * reach + 1, np.float32), steps, number)
        for i in range(pixels.shape[1]):
            if is_inside[b, i]:
                _write_point(np.int32(i), pixels[b, i, 0], pixels[b, i, 1], of_object, settings, room)
        for cell in range(cells):
            nearest[b, cell] = number[cell] if steps[cell] <= farthest else -1


@kernel(fastmath=FAST)
def _write_point(own: int, u: float, v: float, region: _Region, settings: IndexSettings, room: _Room) -> None:
    """Write one point into the cells around it that none is nearer to; of points as near, the first stays."""
    (first, columns), (across, steps, number) = region, room
    reach = len(across) // 2
    column, row = np.rint(u / settings.side_px), np.rint(v / settings.side_px)
    away_u, away_v = settings.side_px * column - u, settings.side_px * row - v
    for k in range(len(across)):
        across[k] = settings.distance_steps * (away_u + settings.side_px * (k - reach)) ** 2
    # Unsigned, an index needs no look whether it is negative: eight times faster.
    begin = np.uint64((row - first[1] - reach) * columns + (column - first[0]) - reach)
    for down in range(-reach, reach + 1):
        along = np.float32(settings.distance_steps * (away_v + settings.side_px * down) ** 2)
        for k in range(np.uint64(len(across))):
            cell, far = begin + k, np.floor(across[k] + along)
            is_nearer = far < steps[cell]
            number[cell] = own if is_nearer else number[cell]
            steps[cell] = far if is_nearer else steps[cell]
        begin += np.uint64(columns)


@accelerates(index_contours)
def index_contours_numba(
    contours: Contours, image_size: tuple[int, int], radius_px: int | Int[Tensor, "b"] | host_sync.AsyncValue, cell_px: int
) -> ContourIndex:
    """Point by point."""
    answer = radii(radius_px, contours)
    margin = reach(max([0, *answer.numbers()]), cell_px) + 2
    middle = 0.5 * (image_size[1] - 1), 0.5 * (image_size[0] - 1)
    settings = IndexSettings(*middle, float(cell_px), margin, DISTANCE_STEPS, HALF_DIAGONAL, FAR_CELLS)
    pixels, mask, radius = as_arrays(contours.pixels, contours.mask, answer.on_device)
    first, is_inside = contours.pixels.new_empty(len(pixels), 2), np.empty_like(mask)
    rows, columns = extents(pixels, mask, radius, settings, is_inside, first.numpy())
    # Narrow numbers: half as much of the memory that a processor has near.
    nearest = torch.empty(len(pixels), rows * columns, dtype=torch.int32)
    write(pixels, is_inside, radius, (first.numpy(), columns), settings, nearest.numpy())
    return ContourIndex(first, (rows, columns), cell_px, nearest, contours.pixels, answer)
