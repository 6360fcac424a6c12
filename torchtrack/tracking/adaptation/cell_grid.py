"""An object's part of the image as a square of cells, in which points are counted and lines among them are found."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core.constants import disc

# Cells a side of the square, and those that an object's diameter takes at most.
_SIDE, _DIAMETER = 256, 240.0


@dataclass(frozen=True)
class CellGrid:
    """Cells of a pixel, or larger where the object would not fit. Positions are in cells from here on.

    Args:
        middle: pixel in the middle of the square.
        cell_px: side of a cell.
    """

    middle: Float[Tensor, "b 1 2"]
    cell_px: Float[Tensor, "b 1 1"]

    @classmethod
    def around(cls, middle: Float[Tensor, "b 1 2"], diameter_px: Float[Tensor, "b"]) -> "CellGrid":
        """The square that holds an object of that diameter."""
        return cls(middle, (diameter_px / _DIAMETER).clamp(min=1)[:, None, None])

    def place(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
        """Positions of pixels."""
        return (pixels - self.middle) / self.cell_px + _SIDE // 2

    def pixels(self, places: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
        """Pixels of positions."""
        return (places - _SIDE // 2) * self.cell_px + self.middle


def cell_of(x: Float[Tensor, "*n"], y: Float[Tensor, "*n"]) -> Int[Tensor, "*n"]:
    """Number of the cell at a position; what lies outside falls into the outermost cells."""
    column, row = (value.nan_to_num(0.0).round().clamp(0, _SIDE - 1) for value in (x, y))
    return torch.add(column, row, alpha=_SIDE).long()


def tallied(places: Float[Tensor, "b n 2"], values: Float[Tensor, "b k n"]) -> Float[Tensor, "b k c"]:
    """Sums of values by cell."""
    cell = cell_of(*places.unbind(-1))[:, None].expand_as(values)
    return values.new_zeros(*values.shape[:2], _SIDE**2).scatter_add_(2, cell, values)


def around(radius: int, like: Tensor) -> tuple[Float[Tensor, "d"], Float[Tensor, "d"]]:
    """Offsets (column, row) of the cells within a radius, and of those that are little farther."""
    column, row = disc((radius * radius + 1) ** 0.5, like.dtype, like.device)
    return column, row


def is_near(marked: Float[Tensor, "b c"], places: Float[Tensor, "b n 2"], radius: int) -> Bool[Tensor, "b n"]:
    """Which positions have a marked cell within a radius."""
    column, row = around(radius, places)
    x, y = (value[:, None] + offset[:, None] for value, offset in zip(places.unbind(-1), (column, row), strict=True))
    return (marked.gather(1, cell_of(x, y).flatten(1)).view(x.shape) > 0).any(1)


@dataclass(frozen=True)
class Lines:
    """Straight pieces of line found at positions.

    Args:
        places: middle of the points around each position.
        directions: unit directions of the line through them.
        count: points around each position.
        thickness: variance across the line (cells²).
        length: variance along it.
    """

    places: Float[Tensor, "b n 2"]
    directions: Float[Tensor, "b n 2"]
    count: Float[Tensor, "b n"]
    thickness: Float[Tensor, "b n"]
    length: Float[Tensor, "b n"]


def point_sums(places: Float[Tensor, "b n 2"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b 3 c"]:
    """By cell: the number of points, and the sum of their offsets from its middle."""
    offset = (places - places.round()).nan_to_num(0.0)
    values = torch.stack([torch.ones_like(offset[..., 0]), *offset.unbind(-1)], 1) * mask[:, None]
    return tallied(places, values)


def fit_lines(sums: Float[Tensor, "b 3 c"], places: Float[Tensor, "b n 2"], radius: int) -> Lines:
    """The line through the points around each position: their middle and their principal axis."""
    column, row = around(radius, places)
    base_x, base_y = places.nan_to_num(0.0).round().unbind(-1)
    cell = cell_of(base_x[:, None] + column[:, None], base_y[:, None] + row[:, None])
    number, dx, dy = sums.gather(2, cell.flatten(1)[:, None].expand(-1, 3, -1)).view(len(places), 3, *cell.shape[1:]).unbind(1)
    count = number.sum(1)
    share = number / count.clamp(min=1)[:, None]
    x, y = (offset / number.clamp(min=1) + around[:, None] for offset, around in ((dx, column), (dy, row)))
    mean_x, mean_y = (share * x).sum(1), (share * y).sum(1)
    x, y = x - mean_x[:, None], y - mean_y[:, None]
    xx, xy, yy = ((share * product).sum(1) for product in (x * x, x * y, y * y))
    half_sum, half_difference = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = (half_difference.square() + xy.square()).sqrt()
    angle = 0.5 * torch.atan2(xy, half_difference)
    middle = torch.stack([base_x + mean_x, base_y + mean_y], -1)
    return Lines(middle, torch.stack([angle.cos(), angle.sin()], -1), count, half_sum - root, half_sum + root)
