"""From an object's pose to points on its contours, hidden parts included: on edges and on texture.

Occluding edges (between a front and a back face), creases, texture edges and polyline segments, sampled evenly in the
image. Objects that share a model are handled as one batch.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import ContourConfig
from torchtrack.core import host_sync
from torchtrack.core.camera import MIN_DEPTH_M, project
from torchtrack.core.dispatch import accelerable
from torchtrack.core.lie import affine, transform_points
from torchtrack.core.padded import select_ranked
from torchtrack.object_model.contour_source import ContourKind, ContourModel
from torchtrack.tracking.contours.points import Contours, assemble, widened

# Contour points lie no closer than this in the image (px): events lie on whole pixels, and small objects cost less.
SPACING_PX = 0.5
# Of a model with no more edges than this, all are looked at.
_FEW_EDGES = 512


# Active edges beyond this many are thinned evenly before they are projected.
MAX_ACTIVE_EDGES = 8192


# Texture seen at a grazing angle (cosine below this) is foreshortened beyond use. What fires and is left out draws what is beside it.
MIN_TEXTURE_COSINE = 0.02
# Edges of texture are resolved in full where the next one of the opposite contrast is so far away in the image (px). Of 38,000 events on the print of
# a book at right poses, 57 % agreed on its darker side where that was less than 0.4 px away, 64 % up to 0.6, 68 % up to 0.8, 80 % up to 1, 91 % up
# to 1.2, and 95 % beyond.
RESOLVED_PX = 1.2


# Points and tangents (object frame), kinds, mask, and how far they are resolved.
_Points = tuple[Tensor, ...]


def mesh_contours(
    models: Sequence[ContourModel],
    T_cam_obj: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 4"],
    config: ContourConfig,
) -> Contours:
    """Contours of each object at its pose, hidden parts included."""
    points, tangents, kind, mask, resolved = mesh_points(models, T_cam_obj, intrinsics, config)
    return replace(assemble(points, tangents, kind, mask, T_cam_obj, intrinsics), resolved=resolved)


@accelerable
def mesh_points(models: Sequence[ContourModel], T_cam_obj: Tensor, intrinsics: Tensor, config: ContourConfig) -> _Points:
    """Contour points of all objects, in places of their own, before hidden parts are removed."""
    if len(models) == 1:
        return _model_contours(models[0], T_cam_obj, intrinsics, config)
    parts = [_model_contours(model, T_cam_obj[model.members], intrinsics[model.members], config) for model in models]
    width = max(mask.shape[1] for _, _, _, mask, _ in parts)
    order = torch.cat([model.members for model in models]).argsort()
    return tuple(torch.cat([widened(value, width) for value in column])[order] for column in zip(*parts, strict=True))


def _edge_points(model: ContourModel, T_cam_obj: Tensor, intrinsics: Tensor, config: ContourConfig) -> _Points:
    """Points on the active edges, spread evenly in the image."""
    batch = len(T_cam_obj)
    camera_obj = -torch.bmm(T_cam_obj[:, :3, :3].transpose(1, 2), T_cam_obj[:, :3, 3:])
    active = model.active_edges(camera_obj[..., 0])
    ends, edges = model.edge_ends.expand(batch, -1, -1, -1), model.edges.expand(batch, -1, -1)
    places = _places_for(active)
    if places < active.shape[1]:
        chosen, active = select_ranked(active, places)
        ends, edges = model.edge_ends[chosen], model.edges[:, chosen].transpose(0, 1)
    lengths, start_z, end_z = _lengths_px(ends, T_cam_obj, intrinsics)
    lengths = lengths * active
    cumulative = lengths.cumsum(-1)
    total = cumulative[:, -1:]
    counts = (total / SPACING_PX).ceil().nan_to_num(0.0).clamp(max=config.max_edge_points)
    count = max(int(counts.amax()), 1) if host_sync.read_at_once(counts) else config.max_edge_points
    number = torch.arange(count, device=lengths.device, dtype=lengths.dtype)
    target = (number + 0.5) / counts.clamp(min=1) * total
    edge = torch.searchsorted(cumulative, target).clamp(max=lengths.shape[1] - 1)[:, None]
    until, length, z0, z1 = torch.stack([cumulative, lengths, start_z, end_z], 1).gather(2, edge.expand(-1, 4, -1)).unbind(1)
    along = 1 - (until - target) / length.clamp(min=1e-9)
    # Even steps in the image are not even along the edge: undo the perspective.
    along = (along * z0 / torch.addcmul(z1, along, z0 - z1).clamp(min=MIN_DEPTH_M)).clamp(0, 1)
    start, vector, direction, turning, kind = edges.gather(2, edge.expand(-1, edges.shape[1], -1)).split((3, 3, 3, 3, 1), 1)
    points = torch.addcmul(start, along[:, None], vector)
    # The normal in the image is to point out of the object: tangents turn with it on their right.
    side = (turning * (points - camera_obj)).sum(1, keepdim=True)
    tangents = torch.where(side > 0, direction, -direction)
    return points.transpose(1, 2), tangents.transpose(1, 2), kind[:, 0].long(), number < counts, torch.ones_like(along)


def _places_for(active: Bool[Tensor, "b e"]) -> int:
    """Places for the active edges of each object: of many edges, few are. On a GPU, which would have to be waited for, as many as there may be."""
    edges = active.shape[1]
    if edges <= _FEW_EDGES or not host_sync.read_at_once(active):
        return min(edges, MAX_ACTIVE_EDGES)
    return min(max(int(active.sum(1).amax()), 1), MAX_ACTIVE_EDGES)


def _lengths_px(ends: Float[Tensor, "b e 2 3"], T_cam_obj: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Lengths of edges in the image, zero for those that reach behind the camera, and the depths of their ends."""
    start_cam, end_cam = (transform_points(T_cam_obj, points) for points in ends.unbind(2))
    start_z, end_z = start_cam[..., 2], end_cam[..., 2]
    lengths = (project(end_cam, intrinsics) - project(start_cam, intrinsics)).square().sum(-1).sqrt()
    return lengths * ((start_z > MIN_DEPTH_M) & (end_z > MIN_DEPTH_M)), start_z, end_z


