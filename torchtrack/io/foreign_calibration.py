"""Calibrations as other tools write them, in YAML or JSON.

- OpenCV (``FileStorage``) and ROS (``camera_info``): ``camera_matrix`` and ``distortion_coefficients`` with ``data``, ``image_width``
  and ``image_height``;
- Metavision: ``K`` and ``D``, or ``camera_matrix`` and ``distortion_coefficients``, with ``width`` and ``height`` or ``image_size``;
- Kalibr (``camchain``): ``cam0`` with ``intrinsics``, ``distortion_coeffs`` and ``resolution``; of more cameras the first is taken.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from torchtrack.camera import Camera
from torchtrack.errors import CalibrationError

_MATRIX = ("camera_matrix", "K", "intrinsic_matrix")
_DISTORTION = ("distortion_coefficients", "distortion_coeffs", "D", "dist_coeffs")
_SIZE = ("image_size", "resolution", "img_size")
_WIDTH, _HEIGHT = ("image_width", "width", "img_width"), ("image_height", "height", "img_height")
_MODELS = {
    **dict.fromkeys(("radtan", "plumb_bob", "rational_polynomial", "brown_conrady", "brown"), "plumb_bob"),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt"), "fisheye"),
    "none": "none",
}
# What OpenCV can hold beyond the eight coefficients of plumb bob: thin prisms and tilted sensors.
_COUNTS = {"plumb_bob": (4, 5, 8), "fisheye": (4,), "none": (0,)}


class _Loader(yaml.SafeLoader):
    """YAML with the matrices of OpenCV, which are mappings with a tag."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    """A matrix of OpenCV as the mapping that it is."""
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def load_yaml(text: str) -> Any:
    """What a YAML or JSON text holds, also in OpenCV's dialect.

    Raises:
        yaml.YAMLError: if it is neither.
    """
    # OpenCV writes a colon where the standard has a space.
    head, newline, rest = text.partition("\n")
    return yaml.load(rest if head.startswith("%YAML:") else head + newline + rest, Loader=_Loader)


def foreign_camera(content: Mapping[str, Any], width: int | None = None, height: int | None = None) -> Camera | None:
    """The camera of a calibration of another tool; None if it is none of those that are known.

    Args:
        content: what the file holds.
        width, height: sensor size (px), where the file does not say it.

    Raises:
        CalibrationError: if it is one, but something is missing or makes no sense.
    """
    chain = sorted(key for key in content if key.startswith("cam") and isinstance(content[key], Mapping) and "intrinsics" in content[key])
    if chain:
        return _kalibr(content[chain[0]], chain[0])
    matrix = _first(content, _MATRIX)
    if matrix is None:
        return None
    K = _numbers(matrix, "the camera matrix")
    if K.size != 9:
        raise CalibrationError(f"the camera matrix must have 9 numbers, got {K.size}.")
    coefficients = _first(content, _DISTORTION)
    model = str(_first(content, ("distortion_model", "camera_model", "model")) or "plumb_bob")
    size = _size(content)
    model, distortion = _distortion(model, [] if coefficients is None else _numbers(coefficients, "the distortion").tolist())
    return Camera.from_matrix(K.reshape(3, 3), *_agreed(size, (width, height)), model, distortion)


def _kalibr(camera: Mapping[str, Any], name: str) -> Camera:
    if camera.get("camera_model", "pinhole") != "pinhole":
        raise CalibrationError(f"{name} has the camera model '{camera['camera_model']}'; pinhole is known.")
    intrinsics = _numbers(camera["intrinsics"], "intrinsics").tolist()
    if len(intrinsics) != 4:
        raise CalibrationError(f"{name}: expected intrinsics fx, fy, cx, cy, got {len(intrinsics)} numbers.")
    model, distortion = _distortion(str(camera.get("distortion_model", "none")), _numbers(camera.get("distortion_coeffs", []), "distortion").tolist())
    fx, fy, cx, cy = intrinsics
    return Camera(fx, fy, cx, cy, *_agreed(_size(camera), (None, None)), model, distortion)


def _first(content: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((content[name] for name in names if name in content), None)


def _numbers(value: Any, what: str) -> np.ndarray:
    """Numbers of a list, nested or not, or of a mapping with ``data``."""
    try:
        numbers = np.asarray(value["data"] if isinstance(value, Mapping) else value, np.float64).ravel()
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(f"{what} must be numbers, got {value!r}.") from error
    return numbers


def _size(content: Mapping[str, Any]) -> tuple[int | None, int | None]:
    pair = _first(content, _SIZE)
    if pair is not None:
        values = list(pair.values()) if isinstance(pair, Mapping) else pair
        if not isinstance(values, list) or len(values) != 2:
            raise CalibrationError(f"the image size must be width and height, got {pair!r}.")
        return _length(values[0]), _length(values[1])
    return _length(_first(content, _WIDTH)), _length(_first(content, _HEIGHT))


def _length(value: Any) -> int | None:
    if value is not None and not isinstance(value, int):
        raise CalibrationError(f"width and height must be whole numbers, got {value!r}.")
    return value


def _agreed(stored: tuple[int | None, int | None], given: tuple[int | None, int | None]) -> tuple[int, int]:
    for name, there, here in zip(("width", "height"), stored, given, strict=True):
        if there is not None and here is not None and there != here:
            raise CalibrationError(f"{name} is {there} here, but {here} was given. Leave it out, or correct it.")
    width, height = (there if there is not None else here for there, here in zip(stored, given, strict=True))
    if width is None or height is None:
        raise CalibrationError("this file does not say the sensor size. Give width and height in pixels.")
    return width, height


def _distortion(model: str, coefficients: list[float]) -> tuple[str, tuple[float, ...]]:
    """Model and coefficients as :class:`Camera` has them; zeros at the end are left out where they are too many."""
    if model.lower() not in _MODELS:
        raise CalibrationError(f"the distortion model '{model}' is not known; known are {', '.join(_MODELS)}.")
    name = _MODELS[model.lower()]
    if not any(coefficients):
        return "none", ()
    used = max(index + 1 for index, value in enumerate(coefficients) if value)
    fitting = [count for count in _COUNTS[name] if count >= used]
    if not fitting:
        raise CalibrationError(f"the model '{model}' has {used} coefficients here, but up to {_COUNTS[name][-1]} are known.")
    count = len(coefficients) if len(coefficients) in fitting else fitting[0]
    return name, tuple((coefficients + [0.0] * count)[:count])
