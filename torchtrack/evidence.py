"""What a weigher sees of a window before it is aligned: all that tells whether an observation is of the contour near it."""

from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor, nn

from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.history import History
from torchtrack.tracking.frontend.window_events import ObjectEvents, WindowEvents
from torchtrack.tracking.motion.prediction import Prediction


@dataclass(frozen=True)
class Evidence:
    """One window of every object, at the predicted pose; all constants, as far as gradients go.

    Args:
        observations: what is to be judged.
        seen: events of the window; all of them, where a weigher of one's own is to judge.
        prediction: pose, motion and uncertainty of each object at the window's end.
        contours: visible contours there.
        index: which of them is nearest to a pixel.
        history: the time surface, also of the past before the window.
    """

    observations: Observations
    seen: ObjectEvents
    prediction: Prediction
    contours: Contours
    index: ContourIndex
    history: History

    @property
    def events(self) -> WindowEvents:
        """Events of the window, a row for each object."""
        return self.seen.rows()

    def age_s(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n"]:
        """Time since the newest event (s) at ideal pixels, rounded to whole ones; huge where there never was any."""
        return self.history.age_s(pixels)


def judged(evidence: Evidence, weigher: nn.Module) -> Observations:
    """The observations, with how far a weigher believes each of them.

    Raises:
        ValueError: if the weigher gives something else than one number for each observation.
    """
    trust = weigher(evidence)
    expected = evidence.observations.age_s.shape
    if trust.shape != expected:
        raise ValueError(f"a weigher must give one number for each observation, shape {list(expected)}; got {list(trust.shape)}.")
    return replace(evidence.observations, trust=trust.to(evidence.observations.age_s.dtype))
