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
import re
import tempfile
import zipfile
from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from torchtrack.camera import Camera
from torchtrack.errors import CalibrationError, EventDataError, MissingFileError, PoseError
from torchtrack.events import EventBatch, check_events
from torchtrack.io.container import is_container, read_container
from torchtrack.io.npz import NpzEvents, keys_of, open_archive, read_array
from torchtrack.io.sequence_arrays import distortion_arrays, pose_arrays
from torchtrack.io.sequence_types import Sequence, SequenceObject
from torchtrack.io.trajectory import Trajectory
from torchtrack.io.zip_archive import is_zip

_EXTRA = ("velocity", "occluder_poses", "occluder_labels")
_LABEL = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")


def read_sequence(path: str | os.PathLike[str]) -> Sequence:
    """Read a sequence; its events stay on disk until they are streamed.

    Raises:
        MissingFileError: if the file, or a mesh that it names, is not there.
        UnknownFormatError: if it is neither an ``.npz`` file nor a sequence in HDF5.
        EventDataError: if an array is missing, damaged or of the wrong shape.
        CalibrationError: if the camera makes no sense.
        PoseError: if the ground truth is not rigid, or its times do not increase.
    """
    path = Path(path)
    if is_container(path):
        return read_container(path)
    events = NpzEvents(path)
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
    if not path.is_file():
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
    except json.JSONDecodeError as error:
        raise EventDataError(f"'{path}': 'meta' is not JSON ({error}).") from error
    return meta if isinstance(meta, dict) else {"meta": meta}


def _sequence_object(path: Path, label: str, mesh_file: str, ground_truth: Trajectory | None) -> SequenceObject:
    mesh_path = path.parent / mesh_file
    if not mesh_path.is_file():
        raise MissingFileError(
            f"'{path}' names the mesh '{mesh_file}' for its object '{label}' (key 'mesh_files'), "
            f"but '{mesh_path}' does not exist. Put it beside the sequence."
        )
    textured = path.with_name(f"{path.stem}_{label}_textured.glb")
    return SequenceObject(label, mesh_path, textured if textured.is_file() else None, ground_truth)


def write_sequence(
    path: str | os.PathLike[str],
    *,
    x: np.ndarray,
    y: np.ndarray,
    t_us: np.ndarray,
    polarity: np.ndarray,
    camera: Camera,
    labels: ListOf[str],
    meshes: ListOf[trimesh.Trimesh],
    trajectories: ListOf[Trajectory],
    meta: dict[str, Any],
    textured: ListOf[trimesh.Trimesh | trimesh.Scene | None] | None = None,
    extra: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a sequence and its meshes (``NAME_LABEL.ply``, ``NAME_LABEL_textured.glb``) as :func:`read_sequence` reads it.

    Everything is written to temporary files first and put in place at the end, the ``.npz`` last, so that nothing
    half-written is left behind. Events are stored uncompressed.

    Args:
        path: the ``.npz`` file to write.
        x, y, t_us, polarity: events, sorted by time (µs), one length.
        camera: the camera.
        labels, meshes: one per object; labels are used in file names; meshes in metres.
        trajectories: the true poses, one per object, all at the same times.
        meta: what JSON can hold.
        textured: one textured mesh (or None) per object, where there are any.
        extra: further arrays by name; a name of the layout is not replaced.

    Raises:
        EventDataError: if events are unsorted or outside the sensor, labels are unfit, or the counts disagree.
        PoseError: if the trajectories do not share their times.
    """
    path = Path(path)
    textured = textured if textured is not None else [None] * len(labels)
    _check_objects(path, labels, len(meshes), len(trajectories), len(textured))
    check_events(EventBatch.from_numpy(x, y, t_us, polarity), camera.width, camera.height, str(path))
    mesh_files = [f"{path.stem}_{label}.ply" for label in labels]
    arrays: dict[str, Any] = {
        **(extra or {}),
        "t": np.asarray(t_us, np.int64),
        "x": np.asarray(x, np.uint16),
        "y": np.asarray(y, np.uint16),
        "p": (np.asarray(polarity) > 0).astype(np.uint8),
        "K": camera.matrix,
        "width": np.int64(camera.width),
        "height": np.int64(camera.height),
        **distortion_arrays(camera),
        **pose_arrays(trajectories),
        "labels": np.array(labels),
        "mesh_files": np.array(mesh_files),
        "meta": np.array(json.dumps(meta)),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        written = Path(folder)
        for mesh, mesh_file in zip(meshes, mesh_files, strict=True):
            _geometry(mesh).export(written / mesh_file)
        for label, model in zip(labels, textured, strict=True):
            if model is not None:
                model.export(written / f"{path.stem}_{label}_textured.glb")
        with (written / path.name).open("wb") as stream:
            np.savez(stream, **arrays)
        # The file that names the others comes last: whoever sees it finds them.
        for file in sorted(written.iterdir(), key=lambda file: file.name == path.name):
            file.replace(path.parent / file.name)


def _check_objects(path: Path, labels: ListOf[str], meshes: int, trajectories: int, textured: int) -> None:
    if path.suffix != ".npz":
        raise EventDataError(f"a sequence is written to a .npz file, got '{path}'.")
    if not labels or {len(labels)} != {meshes, trajectories, textured}:
        raise EventDataError(
            f"every object needs a label, a mesh and a trajectory: got {len(labels)} labels, {meshes} meshes, "
            f"{trajectories} trajectories and {textured} textured meshes (or None)."
        )
    unfit = [label for label in labels if not _LABEL.fullmatch(label)]
    if unfit or len(set(labels)) != len(labels):
        raise EventDataError(f"labels go into file names: each must differ and hold letters, digits and _.+- alone, got {list(labels)}.")


def _geometry(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh without a texture, which a ``.ply`` cannot carry; colours stay."""
    if not isinstance(mesh.visual, trimesh.visual.TextureVisuals):
        return mesh
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
