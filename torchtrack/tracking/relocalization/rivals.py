"""Rivals of a pose that is about to be confirmed: is there another one, turned far from it, that explains far more?

A run may start from a pose that is tens of degrees off, and a search may find such a one. Edges that lie where others should explain six to nine
tenths of the contour there, as many as at a right pose that is seen badly; no threshold tells the two apart. What does is that around a wrong pose
there is one that explains more of the contour, by more events, which gather more; around a right one there is none.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.padded import repeated, rows_in_all
from torchtrack.tracking.motion.model import covariance_at_rest
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.acceptance import AS_MUCH, Choice, is_likely
from torchtrack.tracking.relocalization.evidence import TriggerEvidence
from torchtrack.tracking.relocalization.hypotheses import Hypotheses, anywhere_scale, sampled_anywhere
from torchtrack.tracking.relocalization.lost_objects import LostObjects
from torchtrack.tracking.validation.scored_fit import ScoredFit
from torchtrack.tracking.validation.verdict import AGREES_FROM

# Standard deviations of what was put in its place but turned wrong: rotation (rad), across the image (diameters), and depth (as a share of it).
# Of 33 poses that were more than 20 degrees off, a pose within 12 degrees of the truth was among the rivals of 19; with 0.7 rad, 0.15 diameters and
# a tenth of the depth of 15, with 0.35 rad of 19.
_TURNED_RAD, _ACROSS_DIAMETERS, _DEPTH_SHARE = 0.5, 0.1, 0.05
# Of the rotations that are tried where an object may be anywhere, this ratio is enough: with 400, a pose within 12 degrees of the truth was among the
# rivals of 18 of 23 other poses that were more than 20 degrees off, and with 1000, which take twice as long, of 16.
_ROTATIONS_RATIO = 0.4
# A rival explains so many times as much: of the contour, times by how many events, times how far they gather, each of which is no less. Of 70 poses
# that were more than 20 degrees off, 42 gave way to one that was not with 1.3, 40 with 1.5, 39 with 1.6 and 36 with 2; 11, 10, 9 and 6 to another
# wrong one, which is looked at as well before it is confirmed. None of 266 poses that were right within 12 degrees gave way to one more than 20
# degrees off. But a right pose of a plate, whose print its model lacks, did behind bars with 1.5, to one that explains 1.53 times as much.
_FAR_MORE = 1.6


def turned(prediction: Prediction, config: TrackerConfig) -> Prediction:
    """The prediction as uncertain as what was put in its place but turned wrong."""
    objects = prediction.objects
    across_m, depth_m = _ACROSS_DIAMETERS * objects.diameter_m.double(), _DEPTH_SHARE * objects.depth_m(prediction.T_cam_obj).double()
    rotation_rad = torch.full_like(depth_m, _TURNED_RAD)
    pose = torch.stack([rotation_rad, rotation_rad, rotation_rad, across_m, across_m, depth_m], 1)
    return replace(prediction, covariance=covariance_at_rest(pose, objects.diameter_m, config.motion))


def turned_far(lost: LostObjects) -> Hypotheses:
    """Turned far from the objects' predictions, in their places."""
    prediction = turned(lost.window.prediction.detached().copies(lost.numbers), lost.config)
    search = lost.config.relocalization
    search = search.model_copy(update={"rotations": max(int(_ROTATIONS_RATIO * search.rotations), 1)})
    lost = replace(lost, config=lost.config.model_copy(update={"relocalization": search}))
    # One that is accepted is no jump.
    return replace(sampled_anywhere(lost, prediction), replaces_prediction=True, gate_scale=anywhere_scale(lost))


def explains_far_more(evidence: TriggerEvidence, scored: ScoredFit, config: TrackerConfig) -> "FarMore":
    """Of poses that are turned far: they are compared with what the object's own pose explains by then."""
    return FarMore()


@dataclass(frozen=True)
class FarMore:
    """Accepts what explains far more than the object's own pose."""

    def rows(self, chosen: Int[Tensor, "k"]) -> "FarMore":
        """The same is asked of each object."""
        return self

    def choose(self, tried: ScoredFit, hypotheses: Hypotheses, lost: LostObjects) -> Choice:
        """The rival of each object that explains most."""
        own, rows, count = lost.window.scored, lost.rows, len(tried.count)
        values = ((tried.score, own.score), (tried.count, own.count), (tried.inlier_ratio, own.inlier_ratio))
        # Of what does not tell how far it gathers nothing is better.
        times = torch.stack([theirs / repeated(mine[rows], count).clamp(min=1e-6) for theirs, mine in values])
        # What texture contradicts gives way to what is about as good and is not contradicted.
        is_wrong = own.texture_agreement[rows] < AGREES_FROM
        least = repeated(torch.where(is_wrong, 1 - AS_MUCH, 1.0), count)
        eligible = (times >= least).all(0) & (tried.count >= lost.config.validation.min_observations)
        eligible = eligible & is_likely(tried.fit.solution.from_prior, hypotheses.covariance) & ~(tried.texture_agreement < AGREES_FROM)
        more = torch.where(eligible, times.prod(0), 0).unflatten(0, (len(rows), -1))
        best = rows_in_all(more.argmax(1, keepdim=True), more.shape[1])
        return Choice(best, more.flatten().index_select(0, best) > torch.where(is_wrong, 0, _FAR_MORE))
