"""The nearest contour point of every place in an object's region, looked up at once for any number of observations.

The index is made once per extraction of contours; when the pose moves by a few pixels, the observation is moved back
instead.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.contours import Contours

# Squared distances are compared in these fractions of a pixel².
_DISTANCE_STEPS = 16


@dataclass(frozen=True)
class ContourIndex:
    """The nearest contour point of every cell of a region, within a radius.

    Args:
        origin: cell (column, row) of the region's first entry; cell (0, 0) is centred at pixel (0, 0).
        size: rows and columns of the region, whose outermost cells are empty.
        cell_px: side of a cell.
        nearest: contour index per cell, -1 where none is near.
        pixels: where the contour points were when the index was made.
    """

    origin: Int[Tensor, "b 2"]
    size: tuple[int, int]
    cell_px: int
    nearest: Int[Tensor, "b p"]
    pixels: Float[Tensor, "b m 2"]

    def look_up(self, pixels: Float[Tensor, "b n 2"]) -> Int[Tensor, "b n"]:
        """The contour point nearest to the centre of each pixel's cell, -1 where none is near."""
        rows, columns = self.size
        place = torch.nan_to_num((pixels / self.cell_px).round() - self.origin[:, None], nan=0.0)
        # The region's border is empty: whatever lies outside finds nothing there.
        column, row = torch.minimum(place.clamp(min=0), place.new_tensor([columns - 1, rows - 1])).unbind(-1)
        return self.nearest.gather(1, torch.add(column, row, alpha=columns).long())


def index_contours(contours: Contours, image_size: tuple[int, int], radius_px: int | Int[Tensor, "b"], cell_px: int) -> ContourIndex:
    """Index the visible contour points; those far outside the image (height, width) are left out.

    Every point writes its distance and number to the cells around it, and the least stays.

    Args:
        radius_px: how far from a contour it is still found; one for all objects, or one for each.
    """
    batch, count, _ = contours.pixels.shape
    device = contours.pixels.device
    radius = torch.as_tensor(radius_px, device=device).expand(batch)
    limit, around_px = torch.tensor([image_size[1] - 1, image_size[0] - 1], device=device), radius[:, None, None]
    inside = contours.mask & ((contours.pixels > -around_px) & (contours.pixels < limit + around_px)).all(-1)
    centre = torch.where(inside[..., None], contours.pixels / cell_px, 0).round().long()
    largest_px = int(radius.max()) if batch else 0
    reach = -(-largest_px // cell_px)
    low = torch.where(inside[..., None], centre, 2**31).amin(1).clamp(max=2**30) - reach - 1
    columns, rows = (torch.where(inside[..., None], centre - low[:, None], 0).amax((0, 1)) + reach + 2).tolist()
    disc = _disc(reach, largest_px / cell_px, device)
    distance_sq = _squared_distances(contours.pixels, cell_px * centre, cell_px * disc)
    key = (_DISTANCE_STEPS * distance_sq).long() * count + torch.arange(count, device=device)[:, None]
    nothing = torch.iinfo(torch.int64).max
    # Each object within its own radius, whatever its neighbours need.
    beyond = disc.square().sum(-1) * cell_px**2 > radius[:, None].square()
    key = key.masked_fill(beyond[:, None], nothing)
    # Masked points write to spare entries after the last.
    local = centre - low[:, None]
    first = torch.where(inside, local[..., 1] * columns + local[..., 0], rows * columns + reach * (columns + 1))
    cell = first[..., None] + (disc[:, 1] * columns + disc[:, 0])
    keys = torch.full((batch, rows * columns + 2 * reach * (columns + 1) + 1), nothing, device=device)
    keys = keys.scatter_reduce(1, cell.flatten(1), key.flatten(1), "amin")[:, : rows * columns]
    return ContourIndex(low, (rows, columns), cell_px, torch.where(keys == nothing, -1, keys % count), contours.pixels)


def _disc(reach: int, radius: float, device: torch.device) -> Tensor:
    """Offsets (column, row) of the cells within ``radius`` cells."""
    step = torch.arange(-reach, reach + 1, device=device)
    square = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1).flatten(0, 1)
    return square[square.square().sum(-1) <= radius**2]


def _squared_distances(pixels: Tensor, centres: Tensor, offsets: Tensor) -> Tensor:
    """``|c + o - p|²`` of every point ``p [b, m, 2]``, its ``c`` and every offset ``o [d, 2]``, as one matrix product."""
    to_centre = centres.to(pixels.dtype) - pixels
    offsets = offsets.to(pixels.dtype)
    point_part = torch.cat([to_centre.square().sum(-1, keepdim=True), torch.ones_like(to_centre[..., :1]), 2 * to_centre], -1)
    offset_part = torch.cat([torch.ones_like(offsets[:, :1]), offsets.square().sum(-1, keepdim=True), offsets], -1)
    return (point_part @ offset_part.T).clamp(min=0)
