"""Association of corners and events with contours, with gates, and moved to the window's end.

Many observations look their nearest contour point up in an index (:mod:`torchtrack.tracking.contours.index`); corners may search
along their flow, as the paper does.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.linalg import vecdot

from torchtrack.common_error import APART_PX, ASIDE_PX, DEPTH_SHARE, PARALLEL, SORTED_PX2, TOUCHING_PX, mistaken_px2
from torchtrack.config.tracker import MatchingConfig
from torchtrack.core import dispatch
from torchtrack.core.constants import constant, one
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.core.padded import take_points
from torchtrack.kernels.arrays import as_arrays
from torchtrack.kernels.settings import TableSettings
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.polarity_memory import octant
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.bursts import without_tail

# An edge this parallel to the flow (|n·f| below) is not crossed by it.
_MIN_CROSSING = 0.3
# Contours slower than this across themselves (px/s) have no clear leading side.
SLOW_PX_S = 10.0
# Concentration: side of a patch (16 px, as a power of two), patches a side of the image, and offsets that are near and on a contour (px).
PATCH_BITS, PATCHES, SMEAR_PX, ON_CONTOUR_PX = 4, 64, 3.0, 0.8
# Mutual agreement: side of a bit of contour (8 px, as a power of two), and how many others there make its mean count in full.
_PIECE_BITS, _MANY_OTHERS = 3, 3


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
        offsets: distance of each observation from its contour along the normal, in px over the widening of the gate.
        near: which observations have a contour so near that ``offsets`` says something, matched or not.
        limb: 1 where the contour is the limb of a smooth surface, 0 where not.
        beside: how many observations are on the contour in the patch of the image that each lies in.
        mistaken_px2: mean square of how far off each is, should it be of an edge that lies beside its contour (px²).
        dark: 1 where an event says that the outer side of its contour is the darker one, -1 the inner one; 0 where that is not known.
        as_expected: how far that is what it is expected to say, 0 to 1.
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
    limb: Float[Tensor, "b n"]
    beside: Float[Tensor, "b n"]
    mistaken_px2: Float[Tensor, "b n"]
    dark: Float[Tensor, "b n"]
    as_expected: Float[Tensor, "b n"]


@dataclass(frozen=True)
class ContourTable:
    """What observations take from their contour point, laid out in rows.

    Args:
        rows: the values of all contour points, laid out so that one selection takes them for all observations.
        index: the contour point nearest to each place in the image.
        not_plain: objects of which print or smooth limbs are seen.
    """

    rows: Float[Tensor, "b k m"]
    index: ContourIndex
    not_plain: Bool[Tensor, "b"]

    @classmethod
    def of(
        cls, contours: Contours, index: ContourIndex, polarity: Float[Tensor, "b 8"] | None = None, *, of_print: bool = True, close_px: float = 0.0
    ) -> "ContourTable":
        """The table of contours and their index.

        The normals of the mesh's own edges are oriented: they point outwards. Those of print point to its darker side.

        Args:
            polarity: expected of the mesh's own edges, by the octant that they face (:func:`torchtrack.polarity_memory.expected_polarity`).
            of_print: whether anything is expected of print.
            close_px: distance from which parallel edges are told apart; 0 for always.
        """
        if dispatch.apply_to(contours.pixels):
            return _table_by_kernel(contours, index, polarity, of_print=of_print, close_px=close_px)
        limb, crease, texture = (contours.kind == int(kind) for kind in (ContourKind.LIMB, ContourKind.CREASE, ContourKind.TEXTURE))
        oriented, expected = limb | crease, (texture & of_print).to(contours.pixels.dtype)
        if polarity is not None:
            expected = torch.where(oriented, polarity.gather(1, octant(contours.normals)), expected)
        mistaken = mistaken_px2(contours, index, oriented, crease, close_px) if close_px else torch.zeros_like(expected)
        marks = torch.stack([limb.to(expected.dtype), oriented.to(expected.dtype), expected, mistaken], -1)
        values = (contours.points_obj, contours.normals, index.pixels, marks)
        return cls(torch.cat([value.transpose(1, 2) for value in values], 1), index, ((limb | texture) & contours.mask).any(1))

    def take(self, contour: Int[Tensor, "b n"]) -> tuple[Tensor, ...]:
        """Of contour points: places on the object, normals, pixels when indexed; limb or not, oriented or not, darker side expected, mistaken."""
        taken = self.rows.gather(2, contour[:, None].expand(-1, self.rows.shape[1], -1)).transpose(1, 2)
        points_obj, normals, indexed, marks = taken.split((3, 2, 2, 4), -1)
        return points_obj, normals, indexed, *marks.unbind(-1)


def _table_by_kernel(contours: Contours, index: ContourIndex, polarity: Tensor | None, *, of_print: bool, close_px: float) -> ContourTable:
    """:meth:`ContourTable.of`, point by point."""
    # Not at the top: Numba is an extra.
    from torchtrack.kernels import table as kernels

    limb, crease, texture = (int(kind) for kind in (ContourKind.LIMB, ContourKind.CREASE, ContourKind.TEXTURE))
    close = ASIDE_PX, PARALLEL, APART_PX, TOUCHING_PX, DEPTH_SHARE, SORTED_PX2
    settings = TableSettings(limb, crease, texture, of_print, close_px, *close)
    table, not_plain = contours.points_obj.new_empty(*contours.mask.shape, kernels.COLUMNS), torch.empty_like(contours.mask[:, 0])
    points, pixels, normals, indexed = (value.transpose(1, 2) for value in (contours.points_obj, contours.pixels, contours.normals, index.pixels))
    expected = pixels.new_empty(len(table), 0) if polarity is None else polarity
    given = as_arrays(points, contours.points_cam[..., 2], pixels, normals, contours.kind, contours.mask, indexed, index.nearest, index.first)
    kernels.fill(*given, index.cells, *as_arrays(expected), settings, table.numpy(), not_plain.numpy())
    return ContourTable(table.transpose(1, 2), index, not_plain)


def match_nearest(
    observations: Observations,
    table: ContourTable,
    place: Float[Tensor, "b n 2"],
    objects: MovingObjects,
    gate_px: float,
    config: MatchingConfig,
    wider: Float[Tensor, "b"] | None = None,
    finely: Bool[Tensor, "b"] | None = None,
) -> tuple[Matches, Float[Tensor, "b n 2"]]:
    """Match each observation with its nearest contour point, as far as the gate; distances count along the normal.

    Args:
        table: of the contours, as they were indexed at some pose.
        place: where to look for each observation among the contours as indexed; returned anew for the next round.
        objects: at the current poses; a velocity of zero switches motion compensation off.
        wider: by how much the gate, and all that is measured against contours, is wider for each object.
        finely: objects whose contours are looked up finely; none where not given.
    """
    wider = torch.ones_like(place[:, 0, 0]) if wider is None else wider
    found = table.index.look_up(place, finely)
    points_obj, normals, indexed, limb, oriented, expected, mistaken = table.take(contour := found.clamp(min=0))
    pixels, velocity, change = objects.show(points_obj)
    crossing_px_s = vecdot(normals, velocity)
    dark = observations.polarity * _leading(crossing_px_s)
    age_s = without_tail(observations.age_s, observations.into_burst_s, crossing_px_s, config.burst_px)
    carried = torch.addcmul(observations.pixels, velocity, age_s[..., None])
    if change is not None:
        # It had moved less, or more, when it was slower or faster.
        carried = torch.addcmul(carried, change, age_s[..., None].square(), value=-0.5)
    targets = torch.addcmul(carried, normals, (dark * _dark_shift_px(limb, config))[..., None], value=-1)
    difference = pixels - targets
    near = observations.mask & (found >= 0)
    matched = near & (vecdot(difference, difference) < (gate_px * wider)[:, None].square())
    offsets = vecdot(difference, normals) / wider[:, None]
    as_expected, dark = _agreeing(dark * expected, config), dark * oriented
    weights, beside = _weights(offsets, targets, near, dark, as_expected, config)
    if config.mutual_px:
        weights = weights * mutual_agreement(pixels, offsets, matched, config.mutual_px)
    matches = Matches(contour, matched, weights, age_s, points_obj, targets, normals, offsets, near, limb, beside, mistaken, dark, as_expected)
    # Without the dark shift: between edges that lie close, it would make a choice confirm itself.
    return matches, torch.where(matched[..., None], carried - (pixels - indexed), place)


def _leading(speed_px_s: Tensor) -> Tensor:
    """Whether a contour moves along its normal or against it: 1 or -1, and less where it is slow."""
    return speed_px_s / (speed_px_s.abs() + constant((SLOW_PX_S,), speed_px_s.dtype, speed_px_s.device))


def _dark_shift_px(limb: Tensor, config: MatchingConfig) -> Tensor:
    """How far events lie to the dark side of their edge: a step's, or, less, that of a limb, towards which shading fades."""
    return torch.add(constant((config.dark_shift_px,), limb.dtype, limb.device), limb, alpha=config.limb_dark_shift_px - config.dark_shift_px)


