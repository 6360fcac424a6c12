"""Poses that are tried, scored as one batch on the events of a view; the best of them, pulled onto the events and scored again.

A pose is scored by what of its outline lies on events along it, and by what of the events lies on its outline. Outlines that move along
themselves hardly fire, and count less.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchtrack.core.neighbours import largest_around
from torchtrack.errors import PoseError
from torchtrack.object_model.rotational_symmetry import RotationGroup
from torchtrack.run.first_pose.event_lines import EventLines, direction_of, near_events
from torchtrack.run.first_pose.outlines import ViewedObject
from torchtrack.run.first_pose.parts import Parts
from torchtrack.run.first_pose.start import Box
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization.edge_search import FAR_PX, NEAR_PX

# What an outline counts that moves along itself, of one that moves across.
_SILENT = 0.3
# Of each rotation's outline so many points are looked at.
_POINTS = 100
# The box of an outline may be so much wider, for its height, than the one that it is to fill.
_SHAPE = math.log(1.45)
# Outlines of fewer points are none.
_FEWEST_POINTS = 3
# Best of the first look that are compared, and those of them that are pulled, once and again.
_COMPARED, _PULLED, _PULLED_AGAIN = 3000, 192, 64
# Pulled at a time: what is not to be held up for long is searched for in parts.
_PULLED_TOGETHER = 64
# Poses with rotations this near to a better one's are left out (degrees): at first, and when they are pulled.
_APART_DEG, _SAME_DEG = 7.0, 3.0
# Events lie on an outline that comes through their cell of so many pixels, or through the next one: at a first look, and at the last.
_COARSE_CELL_PX, _FINE_CELL_PX = 4, 2


_LOOK = "Draw the box around the whole object, and check the model (`torchtrack model`)."


@dataclass(frozen=True)
class Trials:
    """What is tried.

    Args:
        rotations: in the view's frame.
        depth_m: of the centre, which outlines are taken from.
        scales: depths that are tried are ``depth_m`` divided by these, in a view of a box those that fill it.
        shifts_px: moves in the image that are tried.
        centre_px: where the centre is; none where outlines are to fill the ``box``.
        box: of the object in the view.
    """

    rotations: Float[Tensor, "n 3 3"]
    depth_m: float
    scales: Float[Tensor, "s"]
    shifts_px: Float[Tensor, "k 2"]
    centre_px: Float[Tensor, "2"] | None
    box: Box


@dataclass(frozen=True)
class Scored:
    """Poses in the view's frame and their scores, best first."""

    T_view_obj: Float[Tensor, "n 4 4"]
    score: Float[Tensor, "n"]

    @classmethod
    def joined(cls, parts: Sequence["Scored"]) -> "Scored":
        """The poses of all parts."""
        return cls(torch.cat([some.T_view_obj for some in parts]), torch.cat([some.score for some in parts]))

    def best(self, count: int) -> "Scored":
        """Those with the highest scores."""
        chosen = self.score.topk(min(count, len(self.score))).indices
        return Scored(self.T_view_obj[chosen], self.score[chosen])

    def apart(self, group: RotationGroup, apart_deg: float, count: int) -> "Scored":
        """The best that are not like a better one, with the rotations of the object left aside."""
        rotations, kept = self.T_view_obj[:, :3, :3].double(), []
        free = torch.ones(len(rotations), dtype=torch.bool)
        for number in self.score.argsort(descending=True).tolist():
            if free[number]:
                kept.append(number)
                free &= group.angles_deg(rotations[number : number + 1], rotations)[0] > apart_deg
            if len(kept) == count:
                break
        return Scored(self.T_view_obj[kept], self.score[kept])


def search_in_parts(trials: Trials, viewed: ViewedObject, lines: EventLines, group: RotationGroup) -> Parts[Scored]:
    """The best of what is tried, pulled onto the events.

    Raises:
        PoseError: if the object fills a box of this shape in no rotation.
    """
    looked_at = yield from _looked_at(trials, viewed, lines)
    first = looked_at.best(_COMPARED).apart(group, _APART_DEG, _PULLED)
    if len(first.score) == 0:
        raise PoseError(f"in no rotation the object fills a box of this shape. {_LOOK}")
    yield
    again = (yield from _pulled(first, viewed, lines, FAR_PX)).apart(group, _SAME_DEG, _PULLED_AGAIN)
    pulled = yield from _pulled(again, viewed, lines, NEAR_PX)
    return pulled.apart(group, _SAME_DEG, _PULLED_AGAIN)


def _pulled(some: Scored, viewed: ViewedObject, lines: EventLines, reaches_px: tuple[float, ...]) -> Parts[Scored]:
    """Poses pulled onto the events, and scored there."""
    parts = []
    for T in some.T_view_obj.split(_PULLED_TOGETHER):
        parts.append(scored(viewed.pulled(T, lines.density, reaches_px), viewed, lines))
        yield
    return Scored.joined(parts)


