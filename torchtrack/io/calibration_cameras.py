"""The cameras of one calibration file, and which of them is meant.

Kalibr (``cam0``, ``cam1``), DSEC (``intrinsics`` with ``cam0``, ``camRect0``), Basalt (``value0`` with lists) and OpenCV's stereo
sample (``M1``, ``D1``, ``M2``, ``D2``) hold several.
"""

import warnings
from collections.abc import Mapping
from typing import Any

from torchtrack.errors import CalibrationError, TorchtrackWarning
from torchtrack.io.calibration_numbers import Given, size_of

Camera = Mapping[str, Any]
_TOPICS = ("rostopic", "topic", "camera_name", "label", "frame_id")


def cameras_of(content: Mapping[str, Any]) -> dict[str, Camera]:
    """The cameras of a file by name; of a file of one, itself by the empty name."""
    basalt = content.get("value0")
    if isinstance(basalt, Mapping) and isinstance(basalt.get("intrinsics"), list):
        return _of_basalt(basalt)
    named = content.get("intrinsics")
    if isinstance(named, Mapping) and (cameras_in_it := _mappings(named)):
        return cameras_in_it
    if chain := {name: camera for name, camera in _mappings(content).items() if "intrinsics" in camera}:
        return chain
    stereo = [number for number in ("1", "2") if f"M{number}" in content]
    if stereo:
        shared = {key: value for key, value in content.items() if key[:-1] not in ("M", "D")}
        return {f"M{number}": {**shared, "K": content[f"M{number}"], "D": content.get(f"D{number}", [])} for number in stereo}
    return {"": content}


def _mappings(content: Mapping[str, Any]) -> dict[str, Camera]:
    return {str(name): _by_text(value) for name, value in content.items() if isinstance(value, Mapping)}


def _by_text(content: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(key): value for key, value in content.items()}


def _of_basalt(content: Mapping[str, Any]) -> dict[str, Camera]:
    sizes, cameras = content.get("resolution"), content["intrinsics"]
    if not all(isinstance(camera, Mapping) and isinstance(camera.get("intrinsics"), Mapping) for camera in cameras):
        raise CalibrationError("value0.intrinsics must list cameras, each with camera_type and intrinsics by name, as Basalt writes it.")
    if sizes is not None and (not isinstance(sizes, list) or len(sizes) != len(cameras)):
        raise CalibrationError(f"value0.resolution must list one size for each of the {len(cameras)} cameras.")
    with_size = [{} if sizes is None else {"resolution": size} for size in sizes or cameras]
    return {f"cam{number}": {**_by_text(camera), **size} for number, (camera, size) in enumerate(zip(cameras, with_size, strict=True))}


def chosen(cameras: dict[str, Camera], given: Given) -> tuple[str, Camera]:
    """Name and content of the camera that is meant: by its name, else the first that has the given size, which is told.

    Raises:
        CalibrationError: if there is none of this name.
    """
    listed = ", ".join(f"'{name}'{_shown(camera)}" for name, camera in cameras.items())
    if given.name is not None:
        matches = [name for name, camera in cameras.items() if given.name in (name, *_topics(camera))]
        if len(matches) != 1:
            explanation = "several have it" if matches else f"there are {listed}" if any(cameras) else "the file holds one, which has no such name"
            raise CalibrationError(f"camera.name: '{given.name}' is no camera of this file; {explanation}.")
        return matches[0], cameras[matches[0]]
    if len(cameras) == 1:
        return next(iter(cameras.items()))
    fitting = [name for name in sorted(cameras) if _has_size(cameras[name], given)]
    # What is rectified has lost its lens: events have not. Where none fits, the first is refused with what disagrees.
    name = min(fitting or sorted(cameras), key=lambda name: "rect" in name.lower())
    warnings.warn(f"{len(cameras)} cameras: {listed}. '{name}' is taken; camera.name chooses another.", TorchtrackWarning, stacklevel=2)
    return name, cameras[name]


def _topics(camera: Camera) -> list[str]:
    return [str(camera[key]) for key in _TOPICS if key in camera]


def _shown(camera: Camera) -> str:
    width, height = size_of(camera)
    facts = [*_topics(camera)[:1], *([f"{width}x{height}"] if width and height else [])]
    return f" ({', '.join(facts)})" if facts else ""


def _has_size(camera: Camera, given: Given) -> bool:
    pairs = zip(size_of(camera), (given.width, given.height), strict=True)
    return all(there is None or here is None or there == here for there, here in pairs)