def _weights(offsets: Tensor, targets: Tensor, near: Tensor, dark: Tensor, as_expected: Tensor, config: MatchingConfig) -> tuple[Tensor, Tensor]:
    """How far each observation is to be trusted, by those around it, and how many of these are on the contour."""
    cell, on_and_near = patch(targets), on_and_around(offsets, near) * as_expected[:, None]
    values = torch.cat([on_and_near, on_and_near[:, :1] * dark[:, None]], 1)
    on_count, near_count, votes = patch_sums(cell, values).gather(2, cell[:, None].expand(-1, 3, -1)).unbind(1)
    weights = as_expected * concentration(on_count, near_count, config) if config.concentration else as_expected
    return weights * polarity_agreement(dark, votes, on_count, config) if config.polarity else weights, on_count


def concentration(on_count: Float[Tensor, "b n"], near_count: Float[Tensor, "b n"], config: MatchingConfig) -> Float[Tensor, "b n"]:
    """How closely the observations around each one lie on the contour, 0 to 1, by their numbers in its patch of the image.

    Events of a contour, moved to the window's end with the contour's own motion, gather within a pixel of it. What moves
    otherwise (an occluder, the background, another object) is smeared over the whole gate. So: in each patch, the share
    of the observations near a contour that are on it. No patch counts for nothing: one that is off the contour as a whole
    must still pull a pose back that has begun to slip.
    """
    share, gain = (on_count + one(on_count)) / (near_count + _two(near_count)), 1 / (config.gathered_share - config.smeared_share)
    smeared = constant((-config.smeared_share * gain,), share.dtype, share.device)
    return torch.add(smeared, share, alpha=gain).clamp_(config.least_trust, 1)


