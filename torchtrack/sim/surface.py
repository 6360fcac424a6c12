"""Surfaces for the renderer: triangles with normals, texture coordinates and reflectances.

Reflectance is linear in light. Images and colours of a mesh are sRGB, as glTF 2.0 has it, and are taken to linear light
and to one grey channel (Rec. 709 luma weights).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from torchtrack.errors import ModelError

_LUMA = np.array([0.2126, 0.7152, 0.0722])
DEFAULT_CREASE_DEG = 30.0


def srgb_to_linear(value: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    value = np.asarray(value, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Values in 0..1 as sRGB, of linear light, for showing a luminance image."""
    value = np.clip(np.asarray(value, dtype=np.float64), 0, 1)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)


def grey_reflectance(rgb: ndarray) -> Float[ndarray, "..."]:
    """Linear grey of 8-bit sRGB colours ``[..., 3 or 4]``; transparency is ignored."""
    return srgb_to_linear(np.asarray(rgb)[..., :3] / 255.0) @ _LUMA


@dataclass(frozen=True)
class RenderObject:
    """Triangles of one object, in its own frame.

    Args:
        corners: m.
        normals: unit normals at the corners.
        uv: texture coordinates of the corners, v counted downwards from the top of the image.
        albedo: reflectance of the corners; it multiplies the texture.
        texture: reflectances ``[h, w]``; one texel where there is no texture.
        gloss: strength of the highlight.
        is_closed: whether it is closed and wound outwards, so that the backs of its faces are never seen.
    """

    corners: Float[ndarray, "f 3 3"]
    normals: Float[ndarray, "f 3 3"]
    uv: Float[ndarray, "f 3 2"]
    albedo: Float[ndarray, "f 3"]
    texture: Float[ndarray, "h w"]
    gloss: float = 0.1
    is_closed: bool = False

    @classmethod
    def from_mesh(
        cls, mesh: trimesh.Trimesh, reflectance: float = 0.6, gloss: float = 0.1, crease_angle_deg: float = DEFAULT_CREASE_DEG
    ) -> "RenderObject":
        """Prepare a mesh: its texture or colours where it has any, else an even ``reflectance``.

        Normals are smoothed over edges that bend by less than ``crease_angle_deg``: curved meshes look smooth and angular
        ones keep flat faces.

        Raises:
            ModelError: if the mesh is empty or not finite.
        """
        if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
            raise ModelError(f"cannot draw a mesh of {len(mesh.faces)} faces; it needs faces, and vertices that are finite.")
        faces = np.asarray(mesh.faces)
        corners = np.asarray(mesh.vertices, dtype=np.float64)[faces]
        uv, albedo, texture = np.zeros((*faces.shape, 2)), np.full(faces.shape, reflectance), np.ones((1, 1))
        if (printed := _texture(mesh)) is not None:
            albedo, texture = np.ones(faces.shape), grey_reflectance(printed[0])
            uv = printed[1][faces] * [1, -1] + [0, 1]
        elif isinstance(mesh.visual, trimesh.visual.ColorVisuals) and mesh.visual.defined:
            albedo = grey_reflectance(np.asarray(mesh.visual.vertex_colors))[faces]
        return cls(corners, corner_normals(corners, crease_angle_deg), uv, albedo, texture, gloss, _is_closed(mesh))


def _is_closed(mesh: trimesh.Trimesh) -> bool:
    """Whether the mesh is closed and wound outwards, once vertices at one place are joined."""
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    return bool(welded.is_watertight and welded.is_winding_consistent and welded.volume > 0)


def _texture(mesh: trimesh.Trimesh) -> tuple[ndarray, ndarray] | None:
    """The texture ``[h, w, 3]`` of a mesh and its coordinates at the vertices ``[v, 2]``, or None."""
    visual = mesh.visual
    if not isinstance(visual, trimesh.visual.TextureVisuals) or visual.uv is None:
        return None
    image = getattr(visual.material, "baseColorTexture", None) or getattr(visual.material, "image", None)
    return None if image is None else (np.asarray(image.convert("RGB")), np.asarray(visual.uv, dtype=np.float64))


