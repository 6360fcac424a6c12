"""How far each match is to be trusted."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.linalg import vecdot

from torchtrack.config.components import Component
from torchtrack.config.tracker import AssociationConfig, TrackerConfig
from torchtrack.core.constants import constant, scalar_one
from torchtrack.core.padded import take_points
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours

# Where an edge is looked for beside another (px): found as far as twice that.
ASIDE_PX = 2.0


# Contours with normals this parallel (|n·m| above) and this far apart (px) are two edges.
PARALLEL, APART_PX = 0.9, 0.5


# So are sharp edges that hardly lie apart in the image, if they do in depth: by more than this share of the depth of all that is seen.
TOUCHING_PX, DEPTH_SHARE = 0.1, 0.2


# Events around such two edges sort themselves onto both by chance: as if these were farther apart by this much (px²).
SORTED_PX2 = 0.3


def effective_weight(neighbours: Float[Tensor, "b n"], common_px2: Float[Tensor, "b n"], observation_px: float) -> Float[Tensor, "b n"]:
    """What each of so many observations in one place of the image tells, of what it would tell alone.

    Side by side they err alike, so the mean of n has a variance of ``common_px2 + observation_px² / n``. Otherwise a pose would
    follow the places with the most events, and what is seen of an object that is half hidden would seem to tell all.

    Args:
        neighbours: how many observations are on the contour in the place of each.
        common_px2: variance of what they have in common (px²).
        observation_px: standard deviation of what each has alone.
    """
    return torch.addcmul(scalar_one(neighbours), neighbours, common_px2, value=observation_px**-2).reciprocal()


def edge_ambiguity_px2(
    contours: Contours, index: ContourIndex, of_edges: Bool[Tensor, "b m"], sharp: Bool[Tensor, "b m"], close_px: float
) -> Float[Tensor, "b m"]:
    """Mean square of how far off what is seen on each contour point is, should it be of the edge beside (px²).

    A face that comes into sight has its new edge beside the old one, and of the two often only one fires, as the other hardly
    shows. Events around it are then taken for those of the silent edge, too, which they draw to themselves: the face never opens.
    Of two edges ``s`` apart the wrong one is chosen with a probability of ``exp(-(s / close_px)²) / 2``, and that is ``s`` off.

    Where two sharp edges at different depths nearly cover each other, what is noise to one side of them is taken for the one, and
    what is noise to the other side for the other: a pose that draws them apart explains both, however silent one of them is.

    Args:
        contours: with the ``index`` of them.
        of_edges: points that are on edges of the mesh: of texture, both sides fire.
        sharp: which of them are creases.
        close_px: distance from which edges are told apart.
    """
    pixels, normals = contours.pixels[:, None], contours.normals[:, None]
    aside_px = constant((-ASIDE_PX, ASIDE_PX), pixels.dtype, pixels.device)[:, None]
    nearest_index = index.look_up(torch.addcmul(pixels, normals, aside_px[..., None]).flatten(1, 2))
    counts = contours.mask & of_edges
    depth_m = contours.points_cam[..., 2]
    marks = torch.stack([counts.to(pixels.dtype), sharp.to(pixels.dtype), depth_m], -1)
    known = take_points(torch.cat([contours.pixels, contours.normals, marks], -1), nearest_index.clamp(min=0)).unflatten(1, (2, -1))
    other_pixels, other_normals, other_marks = known.split((2, 2, 3), -1)
    is_edge, is_sharp, other_depth_m = other_marks.unbind(-1)
    apart_px = vecdot(other_pixels - pixels, normals)
    is_parallel = vecdot(other_normals, normals).abs() > PARALLEL
    least_m = DEPTH_SHARE * _range_m(depth_m, contours.mask)[:, None, None]
    is_deep = ((other_depth_m - depth_m[:, None]).abs() > least_m) & sharp[:, None] & (is_sharp > 0)
    # To the side that was looked at, and not the same edge.
    beyond_px = apart_px * aside_px / ASIDE_PX
    is_apart = (beyond_px > APART_PX) | (is_deep & (beyond_px > TOUCHING_PX))
    is_other = is_apart & is_parallel & counts[:, None] & (is_edge > 0) & (nearest_index >= 0).unflatten(1, (2, -1))
    squared = apart_px.square()
    seeming = torch.where(is_deep, squared + SORTED_PX2, squared)
    return torch.where(is_other, 0.5 * seeming * torch.exp(squared * -(close_px**-2)), 0).amax(1)


def _range_m(depth_m: Float[Tensor, "b m"], mask: Bool[Tensor, "b m"]) -> Float[Tensor, "b"]:
    """How far apart in depth the nearest and the farthest point of each object are (m)."""
    return torch.where(mask, depth_m, -torch.inf).amax(1) - torch.where(mask, depth_m, torch.inf).amin(1)


# Contours slower than this across themselves (px/s) have no clear leading side.
SLOW_PX_S = 10.0


# Concentration: of the observations near a contour, the share on it at which a patch counts least, and in full; and what it counts then. No patch
# counts for nothing: one that is off its contour as a whole must still pull back a pose that slips. Off, errors are 0.30° / 0.78 mm instead of
# 0.30° / 0.71 mm (docs/results.md); the numbers were not measured alone.
SMEARED_SHARE, GATHERED_SHARE, LEAST_TRUST = 0.35, 0.6, 0.02
# Polarity: how fast trust falls with the majority of the others, and what the wrong one still counts. Not measured alone.
POLARITY_GAIN, LEAST_AGREEMENT = 1.5, 0.05
# How far to the dark side of a sharp edge events lie (px), as a blurred step's logarithm does, and of a smooth silhouette, towards which shading
# fades. Errors without the one are 0.33° / 0.85 mm, without the other 0.29° / 0.76 mm, with both 0.30° / 0.71 mm (docs/results.md).
DARK_SHIFT_PX, SILHOUETTE_DARK_SHIFT_PX = 0.15, 0.06
# Concentration: side of a patch (16 px, as a power of two), patches a side of the image, and offsets that are near and on a contour (px).
PATCH_BITS, PATCHES, SMEAR_PX, ON_CONTOUR_PX = 4, 64, 3.0, 0.8


def leading_side(speed_px_s: Tensor) -> Tensor:
    """Whether a contour moves along its normal or against it: 1 or -1, and less where it is slow."""
    return speed_px_s / (speed_px_s.abs() + constant((SLOW_PX_S,), speed_px_s.dtype, speed_px_s.device))


def dark_shifts_px(config: TrackerConfig) -> tuple[float, float]:
    """How far events lie to the dark side of a step, and of a smooth silhouette; zero where that is disabled."""
    of_each = (Component.DARK_SHIFT, DARK_SHIFT_PX), (Component.SILHOUETTE_DARK_SHIFT, SILHOUETTE_DARK_SHIFT_PX)
    step_px, silhouette_px = (shift_px if config.uses(component) else 0.0 for component, shift_px in of_each)
    return step_px, silhouette_px


def dark_shift_px(silhouette: Tensor, config: TrackerConfig) -> Tensor:
    """How far events lie to the dark side of their edge: a step's, or, less, that of a smooth silhouette, towards which shading fades."""
    step_px, silhouette_px = dark_shifts_px(config)
    return torch.add(constant((step_px,), silhouette.dtype, silhouette.device), silhouette, alpha=silhouette_px - step_px)


