"""The box around the points of each object that count."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def bounds(points: Float[Tensor, "b m k"], mask: Bool[Tensor, "b m"]) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """Least and greatest coordinates of each object's points; without points, plus and minus infinity."""
    counts = mask[..., None]
    return torch.where(counts, points, torch.inf).amin(1), torch.where(counts, points, -torch.inf).amax(1)
