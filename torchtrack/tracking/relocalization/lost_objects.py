"""What relocalization works on: what a window gave so far, and objects of it that other poses are tried for."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.constants import constant, once
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
class LostObjects:
    """Objects that other poses are tried for, a compact batch, as the sources of hypotheses see it.

    Args:
        numbers: of the objects.
        window: what the window gave so far, for all objects.
        widened: the predictions of all objects, of those that drift as uncertain as that makes them.
        sigma_px: standard deviation of these objects' widened predictions in the image.
        is_wide: whether hardly anything is known of where they are, from these predictions.
        events: of these objects.
        last_seen: where objects were validated for the last time.
    """

    numbers: tuple[int, ...]
    window: Relocalized
    widened: Prediction
    sigma_px: Float[Tensor, "k"]
    is_wide: bool
    events: WindowEvents
    last_seen: LastSeen
    config: TrackerConfig

    @once
    def rows(self) -> Int[Tensor, "k"]:
        """Their numbers as an index of all objects."""
        return constant(self.numbers, torch.int64, self.sigma_px.device)

    def predicted(self) -> Prediction:
        """Their widened predictions."""
        return self.widened.copies(self.numbers)

    def contours(self) -> Contours:
        """Their contours where they are by now."""
        return self.window.scored.fit.contours.rows(self.rows)
