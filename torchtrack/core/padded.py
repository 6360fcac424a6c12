"""The box around the points of each object that count."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def bounds(points: Float[Tensor, "b m k"], mask: Bool[Tensor, "b m"]) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """Least and greatest coordinates of each object's points; without points, plus and minus infinity."""
    counts = mask[..., None]
    return torch.where(counts, points, torch.inf).amin(1), torch.where(counts, points, -torch.inf).amax(1)


def select_ranked(mask: Bool[Tensor, "b n"], count: int) -> tuple[Int[Tensor, "b c"], Bool[Tensor, "b c"]]:
    """Indices of ``count`` true entries of each row, spread evenly over them, and which of these exist.

    Deterministic, of static shape, and independent of the other rows.
    """
    cumulative = mask.cumsum(-1)
    total = cumulative[:, -1:]
    step = torch.arange(count, device=mask.device, dtype=torch.float64)
    rank = (step * (total.double() / max(count, 1)).clamp(min=1)).long() + 1
    index = torch.searchsorted(cumulative, rank)
    return index.clamp(max=mask.shape[1] - 1), rank <= total


def take_points(values: Float[Tensor, "b n k"], index: Int[Tensor, "b m"]) -> Float[Tensor, "b m k"]:
    """``values[b, index[b, m]]``.

    In memory the coordinates are rows, before and after, as :func:`torchtrack.core.lie.transform_points` leaves them.
    """
    return values.transpose(1, 2).gather(2, index[:, None].expand(-1, values.shape[2], -1)).transpose(1, 2)
