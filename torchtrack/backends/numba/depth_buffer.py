"""Contour points behind what is drawn in a depth buffer: :func:`torchtrack.tracking.contours.depth_buffer.hidden_in_buffer`, sample by sample."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from torchtrack.backends.numba.arrays import ContourArrays, as_arrays, contour_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, entries, inverse_depth, lens, placed
from torchtrack.backends.numba.models import arrays_of
from torchtrack.backends.numba.parameters import GridSettings
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours import depth_buffer
from torchtrack.tracking.contours.depth_buffer import Scene
from torchtrack.tracking.contours.points import Contours


class Views(NamedTuple):
    """Objects as cameras see them.

    Args:
        first: ``[s, 2]``, the first cell (column, row) of each stream's buffer.
        T_cam_obj, intrinsics, diameters_m, stream_index: ``[b, 4, 4]``, ``[b, 4]``, and ``[b]``.
        drawn, exact: ``[b]``, which are drawn, and whose own surface does not count for them.
        margin_m: ``[b]``, how far behind a surface their points are hidden.
    """

    first: Array
    T_cam_obj: Array
    intrinsics: Array
    diameters_m: Array
    stream_index: Array
    drawn: Array
    exact: Array
    margin_m: Array


class Buffers(NamedTuple):
    """Depth buffers of all streams, one for each size of holes.

    Args:
        nearest: ``[k, p]``, depths in whole steps with the object in the low bits.
        used: ``[k]``, whether anything was drawn there.
    """

    nearest: Array
    used: Array


class Part(NamedTuple):
    """The part of a buffer that is a stream's: its first cell, and how many rows are before it."""

    column: float
    row: float
    rows_before: int


class Samples(NamedTuple):
    """Where surface samples are drawn, and what: cells, and depths in whole steps above the bits for an object."""

    cells: Array
    keys: Array


@kernel()
def _part_of(views: Views, b: int, grid: GridSettings) -> Part:
    """The part of a buffer that an object is drawn into."""
    stream = views.stream_index[b]
    return Part(views.first[stream, 0], views.first[stream, 1], stream * grid.rows)


@kernel(fastmath=FAST)
def _cell(u: float, v: float, part: Part, grid: GridSettings) -> int:
    """The cell of a depth buffer that a pixel falls into; what lies outside falls into the outermost, what is not a number into the first."""
    column, row = np.rint(u / grid.side_px) - part.column, np.rint(v / grid.side_px) - part.row
    # Written so that what is not a number finds a cell, too.
    column, row = min(column if column > 0 else 0.0, grid.columns - 1.0), min(row if row > 0 else 0.0, grid.rows - 1.0)
    return int((row + part.rows_before) * grid.columns + column)


@kernel()
def around(contours: ContourArrays, stream_index: Array, cell_px: float, size: tuple[int, int], first: Array) -> tuple[int, int]:
    """Rows and columns of depth buffers that hold what is asked for: :meth:`torchtrack.tracking.contours.depth_buffer.DepthGrid.around`.

    Args:
        size: height and width of the image (px); pixels outside it are not asked for.
        first: ``[s, 2]``, filled: first cell (column, row) of each stream's buffer.
    """
    (_, pixels, _, mask, _), (height, width) = contours, size
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
def _density(samples: int, T_cam_obj: Array, intrinsics: Array, diameter_m: float, grid: GridSettings) -> tuple[int, int]:
    """The so manieth surface sample of an object that is taken, a power of two, and the side of squares that fit into no hole between them.

    As :func:`torchtrack.tracking.contours.depth_buffer.depth_buffer` has them.
    """
    size_cells = diameter_m * intrinsics[0] / max(T_cam_obj[2, 3], grid.least_depth_m) / grid.side_px
    spare, every, side = samples / max(grid.samples_per_cell * size_cells * size_cells, 1.0), 1, 1
    while 2 * every <= spare:
        every *= 2
    while side < grid.most_cells and side**2 * spare * grid.samples_per_cell < grid.samples_per_square:
        side += 1
    return every, side


@kernel(fastmath=FAST)
def draw(members: Array, samples: Array, views: Views, grid: GridSettings, buffers: Buffers) -> None:
    """Draw surface samples of objects of one model into depth buffers; of objects as near, the first stays.

    Args:
        members: numbers of the objects.
        samples: ``[3, n]``, in the object's frame.
    """
    views, buffers = Views(*views), Buffers(*buffers)
    room = Samples(np.empty(samples.shape[1], np.int32), np.empty(samples.shape[1], np.int64))
    for b in members:
        if not views.drawn[b]:
            continue
        every, side = _density(samples.shape[1], views.T_cam_obj[b], views.intrinsics[b], views.diameters_m[b], grid)
        taken, own = samples if every == 1 else samples[:, ::every].copy(), buffers.nearest[side - 1]
        buffers.used[side - 1] = True
        _place(taken, entries(views.T_cam_obj[b]), lens(views.intrinsics[b]), _part_of(views, b, grid), grid, room)
        for i in range(taken.shape[1]):
            cell = np.uint64(room.cells[i])
            own[cell] = min(own[cell], room.keys[i] + b)


