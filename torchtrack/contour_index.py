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
    largest_px = int(radius.max()) if batch else 0
    reach = -(-largest_px // cell_px)
    centre = (contours.pixels / cell_px).round()
    low = torch.where(inside[..., None], centre, torch.inf).amin(1).clamp(max=_FAR_CELLS) - (reach + 1)
    local = torch.where(inside[..., None], centre - low[:, None], 0)
    columns, rows = (int(size) + reach + 2 for size in local.amax((0, 1)).tolist())
    disc = contours.pixels.new_tensor(_disc(reach, largest_px / cell_px))
    distance_sq = _squared_distances(contours.pixels, cell_px * centre, cell_px * disc)
    if batch > 1:
        # Each object within its own radius, whatever its neighbours need.
        distance_sq = distance_sq.masked_fill((disc.square().sum(-1) * cell_px**2 > radius[:, None].square())[:, None], torch.inf)
    key = (_DISTANCE_STEPS * distance_sq).clamp(max=_FAR_STEPS).long() * count + torch.arange(count, device=device)[:, None]
    # Masked points write to spare entries after the last.
    first = torch.where(inside, torch.add(local[..., 0], local[..., 1], alpha=columns), rows * columns + reach * (columns + 1))
    cell = (first[..., None] + torch.add(disc[:, 0], disc[:, 1], alpha=columns)).long()
    nothing = _FAR_STEPS * count
    keys = torch.full((batch, rows * columns + 2 * reach * (columns + 1) + 1), nothing, device=device)
    keys = keys.scatter_reduce_(1, cell.flatten(1), key.flatten(1), "amin")[:, : rows * columns]
    return ContourIndex(low - 0.5, (rows, columns), cell_px, torch.where(keys < nothing, keys % count, -1), contours.pixels)


@lru_cache
def _disc(reach: int, radius: float) -> tuple[tuple[int, int], ...]:
    """Offsets (column, row) of the cells within ``radius`` cells."""
    steps = range(-reach, reach + 1)
    return tuple((column, row) for row in steps for column in steps if row**2 + column**2 <= radius**2)


def _squared_distances(pixels: Tensor, centres: Tensor, offsets: Tensor) -> Tensor:
    """``|c + o - p|²`` of every point ``p [b, m, 2]``, its ``c`` and every offset ``o [d, 2]``, as one matrix product."""
    to_centre = centres - pixels
    point_part = torch.cat([to_centre.square().sum(-1, keepdim=True), torch.ones_like(to_centre[..., :1]), 2 * to_centre], -1)
    offset_part = torch.cat([torch.ones_like(offsets[:, :1]), offsets.square().sum(-1, keepdim=True), offsets], -1)
    return (point_part @ offset_part.T).clamp(min=0)
