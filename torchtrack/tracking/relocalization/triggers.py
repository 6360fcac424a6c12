"""Why other poses than the predicted one are tried: a flag for each reason, one small function for each flag.

A pose that slipped onto other edges is sure of itself, and they explain its contours. What gives it away is that events around its
contours no longer gather on them as they did. An object of which that is so for a while may have drifted off unnoticed, and
the farther, the longer it lasts. So may an object that merely explains less than when it is seen well: as a rule it is partly hidden
instead, so that a pose elsewhere has to explain nearly all, and no fewer events, to be taken for it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntFlag, auto

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.search import SearchConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.constants import constant
from torchtrack.core.host_sync import none_of
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.motion.model import MOST_UNCERTAIN
from torchtrack.tracking.relocalization.symmetric import Ambiguities
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.validation.scored_fit import Found
from torchtrack.tracking.validation.status import are_many

# An object is new while what it explains when seen well, which rises with every window, is below this share of what it explains.
_NEW = 0.9
# Events that gather less than this share of how far they do when an object is seen well are smeared.
SMEARED = 0.8
# A prediction that is so uncertain, as a share of the most that predictions become, tells nothing any more.
_NOTHING_KNOWN = 0.8
# Farther away, or nearer, than when it was last seen well by this factor, an object may have been mistaken for others' edges.
_DEPTH_FACTOR = 1.25


class Trigger(IntFlag):
    """Why other poses of an object are tried; what each means is said by the function of its name below."""

    STARTING = auto()
    UNCERTAIN = auto()
    NEW = auto()
    LOW_SCORE = auto()
    SCORE_DROP = auto()
    DRIFT = auto()
    SLOW_DRIFT = auto()
    HELD = auto()
    MIRROR_AMBIGUOUS = auto()
    AXIS_AMBIGUOUS = auto()
    NOT_VALIDATED = auto()
    DEPTH_CHANGED = auto()
    FAR_BELOW_REFERENCE = auto()
    LOST = auto()


NONE = Trigger(0)
# An object that may have drifted off, at once or slowly.
DRIFTS = Trigger.DRIFT | Trigger.SLOW_DRIFT
# An object that is looked for all around where it was last validated.
AROUND_LAST_SEEN = Trigger.DEPTH_CHANGED | Trigger.FAR_BELOW_REFERENCE
# An object that is looked for around its prediction.
AROUND_PREDICTION = Trigger.STARTING | Trigger.UNCERTAIN | Trigger.NEW | Trigger.LOW_SCORE | DRIFTS
# What calls for a search. An object that is lost is expected where it was last validated, and uncertain there; an object that was not
# validated for long is uncertain or drifts.
SEARCHED = AROUND_PREDICTION | AROUND_LAST_SEEN | Trigger.SCORE_DROP | Trigger.MIRROR_AMBIGUOUS | Trigger.AXIS_AMBIGUOUS


@dataclass(frozen=True)
class Schedule:
    """What is known of a window before it is looked at.

    Args:
        triggers: those of :class:`Trigger` that hang on the state alone.
        is_due: objects that it is time for, should they be very uncertain: what is hidden is not found by looking more often.
        is_drift_due: objects that it is time to look for farther away, should there be reason to.
    """

    triggers: Int[Tensor, "b"]
    is_due: Bool[Tensor, "b"]
    is_drift_due: Bool[Tensor, "b"]


@dataclass(frozen=True)
class TriggerEvidence:
    """What the triggers are set by, once a window is aligned.

    Args:
        sigma_px: standard deviation of each object's prediction in the image (px).
        score: of the fit; ``last_score`` is that of the window before: a single window that is a little worse is no reason.
        mean_score: as a rule.
        matches: matched observations of the fit.
        reference_explained_ratio: what the object explains when it is seen well.
        drift_s: for how long it has explained too little by smeared events (s).
        time_since_validated_s: how long ago it was last seen well (s).
        is_starting: objects whose motion is not known yet.
        is_due, is_drift_due: as :class:`Schedule` has them.
        has_symmetry: objects with a plane of symmetry; ``has_axis``, with an axis that most of it can be rotated about unseen.
        earlier: triggers that are set already.
    """

    sigma_px: Float[Tensor, "b"]
    score: Float[Tensor, "b"]
    last_score: Float[Tensor, "b"]
    mean_score: Float[Tensor, "b"]
    matches: Int[Tensor, "b"]
    reference_explained_ratio: Float[Tensor, "b"]
    drift_s: Float[Tensor, "b"]
    time_since_validated_s: Float[Tensor, "b"]
    is_starting: Bool[Tensor, "b"]
    is_due: Bool[Tensor, "b"]
    is_drift_due: Bool[Tensor, "b"]
    has_symmetry: Bool[Tensor, "b"]
    has_axis: Bool[Tensor, "b"]
    earlier: Int[Tensor, "b"]

    def stays_below(self, level: Float[Tensor, "b"]) -> Bool[Tensor, "b"]:
        """Whose score was below ``level`` in two windows in a row."""
        return torch.maximum(self.score, self.last_score) < level


def schedule(state: TrackerState, objects: ObjectBatch, t_us: Int[Tensor, "s"], config: TrackerConfig) -> Schedule:
    """What the state alone says of the window that ends at ``t_us``: which objects are lost, and which are looked for all around."""
    search = config.search
    is_due, is_drift_due = is_time(state.t_us, t_us, search.interval_us, search.doubt_us)[:, objects.stream_index]
    return Schedule(_not_validated_for_long(state, objects, is_drift_due, config), is_due, is_drift_due)


def gather_evidence(
    state: TrackerState,
    window: Schedule,
    scored: Found,
    sigma_px: Float[Tensor, "b"],
    is_starting: Bool[Tensor, "b"],
    ambiguities: Ambiguities,
) -> TriggerEvidence:
    """The evidence of a window that was aligned."""
    return TriggerEvidence(
        sigma_px=sigma_px,
        score=scored.score,
        last_score=state.score,
        mean_score=state.usual_score,
        matches=scored.count,
        reference_explained_ratio=state.full_share,
        drift_s=state.doubted_s,
        time_since_validated_s=state.unseen_s,
        is_starting=is_starting,
        is_due=window.is_due,
        is_drift_due=window.is_drift_due,
        has_symmetry=ambiguities.has_symmetry,
        has_axis=ambiguities.has_axis,
        earlier=window.triggers,
    )


def triggers(evidence: TriggerEvidence, config: TrackerConfig) -> Int[Tensor, "b"]:
    """The :class:`Trigger` bits of each object; none where other poses are never tried."""
    if not searches(config):
        return torch.zeros_like(evidence.earlier)
    for conditions in _CONDITIONS:
        evidence = replace(evidence, earlier=evidence.earlier | _bits(conditions, evidence, config))
    return evidence.earlier


def has(flags: Int[Tensor, "b"], wanted: Trigger) -> Bool[Tensor, "b"]:
    """Which objects have any of some triggers."""
    return (flags & int(wanted)) != 0


Condition = Callable[[TriggerEvidence, TrackerConfig], Bool[Tensor, "b"]]


def _bits(conditions: Mapping[int, Condition], evidence: TriggerEvidence, config: TrackerConfig) -> Int[Tensor, "b"]:
    """The bit of each condition that holds, in one number."""
    numbers = constant(tuple((bit,) for bit in conditions), evidence.earlier.dtype, evidence.earlier.device)
    return (torch.stack([condition(evidence, config) for condition in conditions.values()]) * numbers).sum(0)


# ---- the conditions


def is_drifting(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """DRIFT: objects that have explained too little, by smeared events, for so long that they are looked for farther away."""
    due, search = evidence.is_drift_due, config.search
    return due & (evidence.drift_s >= 1e-6 * search.doubt_us) if search.doubt_us else torch.zeros_like(due)


def is_drifting_slowly(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """SLOW_DRIFT: objects, sure of their place, that explained less than when seen well for so long that they are looked for farther away.

    The mean follows a drift that is slow, and the covariance forgets the direction that it went in.
    """
    due, search = evidence.is_drift_due, config.search
    if none_of(due):
        return due
    if not (search.doubt_us and search.strayed_to):
        return torch.zeros_like(due)
    low = evidence.last_score < search.strayed_to * evidence.reference_explained_ratio
    long = evidence.time_since_validated_s >= 1e-6 * search.doubt_us
    other = is_drifting(evidence, config) | evidence.is_starting
    return ~other & (due & low & long & (evidence.sigma_px < search.slip_sigma_px))


def is_held(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """HELD: objects that drift, and yet are sure of their place and explain enough there: they are looked for near it alone.

    Where something passes before an object, its edges smear the events around it, and what is laid along them explains more.
    """
    drifts, search = has(evidence.earlier, Trigger.DRIFT), config.search
    if none_of(drifts):
        return drifts
    sure = drifts & ~evidence.is_starting & (evidence.sigma_px < search.slip_sigma_px)
    explains = evidence.score >= search.stands_from * evidence.reference_explained_ratio
    return sure & explains & are_many(evidence.matches, config.quality) & (search.stands_from > 0)


def is_starting(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """STARTING: objects whose motion is not known yet."""
    return evidence.is_starting if config.search.at_start else torch.zeros_like(evidence.is_starting)


def is_uncertain(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """UNCERTAIN: objects whose prediction is not certain; of those where it is very uncertain, when it is time."""
    return _is_near_or_due(evidence, config) & (evidence.sigma_px > config.search.from_sigma_px)


def is_scored_low(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """LOW_SCORE: objects whose score stays below the mean; of the very uncertain ones, when it is time."""
    return _is_near_or_due(evidence, config) & evidence.stays_below(config.search.dropped_to * evidence.mean_score)


def is_new(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """NEW: objects that never explained much more than now, and leave much unexplained: the mean does not tell yet that they slip.

    Once in a while only: an object that begins half hidden is new for long.
    """
    if none_of(evidence.is_due):
        return evidence.is_due
    best = torch.maximum(evidence.score, evidence.last_score)
    new = ~evidence.is_starting & evidence.is_due & (evidence.reference_explained_ratio < _NEW * best)
    return new & (best < config.search.new_share)


def has_score_dropped(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """SCORE_DROP: objects that are sure of their place, and explain far less all at once."""
    dropped = evidence.score < config.search.slipped_to * evidence.mean_score
    return _is_sure(evidence, config.search) & ~has(evidence.earlier, DRIFTS) & dropped


def is_mirror_ambiguous(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """MIRROR_AMBIGUOUS: objects that may be in a pose that has the outline of the right one: sure of it, they do not explain all."""
    if none_of(evidence.is_drift_due):
        return evidence.is_drift_due
    low = evidence.stays_below(config.search.mirrored_to * evidence.reference_explained_ratio)
    return _is_sure(evidence, config.search) & low & _looks_far(evidence, config.search) & evidence.has_symmetry


def is_axis_ambiguous(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """AXIS_AMBIGUOUS: objects that may be rotated about their axis: sure of their place, they explain as much as when seen well again."""
    if none_of(evidence.is_drift_due):
        return evidence.is_drift_due
    unseen = may_have_rotated(evidence.has_axis, evidence.time_since_validated_s, config.search)
    if none_of(unseen):
        return unseen
    well = evidence.score >= config.search.slip_share * evidence.reference_explained_ratio
    return unseen & _is_sure(evidence, config.search) & well & _looks_far(evidence, config.search)


def is_not_validated(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """NOT_VALIDATED: objects that drift or are very uncertain, and were not seen well for long: they are also looked for as they were then."""
    if none_of(evidence.is_drift_due):
        return evidence.is_drift_due
    search = config.search
    long = (evidence.time_since_validated_s >= 1e-6 * search.unseen_us) & (search.unseen_us > 0)
    return _looks_far(evidence, search) & long & (has(evidence.earlier, DRIFTS) | (evidence.sigma_px > search.wide_sigma_px))


# First those that others hang on.
_CONDITIONS: tuple[dict[int, Condition], ...] = (
    {int(Trigger.DRIFT): is_drifting, int(Trigger.SLOW_DRIFT): is_drifting_slowly},
    {
        int(Trigger.STARTING): is_starting,
        int(Trigger.UNCERTAIN): is_uncertain,
        int(Trigger.NEW): is_new,
        int(Trigger.LOW_SCORE): is_scored_low,
        int(Trigger.SCORE_DROP): has_score_dropped,
        int(Trigger.HELD): is_held,
        int(Trigger.MIRROR_AMBIGUOUS): is_mirror_ambiguous,
        int(Trigger.AXIS_AMBIGUOUS): is_axis_ambiguous,
        int(Trigger.NOT_VALIDATED): is_not_validated,
    },
)


def _is_sure(evidence: TriggerEvidence, config: SearchConfig) -> Bool[Tensor, "b"]:
    return ~evidence.is_starting & (evidence.sigma_px < config.slip_sigma_px)


def _is_near_or_due(evidence: TriggerEvidence, config: TrackerConfig) -> Bool[Tensor, "b"]:
    return evidence.is_due | (evidence.sigma_px <= config.search.wide_sigma_px)


def _looks_far(evidence: TriggerEvidence, config: SearchConfig) -> Bool[Tensor, "b"]:
    return evidence.is_drift_due & (config.doubt_us > 0)


# ---- those that hang on the state alone


def _not_validated_for_long(state: TrackerState, objects: ObjectBatch, is_drift_due: Bool[Tensor, "b"], config: TrackerConfig) -> Int[Tensor, "b"]:
    """LOST, DEPTH_CHANGED and FAR_BELOW_REFERENCE, of objects that were found once, and then not seen well for long.

    LOST: nothing is known of them any more but where they were last seen well, and they are expected there. Others are looked for all
    around that place. Those that explain little are partly hidden, as a rule; but a pose may also have gone along with what hid the
    object, and hold on to other edges.
    """
    unseen = _is_unseen_for_long(state, config)
    if none_of(unseen):
        return unseen.long()
    lost = unseen & _is_unknown(state, objects.diameter_m)
    due = unseen & is_drift_due & ~lost
    now_m, then_m = (objects.depth_m(T.to(objects.intrinsics.dtype)) for T in (state.T_cam_obj, state.T_last_seen))
    changed = due & (torch.maximum(now_m / then_m, then_m / now_m) > _DEPTH_FACTOR)
    below = due & (state.score < config.search.anew_below * state.full_share)
    bits = Trigger.LOST, Trigger.DEPTH_CHANGED, Trigger.FAR_BELOW_REFERENCE
    return (torch.stack([lost, changed, below]) * constant(tuple((int(bit),) for bit in bits), torch.int64, lost.device)).sum(0)


def _is_unseen_for_long(state: TrackerState, config: TrackerConfig) -> Bool[Tensor, "b"]:
    if not (config.search.anew_us and searches(config)):
        return torch.zeros_like(state.unseen_s, dtype=torch.bool)
    return (state.unseen_s >= 1e-6 * config.search.anew_us) & (state.usual_score > 0)


def _is_unknown(state: TrackerState, diameter_m: Float[Tensor, "b"]) -> Bool[Tensor, "b"]:
    sigma = state.covariance.diagonal(dim1=-2, dim2=-1)[:, :6].sqrt()
    rotation_rad, move_m = sigma.unflatten(1, (2, 3)).amax(-1).unbind(1)
    return (rotation_rad > _NOTHING_KNOWN * MOST_UNCERTAIN) | (move_m > _NOTHING_KNOWN * MOST_UNCERTAIN * diameter_m)


# ---- what else hangs on the same settings


def is_time(since_us: Int[Tensor, "s"], t_us: Int[Tensor, "s"], *intervals_us: int) -> Bool[Tensor, "k s"]:
    """Streams in which it is time for what is done once in each of some intervals: by the clock, whatever the windows."""
    each_us = constant(tuple((max(interval_us, 1),) for interval_us in intervals_us), t_us.dtype, t_us.device)
    return t_us // each_us > since_us // each_us


def searches(config: TrackerConfig) -> bool:
    """Whether other poses are ever tried."""
    return config.search.hypotheses > 0 and config.solver.prior


def tries_mirrored(config: TrackerConfig) -> bool:
    """Whether mirrored ones are."""
    return searches(config) and config.search.mirrored_to > 0


def tries_rotated(config: TrackerConfig) -> bool:
    """Whether those rotated about an axis are."""
    return searches(config) and config.search.turned and config.search.doubt_us > 0


def may_have_rotated(has_axis: Bool[Tensor, "b"], time_since_validated_s: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
    """Which objects with an axis were not seen well for so long that they may have rotated about it unseen."""
    return has_axis & (time_since_validated_s >= 1e-6 * config.doubt_us)


def is_smeared(
    score: Float[Tensor, "b"],
    reference_explained_ratio: Float[Tensor, "b"],
    inlier_ratio: Float[Tensor, "b"],
    reference_inlier_ratio: Float[Tensor, "b"],
    config: SearchConfig,
) -> Bool[Tensor, "b"]:
    """Which objects explain so much less than when they are seen well, by smeared events, that they may be elsewhere.

    Where less is explained but events gather as ever, an object is right, and partly hidden.
    """
    return (inlier_ratio < SMEARED * reference_inlier_ratio) & (score < config.doubted_below * reference_explained_ratio)


def reference_where_known(sigma_px: Float[Tensor, "b"], reference_inlier_ratio: Float[Tensor, "b"], config: SearchConfig) -> Float[Tensor, "b"]:
    """How far events gather on contours when objects are seen well; zero, for nothing, of objects whose place is not known.

    They were hidden, as a rule, and the events of what hides them do not gather where they are seen again.
    """
    return torch.where(sigma_px > config.from_sigma_px, 0, reference_inlier_ratio)
