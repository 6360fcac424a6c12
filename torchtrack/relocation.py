"""Where an object is looked for that has not been seen well for a while: all around the pose that it had then.

A prediction goes on from what was last taken for the object. One that is lost coasts away, until it is out of the image; a
pose that slipped runs off in depth, where the few events on its small contours explain all of them; or it holds on to other
edges, which explain some of it. Meanwhile the object is seen well again, not far from where it was, and nobody looks there.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.doubt import is_due, searches
from torchtrack.state import TrackerState
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.motion.model import MOST_UNCERTAIN, rim_and_centre
from torchtrack.tracking.motion.prediction import Prediction

# A prediction that is so uncertain, as a share of the most that predictions become, tells nothing any more.
_NOTHING_KNOWN = 0.8
# Farther away, or nearer, than when it was last seen well by this factor, an object may have been mistaken for others' edges.
_OFF_IN_DEPTH = 1.25
# Standard deviations: turn (rad), and depth (as a share of it).
_TURN_RAD, _DEPTH_SHARE = 1.0, 0.1
# And way across the image (px/s, and as a share of its diagonal), the longer the object was not seen well.
_SPEED_PX_S, _DIAGONALS = 400.0, 0.2
# One look after the other: as far as in a third of all that, in two, in all. A few hundred poses come near the right one but rarely in all.
_LOOKS = 3


@dataclass(frozen=True)
class LastSeen:
    """Where objects are expected that nothing else is known of.

    Args:
        T_cam_obj: their poses when they were last seen well (float64).
        covariance: of pose and velocity, in the chart of :mod:`torchtrack.tracking.motion.model` (float64).
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    covariance: Float[Tensor, "b 12 12"]

    @classmethod
    def of(cls, state: TrackerState, objects: ObjectBatch, t_us: Int[Tensor, "s"], config: TrackerConfig) -> "LastSeen":
        """Poses as they were, as uncertain as this window's look asks for.

        Args:
            t_us: end of the window: it says which look it is.
        """
        T_cam_obj = state.T_last_seen.to(objects.intrinsics.dtype)
        look = (t_us // max(config.search.interval_us, 1) % _LOOKS)[objects.stream_index]
        share = (look + 1).double() / _LOOKS
        height, width = objects.image_size
        across_px = (_SPEED_PX_S * state.unseen_s.double()).clamp(max=_DIAGONALS * (height**2 + width**2) ** 0.5)
        across_m, depth_m = across_px / objects.px_per_m(T_cam_obj).double(), _DEPTH_SHARE * objects.depth_m(T_cam_obj).double()
        turn_rad = torch.full_like(depth_m, _TURN_RAD)
        pose = share[:, None] * torch.stack([turn_rad, turn_rad, turn_rad, across_m, across_m, depth_m], 1)
        diameter_m = objects.diameter_m.double()[:, None]
        rate = rim_and_centre(torch.full_like(diameter_m, config.motion.initial_speed_m_s), diameter_m)
        return cls(state.T_last_seen, torch.diag_embed(torch.cat([pose, rate], 1).square()))

    def in_place_of(self, state: TrackerState, lost: Bool[Tensor, "b"]) -> TrackerState:
        """The state with objects that are ``lost`` at rest where they were last seen well."""
        chosen = lost[:, None, None]
        return replace(
            state,
            T_cam_obj=torch.where(chosen, self.T_cam_obj, state.T_cam_obj),
            velocity=torch.where(lost[:, None], 0, state.velocity),
            acceleration=torch.where(lost[:, None], 0, state.acceleration),
            covariance=torch.where(chosen, self.covariance, state.covariance),
        )

    def prediction(self, number: int, prediction: Prediction) -> Prediction:
        """The prediction of one object alone, at rest there."""
        one, own = prediction.copies(number, 1), slice(number, number + 1)
        acceleration = one.acceleration and replace(one.acceleration, expected=torch.zeros_like(one.acceleration.expected))
        T_cam_obj, velocity = self.T_cam_obj[own].to(one.T_cam_obj.dtype), torch.zeros_like(one.velocity)
        return Prediction(one.objects, T_cam_obj, torch.ones_like(one.usable), velocity, self.covariance[own], acceleration)


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


def anywhere(covariance: Float[Tensor, "b 12 12"], chosen: Bool[Tensor, "b"]) -> Float[Tensor, "b 12 12"]:
    """Covariances of poses and velocities, of the ``chosen`` objects so large that they may be anywhere in the image."""
    unknown = torch.eye(12, dtype=covariance.dtype, device=covariance.device)
    return torch.where(chosen[:, None, None], unknown, covariance)


def _unseen_for_long(state: TrackerState, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Which objects were found once, and then not seen well for long."""
    if not (config.search.anew_us and searches(config)):
        return torch.zeros_like(state.unseen_s, dtype=torch.bool)
    return (state.unseen_s >= 1e-6 * config.search.anew_us) & (state.usual_score > 0)
