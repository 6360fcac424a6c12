"""What a pose is worth: status, trust and references of an object, by what a window measured of it.

Each rule is written once, by operations on single numbers. PyTorch runs them on tensors, of all objects at once; a backend
compiles the same source for one object after the other. So they use ``where``, ``clamp``, ``isnan`` and ``logical_not``, operators
and named tuples, and nothing else.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor, clamp, isnan, logical_not, where

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.validation.status import Status

# What has to be looked for with a gate this many times wider may be anywhere.
_ANYWHERE = 2.0
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
# Weight of a new window in the mean score, and in references; and in these where it is less: what is hidden for a while is not seen well.
USUAL_GAIN, FALL_GAIN = 0.1, 0.005
# A pose that explains this ratio of what it does when seen well is remembered as one: most that slipped explain less.
CERTAIN = 0.9
# A pose is confirmed by so many windows, less those that explain clearly less, in which events explain this share of the moving contour.
# Of 27 starts that were 40 degrees off, 0.5 lets 142 of 1,620 windows be TRACKING while wrong, 0.55 13, 0.6 and 0.65 one; 31 starts that were
# right were confirmed by the third window in the median.
CONFIRMED_FROM, CONFIRMED_BY, _CLEARLY = 0.6, 3.0, 0.1
# Events on texture that agree less than this on its darker side speak against a pose. Of 3,355 windows of poses within 5 degrees, 99 % agree 0.79 or
# more; of 432 of poses that were more than 20 degrees off, 82 % agree less than 0.75. Of 3,220 windows of confirmed poses within 5 degrees, none
# agrees less than 0.75; but those of a book that is seen small and from the side do, by 0.66 at least.
AGREES_FROM, STILL_AGREES_FROM = 0.75, 0.65
_TRACKING, _UNCERTAIN, _LOST, _TOO_FEW_EVENTS, _OUT_OF_VIEW, _DIVERGED = (int(status) for status in Status)


class Limits(NamedTuple):
    """What decides: settings and constants, as numbers.

    Args:
        refound_above: as :data:`REFOUND_ABOVE`, no less than ``lost_below``.
        many: observations that tell of an object of which little is explained.
        partly_hidden: whether these are told apart.
        drift_below: as :data:`DRIFT_BELOW`.
        confirmed_from: as :data:`CONFIRMED_FROM`, no less than ``uncertain_below``.
        speaking_windows: as :data:`CONFIRMED_BY`; none where corners alone are observed, which lie on little of a contour.
        confirmed_by: these, and a look at other poses that found none that explains far more, where other poses are tried.
        rests, holds: whether objects stay where they were that fail where hardly anything fires, and all that fail.
    """

    uncertain_below: float
    lost_below: float
    refound_above: float
    min_observations: int
    many: int
    min_visible_ratio: float
    max_rotation_rad: float
    max_translation: float
    partly_hidden: bool
    drift_below: float
    confirmed_from: float
    speaking_windows: float
    confirmed_by: float
    rests: bool
    holds: bool

    @classmethod
    def from_config(cls, config: TrackerConfig) -> "Limits":
        """By a tracker's settings."""
        validation = config.validation
        speaking_windows = CONFIRMED_BY if config.association.max_events else 0.0
        looks = config.searches and config.uses(Component.UNCONFIRMED) and speaking_windows > 0.0
        return cls(
            uncertain_below=validation.uncertain_below,
            lost_below=validation.lost_below,
            refound_above=max(REFOUND_ABOVE, validation.lost_below),
            min_observations=validation.min_observations,
            many=HIDDEN_TIMES * validation.min_observations,
            min_visible_ratio=validation.min_visible_ratio,
            max_rotation_rad=validation.max_rotation_rad,
            max_translation=validation.max_translation,
            partly_hidden=config.uses(Component.PARTLY_HIDDEN),
            drift_below=DRIFT_BELOW,
            confirmed_from=max(CONFIRMED_FROM, validation.uncertain_below),
            speaking_windows=speaking_windows,
            confirmed_by=speaking_windows + looks,
            rests=config.motion.without_events == "rest",
            holds=config.motion.without_events == "hold",
        )


class Measured(NamedTuple):
    """What a window measured of each object.

    Args:
        explained_ratio, score, inlier_ratio, reference_inlier_ratio, texture_agreement: as
            :class:`torchtrack.tracking.validation.scored_fit.ScoredFit` has them.
        in_view: ratio of the contour inside the image.
        matched: observations that are matched with it.
        near: observations that are near its contours.
        gate_scale: of the object's first gate: an uncertain one may be so much farther away.
        rotated_rad, moved_diameters: from the prediction to the pose.
        is_moving: whether enough of the contour moves for events to explain it.
        is_usable: whether there was a prediction before the camera.
        is_relocalized: as the fit has it.
    """

    explained_ratio: Float[Tensor, "b"]
    score: Float[Tensor, "b"]
    inlier_ratio: Float[Tensor, "b"]
    reference_inlier_ratio: Float[Tensor, "b"]
    texture_agreement: Float[Tensor, "b"]
    in_view: Float[Tensor, "b"]
    gate_scale: Float[Tensor, "b"]
    rotated_rad: Float[Tensor, "b"]
    moved_diameters: Float[Tensor, "b"]
    matched: Int[Tensor, "b"]
    near: Int[Tensor, "b"]
    is_moving: Bool[Tensor, "b"]
    is_usable: Bool[Tensor, "b"]
    is_relocalized: Bool[Tensor, "b"]


