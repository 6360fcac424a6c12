"""Which lens model a calibration of another tool is of, by every key that can say it."""

import warnings
from collections.abc import Mapping
from typing import Any

from torchtrack.errors import CalibrationError, TorchtrackWarning
from torchtrack.io.calibration_numbers import Given

_NAMES = {
    **dict.fromkeys(("radtan", "radialtangential", "plumb_bob", "rational_polynomial", "brown_conrady", "brown", "opencv"), "plumb_bob"),
    **dict.fromkeys(("pinhole-radtan", "pinhole-radtan8", "pinhole_radtan"), "plumb_bob"),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt", "kannalabrandt8", "kb", "kb4", "pinhole-equi", "opencv_fisheye"), "fisheye"),
    "none": "none",
}
# Of the projection alone: they leave the distortion open.
_OPEN = ("pinhole", "perspective", "")
_NO_FISHEYE = "no fisheye"
# What names of models have in them: where a key is of other things too, a name without these is one of those.
_PARTS_OF_NAMES = ("fish", "equi", "omni", "kannala", "ucm", "mei", "fov", "brown", "radial", "radtan", "division", "sphere", "rational")
# What OpenCV can hold beyond the eight coefficients of plumb bob are thin prisms and tilted sensors.
_COUNTS = {"plumb_bob": (4, 5, 8), "fisheye": (4,), "none": (0,)}
# Radial terms alone, or half a rational model: of these the order is not known.
_UNCLEAR = (1, 2, 3, 6, 7)
# Keys that hold a model's name, whole ("type" is Metavision's) or at their end (Camera.type is ORB-SLAM's).
_SAY = ("type", "model", "lens", "projection")
_SAY_AT_THE_END = (
    *("distortion_model", "distortionmodel", "distortion_type", "camera_model", "cameramodel", "camera_type", "camera.type"),
    *("lens_model", "lensmodel", "lens_type", "model_type", "projection_model", "projection_type", "sensor_model"),
)


def lens(content: Mapping[str, Any], coefficients: list[float], given: Given) -> tuple[str, tuple[float, ...]]:
    """Model and coefficients as :class:`torchtrack.core.camera.Camera` has them; zeros at the end are left out where they are too many.

    Raises:
        CalibrationError: if keys disagree, a model is not known, or its coefficients do not fit it.
    """
    said = {key: name for key, value in content.items() if (name := _said(key, value)) is not None}
    if given.distortion_model is not None:
        said["the setting distortion_model"] = given.distortion_model
    # "fisheye_model: 0" says that it is none, and leaves the rest open.
    denied = next((key for key, name in said.items() if name == _NO_FISHEYE), None)
    models = {name for name in said.values() if name != _NO_FISHEYE}
    if len(models) > 1 or (denied is not None and "fisheye" in models):
        statements = ", ".join(f"{key} says {name}" for key, name in said.items())
        raise CalibrationError(f"the lens model is not clear: {statements}. Correct the file, or leave out what is wrong.")
    if not models and denied is None and len(coefficients) == 4 and any(coefficients):
        warnings.warn(
            "no key says the lens model, and a fisheye model has four coefficients too: they are taken as k1 k2 p1 p2 of plumb_bob. "
            "Say distortion_model: plumb_bob or fisheye, in the file or among the camera's settings.",
            TorchtrackWarning,
            stacklevel=2,
        )
    return _fitting(next(iter(models), "plumb_bob"), coefficients)


def _said(key: str, value: Any) -> str | None:
    """The model that one key says; None for a key that says none."""
    lower = key.lower()
    if lower == "xi":
        raise CalibrationError("the key 'xi' is of the omnidirectional (MEI) model, which is not known; known are plumb_bob and fisheye.")
    if isinstance(value, str) and (lower in _SAY or lower.endswith(_SAY_AT_THE_END)):
        return _named(key, value)
    if not isinstance(value, bool | int | float | str):
        return None
    if "fisheye" in lower:
        return "fisheye" if _is_set(key, value) else _NO_FISHEYE
    if "omni" in lower and _is_set(key, value):
        raise CalibrationError(f"the key '{key}' says that the camera is omnidirectional; known models are plumb_bob and fisheye.")
    return None


def _named(key: str, value: str) -> str | None:
    """The model that a name says; None where it says that of the projection alone, or that of another thing."""
    name = value.strip().lower().rpartition(".")[2].replace(" ", "_")
    if name in _OPEN or name in _NAMES:
        return _NAMES.get(name)
    if key.lower() in _SAY and not any(part in name for part in _PARTS_OF_NAMES):
        warnings.warn(
            f"{key} is '{value[:60]}', which is no lens model that is known: it is taken as something else.", TorchtrackWarning, stacklevel=2
        )
        return None
    kind = "camera model" if "camera" in key.lower() else "distortion model" if "distortion" in key.lower() else "lens model"
    raise CalibrationError(f"{key}: the {kind} '{value[:60]}' is not known; known are pinhole, {', '.join(_NAMES)}. Calibrate with one of these.")


def _is_set(key: str, value: bool | int | float | str) -> bool:
    """Whether a switch is on.

    Raises:
        CalibrationError: if it is neither on nor off.
    """
    switch = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False, "off": False}
    on = switch.get(str(value).strip().lower())
    if on is None:
        raise CalibrationError(f"the key '{key}' decides the lens model, and '{str(value)[:60]}' is neither on (1) nor off (0).")
    return on


def _fitting(model: str, coefficients: list[float]) -> tuple[str, tuple[float, ...]]:
    if model == "none" and any(coefficients):
        raise CalibrationError(f"the lens model is 'none', but there are distortion coefficients {coefficients}. Say which model they are of.")
    # A fisheye lens without further terms still bends the image.
    if not any(coefficients) and (model != "fisheye" or not coefficients):
        if model == "fisheye":
            raise CalibrationError("the lens model is fisheye, but there are no distortion coefficients; it takes four, which may be zeros.")
        return "none", ()
    if len(coefficients) in _UNCLEAR:
        counts = f"{' or '.join(map(str, _COUNTS[model]))} coefficients, got {len(coefficients)}"
        raise CalibrationError(f"the model '{model}' takes {counts}. Fill up with zeros, in the order of OpenCV.")
    used = max((index + 1 for index, value in enumerate(coefficients) if value), default=0)
    fitting = [count for count in _COUNTS[model] if count >= used]
    if not fitting:
        raise CalibrationError(f"the model '{model}' has {used} coefficients here, but up to {_COUNTS[model][-1]} are known.")
    count = len(coefficients) if len(coefficients) in fitting else fitting[0]
    return model, tuple((coefficients + [0.0] * count)[:count])
