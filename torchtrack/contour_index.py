"""The nearest contour point of every place in an object's region, looked up at once for any number of observations.

The index is made once per extraction of contours; when the pose moves by a few pixels, the observation is moved back
instead.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.contours import Contours

# Squared distances are compared in these fractions of a pixel²; none that counts comes near this many of them.
_DISTANCE_STEPS, _FAR_STEPS = 16, 2**30
# From the middle of a cell to its corner, in cells.
_HALF_DIAGONAL = 0.5**0.5
# Farther than any cell of an image.
_FAR_CELLS = 2**20


@dataclass(frozen=True)
class ContourIndex:
    """The nearest contour point of every cell of a region, within a radius.

    Args:
        corner: outer corner (column, row) of the region's first cell; cell (0, 0) is centred at pixel (0, 0).
        size: rows and columns of the region, whose outermost cells are empty.
        cell_px: side of a cell.
        nearest: contour index per cell, -1 where none is near.
        pixels: where the contour points were when the index was made.
    """

    corner: Float[Tensor, "b 2"]
    size: tuple[int, int]
    cell_px: int
    nearest: Int[Tensor, "b p"]
    pixels: Float[Tensor, "b m 2"]

    def look_up(self, pixels: Float[Tensor, "b n 2"]) -> Int[Tensor, "b n"]:
        """The contour point nearest to the centre of each pixel's cell, -1 where none is near."""
        rows, columns = self.size
        # Rounded the same way wherever the region begins: events lie halfway between the centres of two cells.
        column, row = (pixels / self.cell_px - self.corner[:, None]).floor().unbind(-1)
        # The region's border is empty: whatever lies outside finds nothing there, nor does what is not a number.
        place = torch.add(column.clamp(0, columns - 1), row.clamp(0, rows - 1), alpha=columns)
        return self.nearest.gather(1, place.nan_to_num_(0.0).long())


def index_contours(contours: Contours, image_size: tuple[int, int], radius_px: int | Int[Tensor, "b"], cell_px: int) -> ContourIndex:
    """Index the visible contour points; those far outside the image (height, width) are left out.

    Every point writes its distance and number to the cells around it, and the least stays.

    Args:
        radius_px: how far from a contour it is still found; one for all objects, or one for each.
    """
    batch, count, _ = contours.pixels.shape
    device = contours.pixels.device
    radius = torch.as_tensor(radius_px, device=device).expand(batch)
    middle = torch.tensor([0.5 * (image_size[1] - 1), 0.5 * (image_size[0] - 1)], dtype=contours.pixels.dtype, device=device)
    inside = contours.mask & ((contours.pixels - middle).abs() < middle + radius[:, None, None]).all(-1)
    radii_px = sorted(set(radius.tolist()))
    margin = _reach(max([0, *radii_px]), cell_px) + 1
    centre = (contours.pixels / cell_px).round()
    low = torch.where(inside[..., None], centre, torch.inf).amin(1).clamp(max=_FAR_CELLS) - margin
    local = torch.where(inside[..., None], centre - low[:, None], 0)
    columns, rows = (int(size) + margin + 1 for size in local.amax((0, 1)).tolist())
    keys = torch.full((batch * rows * columns,), _FAR_STEPS * count, device=device)
    for reach_px in radii_px:
        # Object by object as far as each needs: one that is looked for far away does not make the others pay.
        row, point = (inside & (radius == reach_px)[:, None]).nonzero().unbind(1)
        if len(row) == 0:
            continue
        to_centre = cell_px * centre[row, point] - contours.pixels[row, point]
        u, v = local[row, point].long().unbind(1)
        _write(keys, (row * rows + v) * columns + u, to_centre, point, reach_px, cell_px, columns, count)
    nearest = torch.where(keys < _FAR_STEPS * count, keys % count, -1).view(batch, -1)
    return ContourIndex(low - 0.5, (rows, columns), cell_px, nearest, contours.pixels)


def _write(keys: Tensor, cell: Tensor, to_centre: Tensor, point: Tensor, radius_px: int, cell_px: int, columns: int, count: int) -> None:
    """Write the distances and numbers of points into the cells around theirs, where they are less than what stands there.

    Args:
        cell: of each point.
        to_centre: way from each point to the centre of its cell (px).
    """
    disc = to_centre.new_tensor(_disc(radius_px / cell_px))
    steps = _DISTANCE_STEPS * _squared_distances(to_centre, cell_px * disc)
    key = torch.add(point[:, None], steps.long(), alpha=count).masked_fill_(steps > _DISTANCE_STEPS * radius_px**2, _FAR_STEPS * count)
    around = torch.add(disc[:, 0], disc[:, 1], alpha=columns).long()
    keys.scatter_reduce_(0, (cell[:, None] + around).flatten(), key.flatten(), "amin")


def _reach(radius_px: int, cell_px: int) -> int:
    """How many cells away a point still counts."""
    return int(radius_px / cell_px + _HALF_DIAGONAL)


@lru_cache
def _disc(radius: float) -> tuple[tuple[int, int], ...]:
    """Offsets (column, row) of the cells that reach into ``radius`` cells around a cell's middle."""
    reach = int(radius + _HALF_DIAGONAL)
    steps = range(-reach, reach + 1)
    return tuple((column, row) for row in steps for column in steps if row**2 + column**2 <= (radius + _HALF_DIAGONAL) ** 2)


def _squared_distances(to_centre: Float[Tensor, "p 2"], offsets: Float[Tensor, "d 2"]) -> Float[Tensor, "p d"]:
    """``|c + o|²`` of every ``c`` and every offset ``o``, as one matrix product."""
    point_part = torch.cat([to_centre.square().sum(-1, keepdim=True), torch.ones_like(to_centre[:, :1]), 2 * to_centre], -1)
    offset_part = torch.cat([torch.ones_like(offsets[:, :1]), offsets.square().sum(-1, keepdim=True), offsets], -1)
    return (point_part @ offset_part.T).clamp(min=0)
