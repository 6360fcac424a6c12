"""Which side of an object's contours is the darker one, remembered by the direction that they face in the image.

In one light, and before one background, it stays as it was. Edges of what passes before an object lie on its contours by chance,
move with them for a while, and gather on them as its own events do; but half of them have their darker side where its contours
never had it. So while less is seen of an object than usual, events that say so count little: for the pose, for what the others
around them are worth, and for what is explained.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerable

# What is remembered fades with this time constant (s). Without the memory, errors on the 13 shared sequences are 0.29° / 0.73 mm instead of
# 0.30° / 0.71 mm (docs/results.md), but far more objects that are half hidden were lost when it was made.
PRIOR_S = 0.05
# Directions that are told apart.
_OCTANTS = 8

# An object that explains a smaller share than this when it is seen best is taken for one that is never seen well.
_LEAST_FULL = 0.6
# Shares of what is explained when seen well, from which a window is remembered, and below which the memory counts: at last, in full.
_SEEN_WELL, _SEEN, _HARDLY_SEEN = 0.8, 0.9, 0.6
# So much evidence of a direction in a window makes it count by a half.
LITTLE_EVIDENCE = 3.0


def remembers_polarity(config: TrackerConfig) -> bool:
    """Whether anything is remembered: where polarities do not count, it would be of no use."""
    return config.association.polarity and config.uses(Component.POLARITY_PRIOR)


def nothing_remembered(like: Float[Tensor, "b _"]) -> Float[Tensor, "b 8"]:
    """What is remembered of as many objects as ``like`` has rows, before anything is."""
    return like.new_zeros(len(like), _OCTANTS)


def octant(directions: Float[Tensor, "*n 2"]) -> Int[Tensor, "*n"]:
    """The eighth of the plane that each direction points to."""
    u, v = directions.unbind(-1)
    return (u > 0).long() + 2 * (v > 0) + 4 * (u.abs() > v.abs())


def expected_polarity(
    darker_outside: Float[Tensor, "b 8"], score: Float[Tensor, "b"], reference_explained_ratio: Float[Tensor, "b"]
) -> Float[Tensor, "b 8"]:
    """What events on contours are expected to say of their darker side: 1 for the outer one, -1 for the inner one, 0 for nothing.

    Args:
        darker_outside: from :func:`remembered`; where it was now this and now that, nothing is expected.
        score: of each object, in the window before.
        reference_explained_ratio: explained when the object is seen well.
    """
    seen = score / reference_explained_ratio.clamp(min=_LEAST_FULL)
    counts = ((_SEEN - seen) / (_SEEN - _HARDLY_SEEN)).clamp(0, 1)
    return counts[:, None] * darker_outside * darker_outside.abs()


def is_asked(score: Float[Tensor, "b"], reference_explained_ratio: Float[Tensor, "b"]) -> Bool[Tensor, "b"]:
    """Of which objects anything is expected at all: those that explain less than when they are seen well."""
    return score < _SEEN * reference_explained_ratio.clamp(min=_LEAST_FULL)


def is_seen_well(share: Float[Tensor, "b"], reference_explained_ratio: Float[Tensor, "b"]) -> Bool[Tensor, "b"]:
    """Which objects explain enough for their contours' sides to be remembered."""
    return share >= _SEEN_WELL * reference_explained_ratio.clamp(min=_LEAST_FULL)


@accelerable
def remembered(
    darker_outside: Float[Tensor, "b 8"],
    directions: Float[Tensor, "b n 2"],
    dark: Float[Tensor, "b n"],
    weights: Float[Tensor, "b n"],
    window_s: Float[Tensor, "b"],
) -> Float[Tensor, "b 8"]:
    """What is remembered with a window more: the mean, fading with ``PRIOR_S``, of what events said, by the octant that contours face.

    Args:
        directions: outward normals of the events' contours.
        dark: 1 where an event says that the outer side is the darker one, -1 the inner one, 0 unknown.
        weights: of the events; zero where nothing is to be learned.
    """
    total, evidence = _sums(directions, dark, weights).unbind(1)
    gain = (1 - torch.exp(-window_s / PRIOR_S))[:, None] * evidence / (evidence + LITTLE_EVIDENCE)
    return torch.lerp(darker_outside, total / evidence.clamp(min=1e-3), gain)


def _sums(directions: Float[Tensor, "b n 2"], dark: Float[Tensor, "b n"], weights: Float[Tensor, "b n"]) -> Float[Tensor, "b 2 8"]:
    """What events said of each octant, and how much they said."""
    values = weights[:, None] * torch.stack([dark, dark.abs()], 1)
    sums = values.new_zeros(len(values), 2, _OCTANTS).scatter_add_(2, octant(directions)[:, None].expand_as(values), values)
    return sums.detach()
