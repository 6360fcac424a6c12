"""The nearest contour point of every place in an object's region, looked up at once for any number of observations.

The index is made once per extraction of contours; when the pose moves by a few pixels, the observation is moved back
instead.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.constants import constant, disc
from torchtrack.core.dispatch import accelerable
from torchtrack.core.padded import take_points
from torchtrack.tracking.contours.points import Contours

# Cell of the index (px). Cells of 1 px gave the same on the 13 shared sequences, to 0.01° and 0.03 mm (docs/results.md), and take more time.
INDEX_CELL_PX = 2
# Squared distances are compared in these fractions of a pixel².
DISTANCE_STEPS = 16
# Points whose distances are written at once: larger temporaries page-fault on the CPU.
_CHUNK = 2048
# Events lie at whole pixels, on the borders of cells or in the middle of four: looked up a little aside, roundings choose nothing (px).
OFF_BORDER_PX = 2.0**-8
# From the middle of a cell to its corner, in cells.
HALF_DIAGONAL = 0.5**0.5
# Farther than any cell of an image, and than any contour is looked for (px).
FAR_CELLS, _FAR_PX = 2**20, 2.0**12


@dataclass(frozen=True)
class ContourIndex:
    """The nearest contour point of every cell of a region, within a radius.

    Args:
        first: the region's first cell (column, row); cell (0, 0) is centred at pixel (0, 0).
        size: rows and columns of the region, whose outermost two cells are empty on each side.
        cell_px: side of a cell.
        nearest: contour index per cell, -1 where none is near.
        pixels: where the contour points were when the index was made.
        radius_px: how far from a contour it is found.
    """

    first: Float[Tensor, "b 2"]
    size: tuple[int, int]
    cell_px: int
    nearest: Int[Tensor, "b p"]
    pixels: Float[Tensor, "b m 2"]
    radius_px: host_sync.AsyncValue

    def look_up(self, pixels: Float[Tensor, "b n 2"], subcell_lookup: Bool[Tensor, "b"] | None = None) -> Int[Tensor, "b n"]:
        """The contour point nearest to the centre of each pixel's cell, -1 where none is near.

        Args:
            subcell_lookup: objects of which the four cells around a pixel are asked, and what is nearest to the pixel itself is taken. Where edges
                lie as close as cells, that is often another one.
        """
        rows, columns = self.size
        # Whole cells first: rounded the same way wherever the region begins.
        column, row = pixels.add(0.5 * self.cell_px + OFF_BORDER_PX).div_(self.cell_px).floor_().sub_(self.first[:, None]).unbind(-1)
        nearest = self.nearest.gather(1, self._flat(column.clamp(0, columns - 1), row.clamp(0, rows - 1))).long()
        if subcell_lookup is None or host_sync.none_of(subcell_lookup):
            return nearest
        return torch.where(subcell_lookup[:, None], self._nearest_of_four(pixels), nearest)

    def _nearest_of_four(self, pixels: Float[Tensor, "b n 2"]) -> Int[Tensor, "b n"]:
        """The nearest to each pixel of the contour points that the four cells around it know."""
        rows, columns = self.size
        column, row = pixels.add(OFF_BORDER_PX).div_(self.cell_px).floor_().sub_(self.first[:, None]).unbind(-1)
        first = self._flat(column.clamp(0, columns - 2), row.clamp(0, rows - 2))
        # A table of the places that cells know, where these are fewer than the places asked for.
        table = self._places(self.nearest.long()) if rows * columns <= 4 * pixels.shape[1] else None
        best, least = first, self._squared_way(first, pixels, table)
        # One after the other: what is in memory at a time is then a quarter, and a search for the least of four takes longer still.
        for step in (1, columns, columns + 1):
            cell = first + step
            away = self._squared_way(cell, pixels, table)
            nearer = away < least
            best, least = torch.where(nearer, cell, best), torch.minimum(away, least)
        return self.nearest.gather(1, best).long()

    def _squared_way(self, cell: Int[Tensor, "b n"], pixels: Float[Tensor, "b n 2"], table: Tensor | None) -> Float[Tensor, "b n"]:
        """From each pixel to what the cell knows, squared (px²)."""
        known = self._places(self.nearest.gather(1, cell).long()) if table is None else take_points(table, cell)
        u, v = (known - pixels).unbind(-1)
        return torch.addcmul(u * u, v, v)

    def _places(self, number: Int[Tensor, "b k"]) -> Float[Tensor, "b k 2"]:
        """Where contour points were when the index was made; far away for none."""
        return torch.where(number[..., None] >= 0, take_points(self.pixels, number.clamp(min=0)), _FAR_PX)

    def _flat(self, column: Float[Tensor, "b n"], row: Float[Tensor, "b n"]) -> Int[Tensor, "b n"]:
        """Numbers of cells. The region's border is empty: whatever lies outside finds nothing there, nor does what is not a number."""
        return torch.add(column, row, alpha=self.size[1]).nan_to_num_(0.0).long()


