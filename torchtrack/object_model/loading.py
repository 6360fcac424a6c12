"""Mesh files through trimesh, in metres, with what is wrong with them said plainly."""

import json
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh

from torchtrack.errors import MissingFileError, ModelError, TorchtrackWarning, UnknownFormatError
from torchtrack.object_model.settings import METRES_PER_UNIT
from torchtrack.object_model.surface import texture_image

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
_SMALLEST_M, _LARGEST_M = 0.005, 5.0


def check_file(path: str | Path, suffixes: tuple[str, ...]) -> Path:
    """The path, if it is a file with one of the suffixes.

    Raises:
        MissingFileError: if there is no such file.
        UnknownFormatError: if its suffix is another.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"the object model '{path}' does not exist. Check the path; a relative one starts at {Path.cwd()}.")
    if path.suffix.lower() not in suffixes:
        raise UnknownFormatError(f"'{path}' is not an object model: expected a file ending in {', '.join(suffixes)}. Convert it, or rename it.")
    return path


def load_parts(path: str | Path) -> list[trimesh.Trimesh]:
    """The meshes of a file, moved to where its scene puts them, each with its own texture; in the file's unit.

    Warns (:class:`TorchtrackWarning`) when the file names a texture image that cannot be found.

    Raises:
        MissingFileError, UnknownFormatError: as :func:`check_file`.
        ModelError: if the file cannot be read, or has no faces.
    """
    path = check_file(path, MESH_SUFFIXES)
    some_missing = _warn_missing_textures(path)
    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh's readers raise whatever their parsing trips over
        raise ModelError(
            f"cannot read '{path}' as a {path.suffix[1:].upper()} mesh ({error}). Open it in a mesh editor and export it again."
        ) from error
    parts = mesh_parts(scene)
    if not parts:
        raise ModelError(
            f"'{path}' has no triangles: the tracker needs a surface. Export it as a triangle mesh, or give its lines with from_polylines."
        )
    if not some_missing:
        _warn_unread_textures(path, parts)
    return parts


def mesh_parts(mesh: "trimesh.Trimesh | trimesh.Scene | Iterable[trimesh.Trimesh]") -> list[trimesh.Trimesh]:
    """Copies of the meshes that have faces, each where it belongs, without vertices that no face uses."""
    pieces: Iterable[Any] = [mesh] if isinstance(mesh, trimesh.Trimesh) else mesh.dump() if isinstance(mesh, trimesh.Scene) else mesh
    parts = [piece.copy() for piece in pieces if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    for part in parts:
        part.remove_unreferenced_vertices()
    return parts


def checked_scale(points: np.ndarray, unit: str, name: str) -> float:
    """Metres per ``unit``, once points ``[n, 3]`` in that unit have passed the checks that every model must pass.

    Raises:
        ModelError: if a coordinate is not finite, the unit is unknown, or the diameter is outside 5 mm to 5 m.
    """
    if unit not in METRES_PER_UNIT:
        raise ModelError(f"unknown unit '{unit}' for '{name}': use one of {', '.join(METRES_PER_UNIT)}.")
    bad = ~np.isfinite(points).all(1)
    if bad.any():
        raise ModelError(f"{bad.sum()} of {len(points)} vertices of '{name}' are not finite (NaN or infinite). Repair the model and export it again.")
    _check_diameter(float(np.linalg.norm(np.ptp(points, axis=0))), unit, name)
    return METRES_PER_UNIT[unit]


def _check_diameter(diameter: float, unit: str, name: str) -> None:
    """Refuse a size that no tracked object has, and say which unit would make it plausible."""
    metres = diameter * METRES_PER_UNIT[unit]
    if _SMALLEST_M <= metres <= _LARGEST_M:
        return
    plausible = [f"unit='{u}' ({diameter * scale:.3g} m)" for u, scale in METRES_PER_UNIT.items() if _SMALLEST_M <= diameter * scale <= _LARGEST_M]
    advice = f"Plausible would be {' or '.join(plausible)}." if plausible else "No known unit makes it plausible: scale the model in a mesh editor."
    raise ModelError(f"'{name}' is {metres:.3g} m across with unit='{unit}'; expected 5 mm to 5 m. {advice}")


def join_parts(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of all parts, faces in their order, for drawing and export."""
    return parts[0] if len(parts) == 1 else cast(trimesh.Trimesh, trimesh.util.concatenate(parts))


def _warn_missing_textures(path: Path) -> bool:
    """Warn of files that a mesh file names and that are not there; says whether there are any."""
    missing = [name for name in _named_files(path) if not (path.parent / name).is_file()]
    if missing:
        _warn(
            f"'{path}' names {', '.join(repr(name) for name in missing)}, which cannot be found in '{path.parent}': "
            "only the geometry is used. Put the file there, or export the model as GLB, which holds its textures."
        )
    return bool(missing)


def _warn_unread_textures(path: Path, parts: list[trimesh.Trimesh]) -> None:
    """Warn if the materials of a glTF file have textures of which none could be read."""
    materials = _gltf_content(path).get("materials", []) if path.suffix.lower() in (".glb", ".gltf") else []
    textured = any("baseColorTexture" in material.get("pbrMetallicRoughness", {}) for material in materials)
    if textured and all(texture_image(part) is None for part in parts):
        _warn(f"the texture of '{path}' cannot be read: only the geometry is used. Export it with PNG or JPEG images and UV coordinates.")


def _warn(message: str) -> None:
    warnings.warn(message, TorchtrackWarning, stacklevel=5)


def _named_files(path: Path) -> list[str]:
    """Material and image files that a mesh file refers to."""
    suffix = path.suffix.lower()
    if suffix == ".obj":
        return _named_by_obj(path)
    if suffix == ".ply":
        with path.open("rb") as stream:
            header = stream.read(10_000).split(b"end_header")[0].decode("latin-1")
        return re.findall(r"^comment TextureFile (.+?)\s*$", header, re.MULTILINE)
    if suffix in (".glb", ".gltf"):
        images = _gltf_content(path).get("images", [])
        return [image["uri"] for image in images if "uri" in image and not image["uri"].startswith("data:")]
    return []


def _named_by_obj(path: Path) -> list[str]:
    """The material libraries of an OBJ file, and the images of those that are there."""
    named = re.findall(r"^mtllib[ \t]+(.+?)\s*$", path.read_text(encoding="latin-1"), re.MULTILINE)
    for library in list(named):
        if (path.parent / library).is_file():
            # Options such as "-bm 1" come before the image's name.
            text = (path.parent / library).read_text(encoding="latin-1")
            named += re.findall(r"^\s*map_Kd[ \t]+(?:-.*[ \t])?(\S.*?)\s*$", text, re.MULTILINE)
    return named


def _gltf_content(path: Path) -> dict[str, Any]:
    """The JSON part of a glTF file; nothing, if it is damaged (its reader will say how)."""
    with path.open("rb") as stream:
        header = stream.read(20)
        # A binary file begins with a header of 12 bytes, then the length and type of the JSON part.
        text = stream.read(int.from_bytes(header[12:16], "little")) if header[:4] == b"glTF" else header + stream.read()
    try:
        content = json.loads(text)
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}
