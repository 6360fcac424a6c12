"""Making an index of nearest contour points on a GPU: :func:`torchtrack.tracking.contours.index.index_contours`, each object as far as it needs."""

import torch
import triton
import triton.language as tl
from jaxtyping import Int
from torch import Tensor

from torchtrack.backends.triton.compiler import OPTIONS, kernel
from torchtrack.core import host_sync
from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours.index import DISTANCE_STEPS, HALF_DIAGONAL, ContourIndex, index_contours, key_type, radii, reach, size_of_image
from torchtrack.tracking.contours.points import Contours

# As kernels take them.
_STEPS, _HALF_DIAGONAL = tl.constexpr(DISTANCE_STEPS), tl.constexpr(HALF_DIAGONAL)
# Contour points that a program takes, cells of a row that it writes at once, and cells that it reads at once.
_POINTS, _CELLS, _READ = 16, 16, 1024


def _supports(contours: Contours, image_size: tuple[int, int], radius_px: int | Tensor | host_sync.AsyncValue, cell_px: int) -> bool:
    return contours.mask.shape[1] > 0 and contours.pixels.dtype in (torch.float32, torch.float64)


@accelerates(index_contours, supports=_supports, device="cuda", in_graphs=True)
def index_contours_triton(
    contours: Contours, image_size: tuple[int, int], radius_px: int | Int[Tensor, "b"] | host_sync.AsyncValue, cell_px: int
) -> ContourIndex:
    """All points at once; of those as near to a cell, the first stays."""
    answer = radii(radius_px, contours)
    farthest_px = max([0, *answer.numbers()])
    first, rows, columns = size_of_image(image_size, reach(farthest_px, cell_px) + 2, cell_px)
    layout, dtype = [rows, columns, first, cell_px, *image_size], key_type(farthest_px, contours.mask.shape[1])
    nearest = _nearest(contours.pixels, contours.mask, answer.on_device, layout, dtype)
    low = constant((first, first), contours.pixels.dtype, contours.pixels.device).expand(len(nearest), 2)
    return ContourIndex(low, (rows, columns), cell_px, nearest, contours.pixels, answer)


@torch.library.custom_op("torchtrack::nearest_contours", mutates_args=())
def _nearest(pixels: Tensor, mask: Tensor, radius_px: Tensor, layout: list[int], dtype: torch.dtype) -> Tensor:
    """Number of the point nearest to each cell ``[b, p]``, -1 for none.

    Args:
        layout: rows, columns and first cell of the region, side of a cell (px), height and width of the image.
        dtype: that holds a distance and a number.
    """
    rows, columns, first, cell_px, height, width = layout
    (batch, count), cells, none = mask.shape, rows * columns, torch.iinfo(dtype).max
    keys = torch.full((batch, cells), none, dtype=dtype, device=pixels.device)
    with torch.cuda.device_of(pixels):
        write[batch, triton.cdiv(count, _POINTS)](
            pixels.contiguous(), mask.contiguous(), radius_px.contiguous(), keys, count, cells, columns, first, cell_px,
            0.5 * (width - 1), 0.5 * (height - 1), POINTS=_POINTS, CELLS=_CELLS, **OPTIONS,
        )  # fmt: skip
        read[batch, triton.cdiv(cells, _READ)](keys, count, cells, NONE=none, BLOCK=_READ, **OPTIONS)
    return keys


@_nearest.register_fake
def _(pixels: Tensor, mask: Tensor, radius_px: Tensor, layout: list[int], dtype: torch.dtype) -> Tensor:
    return torch.empty(len(mask), layout[0] * layout[1], dtype=dtype, device=pixels.device)


@kernel
def write(
    pixels, exists, radius_px, keys, count, cells, columns, first, side_px, middle_u, middle_v, POINTS: tl.constexpr, CELLS: tl.constexpr
):  # fmt: skip
    """Write the distances and numbers of some of an object's points into the cells around theirs, where they are less than what stands there.

    Args:
        pixels, exists: ``[b, m, 2]`` and ``[b, m]``.
        radius_px: ``[b]``, how far contours are to be found.
        keys: ``[b, cells]``, the largest number; changed.
        first: of the region's columns and rows, and ``middle_u``, ``middle_v`` of the image.
    """
    b = tl.program_id(0).to(tl.int64)
    i = tl.program_id(1) * POINTS + tl.arange(0, POINTS)
    radius = tl.load(radius_px + b).to(tl.float32)
    point = pixels + (b * count + i) * 2
    u, v = tl.load(point, i < count, 0.0), tl.load(point + 1, i < count, 0.0)
    inside = (i < count) & tl.load(exists + b * count + i, i < count, 0).to(tl.int1)
    inside = inside & (tl.abs(u - middle_u) < middle_u + radius) & (tl.abs(v - middle_v) < middle_v + radius)
    # What is not a number is in no cell.
    u, v = tl.where(inside, u, 0.0), tl.where(inside, v, 0.0)
    column, row = tl.floor(u / side_px + 0.5), tl.floor(v / side_px + 0.5)
    away_u, away_v = side_px * column - u, side_px * row - v
    own = keys + b * cells + (row.to(tl.int32) - first) * columns + column.to(tl.int32) - first
    reach, farthest = (radius / side_px + _HALF_DIAGONAL).to(tl.int32), radius * radius * _STEPS
    # Of an object that nothing is known of, the radius is no number to go by.
    reach = tl.where((tl.max(inside.to(tl.int32), 0) > 0) & (radius >= 0), reach, -1)
    for down in range(-reach, reach + 1):
        along = away_v + side_px * down
        for begin in range(-reach, reach + 1, CELLS):
            across = begin + tl.arange(0, CELLS)
            aside = away_u[:, None] + side_px * across[None, :]
            far = tl.floor((aside * aside + (along * along)[:, None]) * _STEPS)
            is_near = inside[:, None] & (far <= farthest) & (across <= reach)[None, :]
            cell = own[:, None] + down * columns + across[None, :]
            tl.atomic_min(cell, far.to(keys.dtype.element_ty) * count + i[:, None], is_near)


@kernel
def read(keys, count, cells, NONE: tl.constexpr, BLOCK: tl.constexpr):
    """Put in each cell's place the number of the point that is nearest to it, or -1 for none."""
    b = tl.program_id(0).to(tl.int64)
    cell = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    key = tl.load(keys + b * cells + cell, cell < cells, 0)
    tl.store(keys + b * cells + cell, tl.where(key < NONE, key % count, -1), cell < cells)