class References(NamedTuple):
    """What is remembered of each object: as :class:`torchtrack.tracking.validation.health.TrackHealth` has it."""

    mean_score: Float[Tensor, "b"]
    reference_explained_ratio: Float[Tensor, "b"]
    reference_inlier_ratio: Float[Tensor, "b"]
    drift_s: Float[Tensor, "b"]
    time_since_validated_s: Float[Tensor, "b"]
    confirmations: Float[Tensor, "b"]


class Verdict(NamedTuple):
    """What a pose is worth.

    Args:
        status: as :class:`torchtrack.tracking.validation.status.Status`.
        failed: objects that go on as predicted.
        held: those of them that stay where they were instead, as those do near which hardly anything fires: what moves does.
        trusted: how far a pose counts against the prediction, 0 to 1.
        is_smeared: see :func:`smeared`.
        is_certain: poses to be remembered as seen well.
    """

    status: Int[Tensor, "b"]
    failed: Bool[Tensor, "b"]
    held: Bool[Tensor, "b"]
    trusted: Float[Tensor, "b"]
    is_smeared: Bool[Tensor, "b"]
    is_certain: Bool[Tensor, "b"]


def needed_ratio(gate_scale: Float[Tensor, "b"], hidden: Float[Tensor, "b"], limits: Limits) -> Float[Tensor, "b"]:
    """The explained ratio below which an object is lost: the more places it was looked for in, the more is asked of a pose.

    No more than of any, as far as it is ``hidden``, as :func:`partly_hidden` has it.
    """
    wider = clamp(gate_scale - 1.0, 0.0, 1.0) * (1.0 - hidden)
    return limits.lost_below + (limits.refound_above - limits.lost_below) * wider


def partly_hidden(measured: Measured, limits: Limits) -> Float[Tensor, "b"]:
    """How far a pose counts, 0 to 1, by events that gather on its contours as they do when the object is seen well, however few these are.

    Of an object that is partly hidden little is explained, but what is seen of it gathers as ever. Were it believed the less,
    it would be expected in ever more places, lost, and hidden parts or not, it would be tracked no more. What a search gave
    is the best of many poses: on one of them, events gather by chance.
    """
    reference = measured.reference_inlier_ratio
    ramp = (measured.inlier_ratio / clamp(reference, 1e-6, 1.0) - HIDDEN_FROM) / (HIDDEN_FULLY - HIDDEN_FROM)
    # Written so that what is not a number counts for nothing.
    tells = (ramp > 0) & logical_not(measured.is_relocalized) & (reference > HIDDEN_LEAST) & (measured.matched >= limits.many)
    return where(tells & limits.partly_hidden, clamp(ramp, 0.0, 1.0), 0.0)


def trust(measured: Measured, reference_explained_ratio: Float[Tensor, "b"], limits: Limits) -> Float[Tensor, "b"]:
    """How far a pose counts against the prediction: nothing where it is lost, fully once it is certain.

    Of an object that was looked for in many places near to its reference is asked: chance explains some.
    """
    asked = VALIDATED_FROM * reference_explained_ratio * clamp(measured.gate_scale - 1.0, 0.0, 1.0)
    full = where(asked > limits.uncertain_below, asked, limits.uncertain_below)
    return clamp((measured.explained_ratio - limits.lost_below) / clamp(full - limits.lost_below, 1e-6, 1.0), 0.0, 1.0)


def judge(measured: Measured, hidden: Float[Tensor, "b"], limits: Limits) -> Int[Tensor, "b"]:
    """The status of each object, the gravest reason last; ``hidden``: how far no more is asked of it for having been looked for in many places."""
    explained, gate_scale = measured.explained_ratio, measured.gate_scale
    # A new pose of what may be anywhere is no jump, however far away it is; what is not a number stays that.
    counts = where(measured.is_relocalized & (gate_scale >= _ANYWHERE), 0.0, 1.0) / gate_scale
    is_near = (counts * measured.rotated_rad < limits.max_rotation_rad) & (counts * measured.moved_diameters < limits.max_translation)
    status = where(explained < limits.uncertain_below, _UNCERTAIN, _TRACKING)
    status = where(explained < needed_ratio(gate_scale, hidden, limits), _LOST, status)
    status = where(measured.matched < limits.min_observations, _TOO_FEW_EVENTS, status)
    status = where(measured.in_view < limits.min_visible_ratio, _OUT_OF_VIEW, status)
    return where(is_near & measured.is_usable, status, _DIVERGED)


