"""How an object is rotated that most of can be rotated unseen about an axis: a can by its handle, or by its print.

While the handle is hidden nothing tells: the rest explains its events however it is rotated, and is sure of itself. When all
of it is seen again, poses all around the axis are compared, until the best is clearly better than all others. Of these, a pose with the
handle behind the rest leaves nothing of its contours unexplained. What speaks against it are the events of the handle, which
it has no contours for: so what counts is how much of them is explained, not which ratio.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.frontend.window_events import WindowEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.acceptance import Choice
from torchtrack.tracking.relocalization.event_image import event_density
from torchtrack.tracking.relocalization.evidence import TriggerEvidence
from torchtrack.tracking.relocalization.hypotheses import Hypotheses
from torchtrack.tracking.relocalization.lost_object import LostObject
from torchtrack.tracking.relocalization.sampling import ENOUGH_EVENTS, score_outlines
from torchtrack.tracking.relocalization.symmetric import RotationAxes
from torchtrack.tracking.relocalization.view_sphere import thinned
from torchtrack.tracking.validation.scored_fit import ScoredFit

# Rotations that are compared, and how many of them are the same: three degrees apart, and twelve.
_ROTATIONS, _SAME = 120, 4
# As many of the best are aligned, and the pose itself.
_ALIGNED = 6
# How much better, in both comparisons taken together, the best has to be than all others. To be rotated to, it has to explain so much more,
# and a larger ratio of its contours, or to lie on so many times as many events: longer contours lie on more of the background's.
_CLEARLY, _LARGER_RATIO, _MORE_EVENTS = 0.1, 0.05, 1.15
# The fastest rotation that is believed (rad/s).
_FASTEST_RAD_S = 12.0


@dataclass(frozen=True, kw_only=True)
class Rotations(Hypotheses):
    """An object as it is, and rotated about its axis.

    Args:
        number: of the object.
        axes: of all objects.
        angles: of the rotations (rad); the first is none.
        event_score: how many more events lie on the contours of each than around them.
        exists: which of them there are.
    """

    number: int
    axes: RotationAxes
    angles: Float[Tensor, "n"]
    event_score: Float[Tensor, "n"]
    exists: Bool[Tensor, "n"]

    def rows(self, count: int) -> Prediction:
        """The rotated predictions."""
        return self.axes.rotated(self.number, self.prediction, self.angles)

    def prediction_at(self, row: Int[Tensor, "1"]) -> Prediction:
        """The rotated prediction in a row."""
        return self.axes.rotated(self.number, self.prediction, self.angles[row])


def rotated(lost: LostObject) -> Rotations:
    """Rotated about its axis as its events say, no farther than it can have been since it was last seen well."""
    prediction, axes = lost.as_scored(), lost.others.ambiguities.axes
    angles = torch.arange(_ROTATIONS, dtype=prediction.T_cam_obj.dtype, device=prediction.T_cam_obj.device) * (2 * math.pi / _ROTATIONS)
    score = _events_on_contours(axes.rotated(lost.number, prediction, angles), prediction, lost.events, lost.config)
    within = torch.minimum(angles, 2 * math.pi - angles) <= _FASTEST_RAD_S * lost.time_since_validated_s
    chosen, exists = _peaks(score, within)
    return Rotations(
        prediction=prediction,
        offsets=prediction.velocity.new_zeros(len(chosen), 12),
        covariance=prediction.covariance[0],
        places=(lost.events.pixels, lost.events.mask),
        is_wide=False,
        replaces_prediction=True,
        number=lost.number,
        axes=axes,
        angles=angles[chosen],
        event_score=score[chosen],
        exists=exists,
    )


@dataclass(frozen=True)
class RotationTest:
    """What a rotation has to be to be accepted: clearly better than all others, or the pose as it is stays."""

    def row(self, number: int) -> "RotationTest":
        """The same of every object."""
        return self

    def choose(self, tried: ScoredFit, hypotheses: Hypotheses, lost: LostObject) -> Choice:
        """The best of the rotations; the first is the pose as it is, which has to be clearly the best to be confirmed."""
        if not isinstance(hypotheses, Rotations):
            raise TypeError(f"a rotation test compares rotations, not {type(hypotheses).__name__}.")
        score = hypotheses.event_score
        length = tried.fit.contours.mask.sum(-1)
        explained = length * (2 * tried.score - 1) / length[0].clamp(min=1)
        strength = torch.where(hypotheses.exists, explained + score / score.max().clamp(min=1e-6), -torch.inf)
        first, second = strength.topk(2).values
        best = strength.argmax()[None]
        clear = (first - second >= _CLEARLY) & (tried.count[best] >= lost.config.validation.min_observations)
        larger = (tried.score[best] >= tried.score[0] + _LARGER_RATIO) | (score[best] >= _MORE_EVENTS * score[0])
        accepted = clear & (best > 0) & (explained[best] >= explained[0] + _CLEARLY) & larger
        # What was rotated has to be confirmed by the next look.
        return Choice(best, accepted, axis_is_clear=clear & (best == 0))


def rotation_test(evidence: TriggerEvidence, flags: Int[Tensor, "b"], scored: ScoredFit, config: TrackerConfig) -> RotationTest:
    """Of rotations about an axis."""
    return RotationTest()


def _events_on_contours(rotations: Prediction, prediction: Prediction, events: WindowEvents, config: TrackerConfig) -> Float[Tensor, "n"]:
    """How many more events lie on the contours of each rotation than around them: in all, not for each of their points."""
    places = prediction.carried(events.pixels, events.age_s), events.mask
    image = event_density(*places, prediction.objects.image_size).clamp(max=ENOUGH_EVENTS)
    contours = rotations.objects.contours(rotations.T_cam_obj, config.contours)
    return score_outlines(thinned(contours), rotations.T_cam_obj, prediction.objects.intrinsics, image) * contours.mask.sum(-1)


def _peaks(score: Float[Tensor, "n"], within: Bool[Tensor, "n"]) -> tuple[Int[Tensor, "k"], Bool[Tensor, "k"]]:
    """The pose itself, and the rotations ``within`` reach that are better than those next to them, the best first; and which of these there are."""
    around = pad(score[None, None], (_SAME, _SAME), mode="circular")
    peaks = torch.where(within & (score == max_pool1d(around, 2 * _SAME + 1, 1)[0, 0]), score, -torch.inf)
    peaks[: _SAME + 1], peaks[-_SAME:] = -torch.inf, -torch.inf
    best = peaks.topk(_ALIGNED)
    chosen, exists = (pad(values, (1, 0), value=first) for values, first in ((best.indices, 0), (best.values > -torch.inf, True)))
    return chosen, exists
