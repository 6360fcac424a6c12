"""The table of what observations take from contour points: :meth:`torchtrack.tracking.association.nearest.contour_table`, point by point."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.backends.numba.index import cells_of
from torchtrack.backends.numba.look_up import nearest
from torchtrack.backends.numba.matching import COLUMNS, EDGE_AMBIGUITY, EXPECTED, INDEXED_U, INDEXED_V, NORMAL_U, NORMAL_V, ORIENTED, SMOOTH, X, Y, Z
from torchtrack.backends.numba.measures import octant
from torchtrack.backends.numba.parameters import Cells, TableSettings, filled
from torchtrack.core.dispatch import accelerates
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association import nearest as nearest_contours
from torchtrack.tracking.association import weights
from torchtrack.tracking.association.nearest import ContourTable
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours

__all__ = ["COLUMNS", "fill"]


@kernel()
def fill(
    points_obj: Array,
    depth_m: Array,
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
    not_plain: Array,
) -> None:
    """Fill ``table [b, m, COLUMNS]``, with zeros for points that do not count, and ``not_plain [b]``: which objects show texture or silhouettes.

    Args:
        points_obj, depth_m, pixels, normals, kind, mask: of contours; ``pixels`` and ``normals`` as ``[b, 2, m]``, ``points_obj`` as ``[b, 3, m]``.
        indexed: ``[b, 2, m]``, pixels when indexed.
        polarity: ``[b, 8]``, expected by octant; ``[b, 0]`` where nothing is.
    """
    table[:] = 0.0
    for b in range(len(table)):
        expected = polarity[b] if polarity.shape[1] else polarity.ravel()
        not_plain[b] = _fill_one(points_obj[b], normals[b], kind[b], mask[b], indexed[b], expected, settings, table[b])
        if settings.close_px:
            _add_edge_ambiguity(depth_m[b], pixels[b], normals[b], kind[b], mask[b], nearest_of_cell[b], first[b], cells, settings, table[b])


@kernel()
def _fill_one(
    points_obj: Array,
    normals: Array,
    kind: Array,
    mask: Array,
    indexed: Array,
    polarity: Array,
    settings: TableSettings,
    table: Array,
) -> bool:
    """Fill the table of one object, but for how far off what is seen may be; whether it shows texture or silhouettes."""
    not_plain = False
    for i in range(len(mask)):
        if not mask[i]:
            continue
        table[i, X], table[i, Y], table[i, Z] = points_obj[0, i], points_obj[1, i], points_obj[2, i]
        table[i, NORMAL_U], table[i, NORMAL_V] = normals[0, i], normals[1, i]
        table[i, INDEXED_U], table[i, INDEXED_V] = indexed[0, i], indexed[1, i]
        is_smooth = kind[i] == settings.silhouette
        is_oriented = is_smooth or kind[i] == settings.crease
        table[i, SMOOTH], table[i, ORIENTED] = is_smooth, is_oriented
        not_plain = not_plain or is_smooth or kind[i] == settings.texture
        if is_oriented and len(polarity):
            table[i, EXPECTED] = polarity[octant(normals[0, i], normals[1, i])]
    return not_plain


@kernel()
def _add_edge_ambiguity(
    depth_m: Array,
    pixels: Array,
    normals: Array,
    kind: Array,
    mask: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    settings: TableSettings,
    table: Array,
) -> None:
    """How far off what is seen on points of edges is, should it be of the edge beside: :func:`tracking.association.weights.edge_ambiguity_px2`."""
    least_m = settings.depth_share * _range(depth_m, mask)
    for i in range(len(mask)):
        if not mask[i] or not table[i, ORIENTED]:
            continue
        u, v, nu, nv = pixels[0, i], pixels[1, i], normals[0, i], normals[1, i]
        for side_px in (-settings.aside_px, settings.aside_px):
            other = nearest(nearest_of_cell, first, u + side_px * nu, v + side_px * nv, cells)
            if other < 0 or not mask[other] or not table[other, ORIENTED]:
                continue
            apart_px = (pixels[0, other] - u) * nu + (pixels[1, other] - v) * nv
            is_parallel = abs(normals[0, other] * nu + normals[1, other] * nv) > settings.parallel
            is_deep = abs(depth_m[other] - depth_m[i]) > least_m and kind[i] == settings.crease and kind[other] == settings.crease
            least_px = settings.touching_px if is_deep else settings.apart_px
            if is_parallel and apart_px * side_px > least_px * settings.aside_px:
                squared = apart_px * apart_px
                edge_ambiguity = 0.5 * (squared + settings.sorted_px2 * is_deep) * np.exp(-squared / settings.close_px**2)
                table[i, EDGE_AMBIGUITY] = max(table[i, EDGE_AMBIGUITY], edge_ambiguity)


@kernel()
def _range(values: Array, mask: Array) -> float:
    """How far apart the least and the largest of those values are that count; 0 of none."""
    least, largest = np.inf, -np.inf
    for i in range(len(mask)):
        if mask[i]:
            least, largest = min(least, values[i]), max(largest, values[i])
    return max(largest - least, 0.0)


@accelerates(nearest_contours.contour_table)
def contour_table_numba(
    contours: Contours, index: ContourIndex, polarity: Float[Tensor, "b 8"] | None = None, *, close_px: float = 0.0
) -> ContourTable:
    """Point by point."""
    silhouette, crease, texture = (int(kind) for kind in (ContourKind.SMOOTH, ContourKind.CREASE, ContourKind.TEXTURE))
    settings = filled(TableSettings, weights, silhouette=silhouette, crease=crease, texture=texture, close_px=close_px)
    table, not_plain = contours.points_obj.new_empty(*contours.mask.shape, COLUMNS), torch.empty_like(contours.mask[:, 0])
    points, pixels, normals, indexed = (value.transpose(1, 2) for value in (contours.points_obj, contours.pixels, contours.normals, index.pixels))
    expected = pixels.new_empty(len(table), 0) if polarity is None else polarity
    given = as_arrays(points, contours.points_cam[..., 2], pixels, normals, contours.kind, contours.mask, indexed, index.nearest, index.first)
    fill(*given, cells_of(index), *as_arrays(expected), settings, table.numpy(), not_plain.numpy())
    return ContourTable(table.transpose(1, 2), index, not_plain)
