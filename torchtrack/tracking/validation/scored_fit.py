"""A fit with its score."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.constants import once
from torchtrack.tracking.estimation.rounds import Fit
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.validation.measures import constrained_2d, fit_measures

# From this ratio of how far they do when an object is seen well, events gather in full.
_GATHERED_FROM = 0.9


@dataclass(frozen=True)
class ScoredFit:
    """What a window gave for each object, with its score.

    Args:
        fit: poses, and what they stand on.
        measured_ratio: ratio of the moving contour that events explain; not a number where hardly anything moves.
        ratio_at_rest: what stands for it then.
        count: matched observations.
        inlier_ratio: of the events near the contour, how many are on it; not a number where it does not tell.
        reference_inlier_ratio: the same of when the object is seen well.
        normal_spread: how far the normals of the contours are spread that events lie on.
        texture_agreement: how far events on texture agree on its darker side; not a number where it does not tell.
        visible_ratio: of the contour, what lies in the image.
        required_spread: how far normals have to be spread to count in full; zero for nothing required.
        is_relocalized: objects that a search took to another pose than the prediction led to.
    """

    fit: Fit
    measured_ratio: Float[Tensor, "b"]
    ratio_at_rest: Float[Tensor, "b"]
    count: Int[Tensor, "b"]
    inlier_ratio: Float[Tensor, "b"]
    reference_inlier_ratio: Float[Tensor, "b"]
    normal_spread: Float[Tensor, "b"]
    texture_agreement: Float[Tensor, "b"]
    visible_ratio: Float[Tensor, "b"]
    required_spread: Float[Tensor, "b"]
    is_relocalized: Bool[Tensor, "b"]

    @once
    def explained_ratio(self) -> Float[Tensor, "b"]:
        """What events explain of the contour."""
        return torch.where(self.measured_ratio.isnan(), self.ratio_at_rest, self.measured_ratio)

    @once
    def score(self) -> Float[Tensor, "b"]:
        """The explained ratio, and less where the events around the contour are smeared: what poses are compared by."""
        gathering = self.inlier_ratio / (_GATHERED_FROM * self.reference_inlier_ratio).clamp(min=1e-3)
        return self.explained_ratio * gathering.nan_to_num(1.0).clamp(max=1)


def score_fit(
    prediction: Prediction,
    fit: Fit,
    config: TrackerConfig,
    ratio_at_rest: Float[Tensor, "b"],
    reference_inlier_ratio: Float[Tensor, "b"] | None = None,
    required_spread: Float[Tensor, "b"] | None = None,
) -> ScoredFit:
    """A fit with its score, by the motion that was estimated with it; without enough observations it explains nothing.

    Args:
        reference_inlier_ratio: of when each object is seen well; zero, or none at all, where that is not known.
        required_spread: how far normals have to be spread to count in full; zero, or none at all, for nothing required.
    """
    moving = prediction.at(fit.solution.T_cam_obj, fit.solution.from_prior).moving(compensated=True)
    measured, inliers, spread, agreement, visible = fit_measures(fit.contours, fit.matches, moving, prediction.objects.image_sizes, config)
    # Of what does not move, events are noise.
    inliers = torch.where(measured.isnan(), torch.nan, inliers) if config.uses(Component.INLIER_RATIO) else torch.full_like(measured, torch.nan)
    if required_spread is not None:
        measured = measured * constrained_2d(spread, required_spread)
    nothing = torch.zeros_like(measured)
    return ScoredFit(
        fit=fit,
        measured_ratio=measured,
        ratio_at_rest=ratio_at_rest,
        count=fit.matches.mask.sum(-1),
        inlier_ratio=inliers,
        reference_inlier_ratio=nothing if reference_inlier_ratio is None else reference_inlier_ratio,
        normal_spread=spread,
        texture_agreement=agreement,
        visible_ratio=visible,
        required_spread=nothing if required_spread is None else required_spread,
        is_relocalized=nothing.bool(),
    )


def explained_at_rest(gate_scale: Float[Tensor, "b"]) -> Float[Tensor, "b"]:
    """What an object explains that does not move: all, but nothing where it was looked for in many places.

    Args:
        gate_scale: of each object's first gate.
    """
    return 2 - gate_scale.clamp(1, 2)


def reference_where_known(
    sigma_px: Float[Tensor, "b"], reference_inlier_ratio: Float[Tensor, "b"], config: RelocalizationConfig
) -> Float[Tensor, "b"]:
    """How far events gather on contours when objects are seen well; zero, for nothing, of objects whose place is not known.

    They were hidden, as a rule, and the events of what hides them do not gather where they are seen again.
    """
    return torch.where(sigma_px > config.trigger_sigma_px, 0, reference_inlier_ratio)
