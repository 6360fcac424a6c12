"""How the numbers of a model's file become metres in the object's frame: ``metres = scale * unit * number``, and the origin.

In go the points of a model, out come metres per number and where the origin is moved to, once the points have passed the
checks that every model must pass.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from torchtrack.errors import ModelError
from torchtrack.object_model.notices import tell
from torchtrack.object_model.settings import METRES_PER_UNIT

SMALLEST_M, LARGEST_M = 0.005, 5.0
# Poses are float32: with the origin so many diameters away, their rounding moves the model by 1e-4 and 1e-5 of its diameter.
_FARTHEST, _FAR = 1000.0, 100.0


@dataclass(frozen=True)
class Placement:
    """The unit of a model's numbers, what they are multiplied with beside it, and whether the origin goes to the middle of the model.

    Args:
        unit: a key of ``METRES_PER_UNIT``.
        scale: the model is enlarged by this.
        centre: whether the middle of its bounding box is to be the origin.
    """

    unit: str = "m"
    scale: float = 1.0
    centre: bool = False

    def metres(self, points: Float[ndarray, "n 3"], name: str) -> tuple[float, Float[ndarray, "3"]]:
        """Metres per number, and the point (m) that is to be the origin.

        Warns (:class:`TorchtrackWarning`) of an origin that is far from the model.

        Raises:
            ModelError: if a coordinate is not finite, the unit or scale is none, the diameter is outside 5 mm to 5 m, or the origin
                is too far away and stays there.
        """
        if self.unit not in METRES_PER_UNIT:
            raise ModelError(f"unknown unit '{self.unit}' for '{name}': use one of {', '.join(METRES_PER_UNIT)}.")
        if not 0 < self.scale < np.inf:
            raise ModelError(f"'{name}' cannot be enlarged by {self.scale}: give a scale that is a positive number.")
        bad = ~np.isfinite(points).all(1)
        if bad.any():
            raise ModelError(
                f"{bad.sum()} of {len(points)} vertices of '{name}' are not finite (NaN or infinite). Repair the model and export it again."
            )
        with np.errstate(over="ignore", invalid="ignore"):
            diameter = float(np.linalg.norm(np.ptp(points, axis=0)))
            middle = points.min(0) / 2 + points.max(0) / 2
        factor = METRES_PER_UNIT[self.unit] * self.scale
        self._check_diameter(diameter, name)
        if self.centre:
            return factor, middle * factor
        self._check_origin(middle, diameter, name)
        return factor, np.zeros(3)

    def _check_origin(self, middle: Float[ndarray, "3"], diameter: float, name: str) -> None:
        """Refuse a model so far from its own origin that float32 poses of that origin cannot say where the model is."""
        ratio = float(np.linalg.norm(middle)) / diameter
        if ratio <= _FAR:
            return
        shift = ", ".join(f"{0 - value:.10g}" for value in middle)
        problem = f"'{name}' lies {ratio:,.0f} times its diameter from its own origin, as models in map coordinates do"
        advice = (
            f"Set centre to true, or move it by ({shift}) {self.unit} in a mesh editor, so that its middle is at the origin, "
            "and give initial poses of the moved model."
        )
        if ratio > _FARTHEST:
            raise ModelError(
                f"{problem}: poses, which are of that origin, would be rounded to more than 1e-4 of its size; "
                f"expected less than {_FARTHEST:.0f} times. {advice}"
            )
        tell(f"{problem}: poses are of that origin, so a small error of rotation is a large one of translation. {advice}")

    def _check_diameter(self, diameter: float, name: str) -> None:
        """Refuse a size that no tracked object has, and say which unit would make it plausible."""
        metres = diameter * METRES_PER_UNIT[self.unit] * self.scale
        if SMALLEST_M <= metres <= LARGEST_M:
            return
        units = plausible_units(diameter * self.scale)
        plausible = [f"unit='{unit}' ({diameter * self.scale * METRES_PER_UNIT[unit]:.3g} m)" for unit in units]
        advice = f"Plausible would be {' or '.join(plausible)}." if plausible else "No known unit makes it plausible: set scale, which enlarges it."
        scaled = f" and scale={self.scale:g}" if self.scale != 1 else ""
        raise ModelError(f"'{name}' is {metres:.3g} m across with unit='{self.unit}'{scaled}; expected 5 mm to 5 m. {advice}")


def plausible_units(diameter: float) -> list[str]:
    """Units in which a model that is so many of them across may be a tracked object."""
    return [unit for unit, metres in METRES_PER_UNIT.items() if SMALLEST_M <= diameter * metres <= LARGEST_M]
