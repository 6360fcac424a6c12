"""What tells whether an observation is of the contour near it: its place, and a space-time patch of events around it.

Everything is measured in the frame of the nearest predicted contour: its normal, turned to where the object moves, and
its tangent. The events of the object's own edges, moved to the window's end with the object, gather on lines along the
tangent, and the time surface rises along the normal as the edge's speed says; those of occluders, of the background and
of noise do neither. How far the observation lies from the contour is not told: the gates and the robust loss see to that,
and better with every round. Trust that fell with the distance would hold a pose fast that has begun to slip.
"""

from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import one_hot, softsign

from torchtrack.constants import constant
from torchtrack.contour_model import ContourKind
from torchtrack.contours import take_points
from torchtrack.evidence import Evidence

# Where the patch is sampled: across the contour and along it (px). Negative is behind the moving edge.
_ACROSS_PX = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0)
_ALONG_PX = (-2.0, 0.0, 2.0)
# What is older than this, in px of the edge's motion, says no more.
_OLDEST_PX = 6.0
# Slower than this (px/s), an edge has no direction that it moves to.
_SLOW_PX_S = 10.0
# Events this far outside the image are counted too; beyond them a row of nothing (px).
_BORDER_PX = 8
# Kinds of contours that a model has.
_KINDS = int(ContourKind.SPLAT) + 1
FEATURES = len(_ACROSS_PX) * (2 * len(_ALONG_PX) + 1) + _KINDS + 6
"""How many numbers describe an observation."""


@dataclass(frozen=True)
class _Frame:
    """The contour nearest to each observation, and the observation moved to the window's end with it.

    Args:
        exists: where there is one; ``kind`` of it.
        normal: turned to where the contour moves; ``outward`` is -1 where that turned it round.
        speed_px_s: of the contour along its normal.
        moved: the observation at the window's end.
    """

    exists: Tensor
    kind: Tensor
    normal: Tensor
    outward: Tensor
    speed_px_s: Tensor
    moved: Tensor

    def around(self, centre: Float[Tensor, "b n 2"], along_px: tuple[float, ...]) -> tuple[Float[Tensor, "b n p"], Float[Tensor, "b n p"]]:
        """Columns and rows of the places of a patch around each centre."""
        across, along = constant(tuple(product(_ACROSS_PX, along_px)), centre.dtype, centre.device).T
        (u, v), (nu, nv) = centre[..., None].unbind(-2), self.normal[..., None].unbind(-2)
        return u + across * nu - along * nv, v + across * nv + along * nu


def trust_features(evidence: Evidence) -> Float[Tensor, "b n f"]:
    """What describes each observation: numbers of about unit size."""
    observations = evidence.observations
    frame = _frame(evidence)
    polarity = observations.polarity
    single = [
        (frame.speed_px_s / 100).log1p(),
        polarity,
        polarity * frame.outward,
        polarity.abs(),
        observations.age_s / evidence.events.age_s.amax(-1, keepdim=True).clamp(min=1e-6),
        frame.exists.to(polarity.dtype),
    ]
    # Contours that were learned are print.
    kind = torch.where(frame.kind == int(ContourKind.LEARNED), int(ContourKind.TEXTURE), frame.kind)
    kinds = one_hot(kind, _KINDS).to(polarity.dtype)
    return torch.cat([_counts(evidence, frame), _ages(evidence, frame), kinds, torch.stack(single, -1)], -1)


def _frame(evidence: Evidence) -> _Frame:
    """Nearest contours, as the predicted motion says."""
    observations, contours, prediction = evidence.observations, evidence.contours, evidence.prediction
    plane = prediction.plane_velocity(observations.pixels)
    found = evidence.index.look_up(torch.addcmul(observations.pixels, plane, observations.age_s[..., None]))
    table = torch.cat([contours.normals, prediction.contour_velocity(contours), contours.kind[..., None].to(plane.dtype)], -1)
    normals, velocity, kind = take_points(table, found.clamp(min=0)).split([2, 2, 1], -1)
    speed = (normals * velocity).sum(-1)
    outward = torch.where(speed < 0, -1.0, 1.0).to(speed.dtype)
    moved = torch.addcmul(observations.pixels, velocity, observations.age_s[..., None])
    return _Frame(found >= 0, kind[..., 0].long(), outward[..., None] * normals, outward, speed.abs().clamp(min=_SLOW_PX_S), moved)


def _ages(evidence: Evidence, frame: _Frame) -> Float[Tensor, "b n p"]:
    """How much older than the observation the time surface is across the contour, in px of the edge's motion."""
    observations = evidence.observations
    places = torch.stack(frame.around(observations.pixels, (0.0,)), -1)
    newest_s = evidence.age_s(places.flatten(1, 2)).view(places.shape[:3])
    behind_px = (newest_s - observations.age_s[..., None]) * frame.speed_px_s[..., None]
    return behind_px.clamp(-_OLDEST_PX, _OLDEST_PX) / _OLDEST_PX


def _counts(evidence: Evidence, frame: _Frame) -> Float[Tensor, "b n p"]:
    """Events of the observation's own polarity and of the other, around it, all moved to the window's end with the object."""
    events, prediction = evidence.events, evidence.prediction
    moved = prediction.carried(events.pixels, events.age_s)
    height, width = (size + 2 * _BORDER_PX for size in prediction.objects.image_size)
    cell = _cells(moved[..., 0], moved[..., 1], height, width) + (events.polarity > 0)
    counts = torch.zeros(len(cell), 2 * height * width, dtype=moved.dtype, device=moved.device)
    counts = counts.scatter_add(1, cell, events.mask.to(moved.dtype)).view(len(cell), height, width, 2)
    for border in (0, -1):
        counts[:, border] = counts[:, :, border] = 0
    u, v = frame.around(frame.moved, _ALONG_PX)
    places = _cells(u, v, height, width)
    own = places + (evidence.observations.polarity >= 0)[..., None]
    of_both = torch.cat([own, 2 * places + 1 - own], -1)
    found = counts.view(len(cell), -1).gather(1, of_both.flatten(1)).view(of_both.shape)
    return softsign(found)


def _cells(u: Float[Tensor, "*b"], v: Float[Tensor, "*b"], height: int, width: int) -> Int[Tensor, "*b"]:
    """Twice the cell of each pixel in the bordered image; its outermost cells stand for all beyond."""
    column = (u.round() + _BORDER_PX).nan_to_num(0.0).clamp(0, width - 1)
    row = (v.round() + _BORDER_PX).nan_to_num(0.0).clamp(0, height - 1)
    return 2 * torch.add(column, row, alpha=width).long()
