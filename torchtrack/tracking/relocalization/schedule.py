"""What is due in a window, and which objects have triggers already: what the clock and the state alone say."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.constants import constant
from torchtrack.core.host_sync import none_of
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.motion.model import MOST_UNCERTAIN
from torchtrack.tracking.relocalization.evidence import Schedule
from torchtrack.tracking.relocalization.triggers import AROUND_LAST_SEEN, DRIFT_US, Trigger, flags_of, has, waits_for_rivals
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.validation.verdict import Limits

# A prediction that is so uncertain, as a ratio of the most that predictions become, tells nothing any more.
_NOTHING_KNOWN = 0.8
# Farther away, or nearer, than when it was last seen well by this factor, an object may have been mistaken for others' edges.
_DEPTH_FACTOR = 1.25
# From each of these times on that an object was not seen well (s), it is looked for half as often as before. With them, three runs of the trial lost
# 4.6, 5.2 and 4.4 % of the windows; with times twice as long 5.0, 5.3 and 4.7 %.
_HALVED_FROM_S = (0.1, 0.2, 0.4, 0.8)
# What was not seen well for so long, and is lost or far off in depth, is looked for all around where it was then (µs). Not measured alone.
_NOT_VALIDATED_US = 100_000


def schedule(state: TrackerState, objects: ObjectBatch, t_us: Int[Tensor, "s"], config: TrackerConfig) -> Schedule:
    """What the state alone says of the window that ends at ``t_us``: which objects are lost, and which are looked for all around."""
    unseen_s, interval_us = state.health.time_since_validated_s, config.relocalization.interval_us
    halved = (unseen_s[:, None] >= constant(_HALVED_FROM_S, unseen_s.dtype, unseen_s.device)).sum(1)
    usual, far = (_is_due(state.t_us, t_us, intervals_us, halved, objects.stream_index) for intervals_us in _intervals_us(interval_us))
    return Schedule(_not_validated_for_long(state, objects, far, config), usual, far, usual | (halved == 0))


def may_look_far(state: TrackerState, scheduled: Schedule, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Objects that may be looked for farther away than they are expected, by all that is known before the window is looked at."""
    health, is_due = state.health, scheduled.is_drift_due
    far = has(scheduled.triggers, AROUND_LAST_SEEN) | waits_for_rivals(health.confirmations, is_due, Limits.from_config(config))
    if none_of(is_due):
        return far
    return far | (is_due & (torch.maximum(health.drift_s, health.time_since_validated_s) >= 1e-6 * DRIFT_US))


def _intervals_us(interval_us: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Once in which time very uncertain objects are looked for, and others farther away, halved so many times."""
    usual = tuple(interval_us * 2**number for number in range(len(_HALVED_FROM_S) + 1))
    return usual, tuple(max(each_us, DRIFT_US) for each_us in usual)


def _is_due(
    since_us: Int[Tensor, "s"], t_us: Int[Tensor, "s"], intervals_us: tuple[int, ...], halved: Int[Tensor, "b"], stream_index: Int[Tensor, "b"]
) -> Bool[Tensor, "b"]:
    """Objects that it is time for, each in its own of some intervals."""
    return is_time(since_us, t_us, *intervals_us)[:, stream_index].gather(0, halved[None])[0]


def is_time(since_us: Int[Tensor, "s"], t_us: Int[Tensor, "s"], *intervals_us: int) -> Bool[Tensor, "k s"]:
    """Streams in which it is time for what is done once in each of some intervals: by the clock, whatever the windows."""
    each_us = constant(tuple((max(interval_us, 1),) for interval_us in intervals_us), t_us.dtype, t_us.device)
    return t_us // each_us > since_us // each_us


def _not_validated_for_long(state: TrackerState, objects: ObjectBatch, is_drift_due: Bool[Tensor, "b"], config: TrackerConfig) -> Int[Tensor, "b"]:
    """LOST, DEPTH_CHANGED and FAR_BELOW_REFERENCE, of objects that were seen well once, and then not seen well for long.

    LOST: nothing is known of them any more but where they were last seen well, and they are expected there. Others are looked for all
    around that place. Those that explain too little are partly hidden, as a rule; but a pose may also have gone along with what hid the
    object, and hold on to other edges.
    """
    unvalidated = _lacks_validation(state, config)
    if none_of(unvalidated):
        return unvalidated.long()
    lost = unvalidated & _is_unknown(state, objects.diameter_m)
    due = unvalidated & is_drift_due & ~lost
    now_m, then_m = (objects.depth_m(T.to(objects.intrinsics.dtype)) for T in (state.T_cam_obj, state.health.T_last_validated))
    changed = due & (torch.maximum(now_m / then_m, then_m / now_m) > _DEPTH_FACTOR)
    below = due & (state.health.score < config.relocalization.not_validated_below * state.health.reference_explained_ratio)
    return flags_of({int(Trigger.LOST): lost, int(Trigger.DEPTH_CHANGED): changed, int(Trigger.FAR_BELOW_REFERENCE): below})


def _lacks_validation(state: TrackerState, config: TrackerConfig) -> Bool[Tensor, "b"]:
    if not (config.uses(Component.AROUND_LAST_SEEN) and config.searches):
        return torch.zeros_like(state.health.time_since_validated_s, dtype=torch.bool)
    return (state.health.time_since_validated_s >= 1e-6 * _NOT_VALIDATED_US) & (state.health.mean_score > 0)


def _is_unknown(state: TrackerState, diameter_m: Float[Tensor, "b"]) -> Bool[Tensor, "b"]:
    sigma = state.motion.covariance.diagonal(dim1=-2, dim2=-1)[:, :6].sqrt()
    rotation_rad, move_m = sigma.unflatten(1, (2, 3)).amax(-1).unbind(1)
    return (rotation_rad > _NOTHING_KNOWN * MOST_UNCERTAIN) | (move_m > _NOTHING_KNOWN * MOST_UNCERTAIN * diameter_m)
