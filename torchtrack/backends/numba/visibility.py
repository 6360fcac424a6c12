"""Hidden contour points: :func:`torchtrack.tracking.contours.visibility.hidden_by_faces` and the depth buffer there, object by object."""

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, entries, inverse_depth, lens, placed, turned
from torchtrack.backends.numba.models import arrays_of
from torchtrack.backends.numba.parameters import GridSettings
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours import visibility
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.contours.visibility import Scene

# Deeper than what there is nothing at.
_DEEPEST = np.iinfo(np.int64).max
# Dot products of a face with a point: within its three edges, and behind its plane.
_TESTS = 4


@kernel()
def hide_behind_faces(
    members: Array, T_cam_obj: Array, triangles: Array, normals: Array, tolerance_m: Array, points_cam: Array, mask: Array, hidden: Array
) -> None:
    """Mark the points of objects of one model that lie behind one of its faces, as the camera sees them.

    Args:
        members: numbers of the objects.
        T_cam_obj: ``[b, 4, 4]``.
        triangles, normals: ``[f, 3, 3]`` and ``[f, 3]``, in the object's frame.
        tolerance_m: ``[b]``.
        points_cam, mask: ``[b, 3, m]``, and which of them count: ``[b, m]``.
        hidden: ``[b, m]``, changed.
    """
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


@kernel(fastmath=FAST)
def _cell(u: float, v: float, first: Numbers, rows_before: int, grid: GridSettings) -> int:
    """The cell of a depth buffer that a pixel falls into; what lies outside falls into the outermost, what is not a number into the first."""
    column, row = np.rint(u / grid.side_px) - first[0], np.rint(v / grid.side_px) - first[1]
    # Written so that what is not a number finds a cell, too.
    column, row = min(column if column > 0 else 0.0, grid.columns - 1.0), min(row if row > 0 else 0.0, grid.rows - 1.0)
    return int((row + rows_before) * grid.columns + column)


@kernel()
def around(pixels: Array, mask: Array, stream_index: Array, cell_px: float, height: int, width: int, first: Array) -> tuple[int, int]:
    """Rows and columns of depth buffers that hold what is asked for: :meth:`torchtrack.tracking.contours.visibility.DepthGrid.around`.

    Args:
        pixels, mask: ``[b, 2, m]`` and ``[b, m]``.
        height, width: of the image (px); pixels outside it are not asked for.
        first: ``[s, 2]``, filled: first cell (column, row) of each stream's buffer.
    """
    last = np.full(first.shape, -np.inf)
    first[:] = np.inf
    for b in range(len(mask)):
        low, high = first[stream_index[b]], last[stream_index[b]]
        for i in range(mask.shape[1]):
            u, v = pixels[b, 0, i], pixels[b, 1, i]
            if mask[b, i] and u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1:
                low[0], low[1], high[0], high[1] = min(low[0], u), min(low[1], v), max(high[0], u), max(high[1], v)
    columns, rows = 0.0, 0.0
    for s in range(len(first)):
        if not np.isfinite(first[s, 0]):
            first[s] = 0.0
            continue
        for k in range(2):
            # Beside the pixels, and one more that takes what lies outside.
            first[s, k], last[s, k] = np.floor(first[s, k] / cell_px) - 2.0, np.ceil(last[s, k] / cell_px) + 2.0
        columns, rows = max(columns, last[s, 0] - first[s, 0]), max(rows, last[s, 1] - first[s, 1])
    return int(rows) + 1, int(columns) + 1


@kernel()
def _every(samples: int, T_cam_obj: Array, intrinsics: Array, diameter_m: float, grid: GridSettings) -> int:
    """The so manieth surface sample of an object that is taken, a power of two: :func:`tracking.contours.visibility.depth_buffer` halves them so."""
    size_cells = diameter_m * intrinsics[0] / max(T_cam_obj[2, 3], grid.least_depth_m) / grid.side_px
    spare, every = samples / max(grid.samples_per_cell * size_cells * size_cells, 1.0), 1
    while 2 * every <= spare:
        every *= 2
    return every


