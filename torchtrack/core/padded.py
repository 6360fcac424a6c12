"""Rows of which some entries count: the box around those of each object, and a choice of them."""

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import pad

from torchtrack.core import host_sync

# Entries of a short row, of which compiled graphs count one at a time.
_SHORT = 512


def bounds(points: Float[Tensor, "b m k"], mask: Bool[Tensor, "b m"]) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """Least and greatest coordinates of each object's points; without points, plus and minus infinity."""
    counts = mask[..., None]
    return torch.where(counts, points, torch.inf).amin(1), torch.where(counts, points, -torch.inf).amax(1)


def select_ranked(mask: Bool[Tensor, "b n"], count: int) -> tuple[Int[Tensor, "b c"], Bool[Tensor, "b c"]]:
    """Indices of ``count`` true entries of each row, spread evenly over them, and which of these exist.

    Deterministic, of static shape, and independent of the other rows.
    """
    cumulative = running_count(mask)
    total = cumulative[:, -1:]
    step = torch.arange(count, device=mask.device, dtype=torch.float64)
    rank = (step * (total.double() / max(count, 1)).clamp(min=1)).long() + 1
    index = torch.searchsorted(cumulative, rank)
    return index.clamp(max=mask.shape[1] - 1), rank <= total


def running_count(mask: Bool[Tensor, "b n"]) -> Int[Tensor, "b n"]:
    """How many entries of each row, up to each one, are true."""
    return by_short_rows(mask) if torch.compiler.is_compiling() and host_sync.on_gpu(mask) else mask.cumsum(-1)


def by_short_rows(mask: Bool[Tensor, "b n"]) -> Int[Tensor, "b n"]:
    """:func:`running_count` of many short rows at once: a compiler makes one program of a long one, and before PyTorch 2.13 it fails to, for many."""
    rows = pad(mask, (0, -mask.shape[1] % _SHORT)).unflatten(1, (-1, _SHORT)).cumsum(-1)
    before = rows[..., -1].cumsum(-1) - rows[..., -1]
    # A search in it needs a row of its own in memory, not a view.
    return (rows + before[..., None]).flatten(1)[:, : mask.shape[1]].clone(memory_format=torch.contiguous_format)


def repeated(values: Shaped[Tensor, "k *c"], count: int) -> Shaped[Tensor, "n *c"]:
    """Each row as often in turn as makes ``count`` of them; a single one without a copy."""
    return values[:, None].expand(-1, count // len(values), *values.shape[1:]).flatten(0, 1)


def put_rows(
    values: Shaped[Tensor, "b *c"], rows: Int[Tensor, "k"], others: Shaped[Tensor, "k *c"], taken: Bool[Tensor, "k"]
) -> Shaped[Tensor, "b *c"]:
    """The values with others in the place of some rows, where these are ``taken``."""
    chosen = torch.where(taken.view(-1, *[1] * (values.dim() - 1)), others, values.index_select(0, rows))
    return values.index_copy(0, rows, chosen)


def rows_in_all(chosen: Int[Tensor, "k c"], count: int) -> Int[Tensor, "n"]:
    """Numbers of rows among all, of rows that were chosen from ``count`` of each of some objects."""
    return (chosen + count * torch.arange(len(chosen), device=chosen.device)[:, None]).flatten()


def take_points(values: Float[Tensor, "b n k"], index: Int[Tensor, "b m"]) -> Float[Tensor, "b m k"]:
    """``values[b, index[b, m]]``.

    In memory the coordinates are rows, before and after, as :func:`torchtrack.core.lie.transform_points` leaves them.
    """
    return values.transpose(1, 2).gather(2, index[:, None].expand(-1, values.shape[2], -1)).transpose(1, 2)
