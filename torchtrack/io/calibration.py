"""Camera calibration files: the DAVIS ``calib.txt``, a YAML form of our own, and those of other tools.

OpenCV, ROS, Metavision, Kalibr and more are read too, see :mod:`torchtrack.io.foreign_calibration`.

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
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from torchtrack.core.camera import Camera, DistortionModel
from torchtrack.errors import CalibrationError, TorchtrackWarning
from torchtrack.io.calibration_numbers import Given, agreed_size
from torchtrack.io.foreign_calibration import foreign_camera, load_calibration_text
from torchtrack.io.lens_model import lens
from torchtrack.io.whole_text import read_text_file, shown

_FORMS = "expected 'fx fy cx cy k1 k2 p1 p2 k3', or YAML with fx, fy, cx, cy, width, height and distortion, or as OpenCV, ROS or Kalibr write it"


class _CalibrationFile(BaseModel):
    """The YAML form; what the numbers may be is checked by :class:`torchtrack.core.camera.Camera`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion_model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()


def read_calibration(
    path: str | os.PathLike[str],
    width: int | None = None,
    height: int | None = None,
    *,
    name: str | None = None,
    distortion_model: DistortionModel | None = None,
) -> Camera:
    """The camera of a calibration file; its form is told by its content.

    Warns (:class:`~torchtrack.errors.TorchtrackWarning`) where numbers are unusual, or one of several cameras is taken.

    Args:
        path: the file.
        width, height: sensor size in pixels; needed for ``calib.txt``, and must agree with a file that says it.
        name: which camera of several: its key (``cam0``) or its topic.
        distortion_model: lens model, where the file does not say it; must agree with a file that does.

    Raises:
        MissingFileError: if there is no such file.
        LimitError: if it is larger than ``limits.text_bytes``.
        CalibrationError: if it cannot be read, its numbers make no sense, or what is given disagrees or is missing.
    """
    path = Path(path)
    text = read_text_file(path, "calibration file", "text_bytes", CalibrationError)
    given = Given(width, height, name, distortion_model)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TorchtrackWarning)
        try:
            camera = _read(text, given)
        except CalibrationError as error:
            raise CalibrationError(f"{path}: {shown(error)}") from error
    for warning in caught:
        warnings.warn(f"{path}: {warning.message}", warning.category, stacklevel=2)
    return camera


def _read(text: str, given: Given) -> Camera:
    values = _numbers(text)
    if values is not None:
        return _from_numbers(values, given)
    if text.lstrip().startswith("<"):
        raise CalibrationError("this is XML. Save it as YAML: OpenCV does so for a name that ends in .yml.")
    try:
        documents = load_calibration_text(text)
    except yaml.YAMLError as error:
        raise CalibrationError(f"neither numbers nor YAML ({' '.join(str(error).split())[:500]}).") from error
    if not documents or not all(isinstance(document, dict) for document in documents):
        raise CalibrationError(f"{_FORMS}.")
    cameras = [_from_mapping({str(key): value for key, value in document.items()}, given) for document in documents]
    if len(set(cameras)) > 1:
        raise CalibrationError(f"it holds {len(documents)} documents (parted by ---), and their cameras differ. Keep one.")
    return cameras[0]


def _numbers(text: str) -> list[float] | None:
    """The numbers of a file that holds nothing else (comments aside), or None."""
    words = [word for line in text.splitlines() for word in line.partition("#")[0].split()]
    try:
        return [float(word) for word in words] if words else None
    except ValueError:
        return None


def _from_numbers(values: list[float], given: Given) -> Camera:
    if len(values) not in (4, 8, 9, 12):
        raise CalibrationError(f"expected 'fx fy cx cy' and 0, 4, 5 or 8 distortion coefficients, got {len(values)} numbers.")
    if given.width is None or given.height is None:
        raise CalibrationError("this form does not say the sensor size. Give width and height in pixels (DAVIS240C: 240 and 180).")
    fx, fy, cx, cy, *distortion = values
    _check_name(given)
    # The form is of the plumb-bob model, where nobody says another.
    model, coefficients = lens({"distortion_model": "plumb_bob"} if given.distortion_model is None else {}, distortion, given)
    return Camera(fx, fy, cx, cy, given.width, given.height, model, coefficients)


def _check_name(given: Given) -> None:
    if given.name is not None:
        raise CalibrationError(f"camera.name: there is one camera here, and it has no name like '{given.name}'. Leave camera.name out.")


def _from_mapping(content: Mapping[str, Any], given: Given) -> Camera:
    foreign = foreign_camera(content, given)
    if foreign is not None:
        return foreign
    _check_name(given)
    try:
        read = _CalibrationFile.model_validate({"width": given.width, "height": given.height, **content})
    except ValidationError as error:
        if not {"fx", "fy", "cx", "cy"} & set(content):
            raise CalibrationError(f"{_FORMS}; its keys are {', '.join(list(content)[:20])}.") from error
        problems = "; ".join(f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}" for problem in error.errors())
        raise CalibrationError(problems + ".") from error
    width, height = agreed_size((read.width, read.height), given)
    if given.distortion_model not in (None, read.distortion_model):
        raise CalibrationError(f"distortion_model is {read.distortion_model} here, but {given.distortion_model} was given. Correct it.")
    return Camera(read.fx, read.fy, read.cx, read.cy, width, height, read.distortion_model, read.distortion)