@kernel(fastmath=FAST)
def draw(
    members: Array,
    drawn: Array,
    samples: Array,
    T_cam_obj: Array,
    intrinsics: Array,
    diameters_m: Array,
    stream_index: Array,
    first: Array,
    grid: GridSettings,
    depth: Array,
    owner: Array,
) -> None:
    """Draw surface samples of objects of one model into depth buffers; of objects as near, the first stays.

    Args:
        members: numbers of the objects, and which of all are ``drawn [b]``.
        samples: ``[3, n]``, in the object's frame.
        first: ``[s, 2]``, first cell of each stream's buffer.
        depth, owner: ``[p]``, depths in whole steps, and the object of each; changed.
    """
    cells, steps = np.empty(samples.shape[1], np.int32), np.empty(samples.shape[1], np.int64)
    for b in members:
        if not drawn[b]:
            continue
        every = _every(samples.shape[1], T_cam_obj[b], intrinsics[b], diameters_m[b], grid)
        taken, stream = samples if every == 1 else samples[:, ::every].copy(), stream_index[b]
        _place(taken, entries(T_cam_obj[b]), lens(intrinsics[b]), (first[stream, 0], first[stream, 1]), stream * grid.rows, grid, cells, steps)
        for i in range(taken.shape[1]):
            cell = np.uint64(cells[i])
            if steps[i] < depth[cell] or (steps[i] == depth[cell] and b < owner[cell]):
                depth[cell], owner[cell] = steps[i], b


@kernel(fastmath=FAST)
def _place(
    samples: Array,
    pose: Numbers,
    intrinsics: Numbers,
    first: Numbers,
    rows_before: int,
    grid: GridSettings,
    cells: Array,
    steps: Array,
) -> None:
    """Cells of surface samples, and their depths in whole steps, several at once; deeper than all else what is not before the camera."""
    points_x, points_y, points_z = samples[0], samples[1], samples[2]
    for i in range(samples.shape[1]):
        x, y, z = placed(pose, points_x[i], points_y[i], points_z[i])
        inverse = inverse_depth(z)
        cells[i] = _cell(x * inverse * intrinsics[0] + intrinsics[2], y * inverse * intrinsics[1] + intrinsics[3], first, rows_before, grid)
        steps[i] = np.int64(z * grid.steps_per_m) if z > grid.least_depth_m else _DEEPEST


@kernel(fastmath=FAST)
def hide_in_buffer(
    points_cam: Array,
    pixels: Array,
    normals: Array,
    mask: Array,
    exact: Array,
    margin_m: Array,
    stream_index: Array,
    first: Array,
    grid: GridSettings,
    depth: Array,
    owner: Array,
    hidden: Array,
) -> None:
    """Mark points in the image behind a surface in the depth buffer, there and a cell to each side of their contour.

    Args:
        points_cam, pixels, normals: ``[b, 3, m]``, ``[b, 2, m]``, ``[b, 2, m]``; ``mask [b, m]``.
        exact: ``[b]``, objects that their own surface does not count for.
        margin_m: ``[b]``, how far behind it is hidden.
        hidden: ``[b, m]``, changed.
    """
    for b in range(len(mask)):
        stream = stream_index[b]
        own_first, rows_before = (first[stream, 0], first[stream, 1]), stream * grid.rows
        for i in range(mask.shape[1]):
            u, v = pixels[b, 0, i], pixels[b, 1, i]
            if not mask[b, i] or not (u >= 0 and v >= 0 and u <= grid.width - 1 and v <= grid.height - 1):
                continue
            behind, farthest_m = True, points_cam[b, 2, i] - margin_m[b]
            for side in (0.0, -grid.side_px, grid.side_px):
                cell = _cell(u + side * normals[b, 0, i], v + side * normals[b, 1, i], own_first, rows_before, grid)
                counts = not exact[b] or owner[cell] != b
                behind = behind and counts and farthest_m > depth[cell] / grid.steps_per_m
            hidden[b, i] = hidden[b, i] or behind


