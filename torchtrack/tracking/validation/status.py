"""Statuses: what a pose is worth, by what was measured."""

from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.config.validation import ValidationConfig
from torchtrack.core.constants import constant

# What gathers no more than this ratio of how far it does when an object is seen well says nothing for a pose; from the other one on, all.
HIDDEN_FROM, HIDDEN_FULLY = 0.8, 0.95


# It says nothing of objects on which less gathers even then, nor by fewer observations than so many times the least.
HIDDEN_LEAST, HIDDEN_TIMES = 0.5, 4


# Share of the moving contour explained by events from which an uncertain object is found again: at 0.35, occluded ones were no longer passed over.
REFOUND_ABOVE = 0.35
# Share of what is explained when seen well, from which the find of an uncertain object counts. Not measured alone.
VALIDATED_FROM = 0.75
# An object that explains less than this share of what it does when seen well, by smeared events, drifts. Not measured alone.
DRIFT_BELOW = 0.6


# Events that gather less than this ratio of how far they do when an object is seen well are smeared.
SMEARED = 0.8


class Status(IntEnum):
    """What a pose is worth, in the order of gravity."""

    TRACKING = 0
    UNCERTAIN = 1
    LOST = 2
    TOO_FEW_EVENTS = 3
    OUT_OF_VIEW = 4
    DIVERGED = 5


def needed_ratio(gate_scale: Float[Tensor, "b"], config: ValidationConfig, hidden: Float[Tensor, "b"] | None = None) -> Float[Tensor, "b"]:
    """The explained ratio below which an object is lost: the more places it was looked for in, the more is asked of a pose.

    No more than of any, as far as it is ``hidden``, as :func:`partly_hidden` has it.
    """
    wider = (gate_scale - 1).clamp(0, 1)
    if hidden is not None:
        wider = wider * (1 - hidden)
    return config.lost_below + (max(REFOUND_ABOVE, config.lost_below) - config.lost_below) * wider


def partly_hidden(
    inlier_ratio: Float[Tensor, "b"],
    reference_inlier_ratio: Float[Tensor, "b"],
    count: Int[Tensor, "b"],
    is_relocalized: Bool[Tensor, "b"],
    config: TrackerConfig,
) -> Float[Tensor, "b"]:
    """How far a pose counts, 0 to 1, by events that gather on its contours as they do when the object is seen well, however few these are.

    Of an object that is partly hidden little is explained, but what is seen of it gathers as ever. Were it believed the less,
    it would be expected in ever more places, lost, and hidden parts or not, it would be tracked no more. What a search gave
    is the best of many poses: on one of them, events gather by chance.

    Args:
        inlier_ratio: of the events near the contours, how many are on them; not a number where it does not tell.
        reference_inlier_ratio: the same of when the object is seen well; zero where that is not known.
        count: matched observations.
        is_relocalized: objects that a search took to another pose.
    """
    ramp = (inlier_ratio / reference_inlier_ratio.clamp(min=1e-6) - HIDDEN_FROM) / (HIDDEN_FULLY - HIDDEN_FROM)
    # Written so that what is not a number counts for nothing.
    tells = (ramp > 0) & ~is_relocalized & (reference_inlier_ratio > HIDDEN_LEAST) & are_many(count, config.validation)
    return torch.where(tells & config.uses(Component.PARTLY_HIDDEN), ramp.clamp(max=1), 0)


def are_many(count: Int[Tensor, "b"], config: ValidationConfig) -> Bool[Tensor, "b"]:
    """Whether observations are so many that they tell of an object of which little is explained."""
    return count >= HIDDEN_TIMES * config.min_observations


def trust(
    explained_ratio: Float[Tensor, "b"],
    config: ValidationConfig,
    reference_explained_ratio: Float[Tensor, "b"] | None = None,
    gate_scale: Float[Tensor, "b"] | None = None,
) -> Float[Tensor, "b"]:
    """How far a pose counts against the prediction: nothing where it is lost, fully once it is certain.

    Of an object that was looked for in many places (``gate_scale``) near to its reference is asked: chance explains some.
    """
    full = torch.full_like(explained_ratio, config.uncertain_below)
    if reference_explained_ratio is not None and gate_scale is not None:
        full = torch.maximum(full, VALIDATED_FROM * reference_explained_ratio * (gate_scale - 1).clamp(0, 1))
    return ((explained_ratio - config.lost_below) / (full - config.lost_below).clamp(min=1e-6)).clamp(0, 1)


def judge(
    quality: Float[Tensor, "b"],
    observation_count: Int[Tensor, "b"],
    in_view: Float[Tensor, "b"],
    step_from_prediction: Float[Tensor, "b 6"],
    diameters_m: Float[Tensor, "b"],
    config: ValidationConfig,
    gate_scale: Float[Tensor, "b"] | None = None,
    hidden: Float[Tensor, "b"] | None = None,
) -> Int[Tensor, "b"]:
    """The :class:`Status` of each object, the gravest reason first.

    ``gate_scale`` is of each object's first gate: an uncertain one may be so much farther away. ``hidden`` is from
    :func:`partly_hidden`.
    """
    gate_scale = torch.ones_like(quality) if gate_scale is None else gate_scale
    rotated, moved = (step_from_prediction.unflatten(1, (2, 3)).norm(dim=-1) / gate_scale[:, None]).unbind(1)
    reasons: dict[Status, Bool[Tensor, "b"]] = {
        Status.UNCERTAIN: quality < config.uncertain_below,
        Status.LOST: quality < needed_ratio(gate_scale, config, hidden),
        Status.TOO_FEW_EVENTS: observation_count < config.min_observations,
        Status.OUT_OF_VIEW: in_view < config.min_visible_ratio,
        # Written so that what is not a number has diverged.
        Status.DIVERGED: ~((rotated < config.max_rotation_rad) & (moved < config.max_translation * diameters_m)),
    }
    # Statuses are in the order of their gravity.
    numbers = constant(tuple((int(status),) for status in reasons), torch.int64, quality.device)
    return (torch.stack(list(reasons.values())) * numbers).amax(0)


def is_smeared(
    score: Float[Tensor, "b"],
    reference_explained_ratio: Float[Tensor, "b"],
    inlier_ratio: Float[Tensor, "b"],
    reference_inlier_ratio: Float[Tensor, "b"],
) -> Bool[Tensor, "b"]:
    """Which objects explain so much less than when they are seen well, by smeared events, that they may be elsewhere.

    Where less is explained but events gather as ever, an object is right, and partly hidden.
    """
    return (inlier_ratio < SMEARED * reference_inlier_ratio) & (score < DRIFT_BELOW * reference_explained_ratio)
