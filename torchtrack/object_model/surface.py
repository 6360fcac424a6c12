"""A triangle surface made for tracking: vertices welded by position, texture coordinates and colours kept per corner.

Textured files repeat a vertex wherever the UV map has a seam. For geometry those copies are one vertex, or every seam
would look like a border of the surface; for the texture they are not. So positions are welded, and what belongs to the
texture is stored per corner of a face.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh

from torchtrack.errors import ModelError
from torchtrack.object_model.notices import tell
from torchtrack.object_model.textures import UnreadableImageError, as_rgb, texture_image

# Vertices closer than this fraction of the diameter are the same vertex.
_WELD_FRACTION = 1e-6
# A face with a height below this fraction of the diameter has no useful normal.
_FLAT_FRACTION = 1e-7
# Printed black still reflects about 2 % of the light: below it, a step in the file's values is not a step in the world.
_DARKEST = 0.02
_ROWS_OF_PIXELS = 1 << 22


@dataclass(frozen=True)
class Surface:
    """Triangles with ``F`` faces, ``V`` vertices, in float64 metres.

    Attributes:
        vertices: ``[V, 3]`` positions, each one once.
        faces: ``[F, 3]`` vertex indices, outside seen anticlockwise.
        corner_uv: ``[F, 3, 2]`` texture coordinates, v up; NaN where a face has no texture.
        texture_index: ``[F]`` index into ``textures``; -1 where a face has none.
        textures: log-luminance images ``[h, w]`` float32.
        corner_luminance: ``[F, 3]`` log luminance of the colour at each corner; NaN where unknown.
        source_face: ``[F]`` the face's index in the parts it was made from, in their order.
    """

    vertices: np.ndarray
    faces: np.ndarray
    corner_uv: np.ndarray
    texture_index: np.ndarray
    textures: tuple[np.ndarray, ...]
    corner_luminance: np.ndarray
    source_face: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """``[F, 3, 3]`` positions of the corners of every face."""
        return self.vertices[self.faces]

    @property
    def normals(self) -> np.ndarray:
        """``[F, 3]`` unit outward normals."""
        cross = _face_cross(self.corners)
        return cross / np.linalg.norm(cross, axis=1, keepdims=True)

    @property
    def diameter(self) -> float:
        """Diagonal of the bounding box (m)."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    def select(self, faces: np.ndarray) -> "Surface":
        """Only some faces, by mask or index; vertices stay."""
        return replace(
            self,
            faces=self.faces[faces],
            corner_uv=self.corner_uv[faces],
            texture_index=self.texture_index[faces],
            corner_luminance=self.corner_luminance[faces],
            source_face=self.source_face[faces],
        )

    def flip(self, mask: np.ndarray) -> "Surface":
        """The faces of ``mask [F]`` turned inside out."""
        order = np.where(mask[:, None], [2, 1, 0], [0, 1, 2])
        return replace(
            self,
            faces=np.take_along_axis(self.faces, order, 1),
            corner_uv=np.take_along_axis(self.corner_uv, order[..., None], 1),
            corner_luminance=np.take_along_axis(self.corner_luminance, order, 1),
        )


def surface_from_parts(parts: Sequence[trimesh.Trimesh]) -> Surface:
    """One surface of several meshes, each with a texture of its own; degenerate and repeated faces are dropped.

    Raises:
        ModelError: if no face is left.
    """
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
    faces = np.concatenate([np.asarray(part.faces, dtype=np.int64) + offset for part, offset in zip(parts, offsets, strict=False)])
    looks = [_look(part) for part in parts]
    textures = tuple(look.texture for look in looks if look.texture is not None)
    numbers = np.cumsum([look.texture is not None for look in looks]) - 1
    index = [np.full(len(part.faces), number if look.texture is not None else -1) for part, look, number in zip(parts, looks, numbers, strict=True)]
    welded, vertex_of = _weld(vertices)
    surface = Surface(
        vertices=welded,
        faces=vertex_of[faces],
        corner_uv=np.concatenate([look.corner_uv for look in looks]),
        texture_index=np.concatenate(index),
        textures=textures,
        corner_luminance=np.concatenate([look.corner_luminance for look in looks]),
        source_face=np.arange(len(faces)),
    )
    surface = surface.select(_sound_faces(surface))
    if len(surface.faces) == 0:
        raise ModelError(f"all {len(faces)} faces of the mesh are degenerate (no area): it has no surface to track. Export it again as triangles.")
    _tell_flat_parts(surface, np.cumsum([0, *(len(part.faces) for part in parts)]))
    return surface


