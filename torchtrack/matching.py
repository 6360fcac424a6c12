"""Association of corners and events with contours, with gates, and moved to the window's end.

Many observations look their nearest contour point up in an index (:mod:`torchtrack.contour_index`); corners may search
along their flow, as the paper does.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import softsign

from torchtrack.config.tracker import MatchingConfig
from torchtrack.contour_index import ContourIndex
from torchtrack.contours import ContourKind, Contours, take_points
from torchtrack.observations import Observations

# An edge this parallel to the flow (|n·f| below) is not crossed by it.
_MIN_CROSSING = 0.3
# Contours slower than this across themselves (px/s) have no clear leading side.
_SLOW_PX_S = 10.0
# Concentration: side of a patch, patches a side of the image, and offsets that are near and on a contour (px).
_PATCH_PX, _PATCHES, _SMEAR_PX, _ON_CONTOUR_PX = 16, 64, 3.0, 0.8


@dataclass(frozen=True)
class Matches:
    """Contour point of each observation.

    Args:
        contour: index of the contour point; 0 where there is none.
        mask: which observations are matched.
        weights: how far each match is to be trusted, 0 to 1.
        targets: ideal pixels of the observations, moved to the window's end.
        directions: unit directions along which the distance counts.
        offsets: distance of each observation from its contour along the normal, in px over the widening of the gate.
        near: which observations have a contour so near that ``offsets`` says something, matched or not.
    """

    contour: Int[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]
    weights: Float[Tensor, "b n"]
    targets: Float[Tensor, "b n 2"]
    directions: Float[Tensor, "b n 2"]
    offsets: Float[Tensor, "b n"]
    near: Bool[Tensor, "b n"]


@dataclass(frozen=True)
class Belief:
    """What an observation is believed to belong to, from the last round or from the object's plane.

    Args:
        motion: image velocity (px/s) that carries the observation to the window's end, and how far its contour moved
            since the contours were indexed (px).
    """

    motion: Float[Tensor, "b n 4"]

    @classmethod
    def from_velocity(cls, velocity: Float[Tensor, "b n 2"]) -> "Belief":
        """A velocity, and contours where they were indexed."""
        return cls(torch.cat([velocity, torch.zeros_like(velocity)], -1))


def match_nearest(
    observations: Observations,
    contours: Contours,
    index: ContourIndex,
    belief: Belief,
    contour_velocity: Float[Tensor, "b m 2"],
    gate_px: float,
    config: MatchingConfig,
    wider: Float[Tensor, "b"] | None = None,
) -> tuple[Matches, Belief]:
    """Match each observation with its nearest contour point, as far as the gate; distances count along the normal.

    Args:
        contours: at the current pose; ``index`` may be of an earlier one.
        belief: where to look for each observation; returned anew for the next round.
        contour_velocity: velocity of each contour point (px/s); zero to switch motion compensation off.
        wider: by how much the gate, and all that is measured against contours, is wider for each object.
    """
    wider = torch.ones_like(contours.pixels[:, 0, 0]) if wider is None else wider
    believed_velocity, believed_moved = belief.motion.chunk(2, -1)
    found = index.look_up(torch.addcmul(observations.pixels - believed_moved, believed_velocity, observations.age_s[..., None]))
    contour = found.clamp(min=0)
    values = take_points(_contour_table(contours, index, contour_velocity), contour)
    pixels, normals, velocity = values[..., :6].chunk(3, -1)
    sharp, oriented = values[..., 8:].unbind(-1)
    targets = torch.addcmul(observations.pixels, velocity, observations.age_s[..., None])
    # Where the dark side of the contour is, by the polarity: along the normal, or against it.
    dark = observations.polarity * softsign((normals * velocity).sum(-1) / _SLOW_PX_S)
    targets = targets - (config.dark_shift_px * dark * sharp)[..., None] * normals
    near = observations.mask & (found >= 0)
    matched = near & ((pixels - targets).square().sum(-1) < (gate_px * wider)[:, None].square())
    motion = torch.where(matched[..., None], values[..., 4:8], belief.motion)
    offsets = ((pixels - targets) * normals).sum(-1) / wider[:, None]
    weights = _weights(offsets, targets, near, dark * oriented, config)
    return Matches(contour, matched, weights, targets, normals, offsets, near), Belief(motion)


def _contour_table(contours: Contours, index: ContourIndex, velocity: Tensor) -> Tensor:
    """What observations take from their contour point: place, normal, velocity, way since indexing, and two marks.

    Sharp are all but the limbs of smooth surfaces: these are no step, as their shading fades towards them. Oriented
    outwards are the normals of the mesh's own edges.
    """
    sharp = contours.kind != int(ContourKind.LIMB)
    oriented = (contours.kind == int(ContourKind.LIMB)) | (contours.kind == int(ContourKind.CREASE))
    marks = torch.stack([sharp, oriented], -1).to(velocity.dtype)
    return torch.cat([contours.pixels, contours.normals, velocity, contours.pixels - index.pixels, marks], -1)


def _weights(offsets: Tensor, targets: Tensor, near: Tensor, dark: Tensor, config: MatchingConfig) -> Tensor:
    """How far each observation is to be trusted, by those around it."""
    weights = torch.ones_like(offsets)
    if config.concentration:
        weights = concentration(offsets, targets, near, config)
    if config.polarity:
        weights = weights * polarity_agreement(dark, offsets, targets, near, config)
    return weights


def concentration(
    offsets: Float[Tensor, "b n"], targets: Float[Tensor, "b n 2"], near: Bool[Tensor, "b n"], config: MatchingConfig
) -> Float[Tensor, "b n"]:
    """How closely the observations around each one lie on the contour, 0 to 1.

    Events of a contour, moved to the window's end with the contour's own motion, gather within a pixel of it. What moves
    otherwise (an occluder, the background, another object) is smeared over the whole gate. So: in each patch of the
    image, the share of the observations near a contour that are on it. No patch counts for nothing: one that is off the
    contour as a whole must still pull a pose back that has begun to slip.
    """
    cell = patch(targets)
    on_count, near_count = (count.gather(1, cell) for count in patch_counts(offsets, targets, near))
    share = (on_count + 1) / (near_count + 2)
    return ((share - config.smeared_share) / (config.gathered_share - config.smeared_share)).clamp(config.least_trust, 1)


def polarity_agreement(
    dark: Float[Tensor, "b n"], offsets: Float[Tensor, "b n"], targets: Float[Tensor, "b n 2"], near: Bool[Tensor, "b n"], config: MatchingConfig
) -> Float[Tensor, "b n"]:
    """How far each observation's polarity agrees with that of most others on the contour around it.

    The two sides of a contour keep their brightness over a patch: an event that says the opposite comes from shading
    within the object, from the background's own edges, or is noise.

    Args:
        dark: +1 where the polarity says that the contour's outer side is the darker one, -1 the inner one, 0 unknown.
    """
    cell = patch(targets)
    on = (near & (offsets.abs() < _ON_CONTOUR_PX)).to(offsets.dtype)
    nothing = torch.zeros(len(offsets), _PATCHES**2, dtype=offsets.dtype, device=offsets.device)
    votes, voters = (nothing.scatter_add(1, cell, values).gather(1, cell) for values in (on * dark, on))
    agreement = dark * votes / (voters + 2)
    return (1 + config.polarity_gain * agreement).clamp(config.least_agreement, 1)


def patch(pixels: Float[Tensor, "b n 2"]) -> Int[Tensor, "b n"]:
    """The patch of the image that each pixel lies in.

    Patches wrap around: no object is so large that two of its own would meet.
    """
    u, v = (pixels / _PATCH_PX).floor().long().remainder(_PATCHES).unbind(-1)
    return torch.add(u, v, alpha=_PATCHES)


def patch_counts(
    offsets: Float[Tensor, "b n"], targets: Float[Tensor, "b n 2"], near: Bool[Tensor, "b n"]
) -> tuple[Float[Tensor, "b p"], Float[Tensor, "b p"]]:
    """Observations on a contour, and near one, in each patch."""
    cell, distance = patch(targets), offsets.abs()
    nothing = torch.zeros(len(offsets), _PATCHES**2, dtype=offsets.dtype, device=offsets.device)
    on, around = (nothing.scatter_add(1, cell, (near & (distance < limit)).to(offsets.dtype)) for limit in (_ON_CONTOUR_PX, _SMEAR_PX))
    return on, around


def match_along_flow(
    observations: Observations, contours: Contours, contour_velocity: Float[Tensor, "b m 2"], gate_px: float, config: MatchingConfig
) -> Matches:
    """Match each corner with the contour point nearest to it along the line of its flow, either way (the paper's 3.3).

    The paper moves corners along the flow "to locate the edge points"; seen from a pose that is a window old the edge
    lies behind, from a predicted one on either side, so both ways are searched. Contours that the flow hardly crosses
    are no match.
    """
    speed = observations.flow.norm(dim=-1, keepdim=True)
    heading = observations.flow / speed.clamp(min=1e-6)
    offsets = contours.pixels[:, None] - observations.pixels[:, :, None]
    along = (offsets * heading[:, :, None]).sum(-1)
    across = offsets[..., 1] * heading[..., None, 0] - offsets[..., 0] * heading[..., None, 1]
    crossing = (contours.normals[:, None] * heading[:, :, None]).sum(-1).abs()
    allowed = contours.mask[:, None] & (across.abs() < config.flow_tolerance_px) & (along.abs() < gate_px) & (crossing > _MIN_CROSSING)
    distance, contour = torch.where(allowed, along.square() + across.square(), torch.inf).min(-1)
    targets = observations.pixels + take_points(contour_velocity, contour) * observations.age_s[..., None]
    directions = heading if config.residual == "flow" else take_points(contours.normals, contour)
    mask = observations.mask & observations.has_flow & torch.isfinite(distance)
    offsets = torch.where(mask, ((take_points(contours.pixels, contour) - targets) * take_points(contours.normals, contour)).sum(-1), 0)
    return Matches(contour, mask, torch.ones_like(offsets), targets, directions, offsets, mask)


def both_coordinates(matches: Matches) -> Matches:
    """The same matches with the distance in u and in v, as two observations each."""
    axes = torch.eye(2, dtype=matches.targets.dtype, device=matches.targets.device)
    directions = torch.cat([axes[axis].expand_as(matches.targets) for axis in range(2)], 1)
    twice = {name: torch.cat([value, value], 1) for name, value in vars(matches).items()}
    return Matches(**(twice | {"directions": directions}))
