"""Simulated sequences as files: ``.npz`` with the meshes beside it, or all in one ``.h5``."""

import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import trimesh

from torchtrack.core.atomic import atomic_path
from torchtrack.errors import EventDataError
from torchtrack.io.container import ContainerWriter
from torchtrack.io.sequence_types import SequenceObject
from torchtrack.io.sequence_writer import LabelledMesh, write_sequence
from torchtrack.object_model.loading import join_parts
from torchtrack.sim.scenes import Model
from torchtrack.sim.simulation import SimulatedSequence

_HDF5 = (".h5", ".hdf5")


def check_output(path: Path) -> None:
    """Raise :class:`EventDataError` unless a sequence can be written to a file of this name."""
    if path.suffix not in (".npz", *_HDF5):
        raise EventDataError(f"a sequence is written to a .npz or .h5 file, got '{path}'.")


def write(sequence: SimulatedSequence, path: str | Path) -> Path:
    """Write a sequence to ``path``, by its suffix; see :mod:`torchtrack.io.sequence` and :mod:`torchtrack.io.container`.

    Files appear whole or not at all.

    Raises:
        EventDataError: if ``path`` is neither a ``.npz`` nor a ``.h5`` file.
    """
    path = Path(path)
    check_output(path)
    if path.suffix in _HDF5:
        _write_container(sequence, path)
        return path
    # Occluders come after the objects, and have no label among these.
    objects = [
        LabelledMesh(label, _bare(model), trajectory, _printed(model))
        for label, model, trajectory in zip(sequence.labels, sequence.models, sequence.trajectories, strict=False)
    ]
    extra = _extra_arrays(sequence) | {"source": sequence.source.numpy().astype(np.int16)}
    write_sequence(path, sequence.events, sequence.camera, objects, sequence.meta, extra)
    return path


def _write_container(sequence: SimulatedSequence, path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder, atomic_path(path) as temporary:
        objects = [_exported(sequence, number, Path(folder)) for number in range(len(sequence.labels))]
        with closing(ContainerWriter(temporary, sequence.camera, objects, sequence.meta, _extra_arrays(sequence))) as writer:
            writer.write(sequence.events)
            writer.annotate(sequence.source.numpy().astype(np.int16))


def _exported(sequence: SimulatedSequence, number: int, folder: Path) -> SequenceObject:
    """An object with its model files in a folder."""
    label, model, printed_path = sequence.labels[number], sequence.models[number], None
    mesh_path = folder / f"{label}.ply"
    _bare(model).export(mesh_path)
    if (printed := _printed(model)) is not None:
        printed_path = folder / f"{label}.glb"
        printed.export(printed_path)
    return SequenceObject(label, mesh_path, printed_path, sequence.trajectories[number])


def _printed(model: Model) -> trimesh.Trimesh | trimesh.Scene | None:
    """The model, if any of its parts has a texture."""
    if not any(isinstance(part.visual, trimesh.visual.TextureVisuals) for part in model):
        return None
    return model[0] if len(model) == 1 else trimesh.Scene(list(model))


def _bare(model: Model) -> trimesh.Trimesh:
    """Geometry with colours, without a texture: that doubles vertices along its seams, and geometry needs each of them once."""
    colours = [_colours(part) for part in model]
    known = all(of_part is not None for of_part in colours)
    parts = [
        trimesh.Trimesh(part.vertices, part.faces, vertex_colors=of_part if known else None, process=False)
        for part, of_part in zip(model, colours, strict=True)
    ]
    mesh = join_parts(parts)
    return mesh if known else trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)


def _colours(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """Colours of the vertices, where there are any."""
    visual = mesh.visual
    return np.asarray(visual.vertex_colors) if isinstance(visual, trimesh.visual.ColorVisuals) and visual.defined else None


def _extra_arrays(sequence: SimulatedSequence) -> dict[str, np.ndarray]:
    """What a simulated sequence holds beside the common arrays."""
    objects = len(sequence.labels)
    arrays = {"velocity": sequence.velocities[:objects].numpy()}
    if sequence.occluder_labels:
        poses = np.stack([trajectory.T_cam_obj.numpy() for trajectory in sequence.trajectories[objects:]])
        arrays |= {"occluder_poses": poses[0] if len(poses) == 1 else poses, "occluder_labels": np.array(sequence.occluder_labels)}
    return arrays