@accelerable
def index_contours(
    contours: Contours, image_size: tuple[int, int], radius_px: int | Int[Tensor, "b"] | host_sync.AsyncValue, cell_px: int
) -> ContourIndex:
    """Index the visible contour points; those far outside the image (height, width) are left out.

    Every point writes its distance and number to the cells around it, and the least stays. The region is as large as the
    contours need; on a GPU, it is the whole image.

    Args:
        radius_px: how far from a contour it is still found; one for all objects, or one for each.
    """
    batch, count, _ = contours.pixels.shape
    answer = radii(radius_px, contours)
    radius, radii_px = answer.on_device, answer.numbers()
    middle = constant((0.5 * (image_size[1] - 1), 0.5 * (image_size[0] - 1)), contours.pixels.dtype, contours.pixels.device)
    inside = contours.mask & ((contours.pixels - middle).abs() < middle + radius[:, None, None]).all(-1)
    centre = (contours.pixels / cell_px).round()
    margin = reach(max([0, *radii_px]), cell_px) + 2
    low = _first_cells(centre, inside, margin)
    local = torch.where(inside[..., None], centre - low[:, None], margin)
    rows, columns = _size(local, image_size, margin, cell_px)
    if not host_sync.read_at_once(local):
        # Those that are not inside write, too: not all of them to one cell, where each would wait for the others.
        spread = torch.arange(count, device=local.device) % (columns - 2 * margin) + margin
        local[..., 0] = torch.where(inside, local[..., 0], spread.to(local.dtype))
    dtype = key_type(max([0, *radii_px]), count)
    keys = torch.full((batch * rows * columns,), torch.iinfo(dtype).max, dtype=dtype, device=radius.device)
    # Points that are not inside are too far from their cells to write anything.
    to_centre = torch.where(inside[..., None], cell_px * centre - contours.pixels, _FAR_PX)
    for reach_px, row, point in _points_by_radius(inside, radius, radii_px):
        # Object by object as far as each needs: one that is looked for far away does not make the others pay.
        u, v = local[row, point].long().unbind(1)
        cell, at_once = (row * rows + v) * columns + u, _CHUNK if host_sync.read_at_once(row) else len(row)
        parts = zip(cell.split(at_once), to_centre[row, point].split(at_once), point.to(dtype).split(at_once), strict=True)
        for of_part in parts:
            _write(keys, of_part, reach_px, cell_px, columns, count)
    keys = keys.view(batch, -1)
    nearest = torch.where(keys < ((DISTANCE_STEPS * radius.square() + 1) * count)[:, None], keys % count, -1).long()
    return ContourIndex(low, (rows, columns), cell_px, nearest, contours.pixels, answer)


def radii(radius_px: int | Tensor | host_sync.AsyncValue, contours: Contours) -> host_sync.AsyncValue:
    """The radius of each object."""
    if isinstance(radius_px, int):
        return host_sync.AsyncValue.known(radius_px, contours.mask[:, 0].long())
    return radius_px if isinstance(radius_px, host_sync.AsyncValue) else host_sync.AsyncValue.to(radius_px)


def _first_cells(centre: Float[Tensor, "b m 2"], inside: Bool[Tensor, "b m"], margin: int) -> Float[Tensor, "b 2"]:
    """First cell (column, row) of each object's region, ``margin`` cells before its points."""
    if host_sync.read_at_once(centre):
        return torch.where(inside[..., None], centre, torch.inf).amin(1).clamp(max=FAR_CELLS) - margin
    # What is farther from the image than its radius, less than a margin, is not inside.
    return constant((_first_of_image(margin),) * 2, centre.dtype, centre.device).expand(len(centre), 2)


