"""Which way an object is turned that most of can be turned unseen about an axis: a can by its handle, or by its print.

While the handle is hidden nothing tells: the rest explains its events whichever way it is turned, and is sure of itself. When all
of it is seen again, poses all around the axis are compared, until one is clearly better than all others. Of these, one with the
handle behind the rest leaves nothing of its contours unexplained. What speaks against it are the events of the handle, which
it has no contours for: so it counts how much of them is explained, not which share.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from torchtrack.config.search import SearchConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.lie import retract_about
from torchtrack.tracking.frontend.window_events import ObjectEvents, WindowEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.event_image import event_density
from torchtrack.tracking.relocalization.hypotheses import ENOUGH_EVENTS, mark
from torchtrack.tracking.relocalization.refine import align_all, replaced
from torchtrack.tracking.relocalization.view_sphere import thinned
from torchtrack.tracking.validation.scored_fit import Found

# Turns that are compared, and how many of them are the same: three degrees apart, and twelve.
_TURNS, _SAME = 120, 4
# As many of the best are aligned, beside the pose itself.
_ALIGNED = 6
# How much better, in both comparisons taken together, one has to be than all others. To be turned to, it has to explain so much more,
# and a larger share of its contours, or to lie on so many times as many events: longer contours lie on more of the background's.
_CLEARLY, _LARGER_SHARE, _MORE_EVENTS = 0.1, 0.05, 1.15
# How certain a turn is (rad), and a spin (rad/s), that was not seen; and the fastest spin that is believed (rad/s).
_TURN_RAD, _SPIN_RAD_S, _FASTEST_RAD_S = 0.1, 4.0, 12.0


@dataclass(frozen=True)
class TurningAxes:
    """The axis of each object that most of it can be turned about unseen.

    Args:
        points_obj: a point on it (m).
        directions_obj: its unit direction; zero of objects without one.
    """

    points_obj: Float[Tensor, "b 3"]
    directions_obj: Float[Tensor, "b 3"]

    def turned(self, number: int, one: Prediction, angles: Float[Tensor, "n"]) -> Prediction:
        """Predictions of one object, the ``number``-th, alone, turned by some angles about its axis, of which little is known then.

        What is on the axis goes on as it did.
        """
        count, point, direction = len(angles), self.points_obj[number], self.directions_obj[number]
        copies, along = one.copies(0, count), one.T_cam_obj[0, :3, :3] @ direction
        turns = pad(angles[:, None] * along, (0, 3))
        moved = replace(copies, T_cam_obj=retract_about(copies.T_cam_obj, turns, point.expand(count, 3)))
        gained = torch.linalg.cross(copies.velocity[:, :3], moved.centre_cam - copies.centre_cam, dim=-1)
        unknown, spread = torch.zeros_like(one.covariance), torch.outer(along, along).to(one.covariance.dtype)
        for first, sigma in ((0, _TURN_RAD), (6, _SPIN_RAD_S)):
            unknown[:, first : first + 3, first : first + 3] = sigma**2 * spread
        velocity = torch.cat([copies.velocity[:, :3], copies.velocity[:, 3:] + gained], 1)
        return replace(moved, velocity=velocity, covariance=copies.covariance + unknown)


def may_have_turned(has_axis: Bool[Tensor, "b"], unseen_s: Float[Tensor, "b"], config: SearchConfig) -> Bool[Tensor, "b"]:
    """Which objects, not seen well for a while, may have turned about their axis unseen.

    Args:
        has_axis: which have one.
        unseen_s: how long ago they were seen well (s).
    """
    return has_axis & (unseen_s >= 1e-6 * config.doubt_us)


def turns_compared(
    number: int,
    one: Prediction,
    axes: TurningAxes,
    unseen_s: Float[Tensor, ""],
    events: ObjectEvents,
    found: Found,
    prediction: Prediction,
    config: TrackerConfig,
) -> tuple[Found, Prediction]:
    """The object ``number`` turned as its events say, where these do so clearly, and the prediction that it is to be weighed against.

    Args:
        one: the object alone, as it was found.
        unseen_s: how long ago it was seen well (s): it cannot have turned farther than it can spin in this time.
        events: of all objects.
    """
    seen = events.of(number)
    angles = torch.arange(_TURNS, dtype=one.T_cam_obj.dtype, device=one.T_cam_obj.device) * (2 * math.pi / _TURNS)
    totals = _events_on_contours(axes.turned(number, one, angles), one, seen, config)
    within = torch.minimum(angles, 2 * math.pi - angles) <= _FASTEST_RAD_S * unseen_s
    chosen, exists = _peaks(totals, within)
    rows = axes.turned(number, one, angles[chosen])
    tried = align_all(rows, one.velocity.new_zeros(len(chosen), 13), seen, config, found.full_gathered[number], found.asked_apart[number])
    best, clear, turned = _compared(tried, totals[chosen], exists, config.quality.min_observations)
    unclear = found.turn_unclear.clone()
    # What was turned has to be confirmed by the next look.
    unclear[number] &= ~(clear & (best == 0))[0]
    other = axes.turned(number, one, angles[chosen[best]])
    found = replace(replaced(found, number, tried, best, turned), turn_unclear=unclear)
    return found, prediction.exchanged(number, other, turned[0])


def _compared(
    tried: Found, totals: Float[Tensor, "k"], exists: Bool[Tensor, "k"], min_observations: int
) -> tuple[Int[Tensor, "1"], Bool[Tensor, "1"], Bool[Tensor, "1"]]:
    """Which of some turned poses is the best, whether it clearly is, and whether to turn to it; the first is the pose as it is.

    Args:
        totals: how many more events lie on the contours of each than beside them; ``exists`` tells which there are.
    """
    length = tried.fit.contours.mask.sum(-1)
    explained = length * (2 * tried.score - 1) / length[0].clamp(min=1)
    strength = torch.where(exists, explained + totals / totals.max().clamp(min=1e-6), -torch.inf)
    first, second = strength.topk(2).values
    best = strength.argmax()[None]
    clear = (first - second >= _CLEARLY) & (tried.count[best] >= min_observations)
    larger = (tried.score[best] >= tried.score[0] + _LARGER_SHARE) | (totals[best] >= _MORE_EVENTS * totals[0])
    return best, clear, clear & (best > 0) & (explained[best] >= explained[0] + _CLEARLY) & larger


def _events_on_contours(turned: Prediction, one: Prediction, seen: WindowEvents, config: TrackerConfig) -> Float[Tensor, "n"]:
    """How many more events lie on the contours of each prediction than beside them: in all, not for each of their points."""
    image = event_density(one.carried(seen.pixels, seen.age_s), seen.mask, one.objects.image_size).clamp(max=ENOUGH_EVENTS)
    contours = turned.objects.contours(turned.T_cam_obj, config.contours)
    return mark(thinned(contours), turned.T_cam_obj, one.objects.intrinsics, image) * contours.mask.sum(-1)


def _peaks(totals: Float[Tensor, "n"], within: Bool[Tensor, "n"]) -> tuple[Int[Tensor, "k"], Bool[Tensor, "k"]]:
    """The pose itself, and the turns ``within`` reach that are better than those beside them, the best first; and which of these there are."""
    around = pad(totals[None, None], (_SAME, _SAME), mode="circular")
    peaks = torch.where(within & (totals == max_pool1d(around, 2 * _SAME + 1, 1)[0, 0]), totals, -torch.inf)
    peaks[: _SAME + 1], peaks[-_SAME:] = -torch.inf, -torch.inf
    best = peaks.topk(_ALIGNED)
    chosen, exists = (pad(values, (1, 0), value=first) for values, first in ((best.indices, 0), (best.values > -torch.inf, True)))
    return chosen, exists
