"""Writing sequences in ``.npz`` form, with their meshes; see :mod:`torchtrack.io.sequence` for the layout."""

import json
import os
import re
from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from torchtrack.core.atomic import temporary_folder, writing
from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch, check_events
from torchtrack.errors import EventDataError
from torchtrack.io.sequence_arrays import distortion_arrays, pose_arrays
from torchtrack.io.trajectory import Trajectory

_LABEL = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")


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
        OutputError: if the files cannot be written.
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
    with temporary_folder(path) as written, writing(path):
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
