"""Calibrations as other tools write them, in YAML or JSON.

- OpenCV (``FileStorage``, with ``fisheye_model``) and ROS 1 and 2 (``camera_info``): ``camera_matrix``, ``K`` or ``k``, with
  ``distortion_coefficients``, ``D`` or ``d``, ``distortion_model``, and ``image_width`` and ``image_height`` or ``width`` and ``height``;
- Metavision: ``K`` and ``D``, or ``camera_matrix`` and ``distortion_coefficients``, with ``width`` and ``height`` or ``image_size``;
- Kalibr (``camchain``), DSEC (``cam_to_cam``) and Basalt: see :mod:`torchtrack.io.calibration_cameras`;
- camodocal and VINS (``projection_parameters``, ``distortion_parameters``, ``model_type``).
"""

import json
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from torchtrack.core.camera import Camera
from torchtrack.core.yaml_text import LimitedLoader, load_documents
from torchtrack.errors import CalibrationError, TorchtrackWarning
from torchtrack.io.calibration_cameras import cameras_of, chosen
from torchtrack.io.calibration_numbers import Given, agreed_size, first_of, numbers, size_of
from torchtrack.io.lens_model import lens

_MATRIX = ("camera_matrix", "cameraMatrix", "K", "k", "intrinsic_matrix", "intrinsics", "projection_parameters")
_DISTORTION = ("distortion_coefficients", "distortion_coeffs", "distCoeffs", "D", "d", "dist_coeffs", "distortion", "distortion_parameters")
_FOCAL = (("fx", "mu"), ("fy", "mv"), ("cx", "u0"), ("cy", "v0"))
# In OpenCV's order; the last is camodocal's.
_BY_NAME = (
    ("plumb_bob", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    ("fisheye", ("k1", "k2", "k3", "k4")),
    ("fisheye", ("k2", "k3", "k4", "k5")),
)


class _Loader(LimitedLoader):
    """YAML with the matrices of OpenCV, which are mappings with a tag."""


def _matrix(loader: _Loader, node: yaml.Node) -> Any:
    """A matrix of OpenCV as the mapping that it is."""
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def load_calibration_text(text: str) -> list[Any]:
    """What the documents of a YAML or JSON text hold, also in OpenCV's dialect; empty ones are left out.

    Raises:
        yaml.YAMLError: if it is neither, or larger than is read.
    """
    # JSON may be indented by tabs, which YAML may not.
    if text.lstrip()[:1] in ("{", "["):
        try:
            return [json.loads(text)]
        except json.JSONDecodeError:
            pass
        except (ValueError, RecursionError) as error:
            raise yaml.YAMLError(f"JSON that cannot be read: {error}") from error
    # OpenCV writes a colon where the standard has a space.
    head, newline, rest = text.partition("\n")
    documents = load_documents(rest if head.startswith("%YAML:") else head + newline + rest, _Loader)
    return [document for document in documents if document is not None]


def foreign_camera(content: Mapping[str, Any], given: Given) -> Camera | None:
    """The camera of a calibration of another tool; None if it is none of those that are known.

    Args:
        content: what the file holds.
        given: what is said beside it.

    Raises:
        CalibrationError: if it is one, but something is missing or makes no sense.
    """
    cameras = cameras_of(content)
    if not any(cameras) and first_of(content, _MATRIX) is None:
        return None
    name, camera = chosen(cameras, given)
    try:
        return _camera(camera, given)
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {error}" if name else str(error)) from error


def _camera(content: Mapping[str, Any], given: Given) -> Camera:
    _tell_parts_of_the_sensor(content)
    matrix = first_of(content, _MATRIX)
    if matrix is None:
        raise CalibrationError(f"there is no camera matrix: none of {', '.join(_MATRIX)}.")
    parameters = {str(key): value for key, value in matrix.items()} if isinstance(matrix, Mapping) and "data" not in matrix else None
    named, coefficients = _coefficients(content, parameters or {})
    # What names its parameters may name those of the lens among them, and their names say the model.
    said = {**content, **({"xi": parameters["xi"]} if parameters and "xi" in parameters else {})}
    model, distortion = lens({"distortion_model": named, **said} if named else said, coefficients, given)
    K = _by_order(matrix) if parameters is None else _by_name(parameters)
    return Camera.from_matrix(K, *agreed_size(size_of(content), given), model, distortion)


def _by_order(matrix: Any) -> np.ndarray:
    values = numbers(matrix, "the camera matrix")
    if values.size == 4:
        fx, fy, cx, cy = values
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if values.size != 9:
        raise CalibrationError(f"the camera matrix must have 9 numbers, got {values.size}; or be fx, fy, cx, cy.")
    return values.reshape(3, 3)


def _by_name(parameters: Mapping[str, Any]) -> np.ndarray:
    values = [first_of(parameters, names) for names in _FOCAL]
    if None in values:
        raise CalibrationError(f"the camera's parameters must name fx, fy, cx and cy; they name {', '.join(parameters)}.")
    return _by_order(values)


def _coefficients(content: Mapping[str, Any], parameters: Mapping[str, Any]) -> tuple[str | None, list[float]]:
    """Distortion coefficients in OpenCV's order, and the model that their names say; none where none are said."""
    stored = first_of(content, _DISTORTION)
    if isinstance(stored, Mapping) and "data" not in stored:
        parameters, stored = {str(key): value for key, value in stored.items()}, None
    if stored is not None:
        return None, numbers(stored, "the distortion").tolist()
    named = {key for key in parameters if key[:1] in "kp" and key[1:].isdigit()}
    for model, names in _BY_NAME:
        if set(names[:4]) <= named <= set(names):
            count = max(names.index(key) for key in named) + 1
            return model, numbers([parameters.get(key, 0.0) for key in names[:count]], "the distortion").tolist()
    if named:
        raise CalibrationError(f"the distortion names {', '.join(sorted(named))}, which are the coefficients of no model that is known.")
    return None, []


def _tell_parts_of_the_sensor(content: Mapping[str, Any]) -> None:
    """Warn of binning, and of a region of interest, which ROS says beside the intrinsics of the whole sensor."""
    binned = [content.get(name) not in (None, 0, 1) for name in ("binning_x", "binning_y")]
    roi = content.get("roi")
    cut = isinstance(roi, Mapping) and any(roi.get(name) for name in ("x_offset", "y_offset", "width", "height"))
    if any(binned) or cut:
        what = " and ".join(word for word, there in (("binning", any(binned)), ("a region of interest (roi)", cut)) if there)
        warnings.warn(
            f"{what} is said beside the intrinsics, which are of the whole sensor: the events must be so too. For events that are binned or "
            "cut, give the calibration of what they show.",
            TorchtrackWarning,
            stacklevel=2,
        )
