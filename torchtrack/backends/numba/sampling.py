"""Contour points of a mesh: :func:`torchtrack.tracking.contours.sampling.mesh_points`, object by object."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchtrack.backends.numba.arrays import Arrays, as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, entries, inverse_depth, lens, placed, turned
from torchtrack.backends.numba.models import EdgeArrays, TextureArrays, arrays_of
from torchtrack.backends.numba.parameters import SamplingSettings
from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerates
from torchtrack.object_model.contour_source import ContourKind, ContourModel
from torchtrack.tracking.contours.sampling import MAX_ACTIVE_EDGES, MIN_TEXTURE_COSINE, RESOLVED_PX, SPACING_PX, mesh_points

# Rows of a model's table of edges, and of the points sampled on them.
_START, _VECTOR, _DIRECTION, _TURNING, _KIND = 0, 3, 6, 9, 12
_POINT, _TANGENT, _RESOLVED = 0, 3, 6
_SAMPLED = 7


class Sampled(NamedTuple):
    """What is sampled, with room enough: ``[b, _SAMPLED, n]`` and ``[b, n]``, of which there are as many as ``counts [b]`` says; or of one object."""

    rows: Array
    kind: Array
    counts: Array


class ActiveEdges(NamedTuple):
    """Edges that are contours: their numbers, lengths in the image, and depths of their ends."""

    numbers: Array
    length: Array
    depths: Array


class Points(NamedTuple):
    """Contour points of each object: ``[b, 3, m]``, and ``[b, m]``."""

    points_obj: Array
    tangents_obj: Array
    kind: Array
    mask: Array
    resolved: Array


@kernel(fastmath=FAST)
def sample(members: Array, edges: EdgeArrays, texture: TextureArrays, views: Arrays, settings: SamplingSettings, sampled: Sampled) -> None:
    """Points of objects of one model: on its edges, spread evenly in the image, and of its texture.

    Args:
        members: numbers of the objects.
        views: poses ``[b, 4, 4]``, and intrinsics ``[b, 4]``, of all objects.
    """
    sampled, edges, texture, (T_cam_obj, intrinsics) = Sampled(*sampled), EdgeArrays(*edges), TextureArrays(*texture), views
    total = len(edges.ends)
    active, camera_obj = ActiveEdges(np.empty(total, np.int64), np.empty(total), np.empty((total, 2))), np.empty(3)
    for b in members:
        T, pose, of_lens = T_cam_obj[b], entries(T_cam_obj[b]), lens(intrinsics[b])
        for k in range(3):
            camera_obj[k] = -(T[0, k] * T[0, 3] + T[1, k] * T[1, 3] + T[2, k] * T[2, 3])
        used, own = _find_active(edges, camera_obj, settings, active.numbers), Sampled(sampled.rows[b], sampled.kind[b], sampled.counts)
        shown = ActiveEdges(active.numbers[:used], active.length[:used], active.depths[:used])
        _measure(edges.ends, pose, of_lens, settings, shown)
        count = _sample_edges(edges, shown, camera_obj, settings, own)
        sampled.counts[b] = count + _sample_texture(count, texture, pose, of_lens, settings, own)


@kernel(fastmath=FAST)
def _find_active(edges: EdgeArrays, camera_obj: Array, settings: SamplingSettings, active: Array) -> int:
    """Which edges are contours, first in ``active``: how many; of too many, some, spread evenly."""
    front, back = np.empty(len(active), np.bool_), np.empty(len(active), np.bool_)
    _facing(edges.face_normals[0], edges.face_offsets[0], camera_obj, front)
    _facing(edges.face_normals[1], edges.face_offsets[1], camera_obj, back)
    # Of eight edges at a time, mostly none is one.
    shows, used, is_segment, is_crease = np.zeros(-(-len(active) // 8) * 8, np.bool_), 0, edges.is_segment, edges.is_crease
    for e in range(len(active)):
        shows[e] = is_segment[e] | (is_crease[e] & (front[e] | back[e])) | (front[e] != back[e])
    eight = shows.view(np.uint64)
    for k in range(len(eight)):
        if eight[k]:
            for e in range(8 * k, 8 * k + 8):
                if shows[e]:
                    active[used] = e
                    used += 1
    if used <= settings.most_edges:
        return used
    for j in range(settings.most_edges):
        active[j] = active[int(j * (used / settings.most_edges))]
    return settings.most_edges


@kernel(fastmath=FAST)
def _facing(normals: Array, offsets: Array, camera_obj: Array, facing: Array) -> None:
    """Which faces look at the camera: those on one side of the edges, several at once."""
    x, y, z = camera_obj[0], camera_obj[1], camera_obj[2]
    normal_x, normal_y, normal_z = normals[0], normals[1], normals[2]
    for e in range(len(facing)):
        facing[e] = normal_x[e] * x + normal_y[e] * y + normal_z[e] * z > offsets[e]


@kernel(fastmath=FAST)
def _measure(edge_ends: Array, pose: Numbers, intrinsics: Numbers, settings: SamplingSettings, active: ActiveEdges) -> None:
    """Lengths of edges in the image, zero for those that reach behind the camera, and depths of their ends."""
    for j in range(len(active.numbers)):
        ends = edge_ends[active.numbers[j]]
        x0, y0, z0 = placed(pose, ends[0, 0], ends[0, 1], ends[0, 2])
        x1, y1, z1 = placed(pose, ends[1, 0], ends[1, 1], ends[1, 2])
        active.depths[j, 0], active.depths[j, 1], active.length[j] = z0, z1, 0.0
        if z0 > settings.least_depth_m and z1 > settings.least_depth_m:
            du, dv = (x1 / z1 - x0 / z0) * intrinsics[0], (y1 / z1 - y0 / z0) * intrinsics[1]
            active.length[j] = np.sqrt(du * du + dv * dv)


@kernel(fastmath=FAST)
def _sample_edges(edges: EdgeArrays, active: ActiveEdges, camera_obj: Array, settings: SamplingSettings, sampled: Sampled) -> int:
    """Points at even distances in the image along all edges, one after the other; how many."""
    numbers, length, depths = active
    total, rows = length.sum(), sampled.rows
    if not total > 0:
        return 0
    count = settings.max_edge_points
    if settings.spacing_px * count > total:
        count = int(np.ceil(total / settings.spacing_px))
    j, until = 0, length[0]
    for i in range(count):
        target = (i + 0.5) / count * total
        while until < target and j < len(numbers) - 1:
            j += 1
            until += length[j]
        along = 1.0 - (until - target) / max(length[j], 1e-9)
        # Even steps in the image are not even along the edge: undo the perspective.
        z0, z1 = depths[j, 0], depths[j, 1]
        along = min(max(along * z0 / max(z1 + along * (z0 - z1), settings.least_depth_m), 0.0), 1.0)
        e, side = numbers[j], 0.0
        for k in range(3):
            rows[_POINT + k, i] = edges.rows[_START + k, e] + along * edges.rows[_VECTOR + k, e]
            side += edges.rows[_TURNING + k, e] * (rows[_POINT + k, i] - camera_obj[k])
        # The normal in the image is to point out of the object: tangents turn with it on their right.
        sign = 1.0 if side > 0 else -1.0
        for k in range(3):
            rows[_TANGENT + k, i] = sign * edges.rows[_DIRECTION + k, e]
        rows[_RESOLVED, i] = 1.0
        sampled.kind[i] = int(edges.rows[_KIND, e])
    return count


@kernel(fastmath=FAST)
def _sample_texture(first: int, texture: TextureArrays, pose: Numbers, intrinsics: Numbers, settings: SamplingSettings, sampled: Sampled) -> int:
    """Points of texture that looks at the camera, written from place ``first`` on; how many."""
    (spacing_m, points, tangents, normals, gaps_m), (rows, kind, _) = texture, sampled
    if len(points) == 0:
        return 0
    spacing_px = spacing_m * intrinsics[0] * inverse_depth(pose[11])
    # Every second, third and so on, where they lie closer than need be.
    every = len(points)
    if every * spacing_px > settings.spacing_px:
        every = max(int(settings.spacing_px / spacing_px), 1)
    at = first
    for i in range(0, len(points), every):
        x, y, z = placed(pose, points[i, 0], points[i, 1], points[i, 2])
        nx, ny, nz = turned(pose, normals[i, 0], normals[i, 1], normals[i, 2])
        towards = -(nx * x + ny * y + nz * z)
        if towards > settings.least_cosine * np.sqrt(x * x + y * y + z * z):
            for k in range(3):
                rows[_POINT + k, at], rows[_TANGENT + k, at] = points[i, k], tangents[i, k]
            tangent, place = turned(pose, tangents[i, 0], tangents[i, 1], tangents[i, 2]), (x, y, z)
            gap_px = gaps_m[i] * _px_per_m_across(place, tangent, towards, intrinsics)
            kind[at], rows[_RESOLVED, at] = settings.texture, min(gap_px / settings.resolved_px, 1.0)
            at += 1
    return at - first


@kernel(fastmath=FAST)
def _px_per_m_across(place: Numbers, tangent: Numbers, towards: float, intrinsics: Numbers) -> float:
    """:func:`torchtrack.tracking.contours.sampling.px_per_m_across`, of a point whose normal times its place is ``-towards``."""
    per_depth, fx, fy = inverse_depth(place[2]), intrinsics[0], intrinsics[1]
    u, v = fx * (tangent[0] - place[0] * per_depth * tangent[2]), fy * (tangent[1] - place[1] * per_depth * tangent[2])
    return fx * fy * towards * per_depth * per_depth / np.sqrt(max(u * u + v * v, 1e-18))


@kernel(fastmath=FAST)
def gather(sampled: Sampled, points: Points) -> None:
    """Lay out what was sampled in as many places as needed; zero where there is nothing."""
    (rows, kind, counts), (points_obj, tangents_obj, kinds, mask, resolved) = sampled, points
    for b in range(len(counts)):
        for i in range(mask.shape[1]):
            exists = i < counts[b]
            mask[b, i], kinds[b, i] = exists, kind[b, i] if exists else 0
            resolved[b, i] = rows[b, _RESOLVED, i] if exists else 0.0
            for k in range(3):
                points_obj[b, k, i] = rows[b, _POINT + k, i] if exists else 0.0
                tangents_obj[b, k, i] = rows[b, _TANGENT + k, i] if exists else 0.0


def sampling_settings(config: ContourConfig) -> SamplingSettings:
    """What the kernel goes by."""
    return SamplingSettings(
        most_edges=MAX_ACTIVE_EDGES,
        max_edge_points=config.max_edge_points,
        spacing_px=SPACING_PX,
        texture=int(ContourKind.TEXTURE),
        resolved_px=RESOLVED_PX,
        least_cosine=MIN_TEXTURE_COSINE,
        least_depth_m=MIN_DEPTH_M,
    )


@accelerates(mesh_points)
def mesh_points_numba(models: Sequence[ContourModel], T_cam_obj: Tensor, intrinsics: Tensor, config: ContourConfig) -> tuple[Tensor, ...]:
    """Edge by edge."""
    settings, batch = sampling_settings(config), len(T_cam_obj)
    room = settings.max_edge_points + max(len(model.texture_points) for model in models)
    counts = np.zeros(batch, np.int64)
    sampled = T_cam_obj.new_empty(batch, _SAMPLED, room).numpy(), np.empty((batch, room), np.int64), counts
    seen = as_arrays(T_cam_obj, intrinsics)
    for model in models:
        of_model = arrays_of(model)
        sample(of_model.members, of_model.edges, of_model.texture, seen, settings, sampled)
    # One place at least: what selects from contours needs one to point at.
    width = max(int(counts.max()), 1)
    points_obj, tangents_obj = T_cam_obj.new_empty(2, batch, 3, width)
    kinds, mask = torch.empty(batch, width, dtype=torch.int64), torch.empty(batch, width, dtype=torch.bool)
    resolved = T_cam_obj.new_empty(batch, width)
    gather(sampled, as_arrays(points_obj, tangents_obj, kinds, mask, resolved))
    return points_obj.transpose(1, 2), tangents_obj.transpose(1, 2), kinds, mask, resolved