def _texture_mask(model: ContourModel, T_cam_obj: Tensor) -> Tensor:
    """Texture points on faces that look at the camera."""
    points = transform_points(T_cam_obj, model.texture_points.expand(len(T_cam_obj), -1, -1))
    normals = model.texture_normals @ T_cam_obj[:, :3, :3].transpose(1, 2)
    return (normals * points).sum(-1) < -MIN_TEXTURE_COSINE * points.square().sum(-1).sqrt()


def _texture_points(model: ContourModel, T_cam_obj: Tensor, intrinsics: Tensor) -> _Points:
    """Points of the texture that looks at the camera."""
    spacing_px = model.texture_spacing_m * intrinsics[:, 0] / T_cam_obj[:, 2, 3].clamp(min=MIN_DEPTH_M)
    # Every second, third and so on, where they lie closer than need be.
    every = (SPACING_PX / spacing_px).floor().clamp(1, len(model.texture_points)).long()
    number = torch.arange(len(model.texture_points), device=every.device)
    facing = _texture_mask(model, T_cam_obj) & (number % every[:, None] == 0)
    # On a GPU, which would have to be waited for to know how many there are, there are places for as many as there can be.
    count = int(facing.sum(1).amax()) if host_sync.read_at_once(facing) else model.most_texture_facing
    chosen, mask = select_ranked(facing, count)
    of_model = model.texture_points, model.texture_tangents, model.texture_normals
    points, tangents, normals = (values.T[:, chosen].permute(1, 2, 0) for values in of_model)
    gap_px = model.texture_gaps_m[chosen] * px_per_m_across(points, tangents, normals, T_cam_obj, intrinsics).detach()
    return points, tangents, torch.full_like(chosen, int(ContourKind.TEXTURE)), mask, (gap_px / RESOLVED_PX).clamp(max=1)


def px_per_m_across(points: Tensor, tangents: Tensor, normals: Tensor, T_cam_obj: Tensor, intrinsics: Tensor) -> Float[Tensor, "b m"]:
    """Distance in the image across an edge, of lines beside it on the surface, over their distance there: the area shown over the length shown."""
    x, y, z = transform_points(T_cam_obj, points).unbind(-1)
    (tx, ty, tz), (nx, ny, nz) = (affine(T_cam_obj[:, :3, :3], way.transpose(1, 2)).unbind(1) for way in (tangents, normals))
    (fx, fy), inverse_z = intrinsics[:, :2, None].unbind(1), 1 / z.clamp(min=MIN_DEPTH_M)
    area = fx * fy * (nx * x + ny * y + nz * z).abs() * inverse_z.square()
    u, v = fx * (tx - x * inverse_z * tz), fy * (ty - y * inverse_z * tz)
    return area / (u * u + v * v).clamp(min=1e-18).sqrt()


def _model_contours(model: ContourModel, T_cam_obj: Tensor, intrinsics: Tensor, config: ContourConfig) -> _Points:
    """Contour points of objects that share a model, before hidden parts are removed."""
    parts = [_no_points(T_cam_obj)]
    if len(model.edge_ends):
        parts.append(_edge_points(model, T_cam_obj, intrinsics, config))
    if len(model.texture_points):
        parts.append(_texture_points(model, T_cam_obj, intrinsics))
    if len(parts) == 2:
        return parts[1]
    return tuple(torch.cat(column, 1) for column in zip(*parts, strict=True))


def _no_points(T_cam_obj: Tensor) -> _Points:
    """One place of contours, and nothing there: what selects from contours needs a place to point at."""
    nowhere = T_cam_obj.new_zeros(len(T_cam_obj), 1, 3)
    nothing = torch.zeros(len(T_cam_obj), 1, dtype=torch.int64, device=T_cam_obj.device)
    return nowhere, nowhere, nothing, nothing.bool(), nowhere[..., 0]
