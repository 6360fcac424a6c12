"""Where the poses that are tried come from: sources of hypotheses, all of the same signature.

A source looks at an object (:class:`torchtrack.tracking.relocalization.lost_object.LostObject`) and gives poses that are worth
aligning, with what changes where one of them is accepted. A further source of hypotheses is a function like these, and a
line in :mod:`torchtrack.tracking.relocalization.sources`.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.rounds import gate_scale_of
from torchtrack.tracking.frontend.sensors import LEAST_SIGMA_PX
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.last_seen import less_certain
from torchtrack.tracking.relocalization.lost_object import LostObject
from torchtrack.tracking.relocalization.sampling import sample


@dataclass(frozen=True)
class Hypotheses:
    """Poses of an object that are worth aligning.

    Args:
        prediction: of the object alone, which they are taken around.
        offsets: of pose and velocity from there.
        covariance: of pose and velocity, that they were sampled from.
        places: pixels of the object's events at the window's end, and which of them exist.
        is_wide: whether hardly anything was known of where the object is.
        replaces_prediction: whether the prediction takes the place of the object's own where one of them is accepted.
        gate_scale: the scale of the first gate then; none for as it is.
    """

    prediction: Prediction
    offsets: Float[Tensor, "n 12"]
    covariance: Float[Tensor, "12 12"]
    places: tuple[Float[Tensor, "1 e 2"], Bool[Tensor, "1 e"]]
    is_wide: bool
    replaces_prediction: bool = False
    gate_scale: Float[Tensor, "1"] | None = None


def around_prediction(lost: LostObject) -> Hypotheses:
    """Sampled from its prediction: near it, or, where hardly anything is known, in all places of the image."""
    return sampled_around(lost, lost.predicted(), lost.sigma_px, lost.contours())


def around_last_seen(lost: LostObject) -> Hypotheses:
    """All around where it was last validated, at rest there."""
    other = lost.last_seen.prediction(lost.number, lost.window.prediction)
    # A look from there is a wide one, however far this one goes.
    hypotheses = sampled_elsewhere(lost, other, 2 * lost.config.relocalization.wide_sigma_px)
    return replace(hypotheses, gate_scale=anywhere_scale(lost))


def anywhere_scale(lost: LostObject) -> Float[Tensor, "1"]:
    """The scale of the first gate of what may be anywhere."""
    return gate_scale_of(torch.full_like(lost.window.gate_scale[:1], torch.inf), lost.config)


def sampled_around(lost: LostObject, prediction: Prediction, sigma_px: float, outline: Contours) -> Hypotheses:
    """Sampled from a ``prediction`` of the object alone, with its contours there; the first of them is the prediction itself.

    Args:
        sigma_px: standard deviation of the prediction in the image.
    """
    search = lost.config.relocalization
    widened_px = max(sigma_px, LEAST_SIGMA_PX)
    covariance = less_certain(prediction, sigma_px, widened_px).covariance[0]
    places = prediction.carried(lost.events.pixels, lost.events.age_s), lost.events.mask
    offsets = sample(prediction, outline, covariance, widened_px, places, lost.config)
    return Hypotheses(prediction, offsets, covariance, places, is_wide=sigma_px > search.wide_sigma_px)


def sampled_elsewhere(lost: LostObject, prediction: Prediction, sigma_px: float) -> Hypotheses:
    """Sampled around a prediction of the object that is not its own."""
    outline = prediction.objects.contours(prediction.T_cam_obj, lost.config.contours)
    return replace(sampled_around(lost, prediction, sigma_px, outline), replaces_prediction=True)
