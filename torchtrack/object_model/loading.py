"""Mesh files through trimesh, in metres, with what is wrong with them said plainly."""

import io
import logging
import struct
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from PIL import Image

from torchtrack.core.limits import check_limit
from torchtrack.errors import MissingFileError, ModelError, UnknownFormatError
from torchtrack.object_model.gltf import read_gltf
from torchtrack.object_model.notices import tell
from torchtrack.object_model.obj import check_indices, read_obj
from torchtrack.object_model.ply import read_ply
from torchtrack.object_model.side_files import MeshText, find_side_file
from torchtrack.object_model.stl_off import read_off, read_stl
from torchtrack.object_model.textures import check_textures, tell_lost_textures

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
# What trimesh's readers raise, depending on what their parsing trips over.
_READER_ERRORS: tuple[type[Exception], ...] = (
    *(ValueError, TypeError, LookupError, AttributeError, NameError, AssertionError, ArithmeticError, OSError, EOFError, SyntaxError),
    *(NotImplementedError, RecursionError, MemoryError, BufferError, DeprecationWarning, struct.error),
)

# trimesh logs what it survives, with tracebacks, which Python prints where no logging is set up.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def check_file(path: str | Path, suffixes: tuple[str, ...]) -> Path:
    """The path, if it is a file with one of the suffixes.

    Raises:
        MissingFileError: if there is no such file, or what is there is a folder, a pipe or a device.
        UnknownFormatError: if its suffix is another.
        ModelError: if it is empty.
        LimitError: if it is larger than ``limits.mesh_bytes``.
    """
    path = Path(path)
    try:
        exists, is_file = path.exists(), path.is_file()
        size = path.stat().st_size if is_file else 0
    except (OSError, ValueError) as error:
        raise MissingFileError(f"the object model '{path}' cannot be opened ({error}). Check the path and its permissions.") from error
    if exists and not is_file:
        raise MissingFileError(f"the object model '{path}' is a {'folder' if path.is_dir() else 'pipe or device'}, not a file. Give a mesh file.")
    if not exists:
        raise MissingFileError(f"the object model '{path}' does not exist. Check the path; a relative one starts at {Path.cwd()}.")
    if path.suffix.lower() not in suffixes:
        raise UnknownFormatError(f"'{path}' is not an object model: expected a file ending in {', '.join(suffixes)}. Convert it, or rename it.")
    if size == 0:
        raise ModelError(f"the object model '{path}' is empty (0 bytes). Copy it again, or export it again.")
    check_limit("mesh_bytes", size, path)
    return path


def load_parts(path: str | Path) -> list[trimesh.Trimesh]:
    """The meshes of a file, moved to where its scene puts them, each with its own texture; in the file's unit.

    Warns (:class:`TorchtrackWarning`) of every texture that the file names and the model will not have, and of every part
    that is no surface.

    Raises:
        MissingFileError, UnknownFormatError: as :func:`check_file`.
        ModelError: if the file cannot be read, or has no faces.
        LimitError: if it is larger than the limits.
    """
    path = check_file(path, MESH_SUFFIXES)
    try:
        text = _READERS[path.suffix.lower()](path)
    except OSError as error:
        raise ModelError(f"cannot read '{path}': {error}. Check the file and its permissions, or export it again.") from error
    missing = _tell_missing(path, text.named)
    scene = _loaded(path, text)
    meshes = [mesh for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh)]
    # Before any mesh is copied, which decodes its image.
    check_textures(meshes, str(path))
    tell_lost_textures(path, text, meshes, missing)
    parts = mesh_parts(scene, str(path))
    if not parts:
        raise ModelError(
            f"'{path}' has no triangles: the tracker needs a surface. Export it as a triangle mesh, or give its lines with from_polylines."
        )
    check_limit("faces", sum(len(part.faces) for part in parts), path)
    return parts


_READERS = {".glb": read_gltf, ".gltf": read_gltf, ".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".off": read_off}


def _loaded(path: Path, text: MeshText) -> trimesh.Scene:
    """The scene that trimesh reads."""
    # A PLY's image is attached in tell_lost_textures: trimesh would print a traceback of one that it cannot open.
    options: dict[str, Any] = {"skip_materials": True} if text.kind == "ply" else {}
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # numpy would go on with the numbers before the first that it cannot read.
            warnings.filterwarnings("error", message="string or file could not be read", category=DeprecationWarning)
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            return trimesh.load_scene(io.BytesIO(text.data), file_type=text.kind, resolver=text.files, process=False, **options)
    except _READER_ERRORS as error:
        if text.kind == "obj":
            check_indices(path)
        raise ModelError(
            f"cannot read '{path}' as a {path.suffix[1:].upper()} mesh ({type(error).__name__}: {error}). "
            "It is damaged, or of a kind that is not read: open it in a mesh editor and export it again."
        ) from error


def mesh_parts(mesh: "trimesh.Trimesh | trimesh.Scene | Iterable[trimesh.Trimesh]", name: str = "the model") -> list[trimesh.Trimesh]:
    """Copies of the meshes that have faces, each where it belongs, without vertices that no face uses.

    Warns (:class:`TorchtrackWarning`) of parts that have no faces, if others do.

    Raises:
        ModelError: if a face names a vertex that is not there.
    """
    try:
        with np.errstate(all="ignore"):
            pieces: list[Any] = [mesh] if isinstance(mesh, trimesh.Trimesh) else mesh.dump() if isinstance(mesh, trimesh.Scene) else list(mesh)
    except _READER_ERRORS as error:
        raise ModelError(f"the parts of '{name}' cannot be put in their places ({error}): it is damaged, or not 3D. Export it again.") from error
    parts = [piece for piece in pieces if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    for part in parts:
        _check_corners(part, name)
    if parts and len(parts) < len(pieces):
        tell(f"{len(pieces) - len(parts)} of {len(pieces)} parts of '{name}' have no faces (points, lines, or nothing), and are not used.")
    parts = [part.copy() for part in parts]
    for part in parts:
        part.remove_unreferenced_vertices()
    return parts


def _check_corners(part: trimesh.Trimesh, name: str) -> None:
    """Every vertex has three coordinates, and every corner of a face is a vertex."""
    if np.shape(part.vertices)[1:] != (3,):
        raise ModelError(f"some vertices of '{name}' have less than three coordinates: it is damaged. Export it again.")
    wrong = np.flatnonzero(((part.faces < 0) | (part.faces >= len(part.vertices))).any(1))
    if len(wrong):
        face = wrong[0]
        raise ModelError(
            f"face {face} of '{name}' names the vertices {part.faces[face].tolist()}, and there are {len(part.vertices)}: "
            f"it is damaged ({len(wrong)} such faces). Export it again."
        )


def place_part(part: trimesh.Trimesh, factor: float, origin: np.ndarray) -> None:
    """Have a part in metres, with another point (m) as its origin; it is changed."""
    part.apply_scale(factor)
    if origin.any():
        part.apply_translation(-origin)


def join_parts(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of all parts, faces in their order, for drawing and export."""
    return parts[0] if len(parts) == 1 else cast(trimesh.Trimesh, trimesh.util.concatenate(parts))


def _tell_missing(path: Path, named: Iterable[str]) -> frozenset[str]:
    """Warn of files that a mesh file names and that are not there; which they are."""
    missing = [name for name in dict.fromkeys(named) if find_side_file(path, name) is None]
    if missing:
        tell(
            f"'{path}' names {', '.join(repr(name) for name in missing[:5])}, which cannot be found in '{path.parent}': "
            "only the geometry is used. Put the file there, or export the model as GLB, which holds its textures."
        )
    return frozenset(missing)
