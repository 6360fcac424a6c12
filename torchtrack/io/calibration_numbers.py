"""Numbers and sizes of calibrations as other tools write them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchtrack.core.camera import DistortionModel
from torchtrack.errors import CalibrationError

_SIZE = ("image_size", "resolution", "img_size", "imageSize", "cameraResolution", "sensor_size")
_WIDTH = ("image_width", "width", "img_width", "w", "cols")
_HEIGHT = ("image_height", "height", "img_height", "h", "rows")


@dataclass(frozen=True)
class Given:
    """What is said beside a calibration file: each is None where nothing is.

    Args:
        width, height: sensor size (px).
        name: which camera of several.
        distortion_model: of the lens.
    """

    width: int | None = None
    height: int | None = None
    name: str | None = None
    distortion_model: DistortionModel | None = None


def first_of(content: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    """The value of the first of some keys that there is; None for none."""
    return next((content[name] for name in names if name in content), None)


def numbers(value: Any, what: str) -> np.ndarray:
    """Numbers of a list, nested or not, or of a mapping with ``data``, ``[n]`` float64.

    Raises:
        CalibrationError: if it holds anything else.
    """
    try:
        given = np.asarray(value["data"] if isinstance(value, Mapping) else value)
        # Text too: YAML takes 1e-3 for one.
        if given.dtype.kind not in "iufU":
            raise TypeError(f"of {given.dtype}")
        return given.astype(np.float64).ravel()
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{what} must be numbers, got {str(value)[:200]}.") from error


def size_of(content: Mapping[str, Any]) -> tuple[int | None, int | None]:
    """Width and height that a calibration says (px), by their names wherever they have some.

    Raises:
        CalibrationError: if they are no whole numbers, or said twice and differently.
    """
    pair = first_of(content, _SIZE)
    apart = tuple(_length(first_of(content, names)) for names in (_WIDTH[:3], _HEIGHT[:3]))
    if pair is None:
        return apart[0], apart[1]
    if isinstance(pair, Mapping) and "data" not in pair:
        values = [first_of(pair, _WIDTH), first_of(pair, _HEIGHT)]
    else:
        values = pair["data"] if isinstance(pair, Mapping) else pair
    if not isinstance(values, list) or len(values) != 2 or None in values:
        raise CalibrationError(f"the image size must be [width, height], or a mapping with width and height, got {str(pair)[:200]}.")
    return agreed("width", _length(values[0]), apart[0]), agreed("height", _length(values[1]), apart[1])


def _length(value: Any) -> int | None:
    if isinstance(value, bool) or not (value is None or (isinstance(value, int | float) and value == value // 1)):
        raise CalibrationError(f"width and height must be whole numbers, got {str(value)[:200]}.")
    return None if value is None else int(value)


def agreed(name: str, stored: int | None, given: int | None) -> int | None:
    """What a file and the user say of one thing; None where neither does.

    Raises:
        CalibrationError: if they disagree.
    """
    if stored is not None and given is not None and stored != given:
        raise CalibrationError(f"{name} is {stored} here, but {given} was given. Leave it out, or correct it.")
    return stored if stored is not None else given


def agreed_size(stored: tuple[int | None, int | None], given: Given) -> tuple[int, int]:
    """The sensor size by what a file and the user say.

    Raises:
        CalibrationError: if they disagree, or neither says it.
    """
    width, height = agreed("width", stored[0], given.width), agreed("height", stored[1], given.height)
    if width is None or height is None:
        raise CalibrationError("this file does not say the sensor size. Give width and height in pixels.")
    return width, height
