"""Writing sequences in ``.npz`` form, with their meshes; see :mod:`torchtrack.io.sequence` for the layout."""

import json
import os
import re
from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
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


@dataclass(frozen=True)
class LabelledMesh:
    """An object of a sequence that is to be written.

    Args:
        label: used in file names.
        mesh: in metres.
        trajectory: the true poses.
        textured: the mesh with its texture, where it has one.
    """

    label: str
    mesh: trimesh.Trimesh
    trajectory: Trajectory
    textured: trimesh.Trimesh | trimesh.Scene | None = None


def write_sequence(
    path: str | os.PathLike[str],
    events: EventBatch,
    camera: Camera,
    objects: ListOf[LabelledMesh],
    meta: Mapping[str, Any] = MappingProxyType({}),
    extra: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> None:
    """Write a sequence and its meshes (``NAME_LABEL.ply``, ``NAME_LABEL_textured.glb``) as :func:`read_sequence` reads it.

    Everything is written to temporary files first and put in place at the end, the ``.npz`` last, so that nothing
    half-written is left behind. Events are stored uncompressed.

    Args:
        path: the ``.npz`` file to write.
        events: sorted by time.
        objects: at least one; their true poses all at the same times.
        meta: what JSON can hold.
        extra: further arrays by name; a name of the layout is not replaced.

    Raises:
        EventDataError: if events are unsorted or outside the sensor, there is no object, or labels are unfit.
        PoseError: if the trajectories do not share their times.
        OutputError: if the files cannot be written.
    """
    path = Path(path)
    _check_objects(path, [obj.label for obj in objects])
    check_events(events, camera.width, camera.height, str(path))
    mesh_files = [f"{path.stem}_{obj.label}.ply" for obj in objects]
    arrays: dict[str, Any] = {
        **extra,
        "t": events.t_us.numpy(),
        "x": events.x.numpy().astype(np.uint16),
        "y": events.y.numpy().astype(np.uint16),
        "p": events.polarity.numpy().astype(np.uint8),
        "K": camera.matrix,
        "width": np.int64(camera.width),
        "height": np.int64(camera.height),
        **distortion_arrays(camera),
        **pose_arrays([obj.trajectory for obj in objects]),
        "labels": np.array([obj.label for obj in objects]),
        "mesh_files": np.array(mesh_files),
        "meta": np.array(json.dumps(dict(meta))),
    }
    with temporary_folder(path) as written, writing(path):
        for obj, mesh_file in zip(objects, mesh_files, strict=True):
            _geometry(obj.mesh).export(written / mesh_file)
            if obj.textured is not None:
                obj.textured.export(written / f"{path.stem}_{obj.label}_textured.glb")
        with (written / path.name).open("wb") as stream:
            np.savez(stream, **arrays)
        # The file that names the others comes last: whoever sees it finds them.
        for file in sorted(written.iterdir(), key=lambda file: file.name == path.name):
            file.replace(path.parent / file.name)


def _check_objects(path: Path, labels: ListOf[str]) -> None:
    if path.suffix != ".npz":
        raise EventDataError(f"a sequence is written to a .npz file, got '{path}'.")
    if not labels:
        raise EventDataError(f"'{path}' needs at least one object, each with a label, a mesh and its true poses.")
    unfit = [label for label in labels if not _LABEL.fullmatch(label)]
    if unfit or len(set(labels)) != len(labels):
        raise EventDataError(f"labels go into file names: each must differ and hold letters, digits and _.+- alone, got {labels}.")


def _geometry(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh without a texture, which a ``.ply`` cannot carry; colours stay."""
    if not isinstance(mesh.visual, trimesh.visual.TextureVisuals):
        return mesh
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
