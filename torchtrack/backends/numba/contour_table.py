"""The table of what observations take from contour points: :meth:`torchtrack.tracking.association.nearest.contour_table`, point by point."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.alignment import COLUMNS, EXPECTED, INDEXED_U, INDEXED_V, NORMAL_U, NORMAL_V, ORIENTED, SMOOTH, X, Y, Z
from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.backends.numba.measures import octant
from torchtrack.backends.numba.parameters import TableSettings
from torchtrack.core.dispatch import accelerates
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association import nearest as nearest_contours
from torchtrack.tracking.association.nearest import ContourTable
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours

__all__ = ["COLUMNS", "fill"]


class TablePoints(NamedTuple):
    """Contour points: ``[b, 3, m]``, ``[b, 2, m]``, and ``[b, m]``; and their pixels when indexed, ``[b, 2, m]``; or of one object."""

    points_obj: Array
    normals: Array
    kind: Array
    mask: Array
    indexed: Array


@kernel()
def fill(points: TablePoints, polarity: Array, settings: TableSettings, table: Array, not_plain: Array) -> None:
    """Fill ``table [b, m, COLUMNS]``, with zeros for points that do not count, and ``not_plain [b]``: which objects show texture or silhouettes.

    Args:
        polarity: ``[b, 8]``, expected by octant; ``[b, 0]`` where nothing is.
    """
    points = TablePoints(*points)
    table[:] = 0.0
    for b in range(len(table)):
        own = TablePoints(points.points_obj[b], points.normals[b], points.kind[b], points.mask[b], points.indexed[b])
        not_plain[b] = _fill_one(own, polarity[b] if polarity.shape[1] else polarity.ravel(), settings, table[b])


@kernel()
def _fill_one(points: TablePoints, polarity: Array, settings: TableSettings, table: Array) -> bool:
    """Fill the table of one object; whether it shows texture or silhouettes."""
    points_obj, normals, kind, mask, indexed = points
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
        table[i, EXPECTED] = settings.of_texture and kind[i] == settings.texture
        if is_oriented and len(polarity):
            table[i, EXPECTED] = polarity[octant(normals[0, i], normals[1, i])]
    return not_plain


@accelerates(nearest_contours.contour_table)
def contour_table_numba(
    contours: Contours, index: ContourIndex, polarity: Float[Tensor, "b 8"] | None = None, *, of_texture: bool = True
) -> ContourTable:
    """Point by point."""
    settings = TableSettings(int(ContourKind.SMOOTH), int(ContourKind.CREASE), int(ContourKind.TEXTURE), of_texture)
    table, not_plain = contours.points_obj.new_empty(*contours.mask.shape, COLUMNS), torch.empty_like(contours.mask[:, 0])
    points, normals, indexed = (value.transpose(1, 2) for value in (contours.points_obj, contours.normals, index.pixels))
    expected = normals.new_empty(len(table), 0) if polarity is None else polarity
    given = as_arrays(points, normals, contours.kind, contours.mask, indexed)
    fill(given, *as_arrays(expected), settings, table.numpy(), not_plain.numpy())
    return ContourTable(table.transpose(1, 2), index, not_plain)