def scored(T_view_obj: Float[Tensor, "n 4 4"], viewed: ViewedObject, lines: EventLines) -> Scored:
    """Poses by how well their outlines, as they are seen there, and the events explain each other."""
    outlines = viewed.at(T_view_obj)
    on_events = near_events(lines.fine, outlines.pixels, direction_of(outlines.normals))
    counts = outlines.mask * fires(outlines.normals, lines.velocity_px)
    ratio = (on_events * counts).sum(-1) / counts.sum(-1).clamp(min=1e-6)
    return Scored(T_view_obj, ratio + covered_share(outlines.pixels, outlines.mask, lines, _FINE_CELL_PX))


def _looked_at(trials: Trials, viewed: ViewedObject, lines: EventLines) -> Parts[Scored]:
    """The best scale and shift of each rotation."""
    parts = []
    for rotations, outlines in viewed.by_view(trials.rotations, trials.depth_m):
        parts.append(_best_places(trials, rotations, outlines, viewed, lines))
        yield
    return Scored.joined(parts)


def _best_places(trials: Trials, rotations: Float[Tensor, "n 3 3"], outlines: Contours, viewed: ViewedObject, lines: EventLines) -> Scored:
    """The best scale and shift of some rotations with their outlines straight ahead; of those that can fill the box."""
    placing = _placing(trials, outlines, viewed.intrinsics[0, 2:])
    rotations, step = rotations[placing.fits], max(1, outlines.mask.shape[1] // _POINTS)
    pixels, normals, mask = (values[placing.fits, ::step] for values in (outlines.pixels, outlines.normals, outlines.mask))
    middle, scale = placing.middle[placing.fits], placing.scale[placing.fits, None] * trials.scales
    targets = placing.target + trials.shifts_px
    places = ((pixels - middle[:, None])[:, None] * scale[:, :, None, None])[:, :, None] + targets[:, None]
    counts = mask * fires(normals, lines.velocity_px)
    on_events = near_events(lines.coarse, places, direction_of(normals)[:, None, None])
    score = (on_events * counts[:, None, None]).sum(-1) / counts.sum(-1).clamp(min=1e-6)[:, None, None]
    best, place = score.flatten(1).max(1)
    row, at_scale, at_shift = torch.arange(len(place)), place // len(targets), place % len(targets)
    covered = covered_share(places[row, at_scale, at_shift], mask, lines, _COARSE_CELL_PX)
    principal, focal = viewed.intrinsics[0, 2:], viewed.intrinsics[0, :2]
    centre_px = (principal - middle) * scale[row, at_scale, None] + targets[at_shift]
    depth = (trials.depth_m / scale[row, at_scale])[:, None]
    centre = torch.cat([(centre_px - principal) / focal * depth, depth], 1)
    return Scored(viewed.placed(rotations, centre), best + covered)


@dataclass(frozen=True)
class _Placing:
    """How outlines that are straight ahead are placed in the view.

    Args:
        middle: what of each is brought to the ``target`` (px).
        scale: how much larger each becomes.
        fits: which have the shape for it.
    """

    middle: Float[Tensor, "n 2"]
    target: Float[Tensor, "2"]
    scale: Float[Tensor, "n"]
    fits: Bool[Tensor, "n"]


def _placing(trials: Trials, outlines: Contours, principal: Float[Tensor, "2"]) -> _Placing:
    pixels, mask = outlines.pixels, outlines.mask[..., None]
    seen = outlines.mask.sum(1) > _FEWEST_POINTS
    if trials.centre_px is not None:
        return _Placing(principal.expand(len(pixels), 2), trials.centre_px, torch.ones(len(pixels)), seen)
    low, high = torch.where(mask, pixels, torch.inf).amin(1), torch.where(mask, pixels, -torch.inf).amax(1)
    size = (high - low).clamp(min=1.0)
    ratio = (trials.box.size / size).log()
    # The longer side is measured better.
    scale = (ratio * size / size.sum(1, keepdim=True)).sum(1).exp()
    fits = seen & ((ratio[:, 0] - ratio[:, 1]).abs() < _SHAPE)
    return _Placing(((low + high) / 2).nan_to_num(0.0), trials.box.centre, scale, fits)


def fires(normals: Float[Tensor, "*n 2"], velocity_px: Float[Tensor, "2"]) -> Float[Tensor, "*n"]:
    """How much of an outline fires, by its normals: one that moves across itself in full."""
    speed = velocity_px.norm()
    if speed < 1.0:
        return torch.ones_like(normals[..., 0])
    return _SILENT + (1 - _SILENT) * (normals @ (velocity_px / speed)).abs()


def covered_share(pixels: Float[Tensor, "n m 2"], mask: Bool[Tensor, "n m"], lines: EventLines, cell_px: int) -> Float[Tensor, "n"]:
    """Which share of the events lies within a cell of the outlines, or in the next one."""
    side = lines.weights.shape[0] // cell_px
    weights = avg_pool2d(lines.weights[None], cell_px)[0] * cell_px**2
    u, v = (pixels / cell_px).floor().nan_to_num(-1.0).unbind(-1)
    inside = mask & (u >= 0) & (u < side) & (v >= 0) & (v < side)
    place = torch.where(inside, v * side + u, 0).long()
    drawn = torch.zeros(len(pixels), side * side).scatter_reduce(1, place, inside.float(), "amax").view(-1, side, side)
    return (largest_around(drawn, 1) * weights).sum((1, 2))
