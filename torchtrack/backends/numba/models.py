"""The tensors of an object's contour model as kernels take them: they never change, so they are converted once."""

from typing import NamedTuple
from weakref import WeakKeyDictionary

from torch import Tensor

from torchtrack.backends.numba.arrays import Arrays, as_arrays
from torchtrack.backends.numba.compiler import Array
from torchtrack.object_model.contour_source import ContourModel


class EdgeArrays(NamedTuple):
    """A model's edges, as :class:`ContourModel` has them, but for those of faces: ``face_normals [2, 3, e]``, and ``face_offsets [2, e]``."""

    ends: Array
    face_normals: Array
    face_offsets: Array
    is_crease: Array
    is_segment: Array
    rows: Array


class TextureArrays(NamedTuple):
    """A model's points of texture, as :class:`ContourModel` has them."""

    spacing_m: float
    points: Array
    tangents: Array
    normals: Array
    gaps_m: Array


class FaceArrays(NamedTuple):
    """A model's faces, ``[f, 3, 3]`` and ``[f, 3]``; none of dense meshes."""

    triangles: Array
    normals: Array


class ModelArrays(NamedTuple):
    """A :class:`ContourModel` as arrays.

    Args:
        members: numbers of the objects that have it.
        edges, texture: :class:`EdgeArrays` and :class:`TextureArrays`, what contour points are sampled from.
        faces: :class:`FaceArrays`, what hides them.
        surface: samples of the surface, ``[3, n]``.
    """

    members: Array
    edges: Arrays
    texture: tuple[float, *Arrays]
    faces: Arrays
    surface: Array


# With the tensor that tells whether a model was moved to another type since.
_KEPT: WeakKeyDictionary[ContourModel, tuple[Tensor, ModelArrays]] = WeakKeyDictionary()


def arrays_of(model: ContourModel) -> ModelArrays:
    """The arrays of a model."""
    kept = _KEPT.get(model)
    if kept is None or kept[0] is not model.edge_ends:
        kept = _KEPT[model] = model.edge_ends, _made(model)
    return kept[1]


def _made(model: ContourModel) -> ModelArrays:
    edges = model.edge_ends, model.face_normals.movedim(0, -1), model.face_offsets.T, model.is_crease, model.is_segment, model.edges
    texture = as_arrays(model.texture_points, model.texture_tangents, model.texture_normals, model.texture_gaps_m)
    faces, (members, surface) = as_arrays(model.triangles, model.triangle_normals), as_arrays(model.members, model.surface_points.T)
    return ModelArrays(members, as_arrays(*edges), (model.texture_spacing_m, *texture), faces, surface)