def polarity_agreement(
    dark: Float[Tensor, "b n"], votes: Float[Tensor, "b n"], voters: Float[Tensor, "b n"], config: MatchingConfig
) -> Float[Tensor, "b n"]:
    """How far each observation's polarity agrees with that of most others on the contour in its patch of the image.

    The two sides of a contour keep their brightness over a patch: an event that says the opposite comes from shading
    within the object, from the background's own edges, or is noise.

    Args:
        dark: +1 where the polarity says that the contour's outer side is the darker one, -1 the inner one, 0 unknown.
        votes: sum of the same over the observations on the contour, of which there are ``voters``.
    """
    return _agreeing(dark * votes / (voters + _two(voters)), config)


def _agreeing(agreement: Tensor, config: MatchingConfig) -> Tensor:
    """Trust in events whose polarity is what it should be, 1, or the opposite, -1, as far as that is known."""
    return torch.add(one(agreement), agreement, alpha=config.polarity_gain).clamp_(config.least_agreement, 1)


def mutual_agreement(
    pixels: Float[Tensor, "b n 2"], offsets: Float[Tensor, "b n"], matched: Bool[Tensor, "b n"], spread_px: float
) -> Float[Tensor, "b n"]:
    """How far each observation lies where the others of its bit of contour do, 0 to 1: Cauchy's weight of its distance from their mean.

    Events of one edge lie side by side, on the contour or, as a pose begins to slip, beside it. One that lies elsewhere
    than they do is of another edge, or noise. Not the pose but the mean is what it is measured against, so that nothing
    keeps a contour from being pulled to where all its events are.

    Args:
        pixels: the contour point of each.
        offsets: from it, along its normal (px).
        matched: which of them count; one on its own is trusted.
        spread_px: distance from the mean at which trust is a half, among many.
    """
    cell, counted = patch(pixels, _PIECE_BITS), matched.to(offsets.dtype)
    sums = patch_sums(cell, torch.stack([counted, counted * offsets], 1))
    count, total = sums.gather(2, cell[:, None].expand(-1, 2, -1)).unbind(1)
    relative = (offsets - total / count.clamp(min=1)) / spread_px
    known = (count - one(count)).clamp_(0, _MANY_OTHERS) / _MANY_OTHERS
    return torch.addcmul(one(known), known, relative * relative).reciprocal()