def _size(local: Float[Tensor, "b m 2"], image_size: tuple[int, int], margin: int, cell_px: int) -> tuple[int, int]:
    """Rows and columns that hold the cells of all objects' points, with a margin."""
    if host_sync.read_at_once(local):
        columns, rows = local.amax((0, 1)).tolist()
        return int(rows) + margin + 1, int(columns) + margin + 1
    _, rows, columns = size_of_image(image_size, margin, cell_px)
    return rows, columns


def size_of_image(image_size: tuple[int, int], margin: int, cell_px: int) -> tuple[int, int, int]:
    """First cell, rows and columns of a region that holds the whole image (height, width), and what is within a margin of it."""
    rows, columns = (ceil((side - 1) / cell_px) + 4 * margin - 1 for side in image_size)
    return _first_of_image(margin), rows, columns


def _first_of_image(margin: int) -> int:
    return 1 - 2 * margin


def _points_by_radius(inside: Tensor, radius: Tensor, radii_px: Sequence[int]) -> Iterator[tuple[int, Tensor, Tensor]]:
    """For each radius, the objects and numbers of the points that are to be found within it; on a GPU, also of those that are not inside."""
    if host_sync.read_at_once(inside):
        for reach_px in sorted(set(radii_px)):
            row, point = (inside & (radius == reach_px)[:, None]).nonzero().unbind(1)
            if len(row):
                yield reach_px, row, point
        return
    begin, order = 0, radius.argsort()
    for reach_px, objects in sorted(Counter(radii_px).items()):
        row, point = torch.meshgrid(order[begin : begin + objects], torch.arange(inside.shape[1], device=order.device), indexing="ij")
        yield reach_px, row.flatten(), point.flatten()
        begin += objects


def _write(keys: Tensor, points: tuple[Tensor, Tensor, Tensor], radius_px: int, cell_px: int, columns: int, count: int) -> None:
    """Write the distances and numbers of points into the cells around theirs, where they are less than what stands there.

    Args:
        points: the cell of each, the way from each to the centre of its cell (px), and its number.
    """
    cell, to_centre, number = points
    # The cells that reach into the radius around a cell's middle.
    column, row = disc(radius_px / cell_px + HALF_DIAGONAL, to_centre.dtype, to_centre.device)
    steps = _squared_distances(DISTANCE_STEPS**0.5 * to_centre, DISTANCE_STEPS**0.5 * cell_px * torch.stack([column, row], -1))
    # What is farther than the radius need not be told apart, and must fit.
    key = steps.clamp_(0, DISTANCE_STEPS * radius_px**2 + 1).to(keys.dtype).mul_(count).add_(number[:, None])
    around = torch.add(column, row, alpha=columns).long()
    keys.scatter_reduce_(0, (cell[:, None] + around).flatten(), key.flatten(), "amin")


def key_type(radius_px: int, count: int) -> torch.dtype:
    """Of an integer that holds the distance and the number of any of ``count`` points: as narrow as will do."""
    return torch.int32 if DISTANCE_STEPS * (radius_px + 1) ** 2 * count < 2**31 else torch.int64


def reach(radius_px: int, cell_px: int) -> int:
    """How many cells away a point still counts."""
    return int(radius_px / cell_px + HALF_DIAGONAL)


def _squared_distances(to_centre: Float[Tensor, "p 2"], offsets: Float[Tensor, "d 2"]) -> Float[Tensor, "p d"]:
    """``|c + o|²`` of every ``c`` and every offset ``o``: on a CPU as one matrix product."""
    if host_sync.on_gpu(to_centre):
        # Which a compiler makes a part of what is done with them.
        x, y = (to_centre[:, None] + offsets).unbind(-1)
        return torch.addcmul(x * x, y, y)
    point_part = torch.cat([to_centre.square().sum(-1, keepdim=True), torch.ones_like(to_centre[:, :1]), 2 * to_centre], -1)
    offset_part = torch.cat([torch.ones_like(offsets[:, :1]), offsets.square().sum(-1, keepdim=True), offsets], -1)
    return point_part @ offset_part.T
