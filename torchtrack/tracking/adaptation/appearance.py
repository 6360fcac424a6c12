"""What is learned of how objects look while they are tracked."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from torchtrack.tracking.adaptation.learned_contours import LearnedContours


@dataclass(frozen=True)
class Appearance:
    """How objects look to the sensors.

    Args:
        darker_outside: which side of each object's contours is the darker one, by the octant that they face:
            :mod:`torchtrack.tracking.association.polarity`.
        learned: contours learned on the objects; none where that is switched off.
    """

    darker_outside: Float[Tensor, "b 8"]
    learned: LearnedContours | None = None
