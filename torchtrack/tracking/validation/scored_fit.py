"""A fit with its score."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.constants import once
from torchtrack.tracking.estimation.rounds import Fit
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.validation.measures import constrained_2d, shares

# From this share of how far they do when an object is seen well, events gather in full.
_AS_GATHERED = 0.9


@dataclass(frozen=True)
class ScoredFit:
    """What one window gave for each object.

    Args:
        fit: poses, and what they stand on.
        measured: share of the moving contour that events explain; not a number where hardly anything moves.
        at_rest: what stands for it then.
        count: matched observations.
        gathered: share of the events near the contour that are on it; not a number where it does not tell.
        full_gathered: the same of when the object is seen well.
        apart: how far apart the directions of the contours are that events lie on.
        asked_apart: how far apart they have to be to count in full; zero for nothing asked.
        elsewhere: which objects a search found in another place than the prediction led to.
        turn_unclear: which may be turned otherwise about their axis (:mod:`torchtrack.tracking.relocalization.axis_rotation`).
    """

    fit: Fit
    measured: Float[Tensor, "b"]
    at_rest: Float[Tensor, "b"]
    count: Int[Tensor, "b"]
    inlier_ratio: Float[Tensor, "b"]
    reference_inlier_ratio: Float[Tensor, "b"]
    apart: Float[Tensor, "b"]
    required_spread: Float[Tensor, "b"]
    elsewhere: Bool[Tensor, "b"]
    rotation_unclear: Bool[Tensor, "b"]

    @once
    def explained_ratio(self) -> Float[Tensor, "b"]:
        """What events explain of the contour."""
        return torch.where(self.measured.isnan(), self.at_rest, self.measured)

    @once
    def score(self) -> Float[Tensor, "b"]:
        """The share, and less where the events around the contour are smeared: what poses are compared by."""
        inlier_ratio = self.inlier_ratio / (_AS_GATHERED * self.reference_inlier_ratio).clamp(min=1e-3)
        return self.explained_ratio * inlier_ratio.nan_to_num(1.0).clamp(max=1)


def judge_fit(
    prediction: Prediction,
    fit: Fit,
    config: TrackerConfig,
    at_rest: Float[Tensor, "b"],
    reference_inlier_ratio: Float[Tensor, "b"] | None = None,
    required_spread: Float[Tensor, "b"] | None = None,
) -> ScoredFit:
    """A fit with its quality, by the motion that was found with it; without enough observations it explains nothing.

    Args:
        full_gathered: of when each object is seen well; zero, or none at all, where that is not known.
        asked_apart: how far apart directions have to be to count in full; zero, or none at all, for nothing asked.
    """
    moving = prediction.at(fit.solution.T_cam_obj, fit.solution.from_prior).moving(compensated=True)
    measured, inlier_ratio, apart = shares(fit.contours, fit.matches, moving, prediction.objects.image_size, config.validation)
    # Of what does not move, events are noise.
    inlier_ratio = (
        torch.where(measured.isnan(), torch.nan, inlier_ratio) if config.relocalization.by_inlier_ratio else torch.full_like(measured, torch.nan)
    )
    if required_spread is not None:
        measured = measured * constrained_2d(apart, required_spread)
    nothing = torch.zeros_like(measured)
    reference_inlier_ratio, required_spread = (nothing if value is None else value for value in (reference_inlier_ratio, required_spread))
    return ScoredFit(
        fit, measured, at_rest, fit.matches.mask.sum(-1), inlier_ratio, reference_inlier_ratio, apart, required_spread, nothing.bool(), nothing.bool()
    )


def explained_at_rest(gate_scale: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """What an object explains that does not move: all, but nothing where it was looked for in many places.

    Args:
        gate_scale: of each object's first gate.
    """
    return 2 - gate_scale.clamp(1, 2)
