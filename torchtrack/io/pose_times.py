"""Times of poses in text, in the unit that they can be in, as whole microseconds."""

import warnings
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation

import numpy as np

from torchtrack.config.events import TimeUnit
from torchtrack.errors import EventDataError, PoseError, TorchtrackWarning
from torchtrack.io.plausibility import Timed, settled_unit
from torchtrack.io.seconds import parse_seconds

# Poses are measured some times to some thousand times a second.
_POSES = Timed("poses", "initial_pose.time_unit (time_unit)", possible=(0.01, 20_000.0), usual=(0.5, 10_000.0), fewest=10)
_EXPONENT: dict[TimeUnit, int] = {"s": 0, "ms": -3, "us": -6, "ns": -9}
_LOOKED_AT = 10_000
# Keyframes written by hand stand at whole seconds; so do the numbers of images.
_KEYFRAMES_S = 2.0


def pose_times_us(texts: Sequence[str], unit: TimeUnit | None) -> list[int]:
    """Times as they are written, in µs; seconds, where nobody says another unit.

    Raises:
        PoseError: if one is no time, or nobody says the unit and they cannot be seconds.
    """
    try:
        numbers = np.array([float(text) for text in texts[:_LOOKED_AT]])
        stated = "s" if unit is None and _are_keyframes(numbers) else unit
        settled = settled_unit(numbers, "s", stated, "the times of the poses", _POSES)
        if stated != unit and not any("." in text for text in texts[:_LOOKED_AT]):
            message = "the times of the poses are whole numbers, and taken for seconds: are they numbers of images? If not, set time_unit to s."
            warnings.warn(message, TorchtrackWarning, stacklevel=2)
        # Exactly, by their digits.
        return [parse_seconds(text if settled == "s" else str(_scaled(text, settled))) for text in texts]
    except (ValueError, EventDataError) as error:
        raise PoseError(str(error)) from error


def _are_keyframes(numbers: np.ndarray) -> bool:
    """Whether times are whole numbers a second or two apart."""
    whole = bool((np.isfinite(numbers) & (numbers == np.floor(numbers))).all())
    return whole and len(numbers) > 1 and 1.0 <= float(np.median(np.abs(np.diff(numbers)))) <= _KEYFRAMES_S


def _scaled(text: str, unit: TimeUnit) -> Decimal:
    """A time in seconds.

    Raises:
        ValueError: if the text is no number.
    """
    try:
        return Decimal(text).scaleb(_EXPONENT[unit])
    except InvalidOperation:
        raise ValueError(f"'{text[:60]}' is not a number") from None