def _tell_flat_parts(surface: Surface, first_face: np.ndarray) -> None:
    """Warn of parts, whose faces begin at ``first_face [P + 1]``, of which no face is left."""
    kept = np.zeros(first_face[-1], dtype=bool)
    kept[surface.source_face] = True
    left = np.add.reduceat(kept, first_face[:-1]) > 0
    if not left.all():
        tell(
            f"{(~left).sum()} of {len(left)} parts of the model have no face with an area, or are copies of others, and are not used "
            f"(the first is part {int(np.argmin(left)) + 1}): they are scaled to nothing, compressed, or stored twice."
        )


@dataclass(frozen=True)
class _Look:
    """How one mesh looks: a texture with its coordinates, or colours."""

    texture: np.ndarray | None
    corner_uv: np.ndarray
    corner_luminance: np.ndarray


def _look(mesh: trimesh.Trimesh) -> _Look:
    """Texture or colours of a mesh, per corner."""
    visual: Any = mesh.visual  # one of several classes, told apart by their kind
    uv = np.full((len(mesh.faces), 3, 2), np.nan)
    luminance = np.full((len(mesh.faces), 3), np.nan)
    image = texture_image(mesh)
    if image is not None:
        try:
            return _Look(log_luminance(as_rgb(image)), np.asarray(visual.uv, dtype=np.float64)[mesh.faces], luminance)
        except UnreadableImageError as error:
            raise ModelError(f"a texture of the mesh cannot be used: {error}.") from error
    if visual.kind == "vertex":
        luminance = log_luminance(visual.vertex_colors[:, :3])[mesh.faces]
    elif visual.kind == "face":
        luminance = np.repeat(log_luminance(visual.face_colors[:, :3])[:, None], 3, 1)
    elif visual.kind == "texture":
        luminance = np.full_like(luminance, log_luminance(np.asarray(visual.material.main_color)[None, :3]))
    return _Look(None, uv, luminance)


def log_luminance(colours: np.ndarray) -> np.ndarray:
    """Log of the linear luminance (BT.709) of 8-bit sRGB colours ``[..., 3]``, float32.

    An event camera sees the logarithm of the light, so this is the scale on which contrasts are to be compared.
    """
    encoded = np.arange(256) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)
    colours = np.asarray(colours, dtype=np.uint8)
    luminance = np.empty(colours.shape[:-1], dtype=np.float32)
    # Rows of an image at a time: the linear values of a large one take twelve bytes a pixel.
    step = max(1, _ROWS_OF_PIXELS // max(1, colours[0].size // 3)) if len(colours) else 1
    for start in range(0, len(colours), step):
        luminance[start : start + step] = linear[colours[start : start + step]] @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
    luminance += np.float32(_DARKEST)
    return np.log(luminance, out=luminance)


def _weld(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct positions ``[V, 3]`` and the index of each given vertex among them."""
    low = vertices.min(0)
    step = max(float(np.linalg.norm(np.ptp(vertices, axis=0))), 1e-300) * _WELD_FRACTION
    # Copies differ by rounding at most; the odd offset keeps grid lines away from the lowest vertex and its round multiples.
    cell = np.floor((vertices - low) / step + 0.377).astype(np.int64)
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    _, first, vertex_of = np.unique(key, return_index=True, return_inverse=True)
    return vertices[first], vertex_of.reshape(-1)


def _sound_faces(surface: Surface) -> np.ndarray:
    """Indices of the faces that have an area and are not copies of another."""
    corners = surface.corners
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max(1)
    height = np.linalg.norm(_face_cross(corners), axis=1) / np.maximum(longest, 1e-300)
    sound = np.flatnonzero(height > _FLAT_FRACTION * surface.diameter)
    # Turn every face so that its lowest vertex comes first: copies are then equal, mirrored copies (a sheet's back) are not.
    faces = surface.faces[sound]
    turn = (np.arange(3) + faces.argmin(1)[:, None]) % 3
    _, first = np.unique(np.take_along_axis(faces, turn, 1), axis=0, return_index=True)
    return sound[np.sort(first)]


def _face_cross(corners: np.ndarray) -> np.ndarray:
    """Cross product of two sides of every face ``[F, 3, 3]``: twice its area, along its normal."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
