"""What contours are made from: the constant tensors of an object's model."""

import copy
from collections.abc import Iterable, Sequence
from enum import IntEnum
from math import ceil

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn

from torchtrack.config.tracker import ContourConfig
from torchtrack.object_model import ObjectModel

# Faces that meet at more than 60° make a sharp edge, whatever its scale; a scanned mesh is rough at smaller angles.
_SHARP_COSINE = 0.5
# Directions that a model is looked at from, and how many times more points may face a camera between two of them, or near it.
_VIEWS, _MORE_FACING = 512, 1.1
# Points of texture edges of a model, at most: as many as a model is sampled with unless it is asked for more. It bounds time; not measured.
MAX_TEXTURE_POINTS = 4000
# Edges of texture are opposite whose directions to the brighter side have a cosine below minus this, of faces that look the same way; beside each
# other, where they lie within so many spacings along the edge. So many points are compared with all others at once.
_OPPOSITE_COSINE, _BESIDE, _GAPS_AT_ONCE = 0.5, 2.0, 256
# Models of up to this many faces hide their own contours exactly, face by face: of more, one depth buffer takes less time. Not measured closely.
EXACT_FACES = 512


class ContourKind(IntEnum):
    """What a contour point comes from: the smooth silhouette, a sharp edge (occluding or not), and so on."""

    SMOOTH = 0
    CREASE = 1
    TEXTURE = 2
    SEGMENT = 3
    SPLAT = 4
    LEARNED = 5


class ContourModel(nn.Module):
    """The constant tensors of one :class:`ObjectModel` that contours are made from, as buffers."""

    edge_ends: Tensor
    edges: Tensor
    face_normals: Tensor
    face_offsets: Tensor
    is_crease: Tensor
    is_segment: Tensor
    texture_points: Tensor
    texture_tangents: Tensor
    texture_normals: Tensor
    texture_gaps_m: Tensor
    surface_points: Tensor
    triangles: Tensor
    triangle_normals: Tensor
    is_bent: Tensor
    members: Tensor

    def __init__(self, model: ObjectModel, members: Sequence[int], config: ContourConfig) -> None:
        """Take what ``config`` switches on from ``model``, which the objects numbered ``members`` have."""
        super().__init__()
        self.numbers = tuple(members)
        self.register_buffer("members", torch.tensor(members))
        points = torch.cat([model.edge_points, model.segments])
        normals = torch.cat([model.edge_normals, torch.zeros_like(model.segments)])
        is_segment = torch.zeros(len(points), dtype=torch.bool)
        is_segment[len(model.edge_points) :] = True
        self.register_buffer("edge_ends", points.clone())
        self.register_buffer("face_normals", _in_rows(normals))
        self.register_buffer("face_offsets", _in_rows((normals * points[:, :1]).sum(-1)))
        self.register_buffer("is_segment", is_segment)
        self.register_buffer("is_crease", torch.cat([model.edge_is_crease, torch.zeros(len(model.segments), dtype=torch.bool)]) & config.creases)
        texture_count = min(len(model.texture_points), MAX_TEXTURE_POINTS) if config.texture else 0
        spread = torch.linspace(0, max(len(model.texture_points) - 1, 0), texture_count).long()
        for name in ("texture_points", "texture_tangents", "texture_normals"):
            self.register_buffer(name, getattr(model, name)[spread].clone())
        self.texture_spacing_m = _spacing(self.texture_points)
        of_texture = self.texture_points, self.texture_tangents, self.texture_normals
        self.register_buffer("texture_gaps_m", _gaps(*of_texture, _BESIDE * self.texture_spacing_m))
        self.most_texture_facing = _most_facing(self.texture_normals)
        self.register_buffer("edges", _edge_table(points, normals, is_segment))
        # Edges that may be the silhouette of what is smooth in reality.
        self.register_buffer("is_bent", self.edges[-1] == int(ContourKind.SMOOTH))
        self.register_buffer("surface_points", _in_rows(model.surface_points))
        exact = len(model.triangles) <= EXACT_FACES
        triangles = model.triangles if exact else model.triangles[:0]
        self.register_buffer("triangles", triangles.clone())
        self.register_buffer("triangle_normals", _normals(triangles))

    def with_members(self, members: Int[Tensor, "k"], numbers: Iterable[int]) -> "ContourModel":
        """The same model of other objects, whose ``numbers`` are the same as ``members``: a shallow copy, which shares all other tensors."""
        model = copy.copy(self)
        model.numbers, model._buffers = tuple(numbers), {**self._buffers, "members": members}
        return model

    def active_edges(self, camera_obj: Float[Tensor, "b 3"]) -> Bool[Tensor, "b e"]:
        """Which edges are contours for a camera at ``camera_obj`` (object frame)."""
        facing = torch.einsum("esk,bk->bes", self.face_normals, camera_obj) > self.face_offsets
        front, back = facing.unbind(-1)
        return self.is_crease & (front | back) | self.is_segment | (front != back)


