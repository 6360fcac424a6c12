"""Contour points behind an object's own faces, face by face: :func:`torchtrack.tracking.contours.visibility.hidden_by_self`."""

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from torchtrack.backends.numba.arrays import ContourArrays, as_arrays, contour_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.backends.numba.geometry import Numbers, entries, placed, turned
from torchtrack.backends.numba.models import FaceArrays, arrays_of
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours import visibility
from torchtrack.tracking.contours.depth_buffer import Scene
from torchtrack.tracking.contours.points import Contours

# Dot products of a face with a point: within its three edges, and behind its plane.
_TESTS = 4


@kernel()
def hide_behind_faces(members: Array, faces: FaceArrays, T_cam_obj: Array, tolerance_m: Array, contours: ContourArrays, hidden: Array) -> None:
    """Mark the points of objects of one model that lie behind one of its faces, as the camera sees them.

    Args:
        members: numbers of the objects.
        T_cam_obj: ``[b, 4, 4]``.
        tolerance_m: ``[b]``.
        hidden: ``[b, m]``, changed.
    """
    (triangles, normals), (points_cam, _, _, mask, _) = faces, contours
    count = points_cam.shape[2]
    tests = np.empty((len(triangles), _TESTS, 4), points_cam.dtype)
    points, place, deepest = np.empty((3, count), points_cam.dtype), np.empty(count, np.int64), np.empty(count, points_cam.dtype)
    for b in members:
        used = 0
        for i in range(count):
            if mask[b, i]:
                points[0, used], points[1, used], points[2, used] = points_cam[b, 0, i], points_cam[b, 1, i], points_cam[b, 2, i]
                place[used], deepest[used] = i, -np.inf
                used += 1
        pose = entries(T_cam_obj[b])
        for f in range(len(triangles)):
            _set_up(triangles[f], normals[f], pose, tolerance_m[b], tests[f])
        for f in range(len(triangles)):
            _deepen(tests[f], points[0, :used], points[1, :used], points[2, :used], deepest[:used])
        for j in range(used):
            hidden[b, place[j]] = hidden[b, place[j]] or deepest[j] > 0


@kernel()
def _set_up(triangle: Array, normal: Array, pose: Numbers, tolerance_m: float, tests: Array) -> None:
    """Lay out the tests of a face, each positive for points that pass it: a vector, and what is added to its product with the point."""
    corners = np.empty((3, 3))
    for k in range(3):
        corners[k, 0], corners[k, 1], corners[k, 2] = placed(pose, triangle[k, 0], triangle[k, 1], triangle[k, 2])
    sides = np.empty((3, 3))
    for k in range(3):
        a, b = corners[k], corners[(k + 1) % 3]
        sides[k, 0], sides[k, 1], sides[k, 2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    turn = np.sign(sides[0, 0] * corners[2, 0] + sides[0, 1] * corners[2, 1] + sides[0, 2] * corners[2, 2])
    away = turned(pose, normal[0], normal[1], normal[2])
    plane = away[0] * corners[0, 0] + away[1] * corners[0, 1] + away[2] * corners[0, 2]
    for k in range(3):
        tests[3, k] = away[k] * np.sign(plane)
        for side in range(3):
            tests[side, k] = sides[side, k] * turn
    for k in range(3):
        tests[k, 3] = 0.0
    tests[3, 3] = -(abs(plane) + tolerance_m)


@kernel(fastmath={"contract"})
def _deepen(tests: Array, x: Array, y: Array, z: Array, deepest: Array) -> None:
    """Raise, for each point, the least result of the four tests to that of a face."""
    for i in range(len(x)):
        first = tests[0, 0] * x[i] + tests[0, 1] * y[i] + tests[0, 2] * z[i]
        second = tests[1, 0] * x[i] + tests[1, 1] * y[i] + tests[1, 2] * z[i]
        third = tests[2, 0] * x[i] + tests[2, 1] * y[i] + tests[2, 2] * z[i]
        behind = tests[3, 0] * x[i] + tests[3, 1] * y[i] + tests[3, 2] * z[i] + tests[3, 3]
        least = first if first < second else second
        other = third if third < behind else behind
        least = least if least < other else other
        deepest[i] = least if least > deepest[i] else deepest[i]


@accelerates(visibility.hidden_by_self)
def hidden_by_self_numba(scene: Scene, contours: Contours) -> Bool[Tensor, "b m"]:
    """Object by object."""
    hidden = torch.zeros_like(contours.mask)
    points, T_cam_obj, tolerance_m = contour_arrays(contours), *as_arrays(scene.T_cam_obj, visibility.ON_FACE * scene.diameters_m)
    for model in scene.models:
        of_model = arrays_of(model)
        if len(of_model.faces[0]):
            hide_behind_faces(of_model.members, of_model.faces, T_cam_obj, tolerance_m, points, hidden.numpy())
    return hidden
