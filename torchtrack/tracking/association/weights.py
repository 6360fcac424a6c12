"""How far each match is to be trusted."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import AssociationConfig, TrackerConfig
from torchtrack.core.constants import constant, scalar_one

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
# Standard deviation of the error that observations of a smooth silhouette in one place of the image have in common (px): facets of its model, and its
# shading, put a whole piece of it off. With it, smooth objects that a bar hides lose 1.3 instead of 3.7 % of their windows (docs/results.md).
COMMON_PX = 0.25
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


def common_variance(config: TrackerConfig) -> float:
    """Of the error that observations of a smooth silhouette in one place have in common: its variance, over that of one observation."""
    return (COMMON_PX / config.solver.observation_px) ** 2 if config.uses(Component.COMMON_ERROR) else 0.0


def effective_weight(around: Float[Tensor, "b n"], silhouette: Float[Tensor, "b n"], config: TrackerConfig) -> Float[Tensor, "b n"]:
    """How far each observation counts beside those around it that have an error in common with it: so weighted, their mean has its variance at least.

    Args:
        around: how many observations are on the contour in its patch of the image.
        silhouette: 1 where the contour is the smooth silhouette, 0 where not.
    """
    return 1 / (1 + around * silhouette * common_variance(config))


def match_weights(
    offsets: Tensor, targets: Tensor, near: Tensor, dark: Tensor, as_expected: Tensor, config: AssociationConfig
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"]]:
    """How far each observation is to be trusted, by those around it; and how many of these are on the contour."""
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
