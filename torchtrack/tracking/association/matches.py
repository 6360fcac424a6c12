"""What an observation is matched with: where, and how far that is to be trusted; apart from it, what is remembered of contours."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core.field_values import field_values


@dataclass(frozen=True)
class Matches:
    """Contour point of each observation.

    Args:
        contour: index of the contour point; 0 where there is none.
        mask: which observations are matched.
        weights: how far each match is to be trusted, 0 to 1.
        age_s: time from when the contour passed to the window's end (s).
        points_obj: the contour point in the object's frame (m).
        targets: ideal pixels of the observations, moved to the window's end.
        directions: unit directions along which the distance counts.
        offsets: distance of each observation from its contour along the normal, in px over the scale of the gate.
        near: which observations have a contour so near that ``offsets`` says something, matched or not.
        as_expected: how far each says of its contour's darker side what is expected, 0 to 1; 1 where nothing is.
    """

    contour: Int[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]
    weights: Float[Tensor, "b n"]
    age_s: Float[Tensor, "b n"]
    points_obj: Float[Tensor, "b n 3"]
    targets: Float[Tensor, "b n 2"]
    directions: Float[Tensor, "b n 2"]
    offsets: Float[Tensor, "b n"]
    near: Bool[Tensor, "b n"]
    as_expected: Float[Tensor, "b n"]


@dataclass(frozen=True)
class MatchesWithCues(Matches):
    """Matches, and what else there is to be said of them.

    Args:
        dark: 1 where an event says that the outer side of its contour is the darker one, -1 the inner one; 0 where that is not known.
        effective: how far each counts beside those around it that have an error in common with it, 0 to 1.
    """

    dark: Float[Tensor, "b n"]
    effective: Float[Tensor, "b n"]


def both_coordinates(matches: MatchesWithCues) -> MatchesWithCues:
    """The same matches with the distance in u and in v, as two observations each."""
    axes = torch.eye(2, dtype=matches.targets.dtype, device=matches.targets.device)
    directions = torch.cat([axes[axis].expand_as(matches.targets) for axis in range(2)], 1)
    twice = {name: torch.cat([value, value], 1) for name, value in field_values(matches).items()}
    return replace(matches, **(twice | {"directions": directions}))
