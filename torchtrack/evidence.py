"""What a weigher sees of a window before it is aligned: all that tells whether an observation is of the contour near it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor, nn

from torchtrack.contour_index import ContourIndex
from torchtrack.contours import Contours
from torchtrack.observations import ObjectEvents, Observations, WindowEvents
from torchtrack.prediction import Prediction

AgeAt = Callable[[Tensor], Tensor]
"""Time since the newest event (s) at ideal pixels ``[b, n, 2]``, rounded to whole ones; huge where there never was any."""


@dataclass(frozen=True)
class Evidence:
    """One window of every object, at the predicted pose; all constants, as far as gradients go.

    Args:
        observations: what is to be judged.
        seen: events of the window; all of them, where a weigher of one's own is to judge.
        prediction: pose, motion and uncertainty of each object at the window's end.
        contours: visible contours there.
        index: which of them is nearest to a pixel.
        age_s: the time surface, also of the past before the window.
    """

    observations: Observations
    seen: ObjectEvents
    prediction: Prediction
    contours: Contours
    index: ContourIndex
    age_s: AgeAt

    @property
    def events(self) -> WindowEvents:
        """Events of the window, a row for each object."""
        return self.seen.rows()


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