def corner_normals(corners: Float[ndarray, "f 3 3"], crease_angle_deg: float) -> Float[ndarray, "f 3 3"]:
    """Unit normal of each corner: area-weighted mean over the faces around its vertex that bend less than the crease angle."""
    area_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = area_normals / np.maximum(np.linalg.norm(area_normals, axis=1, keepdims=True), 1e-30)
    # Texture seams double a vertex: corners belong together where their positions agree.
    scale = max(float(np.ptp(corners, axis=(0, 1)).max()), 1e-12)
    _, vertex = np.unique(np.round(corners.reshape(-1, 3) / scale, 7), axis=0, return_inverse=True)
    corner, neighbour = _corner_pairs(vertex.ravel())
    keep = (unit[corner // 3] * unit[neighbour // 3]).sum(1) > np.cos(np.radians(crease_angle_deg)) - 1e-9
    normals = np.zeros((3 * len(corners), 3))
    np.add.at(normals, corner[keep], area_normals[neighbour[keep] // 3])
    norm = np.linalg.norm(normals, axis=1, keepdims=True)
    fallback = np.repeat(unit, 3, axis=0)
    return np.where(norm > 1e-30, normals / np.maximum(norm, 1e-30), fallback).reshape(-1, 3, 3)


def _corner_pairs(vertex: Int[ndarray, "c"]) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    """All pairs of corners, each with itself too, that share a vertex."""
    order = np.argsort(vertex, kind="stable")
    counts = np.bincount(vertex)
    starts = np.cumsum(counts) - counts
    per_corner = counts[vertex[order]]
    first = np.repeat(order, per_corner)
    step = np.arange(len(first)) - np.repeat(np.cumsum(per_corner) - per_corner, per_corner)
    return first, order[np.repeat(starts[vertex[order]], per_corner) + step]


Parts = RenderObject | tuple[RenderObject, ...]
"""An object, or its parts."""


@dataclass(frozen=True)
class Scene:
    """All objects of a scene as one list of triangles.

    Args:
        corners, normals: of every face, in the frame of its object.
        object_faces: which faces belong to each object.
        part_faces: the same for the parts of each object, which have a texture each.
        is_closed: of each object (see :class:`RenderObject`).
        look: the other fields of :class:`torchtrack.sim.shading.Surface`.
    """

    corners: Float[ndarray, "f 3 3"]
    normals: Float[ndarray, "f 3 3"]
    object_faces: tuple[slice, ...]
    part_faces: tuple[tuple[slice, ...], ...]
    is_closed: Bool[ndarray, "o"]
    look: dict[str, Any]


def merge_objects(objects: Sequence[Parts]) -> Scene:
    """One list of triangles, with all textures in one array of texels; an object may have parts with a texture each."""
    groups = [item if isinstance(item, tuple) else (item,) for item in objects]
    parts = [part for group in groups for part in group]
    owner = [number for number, group in enumerate(groups) for _ in group]
    counts = [len(part.corners) for part in parts]
    ends = np.cumsum(counts)
    sizes = [part.texture.size for part in parts]
    starts = np.cumsum(sizes) - sizes
    textures = [(start, part.texture.shape[1], part.texture.shape[0]) for start, part in zip(starts, parts, strict=True)]
    normals = np.concatenate([part.normals for part in parts])
    look = {
        "uv": np.concatenate([part.uv for part in parts]).astype(np.float32),
        "albedo": np.concatenate([part.albedo for part in parts]).astype(np.float32),
        "is_flat": _is_flat(normals),
        "texture": np.repeat(np.array(textures, dtype=np.int64), counts, axis=0),
        "texels": np.concatenate([part.texture.ravel() for part in parts]).astype(np.float32),
        "face_object": np.repeat(np.array(owner), counts),
        "gloss": np.repeat(np.array([part.gloss for part in parts], dtype=np.float32), counts),
    }
    of_parts = [slice(int(end - count), int(end)) for end, count in zip(ends, counts, strict=True)]
    by_object = [[faces for faces, number in zip(of_parts, owner, strict=True) if number == wanted] for wanted in range(len(groups))]
    return Scene(
        np.concatenate([part.corners for part in parts]),
        normals,
        tuple(slice(of_object[0].start, of_object[-1].stop) for of_object in by_object),
        tuple(tuple(of_object) for of_object in by_object),
        np.array([all(part.is_closed for part in group) for group in groups]),
        look,
    )


def _is_flat(normals: Float[ndarray, "f 3 3"]) -> Bool[ndarray, "f"]:
    return np.abs(normals - normals[:, :1]).max(axis=(1, 2)) < 1e-6
