"""Shared by several tests: matches_at."""

import torch

from torchtrack.tracking.association.matches import MatchesWithCues


def matches_at(targets, near=None, offsets=0.0):
    """Observations at ``targets``, all ``offsets`` px off the contours that they are near to; none of them is matched."""
    targets = torch.as_tensor(targets, dtype=torch.float64)
    near = torch.ones(targets.shape[:2], dtype=torch.bool) if near is None else torch.as_tensor(near)
    offsets = torch.as_tensor(offsets, dtype=torch.float64).expand(near.shape)
    nothing = torch.zeros(near.shape, dtype=torch.int64)
    points = torch.zeros(*near.shape, 3, dtype=torch.float64)
    directions, zeros, ones = torch.zeros_like(targets), torch.zeros_like(offsets), torch.ones_like(offsets)
    place = points, targets, directions, offsets, near
    return MatchesWithCues(
        nothing,
        torch.zeros_like(near),
        ones,
        zeros,
        *place,
        dark=zeros,
        as_expected=ones,
        effective=ones,
    )