def _in_rows(values: Float[Tensor, "n *c"]) -> Float[Tensor, "n *c"]:
    """A copy that has each coordinate of all of them in one row in memory: so a processor looks at several at once."""
    return values.movedim(0, -1).clone(memory_format=torch.contiguous_format).movedim(-1, 0)


def _most_facing(normals: Float[Tensor, "n 3"]) -> int:
    """How many of some points on faces look at a camera at once, at most: places for them, where they cannot be counted first."""
    views = torch.nn.functional.normalize(torch.randn(_VIEWS, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    facing = (normals @ views.to(normals).T > 0).sum(0)
    return min(ceil(_MORE_FACING * int(facing.amax())), len(normals)) if len(normals) else 0


def _edge_table(points: Float[Tensor, "e 2 3"], face_normals: Float[Tensor, "e 2 3"], is_segment: Bool[Tensor, "e"]) -> Float[Tensor, "13 e"]:
    """Of every edge: start, vector, direction, the way that turns its tangent (see :func:`_edge_points`), and kind."""
    start, vector = points[:, 0], points[:, 1] - points[:, 0]
    sharp = (face_normals[:, 0] * face_normals[:, 1]).sum(-1) < _SHARP_COSINE
    kind = torch.where(is_segment, int(ContourKind.SEGMENT), torch.where(sharp, int(ContourKind.CREASE), int(ContourKind.SMOOTH)))
    turning = torch.linalg.cross(vector, face_normals.sum(1), dim=-1)
    direction = torch.nn.functional.normalize(vector, dim=-1)
    return torch.cat([start, vector, direction, turning, kind[:, None].to(start.dtype)], -1).T.contiguous()


def _normals(triangles: Float[Tensor, "f 3 3"]) -> Float[Tensor, "f 3"]:
    """Unit normals."""
    first, second, third = triangles.unbind(1)
    return torch.nn.functional.normalize(torch.linalg.cross(second - first, third - first, dim=-1), dim=-1)


def _spacing(points: Float[Tensor, "n 3"]) -> float:
    """Distance of most points from the one nearest to them (m)."""
    if len(points) < 2:
        return 0.0
    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=2)
    return float(np.median(distances[:, 1]))


def _gaps(points: Float[Tensor, "n 3"], tangents: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], beside_m: float) -> Float[Tensor, "n"]:
    """Distance across each edge of texture to the nearest opposite one (m), no more than ``beside_m`` along it; infinite where there is none."""
    if len(points) == 0:
        return points.new_zeros(0)
    to_brighter, parts = torch.linalg.cross(normals, tangents, dim=-1), []
    for part in torch.arange(len(points)).split(_GAPS_AT_ONCE):
        ways = (way[part] for way in (to_brighter, tangents))
        across, along = ((way @ points.T - (way * points[part]).sum(-1, keepdim=True)).abs_() for way in ways)
        is_opposite = (to_brighter[part] @ to_brighter.T < -_OPPOSITE_COSINE) & (normals[part] @ normals.T > _OPPOSITE_COSINE)
        parts.append(torch.where(is_opposite & (along <= beside_m), across, torch.inf).amin(1))
    return torch.cat(parts)


def group_by_model(models: Sequence[ObjectModel], config: ContourConfig) -> list[ContourModel]:
    """One :class:`ContourModel` per distinct object model, with the objects that have it."""
    members: dict[int, list[int]] = {}
    for number, model in enumerate(models):
        members.setdefault(id(model), []).append(number)
    return [ContourModel(models[numbers[0]], numbers, config) for numbers in members.values()]
