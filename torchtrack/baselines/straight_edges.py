"""The straight edges of a model, and whether it has enough of them for methods that know lines alone.

Decided by the shape, never by a name: a run of sharp edges or segments that lie on one line, and is long against the
object, is straight; so is an edge of the texture whose points lie on one line. An object is fit for line methods where
at least half of the contour that a camera sees from around it is made of such runs.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from torchtrack.object_model import ObjectModel

# Least length of a straight run (diameters).
_LEAST_RUN = 0.1
# Edges of one run agree in direction this well, and the run's ends are as far apart as its length, but for this share.
_PARALLEL_COSINE, _BENT_SHARE = np.cos(np.deg2rad(2.0)), 0.01
# End points nearer than this are one vertex (diameters).
_SAME_VERTEX = 1e-5
# Points of a straight texture edge lie in a tube around their tangent (radius in diameters, cosine of their own tangents);
# the least run is cut into pieces, of which so many must hold points: they lie about a hundredth of a diameter apart.
_TUBE, _TUBE_COSINE, _PIECES, _FILLED_PIECES = 0.0025, np.cos(np.deg2rad(10.0)), 8, 6
# A camera looks from so many sides, from so far (diameters).
_VIEWS, _VIEW_DISTANCE = 64, 3.0
LEAST_STRAIGHT_SHARE = 0.5


def run_lengths(edges: Float[ndarray, "e 2 3"], diameter_m: float) -> Float[ndarray, " e"]:
    """Length (m) of the straight run that each edge ``[start, end]`` is part of: edges that follow each other on one line."""
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    if len(edges) == 0:
        return length
    run = _runs(edges, diameter_m)
    total = np.bincount(run, length)
    straight = _extents(edges, run) >= (1 - _BENT_SHARE) * total
    return np.where(straight[run], total[run], length)


def _runs(edges: ndarray, diameter_m: float) -> ndarray:
    """The run of each edge, as a number: edges that share a vertex and have the same direction."""
    corners = edges.reshape(-1, 3)
    merged = cKDTree(corners).query_pairs(_SAME_VERTEX * diameter_m, output_type="ndarray")
    joined = coo_array((np.ones(len(merged)), (merged[:, 0], merged[:, 1])), shape=(len(corners), len(corners)))
    vertex = connected_components(joined, directed=False)[1]
    direction = _directions(edges)
    order = np.argsort(vertex, kind="stable")
    first: list[int] = []
    second: list[int] = []
    for ends in np.split(order // 2, np.flatnonzero(np.diff(vertex[order])) + 1):
        a, b = np.nonzero(np.triu(np.abs(direction[ends] @ direction[ends].T) > _PARALLEL_COSINE, 1))
        first.extend(ends[a].tolist())
        second.extend(ends[b].tolist())
    following = coo_array((np.ones(len(first)), (first, second)), shape=(len(edges), len(edges)))
    run: ndarray = connected_components(following, directed=False)[1]
    return run


def _directions(edges: ndarray) -> ndarray:
    """Unit directions of edges; zero for one without length."""
    along = edges[:, 1] - edges[:, 0]
    return along / np.linalg.norm(along, axis=1, keepdims=True).clip(min=1e-12)


def _extents(edges: ndarray, run: ndarray) -> ndarray:
    """How far each run reaches along the direction of one of its edges: less than its length where it bends."""
    _, representative = np.unique(run, return_index=True)
    place = (edges * _directions(edges)[representative][run][:, None]).sum(-1)
    low, high = np.full(len(representative), np.inf), np.full(len(representative), -np.inf)
    np.minimum.at(low, run, place.min(1))
    np.maximum.at(high, run, place.max(1))
    extent: ndarray = high - low
    return extent


def straight_mesh_edges(model: ObjectModel) -> Bool[ndarray, " e"]:
    """Which of the model's mesh edges are part of a long straight crease."""
    straight = np.zeros(len(model.edge_points), dtype=bool)
    crease = model.edge_is_crease.numpy()
    straight[crease] = run_lengths(model.edge_points[model.edge_is_crease].double().numpy(), model.diameter_m) >= _LEAST_RUN * model.diameter_m
    return straight


