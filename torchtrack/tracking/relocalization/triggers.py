"""Why other poses than the predicted one are tried: a flag for each reason, one small function for each flag.

A pose that slipped onto other edges is sure of itself, and they explain its contours. What gives it away is that events around its
contours no longer gather on them as they did. An object of which that is so for a while may have drifted off unnoticed, and
the farther, the longer it lasts. So may an object that merely explains less than when it is seen well: as a rule it is partly hidden
instead, so that a pose elsewhere has to explain nearly all, and no fewer events, to be taken for it.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import IntFlag, auto

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.constants import constant
from torchtrack.core.host_sync import none_of
from torchtrack.tracking.relocalization.evidence import TriggerEvidence
from torchtrack.tracking.validation.verdict import Limits

# What drifts for so long is looked for farther away, once in this time (µs).
DRIFT_US = 50_000
# Below this share of the usual score others are tried, two windows in a row.
LOW_SCORE_BELOW = 0.8
# An object whose prediction has a smaller standard deviation in the image is sure of its place (px).
_SURE_SIGMA_PX = 6.0
# An object is new while what it explains when seen well, which rises with every window, is below this ratio of what it explains.
_NEW = 0.9


class Trigger(IntFlag):
    """Why other poses of an object are tried; what each means is said by the function of its name below."""

    UNCERTAIN = auto()
    NEW = auto()
    LOW_SCORE = auto()
    DRIFT = auto()
    SLOW_DRIFT = auto()
    DEPTH_CHANGED = auto()
    FAR_BELOW_REFERENCE = auto()
    LOST = auto()
    UNCONFIRMED = auto()


# An object that may have drifted off, at once or slowly.
DRIFTS = Trigger.DRIFT | Trigger.SLOW_DRIFT
# An object that is looked for all around where it was last validated.
AROUND_LAST_SEEN = Trigger.DEPTH_CHANGED | Trigger.FAR_BELOW_REFERENCE
# An object that is looked for around its prediction.
AROUND_PREDICTION = Trigger.UNCERTAIN | Trigger.NEW | Trigger.LOW_SCORE | DRIFTS
# What calls for a search. An object that is lost is expected where it was last validated, and uncertain there.
SEARCHED = AROUND_PREDICTION | AROUND_LAST_SEEN | Trigger.UNCONFIRMED

# What a search may be of by itself: each takes as long as the others, or longer.
KINDS = (AROUND_PREDICTION, AROUND_LAST_SEEN, Trigger.UNCONFIRMED)


def next_kind(triggers: Int[Tensor, "b"], last: int) -> int:
    """The kind of search that is next in turn, of those that objects ask for, after one of the kind ``last``; 0 for none."""
    turn = KINDS.index(Trigger(last)) + 1 if last else 0
    return next((int(kind) for kind in (*KINDS[turn:], *KINDS[:turn]) if bool(has(triggers, kind).any())), 0)


def triggered(evidence: TriggerEvidence, config: TrackerConfig) -> TriggerEvidence:
    """The evidence with the :class:`Trigger` bits of each object; with none where other poses are never tried."""
    if not config.searches:
        return replace(evidence, triggers=torch.zeros_like(evidence.triggers))
    for conditions in _CONDITIONS:
        flags = flags_of({bit: condition(evidence, config) for bit, condition in conditions.items()})
        if not none_of(flags):
            evidence = replace(evidence, triggers=evidence.triggers | flags)
    return evidence


def has(flags: Int[Tensor, "b"], wanted: Trigger) -> Bool[Tensor, "b"]:
    """Which objects have any of some triggers."""
    return (flags & int(wanted)) != 0


def flags_of(holds: Mapping[int, Bool[Tensor, "b"]]) -> Int[Tensor, "b"]:
    """The bits that hold of each object, in one number."""
    each = torch.stack([*holds.values()])
    return (each * constant(tuple((bit,) for bit in holds), torch.int64, each.device)).sum(0)


Condition = Callable[[TriggerEvidence, TrackerConfig], Bool[Tensor, "b"]]


# ---- the conditions


def is_drifting(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """DRIFT: objects that have explained too little, by smeared events, for so long that they are looked for farther away."""
    due = evidence.is_drift_due
    if none_of(due):
        return due
    return due & (evidence.drift_s >= 1e-6 * DRIFT_US) if config.uses(Component.DRIFT) else torch.zeros_like(due)


def is_drifting_slowly(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """SLOW_DRIFT: objects, sure of their place, that explained less than when seen well for so long that they are looked for farther away.

    The mean follows a drift that is slow, and the covariance forgets the direction that it went in.
    """
    due, search = evidence.is_drift_due, config.relocalization
    if none_of(due):
        return due
    if not (config.uses(Component.DRIFT) and search.slow_drift_below):
        return torch.zeros_like(due)
    low = evidence.last_score < search.slow_drift_below * evidence.reference_explained_ratio
    long = evidence.time_since_validated_s >= 1e-6 * DRIFT_US
    other = is_drifting(evidence, config) | evidence.is_starting
    return ~other & (due & low & long & (evidence.sigma_px < _SURE_SIGMA_PX))


def is_uncertain(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """UNCERTAIN: objects whose prediction is not certain; of those where it is very uncertain, when it is time."""
    return _is_near_or_due(evidence, config) & (evidence.sigma_px > config.relocalization.trigger_sigma_px)


def is_scored_low(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """LOW_SCORE: objects whose score stays below the mean; of the very uncertain ones, when it is time."""
    low = evidence.stays_below(LOW_SCORE_BELOW * evidence.mean_score)
    return _is_near_or_due(evidence, config) & low & config.uses(Component.LOW_SCORE)


def is_new(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """NEW: objects that never explained much more than now, and leave much unexplained: the mean does not tell yet that they slip.

    Once in a while only: an object that begins half hidden is new for long.
    """
    if none_of(evidence.is_due):
        return evidence.is_due
    best = torch.maximum(evidence.score, evidence.last_score)
    new = ~evidence.is_starting & evidence.is_due & (evidence.reference_explained_ratio < _NEW * best)
    return new & (best < config.relocalization.new_below)


def is_unconfirmed(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """UNCONFIRMED: objects whose pose has windows enough that speak for it, this one among them: it is confirmed once no other explains far more.

    And, once in a while, those whose pose explains enough now, but did not in the windows before, or is contradicted by texture.
    """
    limits = Limits.from_config(config)
    waits = waits_for_rivals(evidence.confirmations, evidence.is_drift_due, limits)
    if none_of(waits):
        return waits
    # What hardly moves is not a number, and says nothing.
    return waits & ~evidence.is_starting & (evidence.measured_ratio >= limits.confirmed_from)


def waits_for_rivals(confirmations: Float[Tensor, "b"], is_drift_due: Bool[Tensor, "b"], limits: Limits) -> Bool[Tensor, "b"]:
    """Objects whose pose waits to be confirmed, where it is time to compare it with others."""
    is_time = (confirmations >= limits.speaking_windows - 1) | is_drift_due
    return is_time & (confirmations < limits.confirmed_by) & (limits.confirmed_by != limits.speaking_windows)


# First those that others hang on.
_CONDITIONS: tuple[dict[int, Condition], ...] = (
    {int(Trigger.DRIFT): is_drifting, int(Trigger.SLOW_DRIFT): is_drifting_slowly},
    {
        int(Trigger.UNCERTAIN): is_uncertain,
        int(Trigger.NEW): is_new,
        int(Trigger.LOW_SCORE): is_scored_low,
        int(Trigger.UNCONFIRMED): is_unconfirmed,
    },
)


def _is_near_or_due(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    return torch.where(evidence.sigma_px <= config.relocalization.wide_sigma_px, evidence.is_near_due, evidence.is_due)
