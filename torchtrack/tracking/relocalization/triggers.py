"""What speaks for trying other poses than the one that is predicted: uncertainty, a drop of what is explained, or a doubt that lasts.

A pose that slipped onto other edges is sure of itself, and they explain its contours. What tells is that events around its
contours no longer gather on them as they did. An object of which that is so for a while may have drifted off unnoticed, and
the farther, the longer it lasts. So may one that merely explains less than when it is seen well: as a rule it is partly hidden
instead, so that a pose elsewhere has to explain nearly all, and no fewer events, to be taken for it.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.search import SearchConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.constants import constant
from torchtrack.core.host_sync import none_of
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.motion.model import MOST_UNCERTAIN
from torchtrack.tracking.state import TrackerState

# An object is new while what it explains when seen well, which rises with every window, is below this share of what it explains.
_NEW = 0.9


# Events that gather less than this share of how far they do when an object is seen well are smeared.
SMEARED = 0.8


@dataclass(frozen=True)
class Doubt:
    """What speaks for trying other poses, before a window is aligned.

    Args:
        sigma_px: standard deviation of each object's prediction in the image.
        last_score: in the window before: one window that is a little worse is no reason.
        usual_score: as a rule.
        starting: objects whose motion is not known yet.
        due: objects that it is time for, should they be very uncertain: what is hidden is not found by looking more often.
        adrift: objects that have been in doubt for long, and which it is time for.
        doubted_s: for how long each has been in doubt, or not been seen well (s).
        full_share: explained when the object is seen well.
        far_due: objects that it is time to look for farther away, should there be reason to.
        has_symmetry: objects with a plane of symmetry.
        unseen_s: how long ago each was last seen well (s).
        strayed: which of those adrift merely explain less than when seen well.
        may_have_turned: which may be turned about an axis unseen: :mod:`torchtrack.tracking.relocalization.axis_rotation`.
        off_in_depth, little: which are to be looked for all around where they were last seen well, and why: :mod:`relocalization.last_seen`.
    """

    sigma_px: Float[Tensor, "b"]
    last_score: Float[Tensor, "b"]
    usual_score: Float[Tensor, "b"]
    starting: Bool[Tensor, "b"]
    due: Bool[Tensor, "b"]
    adrift: Bool[Tensor, "b"]
    doubted_s: Float[Tensor, "b"]
    full_share: Float[Tensor, "b"]
    far_due: Bool[Tensor, "b"]
    has_symmetry: Bool[Tensor, "b"]
    unseen_s: Float[Tensor, "b"]
    strayed: Bool[Tensor, "b"]
    may_have_turned: Bool[Tensor, "b"]
    off_in_depth: Bool[Tensor, "b"]
    little: Bool[Tensor, "b"]

    def reasons(self, score: Float[Tensor, "b"], config: SearchConfig) -> tuple[Bool[Tensor, "b"], ...]:
        """Which objects a search is wanted for: beside the prediction, where they may have slipped to, mirrored, and turned about an axis."""
        is_mirrored = is_turned = self.far_due
        # As a rule it is not time for these.
        if not none_of(self.far_due):
            is_mirrored, is_turned = self.is_mirrored(score, config), self.is_turned(score, config)
        return self.asks(score, config), self.slips(score, config), is_mirrored, is_turned

    def asks(self, score: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
        """Which objects are to be searched for: uncertain and new ones, those whose score stays below the usual, and those long in doubt."""
        starting = self.starting if config.at_start else torch.zeros_like(self.starting)
        due = self.due | (self.sigma_px <= config.wide_sigma_px)
        stays_low = torch.maximum(score, self.last_score) < config.dropped_to * self.usual_score
        return starting | self.adrift | self.is_new(score, config) | (due & ((self.sigma_px > config.from_sigma_px) | stays_low))

    def is_new(self, score: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
        """Which objects never explained much more than now, and leave much unexplained: what is usual does not tell yet that they slip.

        Once in a while only: one that begins half hidden is new for long.
        """
        if none_of(self.due):
            return self.due
        best = torch.maximum(score, self.last_score)
        return ~self.starting & self.due & (self.full_share < _NEW * best) & (best < config.new_share)

    def slips(self, score: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
        """Which objects may have slipped: those that are sure of their place, and explain far less all at once."""
        sure = ~self.starting & ~self.adrift & (self.sigma_px < config.slip_sigma_px)
        return sure & (score < config.slipped_to * self.usual_score)

    def is_mirrored(self, score: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
        """Which objects may be in a pose that has the outline of the right one: those that are sure of it, and do not explain all."""
        sure = ~self.starting & (self.sigma_px < config.slip_sigma_px)
        low = torch.maximum(score, self.last_score) < config.mirrored_to * self.full_share
        return sure & low & self._far_due(config) & self.has_symmetry

    def is_turned(self, score: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
        """Which objects may be turned about their axis: those that are sure of their place, and explain as much as when seen well again."""
        if none_of(self.may_have_turned):
            return self.may_have_turned
        sure = self.may_have_turned & ~self.starting & (self.sigma_px < config.slip_sigma_px)
        return sure & (score >= config.slip_share * self.full_share) & self._far_due(config)

    def has_run_off(self, config: SearchConfig) -> Bool[Tensor, "b"]:
        """Which objects are also looked for as they were last seen well."""
        long = (self.unseen_s >= 1e-6 * config.unseen_us) & (config.unseen_us > 0)
        return self._far_due(config) & long & (self.adrift | (self.sigma_px > config.wide_sigma_px))

    def anew(self) -> Bool[Tensor, "b"]:
        """Which objects are looked for all around where they were last seen well."""
        return self.off_in_depth | self.little

    def _far_due(self, config: SearchConfig) -> Bool[Tensor, "b"]:
        return self.far_due & (config.doubt_us > 0)


def is_due(since_us: Int[Tensor, "s"], t_us: Int[Tensor, "s"], *intervals_us: int) -> Bool[Tensor, "k s"]:
    """Streams in which it is time for what is done once in each of some intervals: by the clock, whatever the windows."""
    each_us = constant(tuple((max(interval_us, 1),) for interval_us in intervals_us), t_us.dtype, t_us.device)
    return t_us // each_us > since_us // each_us


def searches(config: TrackerConfig) -> bool:
    """Whether other poses are ever tried."""
    return config.search.hypotheses > 0 and config.solver.prior


def mirrors(config: TrackerConfig) -> bool:
    """Whether they are mirrored ones, too."""
    return searches(config) and config.search.mirrored_to > 0


def turns(config: TrackerConfig) -> bool:
    """Whether they are turned ones, too."""
    return searches(config) and config.search.turned and config.search.doubt_us > 0


def is_wanted(doubt: Doubt, score: Float[Tensor, "b"], config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Which objects a search is wanted for, as ``score`` tells once the window is aligned."""
    if not searches(config):
        return torch.zeros_like(doubt.starting)
    # Those that have run off are asked for already, as uncertain ones or as those in doubt.
    asks, slips, is_mirrored, is_turned = doubt.reasons(score, config.search)
    return asks | slips | is_mirrored | is_turned | doubt.anew()