@kernel()
def close(nearest: Array, side: int) -> None:
    """Close holes that a square of so many cells does not fit into: :func:`torchtrack.tracking.contours.depth_buffer.closed`.

    Args:
        nearest: ``[s, h, w]``, changed.
    """
    for s in range(len(nearest)):
        # The largest value is the smallest of what they are with the other sign.
        for forward in (False, True):
            _put_least(nearest[s], side, forward)
            for i in range(nearest.shape[1]):
                for j in range(nearest.shape[2]):
                    nearest[s, i, j] = -nearest[s, i, j]


@kernel()
def _put_least(values: Array, side: int, forward: bool) -> None:
    """Put the smallest of the square that begins at each cell, or ends there, into it; one way after the other, several cells at once."""
    rows, columns = values.shape
    across = values.copy()
    for i in range(rows):
        for k in range(1, min(side, columns)):
            first, into = (k, 0) if forward else (0, k)
            for j in range(columns - k):
                across[i, into + j] = min(across[i, into + j], values[i, first + j])
    values[:] = across
    for i in range(rows):
        for k in range(1, side):
            other = i + k if forward else i - k
            if 0 <= other < rows:
                for j in range(columns):
                    values[i, j] = min(values[i, j], across[other, j])


@kernel(fastmath=FAST)
def _place(samples: Array, pose: Numbers, intrinsics: Numbers, part: Part, grid: GridSettings, placed_at: Samples) -> None:
    """Cells of surface samples, and their depths, several at once; nothing behind the camera."""
    (points_x, points_y, points_z), (cells, keys) = (samples[0], samples[1], samples[2]), placed_at
    for i in range(samples.shape[1]):
        x, y, z = placed(pose, points_x[i], points_y[i], points_z[i])
        inverse = inverse_depth(z)
        cells[i] = _cell(x * inverse * intrinsics[0] + intrinsics[2], y * inverse * intrinsics[1] + intrinsics[3], part, grid)
        keys[i] = np.int64(z * grid.steps_per_m) << grid.object_bits if z > grid.least_depth_m else grid.nothing


@kernel(fastmath=FAST)
def hide_in_buffer(contours: ContourArrays, views: Views, grid: GridSettings, nearest: Array, hidden: Array) -> None:
    """Mark points in the image behind a surface in the depth buffer, there and a cell to each side of their contour.

    Args:
        nearest: ``[p]``, as :func:`draw` has them.
        hidden: ``[b, m]``, changed.
    """
    (points_cam, pixels, normals, mask, _), views = contours, Views(*views)
    for b in range(len(mask)):
        part, is_exact = _part_of(views, b, grid), views.exact[b]
        for i in range(mask.shape[1]):
            u, v = pixels[b, 0, i], pixels[b, 1, i]
            if not mask[b, i] or not (u >= 0 and v >= 0 and u <= grid.width - 1 and v <= grid.height - 1):
                continue
            behind, farthest_m = True, points_cam[b, 2, i] - views.margin_m[b]
            for side in (0.0, -grid.side_px, grid.side_px):
                cell = _cell(u + side * normals[b, 0, i], v + side * normals[b, 1, i], part, grid)
                owner, steps = nearest[cell] & ((1 << grid.object_bits) - 1), nearest[cell] >> grid.object_bits
                behind = behind and (not is_exact or owner != b) and farthest_m > steps / grid.steps_per_m
            hidden[b, i] = hidden[b, i] or behind


@accelerates(depth_buffer.hidden_in_buffer)
def hidden_in_buffer_numba(scene: Scene, contours: Contours, drawn: Bool[Tensor, "b"], exact: Bool[Tensor, "b 1"]) -> Bool[Tensor, "b m"]:
    """Sample by sample and point by point."""
    (streams, height, width), first = scene.image_shape, np.empty((scene.image_shape[0], 2))
    hidden, margin_m, points = torch.zeros_like(contours.mask), depth_buffer.DEPTH_MARGIN * scene.diameters_m, contour_arrays(contours)
    seen = as_arrays(scene.T_cam_obj, scene.intrinsics, scene.diameters_m, scene.stream_index, drawn, exact[:, 0], margin_m)
    views, cell_px = (first, *seen), float(depth_buffer.DEPTH_CELL_PX)
    rows, columns = around(points, seen[3], cell_px, (height, width), first)
    depths = depth_buffer.DEPTH_STEPS_PER_M, MIN_DEPTH_M, depth_buffer.OBJECT_BITS, depth_buffer.NOTHING
    squares = depth_buffer.SAMPLES_PER_CELL, depth_buffer.SAMPLES_PER_SQUARE, depth_buffer.MOST_CELLS
    settings = GridSettings(rows, columns, cell_px, height, width, *depths, *squares)
    of_each = np.full((depth_buffer.MOST_CELLS, streams * rows * columns), depth_buffer.NOTHING)
    used = np.zeros(len(of_each), np.bool_)
    for model in scene.models:
        of_model = arrays_of(model)
        draw(of_model.members, of_model.surface, views, settings, (of_each, used))
    nearest = of_each[0]
    for row in used[1:].nonzero()[0] + 1:
        close(of_each[row].reshape(streams, rows, columns), row + 1)
        np.minimum(nearest, of_each[row], out=nearest)
    hide_in_buffer(points, views, settings, nearest, hidden.numpy())
    return hidden