def _two(like: Tensor) -> Tensor:
    return constant((2.0,), like.dtype, like.device)


def patch(pixels: Float[Tensor, "b n 2"], bits: int = PATCH_BITS) -> Int[Tensor, "b n"]:
    """The patch of the image that each pixel lies in, whose side is a power of two (px): that of ``bits``.

    Patches wrap around: no object is so large that two of its own would meet, and if two of few pixels do, little is lost.
    """
    # The whole part of a shift to the right is rounded down, below zero too, unlike that of a division.
    u, v = ((pixels.floor().long() >> bits) & (PATCHES - 1)).unbind(-1)
    return torch.add(u, v, alpha=PATCHES)


def on_and_around(offsets: Float[Tensor, "b n"], near: Bool[Tensor, "b n"]) -> Float[Tensor, "b 2 n"]:
    """Which observations are on a contour, and which are so near to one that their share tells: 1 or 0."""
    limits = constant(((ON_CONTOUR_PX,), (SMEAR_PX,)), offsets.dtype, offsets.device)
    return (near[:, None] & (offsets.abs()[:, None] < limits)).to(offsets.dtype)


def patch_sums(cell: Int[Tensor, "b n"], values: Float[Tensor, "b k n"]) -> Float[Tensor, "b k p"]:
    """Sums of values over the observations of each patch."""
    nothing = torch.zeros(*values.shape[:2], PATCHES**2, dtype=values.dtype, device=values.device)
    return nothing.scatter_add(2, cell[:, None].expand_as(values), values)


def match_along_flow(observations: Observations, contours: Contours, objects: MovingObjects, gate_px: float, config: MatchingConfig) -> Matches:
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
    points_obj = take_points(contours.points_obj, contour)
    targets = torch.addcmul(observations.pixels, objects.show(points_obj)[1], observations.age_s[..., None])
    directions = heading if config.residual == "flow" else take_points(contours.normals, contour)
    mask = observations.mask & observations.has_flow & torch.isfinite(distance)
    offsets = torch.where(mask, ((take_points(contours.pixels, contour) - targets) * take_points(contours.normals, contour)).sum(-1), 0)
    limb = (contours.kind == int(ContourKind.LIMB)).gather(1, contour).to(offsets.dtype)
    none, all_of_it = torch.zeros_like(offsets), torch.ones_like(offsets)
    told = observations.age_s, points_obj, targets, directions, offsets, mask
    return Matches(contour, mask, all_of_it, *told, limb, beside=none, mistaken_px2=none, dark=none, as_expected=all_of_it)


def both_coordinates(matches: Matches) -> Matches:
    """The same matches with the distance in u and in v, as two observations each."""
    axes = torch.eye(2, dtype=matches.targets.dtype, device=matches.targets.device)
    directions = torch.cat([axes[axis].expand_as(matches.targets) for axis in range(2)], 1)
    twice = {name: torch.cat([value, value], 1) for name, value in vars(matches).items()}
    return Matches(**(twice | {"directions": directions}))