def match_weights(
    offsets: Tensor, targets: Tensor, near: Tensor, dark: Tensor, as_expected: Tensor, config: AssociationConfig
) -> tuple[Tensor, Tensor]:
    """How far each observation is to be trusted, by those around it, and how many of these are on the contour."""
    cell, on_and_near = patch(targets), on_and_around(offsets, near) * as_expected[:, None]
    values = torch.cat([on_and_near, on_and_near[:, :1] * dark[:, None]], 1)
    on_count, near_count, votes = patch_sums(cell, values).gather(2, cell[:, None].expand(-1, 3, -1)).unbind(1)
    weights = as_expected * concentration(on_count, near_count) if config.concentration else as_expected
    return weights * polarity_agreement(dark, votes, on_count) if config.polarity else weights, on_count


def concentration(on_count: Float[Tensor, "b n"], near_count: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """How closely the observations around each one lie on the contour, 0 to 1, by their numbers in its patch of the image.

    Events of a contour, moved to the window's end with the contour's own motion, gather within a pixel of it. What moves
    otherwise (an occluder, the background, another object) is smeared over the whole gate. So: in each patch, the share
    of the observations near a contour that are on it.
    """
    share, gain = (on_count + scalar_one(on_count)) / (near_count + two_of(near_count)), 1 / (GATHERED_SHARE - SMEARED_SHARE)
    smeared = constant((-SMEARED_SHARE * gain,), share.dtype, share.device)
    return torch.add(smeared, share, alpha=gain).clamp_(LEAST_TRUST, 1)


def polarity_agreement(dark: Float[Tensor, "b n"], votes: Float[Tensor, "b n"], voters: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
    """How far each observation's polarity agrees with that of most others on the contour in its patch of the image.

    The two sides of a contour keep their brightness over a patch: an event that says the opposite comes from shading
    within the object, from the background's own edges, or is noise.

    Args:
        dark: +1 where the polarity says that the contour's outer side is the darker one, -1 the inner one, 0 unknown.
        votes: sum of the same over the observations on the contour, of which there are ``voters``.
    """
    return agreeing(dark * votes / (voters + two_of(voters)))


def agreeing(agreement: Tensor) -> Tensor:
    """Trust in events whose polarity is what it should be, 1, or the opposite, -1, as far as that is known."""
    return torch.add(scalar_one(agreement), agreement, alpha=POLARITY_GAIN).clamp_(LEAST_AGREEMENT, 1)


def two_of(like: Tensor) -> Tensor:
    """Two, as a tensor like this one."""
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
