"""Camera calibration files: the DAVIS ``calib.txt``, a YAML form of our own, and those of other tools.

OpenCV, ROS, Metavision and Kalibr are read too, see :mod:`torchtrack.io.foreign_calibration`.

``calib.txt`` holds one line of numbers, ``fx fy cx cy`` and then distortion coefficients (plumb bob:
``k1 k2 p1 p2 [k3 [k4 k5 k6]]``); it does not say the sensor size. The YAML form says everything:

.. code-block:: yaml

    fx: 199.09
    fy: 198.83
    cx: 132.19
    cy: 110.71
    width: 240
    height: 180
    distortion_model: plumb_bob   # or fisheye, or none (the default)
    distortion: [-0.368, 0.151, -0.0003, -0.0008, 0.0]
"""

import os
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from torchtrack.camera import Camera, DistortionModel
from torchtrack.errors import CalibrationError, MissingFileError
from torchtrack.io.foreign_calibration import foreign_camera, load_yaml


class _CalibrationFile(BaseModel):
    """The YAML form; what the numbers may be is checked by :class:`torchtrack.camera.Camera`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion_model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()


def read_calibration(path: str | os.PathLike[str], width: int | None = None, height: int | None = None) -> Camera:
    """The camera of a calibration file; DAVIS text and YAML are told apart by content.

    Args:
        path: the file.
        width, height: sensor size in pixels; needed for ``calib.txt``, and must agree with a file that says it.

    Raises:
        MissingFileError: if there is no such file.
        CalibrationError: if it cannot be read, its numbers make no sense, or the sensor size is missing or disagrees.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"calibration file '{path}' does not exist.")
    text = path.read_text(encoding="utf-8", errors="replace")
    numbers = _numbers(text)
    try:
        if numbers is not None:
            return _from_numbers(numbers, width, height)
        return _from_yaml(text, width, height)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _numbers(text: str) -> list[float] | None:
    """The numbers of a file that holds nothing else (comments aside), or None."""
    words = [word for line in text.splitlines() for word in line.partition("#")[0].split()]
    try:
        return [float(word) for word in words] if words else None
    except ValueError:
        return None


def _from_numbers(numbers: list[float], width: int | None, height: int | None) -> Camera:
    if len(numbers) not in (4, 8, 9, 12):
        raise CalibrationError(f"expected 'fx fy cx cy' and 0, 4, 5 or 8 distortion coefficients, got {len(numbers)} numbers.")
    if width is None or height is None:
        raise CalibrationError("this form does not say the sensor size. Give width and height in pixels (DAVIS240C: 240 and 180).")
    fx, fy, cx, cy, *distortion = numbers
    model: DistortionModel = "plumb_bob" if any(distortion) else "none"
    return Camera(fx, fy, cx, cy, width, height, model, tuple(distortion) if any(distortion) else ())


def _from_yaml(text: str, width: int | None, height: int | None) -> Camera:
    try:
        content: Any = load_yaml(text)
    except yaml.YAMLError as error:
        raise CalibrationError(f"neither numbers nor YAML ({' '.join(str(error).split())}).") from error
    if not isinstance(content, dict):
        raise CalibrationError("expected 'fx fy cx cy k1 k2 p1 p2 k3', or YAML with fx, fy, cx, cy, width, height and distortion.")
    foreign = foreign_camera(content, width, height)
    if foreign is not None:
        return foreign
    try:
        read = _CalibrationFile.model_validate(content)
    except ValidationError as error:
        problems = "; ".join(f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}" for problem in error.errors())
        raise CalibrationError(problems + ".") from error
    for name, given, stored in (("width", width, read.width), ("height", height, read.height)):
        if given is not None and given != stored:
            raise CalibrationError(f"{name} is {stored} here, but {given} was given. Leave it out, or correct it.")
    return Camera(**read.model_dump())