@kernel()
def meet(pixels: Array, mask: Array, depth_m: Array, stream_index: Array, diameters_m: Array, beside_px: float, meets: Array) -> None:
    """Which objects may be before another one of their stream: :func:`torchtrack.tracking.contours.visibility.may_overlap_others`.

    Args:
        pixels, mask, depth_m: of contours: ``[b, 2, m]``, ``[b, m]`` and ``[b, m]``.
        meets: ``[b]``, filled.
    """
    low, high, close = np.full((len(mask), 2), np.inf, pixels.dtype), np.full((len(mask), 2), -np.inf, pixels.dtype), np.zeros(len(mask), np.bool_)
    for b in range(len(mask)):
        for i in range(mask.shape[1]):
            if mask[b, i]:
                close[b] |= depth_m[b, i] < diameters_m[b]
                for k in range(2):
                    low[b, k], high[b, k] = min(low[b, k], pixels[b, k, i]), max(high[b, k], pixels[b, k, i])
        low[b] -= beside_px
    for b in range(len(mask)):
        meets[b] = False
        for other in range(len(mask)):
            apart = low[b, 0] > high[other, 0] or low[b, 1] > high[other, 1] or low[other, 0] > high[b, 0] or low[other, 1] > high[b, 1]
            is_beside = close[b] or close[other] or not apart
            meets[b] |= is_beside and other != b and stream_index[b] == stream_index[other]


@accelerates(visibility.may_overlap_others)
def may_overlap_others_numba(scene: Scene, contours: Contours, cell_px: int) -> Bool[Tensor, "b"]:
    """Point by point."""
    meets = torch.empty_like(scene.stream_index, dtype=torch.bool)
    seen = as_arrays(contours.pixels.transpose(1, 2), contours.mask, contours.points_cam[..., 2], scene.stream_index, scene.diameters_m)
    meet(*seen, visibility.OVERLAP_CELLS * cell_px, meets.numpy())
    return meets


@accelerates(visibility.hidden_by_self)
def hidden_by_self_numba(scene: Scene, contours: Contours) -> Bool[Tensor, "b m"]:
    """Object by object."""
    hidden = torch.zeros_like(contours.mask)
    points = as_arrays(contours.points_cam.transpose(1, 2), contours.mask)
    T_cam_obj, tolerance_m = as_arrays(scene.T_cam_obj, visibility.ON_FACE * scene.diameters_m)
    for model in scene.models:
        of_model = arrays_of(model)
        if len(of_model.faces[0]):
            hide_behind_faces(of_model.members, T_cam_obj, *of_model.faces, tolerance_m, *points, hidden.numpy())
    return hidden


@accelerates(visibility.hidden_in_buffer)
def hidden_in_buffer_numba(scene: Scene, contours: Contours, drawn: Bool[Tensor, "b"], exact: Bool[Tensor, "b 1"]) -> Bool[Tensor, "b m"]:
    """Sample by sample and point by point."""
    streams, height, width = scene.image_shape
    hidden, margin_m, first = torch.zeros_like(contours.mask), visibility.DEPTH_MARGIN * scene.diameters_m, np.empty((streams, 2))
    points_cam, pixels, normals, mask = as_arrays(
        *(value.transpose(1, 2) for value in (contours.points_cam, contours.pixels, contours.normals)), contours.mask
    )
    T_cam_obj, intrinsics, stream_index, diameters_m = as_arrays(scene.T_cam_obj, scene.intrinsics, scene.stream_index, scene.diameters_m)
    cell_px = float(visibility.DEPTH_CELL_PX)
    rows, columns = around(pixels, mask, stream_index, cell_px, height, width, first)
    steps_per_m, enough = visibility.DEPTH_STEPS_PER_M, visibility.SAMPLES_PER_CELL
    settings = GridSettings(rows, columns, cell_px, height, width, steps_per_m, MIN_DEPTH_M, enough)
    depth, owner = (np.full(streams * rows * columns, value) for value in (visibility.NOTHING, len(drawn)))
    is_drawn = drawn.numpy()
    for model in scene.models:
        of_model = arrays_of(model)
        draw(of_model.members, is_drawn, of_model.surface, T_cam_obj, intrinsics, diameters_m, stream_index, first, settings, depth, owner)
    own = as_arrays(exact[:, 0], margin_m)
    hide_in_buffer(points_cam, pixels, normals, mask, *own, stream_index, first, settings, depth, owner, hidden.numpy())
    return hidden
