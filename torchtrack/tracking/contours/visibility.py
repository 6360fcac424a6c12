"""Hidden contours: behind the object's own faces, or behind any surface of its stream.

A model of few faces is tested against each of them, exactly: a coarse buffer would hide the long thin faces that such
objects show when they turn. Dense meshes, and objects in front of one another, share one depth buffer per stream.
"""

from dataclasses import replace
from functools import reduce

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.dispatch import accelerable
from torchtrack.core.lie import affine, transform_points
from torchtrack.core.padded import bounds
from torchtrack.tracking.contours.depth_buffer import DEPTH_CELL_PX, Scene, hidden_in_buffer
from torchtrack.tracking.contours.points import Contours

# A point this far behind a face's plane is behind it, not on it (diameters).
ON_FACE = 2e-3
# Tests of points against triangles that are made at once: larger temporaries page-fault on the CPU.
_MOST_TESTS = 2**19
# Images that are farther apart than this have no cell in common.
OVERLAP_CELLS = 2


def hidden_by_faces(
    points_cam: Float[Tensor, "b m 3"], triangles_cam: Float[Tensor, "b f 3 3"], normals_cam: Float[Tensor, "b f 3"], tolerance_m: Float[Tensor, "b"]
) -> Bool[Tensor, "b m"]:
    """Which points lie behind one of the triangles, as the camera sees them.

    The line of sight to a point crosses a triangle when it is on one side of the three planes through the camera and
    an edge; all tests of all points and triangles are one matrix product.
    """
    sides = torch.linalg.cross(triangles_cam, triangles_cam.roll(-1, 2), dim=-1)
    turn = (sides[:, :, 0] * triangles_cam[:, :, 2]).sum(-1)[..., None, None].sign()
    plane = (normals_cam * triangles_cam[:, :, 0]).sum(-1)
    away = plane.sign()[..., None] * normals_cam
    limits = torch.nn.functional.pad(-(plane.abs() + tolerance_m[:, None])[..., None], (3, 0))
    tests = torch.cat([torch.cat([sides * turn, away[:, :, None]], 2), limits[..., None]], 3).flatten(1, 2)
    rows = torch.nn.functional.pad(points_cam.transpose(1, 2), (0, 0, 0, 1), value=1.0)
    at_once = max(_MOST_TESTS // (tests.shape[1] * points_cam.shape[1] + 1), 1) if host_sync.read_at_once(points_cam) else len(points_cam)
    return torch.cat([_hidden_by(*part) for part in zip(tests.split(at_once), rows.split(at_once), strict=True)])


def _hidden_by(tests: Float[Tensor, "b t 4"], points: Float[Tensor, "b 4 m"]) -> Bool[Tensor, "b m"]:
    """Which points pass all four tests of one of the triangles: they lie within its edges, and behind its plane by its limit."""
    if host_sync.on_gpu(points):
        # One test after the other: of the whole product, memory is written and read four times as much, and by a compiler all of it.
        of_each = (affine(test[..., :3], points[:, :3], test[..., 3:]) for test in tests.unflatten(1, (-1, 4)).unbind(2))
        return reduce(torch.minimum, of_each).amax(1) > 0
    return torch.bmm(tests, points).unflatten(1, (-1, 4)).amin(2).amax(1) > 0


@accelerable
def hidden_by_self(scene: Scene, contours: Contours) -> Tensor:
    """Points of objects with few faces that these hide."""
    hidden = torch.zeros_like(contours.mask)
    for model in scene.models:
        if len(model.triangles):
            # All objects, where all have the model: a list of them would be looked up.
            members = slice(None) if len(scene.models) == 1 else model.members
            T_cam_obj = scene.T_cam_obj[members]
            places = _places_in_use(contours.mask[members]) if len(scene.models) > 1 else contours.mask.shape[1]
            corners = model.triangles.flatten(0, 1).expand(len(T_cam_obj), -1, -1)
            triangles = transform_points(T_cam_obj, corners).unflatten(1, (-1, 3))
            normals = model.triangle_normals @ T_cam_obj[:, :3, :3].transpose(1, 2)
            points_cam = contours.points_cam[members][:, :places]
            hidden[members, :places] = hidden_by_faces(points_cam, triangles, normals, ON_FACE * scene.diameters_m[members])
    return hidden


def _places_in_use(mask: Bool[Tensor, "b m"]) -> int:
    """How many places there are up to the last one with a point: others have more contours. On a GPU, which would have to be waited for, all."""
    if not host_sync.read_at_once(mask):
        return mask.shape[1]
    used = mask.any(0).nonzero()
    return int(used[-1]) + 1 if len(used) else 0


def may_overlap_others(scene: Scene, contours: Contours, cell_px: int) -> Bool[Tensor, "b"]:
    """Which objects may share a cell with another one of their stream: where the boxes around their outlines meet."""
    low, high = bounds(contours.pixels, contours.mask)
    low = low - OVERLAP_CELLS * cell_px
    # The outline of what reaches behind the camera is not all in its image; then no point is farther away than the diameter.
    close = torch.where(contours.mask, contours.points_cam[..., 2], torch.inf).amin(1) < scene.diameters_m
    meet = ((low[:, None] <= high) & (low <= high[:, None])).all(-1) | close[:, None] | close
    stream, itself = scene.stream_index, torch.eye(len(close), dtype=torch.bool, device=close.device)
    return (meet & (stream[:, None] == stream) & ~itself).any(1)


def _tested_exactly(scene: Scene) -> Tensor:
    """Which objects are tested against their own faces: a column."""
    exact = torch.zeros(len(scene.T_cam_obj), 1, dtype=torch.bool, device=scene.T_cam_obj.device)
    for model in scene.models:
        # By `exact[members] = ...`, the value would be copied to a GPU each time, and waited for.
        exact.index_fill_(0, model.members, len(model.triangles) > 0)
    return exact


def remove_hidden(contours: Contours, scene: Scene) -> Contours:
    """Contours without the points that the object itself or another one of its stream hides."""
    hidden = hidden_by_self(scene, contours)
    needs_buffer = scene.shared or any(len(model.triangles) == 0 for model in scene.models)
    if needs_buffer:
        exact = _tested_exactly(scene)
        drawn = ~exact[:, 0]
        if scene.shared:
            drawn = drawn | may_overlap_others(scene, contours, DEPTH_CELL_PX)
        if not host_sync.none_of(drawn):
            hidden = hidden | hidden_in_buffer(scene, contours, drawn, exact)
    return replace(contours, mask=contours.mask & ~hidden)