def in_doubt(
    score: Float[Tensor, "b"],
    full_share: Float[Tensor, "b"],
    gathered: Float[Tensor, "b"],
    full_gathered: Float[Tensor, "b"],
    config: SearchConfig,
) -> Bool[Tensor, "b"]:
    """Which objects explain so much less than when they are seen well, by smeared events, that they may be elsewhere.

    Where less is explained but events gather as ever, an object is right, and partly hidden.
    """
    return (gathered < SMEARED * full_gathered) & (score < config.doubted_below * full_share)


def gathered_when_known(doubt: Doubt, full_gathered: Float[Tensor, "b"], config: SearchConfig) -> Float[Tensor, "b"]:
    """How far events gather on contours when objects are seen well; zero, for nothing, of those whose place is not known.

    They were hidden, as a rule, and the events of what hides them do not gather where they are seen again.
    """
    return torch.where(doubt.sigma_px > config.from_sigma_px, 0, full_gathered)


def is_adrift(doubted_s: Float[Tensor, "b"], due: Bool[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
    """Which objects have been in doubt for so long that they are looked for farther away, where that is ``due``."""
    return due & (doubted_s >= 1e-6 * config.doubt_us) if config.doubt_us else torch.zeros_like(due)


def has_strayed(
    last_score: Float[Tensor, "b"],
    full_share: Float[Tensor, "b"],
    unseen_s: Float[Tensor, "b"],
    sigma_px: Float[Tensor, "b"],
    due: Bool[Tensor, "b"],
    config: SearchConfig,
) -> Bool[Tensor, "b"]:
    """Which objects, sure of their place, have not been seen well for so long that they are looked for farther away, where that is ``due``.

    What is usual follows a slip that grows slowly, and the covariance forgets the direction that it went in.
    """
    if none_of(due):
        return due
    if not (config.doubt_us and config.strayed_to):
        return torch.zeros_like(due)
    low = last_score < config.strayed_to * full_share
    return due & low & (unseen_s >= 1e-6 * config.doubt_us) & (sigma_px < config.slip_sigma_px)


# A prediction that is so uncertain, as a share of the most that predictions become, tells nothing any more.
_NOTHING_KNOWN = 0.8


# Farther away, or nearer, than when it was last seen well by this factor, an object may have been mistaken for others' edges.
_OFF_IN_DEPTH = 1.25


def is_lost(state: TrackerState, diameter_m: Float[Tensor, "b"], config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Which objects nothing is known of any more but where they were last seen well, which is long ago."""
    unseen = _unseen_for_long(state, config)
    if host_sync.none_of(unseen):
        return unseen
    sigma = state.covariance.diagonal(dim1=-2, dim2=-1)[:, :6].sqrt()
    turn_rad, move_m = sigma.unflatten(1, (2, 3)).amax(-1).unbind(1)
    unknown = (turn_rad > _NOTHING_KNOWN * MOST_UNCERTAIN) | (move_m > _NOTHING_KNOWN * MOST_UNCERTAIN * diameter_m)
    return unknown & unseen


def looked_for_anew(
    state: TrackerState, objects: ObjectBatch, t_us: Int[Tensor, "s"], config: TrackerConfig
) -> tuple[Bool[Tensor, "b"], Bool[Tensor, "b"]]:
    """Which objects, not seen well for long, are looked for all around where they were then, in the window to ``t_us``, and why.

    Those that explain little are partly hidden, as a rule. But a pose may also have gone along with what hid the object, and hold on to
    other edges. What is lost is expected there as it is.

    Returns:
        Those much farther away than then, or nearer; and those that explain much less.
    """
    unseen = _unseen_for_long(state, config)
    if host_sync.none_of(unseen):
        return unseen, unseen
    due = unseen & is_due(state.t_us, t_us, config.search.doubt_us)[0, objects.stream_index] & ~is_lost(state, objects.diameter_m, config)
    now_m, then_m = (objects.depth_m(T.to(objects.intrinsics.dtype)) for T in (state.T_cam_obj, state.T_last_seen))
    off_in_depth = torch.maximum(now_m / then_m, then_m / now_m) > _OFF_IN_DEPTH
    return due & off_in_depth, due & (state.score < config.search.anew_below * state.full_share)


def _unseen_for_long(state: TrackerState, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Which objects were found once, and then not seen well for long."""
    if not (config.search.anew_us and searches(config)):
        return torch.zeros_like(state.unseen_s, dtype=torch.bool)
    return (state.unseen_s >= 1e-6 * config.search.anew_us) & (state.usual_score > 0)
