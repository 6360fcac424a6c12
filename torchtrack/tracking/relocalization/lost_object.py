"""What relocalization works on: what a window gave so far, and an object of it that other poses are tried for."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.window_events import WindowEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.last_seen import LastSeen
from torchtrack.tracking.validation.scored_fit import ScoredFit


@dataclass(frozen=True)
class Relocalized:
    """What a window gave, with what relocalization has exchanged in it.

    Args:
        scored: the fit of each object.
        prediction: what each is to be weighed against.
        gate_scale: how many times wider than configured the first gate of each is.
        looked: objects that other poses were tried for; none where that was nobody.
    """

    scored: ScoredFit
    prediction: Prediction
    gate_scale: Float[Tensor, "b"]
    looked: Bool[Tensor, "b"] | None = None


@dataclass(frozen=True)
class LostObject:
    """An object that other poses are tried for, as the sources of hypotheses see it.

    Args:
        number: of the object.
        window: what the window gave so far, for all objects.
        widened: the predictions of all objects, of those that drift as uncertain as that makes them.
        sigma_px: standard deviation of the object's widened prediction in the image.
        events: of the object.
        last_seen: where objects were validated for the last time.
    """

    number: int
    window: Relocalized
    widened: Prediction
    sigma_px: float
    events: WindowEvents
    last_seen: LastSeen
    config: TrackerConfig

    def predicted(self) -> Prediction:
        """The widened prediction of the object alone."""
        return self.widened.copies(self.number, 1)

    def contours(self) -> Contours:
        """Its contours where it is by now."""
        return self.window.scored.fit.contours.of_object(self.number)
