"""The table of what observations take from contour points: :meth:`torchtrack.matching.ContourTable.of`, point by point."""

import numpy as np

from torchtrack.kernels.compiler import Array, kernel
from torchtrack.kernels.look_up import nearest
from torchtrack.kernels.matching import COLUMNS, EXPECTED, INDEXED_U, INDEXED_V, LIMB, MISTAKEN, NORMAL_U, NORMAL_V, ORIENTED, X, Y, Z
from torchtrack.kernels.quality import octant
from torchtrack.kernels.settings import Cells, TableSettings

__all__ = ["COLUMNS", "fill"]


@kernel()
def fill(
    points_obj: Array,
    pixels: Array,
    normals: Array,
    kind: Array,
    mask: Array,
    indexed: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    polarity: Array,
    settings: TableSettings,
    table: Array,
) -> None:
    """Fill ``table [b, m, COLUMNS]``, with zeros for points that do not count.

    Args:
        points_obj, pixels, normals, kind, mask: of contours; ``pixels`` and ``normals`` as ``[b, 2, m]``, ``points_obj`` as ``[b, 3, m]``.
        indexed: ``[b, 2, m]``, pixels when indexed.
        polarity: ``[b, 8]``, expected by octant; ``[b, 0]`` where nothing is.
    """
    table[:] = 0.0
    for b in range(len(table)):
        for i in range(table.shape[1]):
            if not mask[b, i]:
                continue
            row = table[b, i]
            row[X], row[Y], row[Z] = points_obj[b, 0, i], points_obj[b, 1, i], points_obj[b, 2, i]
            row[NORMAL_U], row[NORMAL_V] = normals[b, 0, i], normals[b, 1, i]
            row[INDEXED_U], row[INDEXED_V] = indexed[b, 0, i], indexed[b, 1, i]
            is_limb = kind[b, i] == settings.limb
            is_oriented = is_limb or kind[b, i] == settings.crease
            row[LIMB], row[ORIENTED] = is_limb, is_oriented
            row[EXPECTED] = settings.of_print and kind[b, i] == settings.texture
            if is_oriented and polarity.shape[1]:
                row[EXPECTED] = polarity[b, octant(normals[b, 0, i], normals[b, 1, i])]
            if settings.close_px and is_oriented:
                row[MISTAKEN] = _mistaken_px2(i, pixels[b], normals[b], kind[b], mask[b], nearest_of_cell[b], first[b], cells, settings)


@kernel()
def _mistaken_px2(
    i: int, pixels: Array, normals: Array, kind: Array, mask: Array, nearest_of_cell: Array, first: Array, cells: Cells, settings: TableSettings
) -> float:
    """How far off what is seen on a point is, should it be of the edge beside: :func:`torchtrack.common_error.mistaken_px2`."""
    most = 0.0
    u, v, nu, nv = pixels[0, i], pixels[1, i], normals[0, i], normals[1, i]
    for side_px in (-settings.aside_px, settings.aside_px):
        other = nearest(nearest_of_cell, first, u + side_px * nu, v + side_px * nv, cells)
        if other < 0 or not mask[other] or not (kind[other] == settings.limb or kind[other] == settings.crease):
            continue
        apart_px = (pixels[0, other] - u) * nu + (pixels[1, other] - v) * nv
        is_parallel = abs(normals[0, other] * nu + normals[1, other] * nv) > settings.parallel
        if is_parallel and apart_px * side_px > settings.apart_px * settings.aside_px:
            squared = apart_px * apart_px
            most = max(most, 0.5 * squared * np.exp(-squared / settings.close_px**2))
    return most
