"""Where the poses that are tried come from: sources of hypotheses, all of the same signature.

A source looks at objects (:class:`torchtrack.tracking.relocalization.lost_objects.LostObjects`) and gives poses that are worth
aligning, with what changes where one of them is accepted. A further source of hypotheses is a function like these, and a
line in :mod:`torchtrack.tracking.relocalization.sources`.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.tracking.estimation.rounds import gate_scale_of
from torchtrack.tracking.frontend.sensors import LEAST_SIGMA_PX
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.event_image import Places
from torchtrack.tracking.relocalization.last_seen import less_certain
from torchtrack.tracking.relocalization.lost_objects import LostObjects
from torchtrack.tracking.relocalization.sampling import sample_anywhere, sample_near


@dataclass(frozen=True)
class Hypotheses:
    """Poses of objects that are worth aligning, as many in turn of each.

    Args:
        prediction: of the objects, which they are taken around.
        offsets: of pose and velocity from there.
        covariance: of pose and velocity, that they were sampled from.
        places: pixels of each object's events at the window's end, and which of them exist.
        is_wide: whether hardly anything was known of where the objects are.
        replaces_prediction: whether the prediction takes the place of an object's own where one of them is accepted.
        gate_scale: the scale of the first gate then; none for as it is.
    """

    prediction: Prediction
    offsets: Float[Tensor, "n 12"]
    covariance: Float[Tensor, "k 12 12"]
    places: Places
    is_wide: bool
    replaces_prediction: bool = False
    gate_scale: Float[Tensor, "k"] | None = None


def around_prediction(lost: LostObjects) -> Hypotheses:
    """Sampled from their predictions: near these, or, where hardly anything is known, in all places of the image."""
    prediction = lost.predicted()
    if lost.is_wide:
        return sampled_anywhere(lost, prediction)
    places, wider = _places(lost, prediction), less_certain(prediction, lost.sigma_px, lost.sigma_px.clamp(min=LEAST_SIGMA_PX))
    return Hypotheses(prediction, sample_near(wider, lost.contours(), places, lost.config), wider.covariance, places, is_wide=False)


def around_last_seen(lost: LostObjects) -> Hypotheses:
    """All around where they were last validated, at rest there."""
    # A look from there is a wide one, however far this one goes.
    hypotheses = sampled_anywhere(lost, lost.last_seen.prediction(lost.numbers, lost.window.prediction))
    return replace(hypotheses, replaces_prediction=True, gate_scale=anywhere_scale(lost))


def anywhere_scale(lost: LostObjects) -> Float[Tensor, "k"]:
    """The scale of the first gate of what may be anywhere."""
    return gate_scale_of(torch.full_like(lost.sigma_px, torch.inf), lost.config)


def sampled_anywhere(lost: LostObjects, prediction: Prediction) -> Hypotheses:
    """Sampled from a ``prediction`` of the objects that hardly tells where they are; the first of each object's is the prediction itself."""
    places = _places(lost, prediction)
    return Hypotheses(prediction, sample_anywhere(prediction, places, lost.config), prediction.covariance, places, is_wide=True)


def _places(lost: LostObjects, prediction: Prediction) -> Places:
    return prediction.carried(lost.events.pixels, lost.events.age_s), lost.events.mask