def smeared(measured: Measured, reference_explained_ratio: Float[Tensor, "b"], limits: Limits) -> Bool[Tensor, "b"]:
    """Which objects explain so much less than when they are seen well, by smeared events, that they may be elsewhere.

    Where less is explained but events gather as ever, an object is right, and partly hidden.
    """
    gathers_less = measured.inlier_ratio < SMEARED * measured.reference_inlier_ratio
    return gathers_less & (measured.score < limits.drift_below * reference_explained_ratio)


def verdict(measured: Measured, known: References, limits: Limits) -> Verdict:
    """What each object's pose is worth."""
    reference, hidden = known.reference_explained_ratio, partly_hidden(measured, limits)
    status = judge(measured, hidden, limits)
    failed, is_silent = status >= _LOST, (status == _TOO_FEW_EVENTS) & (measured.near < limits.min_observations)
    held = (failed & limits.holds) | (is_silent & limits.rests)
    trusted = trust(measured, reference, limits)
    trusted = where(failed, 0.0, where(hidden > trusted, hidden, trusted))
    is_smeared = logical_not(failed) & smeared(measured, reference, limits)
    status = where(is_smeared & (status < _UNCERTAIN), _UNCERTAIN, status)
    is_certain = (measured.explained_ratio >= CERTAIN * reference) & (status == _TRACKING)
    # Until a pose is confirmed, what explains much may be others' edges: where the object was before is not to be forgotten for them.
    # So may what a search gave just now: windows before it speak for the pose before.
    is_certain = is_certain & (known.confirmations >= limits.confirmed_by) & logical_not(measured.is_relocalized)
    return Verdict(status, failed, held, trusted, is_smeared, is_certain)


def seen_well(before: Float[Tensor, "b"], now: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """A running mean of when objects are seen well: it rises fast, and falls slowly."""
    change = now - before
    return before + where(change > 0, USUAL_GAIN * change, FALL_GAIN * change)


def confirmations(before: Float[Tensor, "b"], measured: Measured, judged: Verdict, limits: Limits) -> Float[Tensor, "b"]:
    """Windows that speak for the pose that a run started from, or that a search gave; with :func:`looked_elsewhere`, enough of them confirm it.

    What does not move says nothing, and what failed before it was confirmed begins anew; so does what texture contradicts, confirmed or not.
    """
    explained, asked = measured.explained_ratio, limits.confirmed_from
    speaks_for = where(explained >= asked, 1.0, where(explained < asked - _CLEARLY, -1.0, 0.0))
    so_far = clamp(before + where(measured.is_moving, speaks_for, 0.0), 0.0, limits.speaking_windows)
    begins_anew = judged.failed & (judged.status != _TOO_FEW_EVENTS)
    is_confirmed = before >= limits.confirmed_by
    # What is not a number contradicts nothing.
    contradicted = measured.texture_agreement < where(is_confirmed, STILL_AGREES_FROM, AGREES_FROM)
    return where(measured.is_relocalized | contradicted, 0.0, where(is_confirmed, before, where(begins_anew, 0.0, so_far)))


def looked_elsewhere(confirmations: Float[Tensor, "b"], looked: Bool[Tensor, "b"], limits: Limits) -> Float[Tensor, "b"]:
    """Confirmations after a look at other poses of those that ``looked`` says, which found none: enough, where windows enough speak for the pose."""
    return where(looked & (confirmations >= limits.speaking_windows), limits.confirmed_by, confirmations)


def confirmed_status(status: Int[Tensor, "b"], confirmations: Float[Tensor, "b"], limits: Limits) -> Int[Tensor, "b"]:
    """Statuses as they are told: a pose that is not confirmed yet is uncertain at best."""
    return where((status == _TRACKING) & (confirmations < limits.confirmed_by), _UNCERTAIN, status)


def remembered(known: References, measured: Measured, judged: Verdict, dt_s: Float[Tensor, "b"], limits: Limits) -> References:
    """References with a window more; of objects that failed, as before."""
    failed, explained, inliers = judged.failed, known.reference_explained_ratio, known.reference_inlier_ratio
    # One good window among bad ones does not end a drift.
    drift_s = known.drift_s + where(failed, 0.0, where(judged.is_smeared, dt_s, -dt_s))
    return References(
        mean_score=where(failed, known.mean_score, known.mean_score + USUAL_GAIN * (measured.score - known.mean_score)),
        reference_explained_ratio=where(failed, explained, seen_well(explained, measured.explained_ratio)),
        reference_inlier_ratio=where(failed | isnan(measured.inlier_ratio), inliers, seen_well(inliers, measured.inlier_ratio)),
        drift_s=where(drift_s > 0.0, drift_s, 0.0),
        time_since_validated_s=where(judged.is_certain, 0.0, known.time_since_validated_s + dt_s),
        confirmations=confirmations(known.confirmations, measured, judged, limits),
    )
