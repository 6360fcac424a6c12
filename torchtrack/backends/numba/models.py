"""The tensors of an object's contour model as kernels take them: they never change, so they are converted once."""

from typing import NamedTuple
from weakref import WeakKeyDictionary

from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import Array
from torchtrack.object_model.contour_source import ContourModel


class ModelArrays(NamedTuple):
    """A :class:`ContourModel` as arrays.

    Args:
        members: numbers of the objects that have it.
        sampled: what contour points are sampled from, in the order that :func:`torchtrack.backends.numba.sampling.sample` takes it.
        faces: triangles and their normals; none of dense meshes.
        surface: samples of the surface, ``[3, n]``.
    """

    members: Array
    sampled: tuple[Array, ...]
    faces: tuple[Array, Array]
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
    of_edges = model.edge_ends, model.face_normals.movedim(0, -1), model.face_offsets.T, model.is_crease, model.is_segment, model.edges
    sampled = as_arrays(*of_edges, model.texture_points, model.texture_tangents, model.texture_normals, model.texture_gaps_m)
    members, triangles, normals, surface = as_arrays(model.members, model.triangles, model.triangle_normals, model.surface_points.T)
    return ModelArrays(members, tuple(sampled), (triangles, normals), surface)