def straight_segments(model: ObjectModel) -> Bool[ndarray, " l"]:
    """Which of the model's own segments are part of a long straight run."""
    result: ndarray = run_lengths(model.segments.double().numpy(), model.diameter_m) >= _LEAST_RUN * model.diameter_m
    return result


def straight_texture(model: ObjectModel) -> Bool[ndarray, " q"]:
    """Which texture points have neighbours all along their tangent, some way to both sides or twice as far to one."""
    points, tangents = model.texture_points.double().numpy(), model.texture_tangents.double().numpy()
    straight = np.zeros(len(points), dtype=bool)
    if len(points) < 2:
        return straight
    least, tube = _LEAST_RUN * model.diameter_m, _TUBE * model.diameter_m
    for number, near in enumerate(cKDTree(points).query_ball_point(points, least)):
        offset = points[near] - points[number]
        along = offset @ tangents[number]
        across_m = np.linalg.norm(offset - along[:, None] * tangents[number], axis=1)
        on_line = along[(across_m < tube) & (np.abs(tangents[near] @ tangents[number]) > _TUBE_COSINE)]
        filled = np.unique(np.floor(on_line / least * _PIECES))
        # Of the stretches that are as long as the least run and hold the point, the one with the most points counts.
        straight[number] = max(np.count_nonzero((filled >= low) & (filled < low + _PIECES)) for low in range(-_PIECES, 1)) >= _FILLED_PIECES
    return straight


def straight_share(model: ObjectModel) -> float:
    """Share of the geometric contour, seen from all around, that is on long straight edges; 0 for a model without any."""
    views = torch.from_numpy(_directions_around(_VIEWS)).to(model.centre.dtype) * _VIEW_DISTANCE * model.diameter_m + model.centre
    to_camera = views[:, None] - model.edge_points.mean(1)
    front, back = (torch.einsum("vek,ek->ve", to_camera, model.edge_normals[:, side]) > 0 for side in (0, 1))
    active = model.edge_is_crease & (front | back) | (front != back)
    contour = torch.cat([_seen_lengths(model.edge_points, views) * active, _seen_lengths(model.segments, views)], 1)
    straight = torch.from_numpy(np.r_[straight_mesh_edges(model), straight_segments(model)])
    total = float(contour.sum())
    return float(contour[:, straight].sum()) / total if total > 0 else 0.0


def _seen_lengths(edges: torch.Tensor, views: torch.Tensor) -> torch.Tensor:
    """Length of each edge as each view shows it: foreshortened."""
    along = edges[:, 1] - edges[:, 0]
    sight = torch.nn.functional.normalize(views[:, None] - edges.mean(1), dim=-1)
    return torch.linalg.cross(sight, along.expand_as(sight), dim=-1).norm(dim=-1)


def _directions_around(count: int) -> ndarray:
    """Unit vectors spread evenly over the sphere (a golden spiral)."""
    number = np.arange(count) + 0.5
    height, turn = 1 - 2 * number / count, np.pi * (1 + 5**0.5) * number
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], 1)


def straight_edges_only(model: ObjectModel) -> ObjectModel:
    """The model with its straight edges alone; its surface still hides what is behind it."""
    edges, texture = torch.from_numpy(straight_mesh_edges(model)), torch.from_numpy(straight_texture(model))
    return replace(
        model,
        edge_points=model.edge_points[edges],
        edge_normals=model.edge_normals[edges],
        edge_is_crease=model.edge_is_crease[edges],
        texture_points=model.texture_points[texture],
        texture_tangents=model.texture_tangents[texture],
        texture_normals=model.texture_normals[texture],
        segments=model.segments[torch.from_numpy(straight_segments(model))],
    )


def too_curved(model: ObjectModel) -> str | None:
    """Why a method that knows straight lines alone cannot track the model; None where it can."""
    share = straight_share(model)
    if share >= LEAST_STRAIGHT_SHARE:
        return None
    return f"'{model.name}' is curved: {100 * share:.0f} % of its contour is on straight edges, {100 * LEAST_STRAIGHT_SHARE:.0f} % are needed"
