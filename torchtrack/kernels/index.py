"""Making an index of nearest contour points: :func:`torchtrack.contour_index.index_contours`, point by point."""

import numpy as np

from torchtrack.kernels.compiler import Array, kernel
from torchtrack.kernels.settings import IndexSettings

_FAR = 2**31 - 1


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
def write(pixels: Array, is_inside: Array, radius_px: Array, first: Array, columns: int, settings: IndexSettings, nearest: Array) -> None:
    """Number of the point nearest to each cell, of those within the radius of its middle; -1 for none.

    Args:
        nearest: ``[b, p]``, filled.
    """
    steps = np.empty(nearest.shape[1], np.int32)
    nearest[:] = -1
    for b in range(len(pixels)):
        steps[:] = _FAR
        farthest = int(settings.distance_steps * radius_px[b] ** 2)
        # The cells that reach into the radius around a cell's middle.
        reach = radius_px[b] / settings.side_px + settings.half_diagonal
        for i in range(pixels.shape[1]):
            if is_inside[b, i]:
                _write_point(i, pixels[b, i, 0], pixels[b, i, 1], reach, farthest, first[b], columns, settings, steps, nearest[b])


@kernel()
def _write_point(
    number: int, u: float, v: float, reach: float, farthest: int, first: Array, columns: int, settings: IndexSettings, steps: Array, nearest: Array
) -> None:
    """Write one point into the cells around it that none is nearer to; of points as near, the first stays."""
    column, row = np.rint(u / settings.side_px), np.rint(v / settings.side_px)
    away_u, away_v = settings.side_px * column - u, settings.side_px * row - v
    middle = int(row - first[1]) * columns + int(column - first[0])
    for down in range(-int(reach), int(reach) + 1):
        width = int(np.sqrt(reach * reach - down * down))
        dv = away_v + settings.side_px * down
        for right in range(-width, width + 1):
            du = away_u + settings.side_px * right
            far, cell = int(settings.distance_steps * (du * du + dv * dv)), middle + down * columns + right
            if far <= farthest and far < steps[cell]:
                steps[cell], nearest[cell] = far, number
