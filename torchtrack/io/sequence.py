"""Sequences: events, camera, object models and ground truth, in one ``.npz`` file with its meshes beside it.

:func:`read_sequence` reads the HDF5 form too, see :mod:`torchtrack.io.container`. Layout of ``NAME.npz`` (numpy, no pickle):

===================== ==================================================================================
``t x y p``           events: µs (int64, sorted), pixels (uint16), polarity (uint8, 1 = brighter)
``K width height``    3x3 camera matrix and sensor size; ``distortion_model distortion`` where there is one
``labels mesh_files`` one per object; the mesh files lie beside the sequence, in metres
``poses pose_t``      ``[P, 4, 4]`` or ``[O, P, 4, 4]`` object to camera, and their times in µs ``[P]`` (optional)
``meta``              JSON text (optional)
``velocity``          ``[O, P, 6]`` rad/s and m/s at ``pose_t``: ``dT/dt = ξ^ T`` (optional; of the simulator)
``source``            per event: number of its object or occluder, -1 background, -2 noise (optional; of the simulator)
``occluder_poses``    as ``poses``, with ``occluder_labels``: what moves through and is not tracked (optional)
===================== ==================================================================================

A ``NAME_LABEL_textured.glb`` beside it is the same object with its texture.
"""

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtrack.config.events import ReadingConfig
from torchtrack.core.camera import Camera
from torchtrack.core.files import is_file, naming
from torchtrack.errors import CalibrationError, EventDataError, MissingFileError, PoseError
from torchtrack.io.container import is_container, read_container
from torchtrack.io.event_file import DEFAULT_CHOICES
from torchtrack.io.npz import NpzEvents, keys_of, open_archive, read_array
from torchtrack.io.sequence_types import Sequence, SequenceObject
from torchtrack.io.trajectory import Trajectory
from torchtrack.io.zip_archive import is_zip

_LONGEST_LABEL = 200
_EXTRA = ("velocity", "occluder_poses", "occluder_labels")


def read_sequence(path: str | os.PathLike[str], strict: bool = False, *, choices: ReadingConfig = DEFAULT_CHOICES) -> Sequence:
    """Read a sequence; its events stay on disk until they are streamed, as ``choices`` say.

    Args:
        path: the file.
        strict: whether what is wrong in the stream is an error, see :func:`torchtrack.io.open_events`.

    Raises:
        MissingFileError: if the file, or a mesh that it names, is not there.
        UnknownFormatError: if it is neither an ``.npz`` file nor a sequence in HDF5.
        EventDataError: if an array is missing, damaged or of the wrong shape.
        CalibrationError: if the camera makes no sense.
        PoseError: if the ground truth is not rigid, or its times do not increase.
    """
    path = Path(path)
    with naming(path):
        return read_container(path, strict, choices=choices) if is_container(path) else _read_archive(path, strict, choices)


def _read_archive(path: Path, strict: bool, choices: ReadingConfig) -> Sequence:
    events = NpzEvents(path, strict=strict, choices=choices)
    with open_archive(path) as archive:
        camera = _read_camera(archive, events, path)
        labels, mesh_files = _read_names(archive, "labels", path), _read_names(archive, "mesh_files", path)
        if len(labels) != len(mesh_files) or not labels:
            raise EventDataError(f"'{path}': labels and mesh_files must name one or more objects each, got {len(labels)} and {len(mesh_files)}.")
        ground_truth = _read_ground_truth(archive, labels, path)
        meta = _read_meta(archive, path)
        extra = {name: read_array(archive, name, path) for name in _EXTRA if name in keys_of(archive)}
    objects = tuple(_sequence_object(path, *row) for row in zip(labels, mesh_files, ground_truth, strict=True))
    return Sequence(path.stem, events, camera, objects, meta, extra)


def is_sequence(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds a sequence: events with a camera, in either form."""
    path = Path(path)
    if not is_file(path):
        return False
    if not is_zip(path):
        return is_container(path)
    with open_archive(path) as archive:
        return "K" in keys_of(archive)


def _read_numbers(archive: zipfile.ZipFile, key: str, path: Path) -> np.ndarray:
    numbers = read_array(archive, key, path)
    if numbers.dtype.kind not in "iuf":
        raise EventDataError(f"'{path}': '{key}' must hold numbers, got {numbers.dtype}.")
    return numbers


def _read_camera(archive: zipfile.ZipFile, events: NpzEvents, path: Path) -> Camera:
    model, distortion = "none", tuple[float, ...]()
    if "distortion_model" in keys_of(archive):
        model = str(read_array(archive, "distortion_model", path))
        distortion = tuple(_read_numbers(archive, "distortion", path).ravel().tolist())
    try:
        return Camera.from_matrix(_read_numbers(archive, "K", path), events.width, events.height, model, distortion)
    except CalibrationError as error:
        raise CalibrationError(f"'{path}': {error}") from error


def _read_names(archive: zipfile.ZipFile, key: str, path: Path) -> list[str]:
    names = read_array(archive, key, path)
    if names.ndim != 1 or names.dtype.kind != "U":
        raise EventDataError(f"'{path}': '{key}' must be a list of texts, got shape {names.shape} of {names.dtype}.")
    return [str(name) for name in names]


def _read_ground_truth(archive: zipfile.ZipFile, labels: list[str], path: Path) -> list[Trajectory | None]:
    if "poses" not in keys_of(archive):
        return [None] * len(labels)
    poses, t_us = _read_numbers(archive, "poses", path), _read_numbers(archive, "pose_t", path)
    stacked = poses[None] if poses.ndim == 3 else poses
    if t_us.ndim != 1 or stacked.shape != (len(labels), len(t_us), 4, 4):
        raise EventDataError(
            f"'{path}': poses must be [P, 4, 4] for one object or [{len(labels)}, P, 4, 4] for its {len(labels)} labels, "
            f"with pose_t [P]; got {poses.shape} and {t_us.shape}."
        )
    try:
        return [Trajectory(torch.tensor(t_us), torch.tensor(of_object)) for of_object in stacked]
    except PoseError as error:
        raise PoseError(f"'{path}', poses: {error}") from error


def _read_meta(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    if "meta" not in keys_of(archive):
        return {}
    try:
        meta = json.loads(str(read_array(archive, "meta", path)))
    except (ValueError, RecursionError) as error:
        raise EventDataError(f"'{path}': 'meta' is not JSON ({error}).") from error
    return meta if isinstance(meta, dict) else {"meta": meta}


def _sequence_object(path: Path, label: str, mesh_file: str, ground_truth: Trajectory | None) -> SequenceObject:
    if not label.isprintable() or "/" in label or len(label) > _LONGEST_LABEL:
        raise EventDataError(f"'{path}' has an object called {label[:_LONGEST_LABEL]!r}, which is no label: it is part of the names of files.")
    mesh_path = path.parent / mesh_file
    if not is_file(mesh_path):
        raise MissingFileError(
            f"'{path}' names the mesh {mesh_file[:_LONGEST_LABEL]!r} for its object '{label}' (key 'mesh_files'), "
            f"but there is no such file in '{path.parent}'. Put it beside the sequence."
        )
    textured = path.with_name(f"{path.stem}_{label}_textured.glb")
    return SequenceObject(label, mesh_path, textured if textured.is_file() else None, ground_truth)
