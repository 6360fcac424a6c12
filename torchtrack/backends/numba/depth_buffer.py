"""Contour points behind what is drawn in a depth buffer: :func:`torchtrack.tracking.contours.depth_buffer.hidden_in_buffer`, sample by sample."""

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, entries, inverse_depth, lens, placed
from torchtrack.backends.numba.models import arrays_of
from torchtrack.backends.numba.parameters import GridSettings
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.contours import depth_buffer
from torchtrack.tracking.contours.depth_buffer import Scene
from torchtrack.tracking.contours.points import Contours


@kernel(fastmath=FAST)
def _cell(u: float, v: float, first: Numbers, rows_before: int, grid: GridSettings) -> int:
    """The cell of a depth buffer that a pixel falls into; what lies outside falls into the outermost, what is not a number into the first."""
    column, row = np.rint(u / grid.side_px) - first[0], np.rint(v / grid.side_px) - first[1]
    # Written so that what is not a number finds a cell, too.
    column, row = min(column if column > 0 else 0.0, grid.columns - 1.0), min(row if row > 0 else 0.0, grid.rows - 1.0)
    return int((row + rows_before) * grid.columns + column)


@kernel()
def around(pixels: Array, mask: Array, stream_index: Array, cell_px: float, height: int, width: int, first: Array) -> tuple[int, int]:
    """Rows and columns of depth buffers that hold what is asked for: :meth:`torchtrack.tracking.contours.depth_buffer.DepthGrid.around`.

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
    nearest: Array,
    used: Array,
) -> None:
    """Draw surface samples of objects of one model into depth buffers; of objects as near, the first stays.

    Args:
        members: numbers of the objects, and which of all are ``drawn [b]``.
        samples: ``[3, n]``, in the object's frame.
        first: ``[s, 2]``, first cell of each stream's buffer.
        nearest: ``[k, p]``, depths in whole steps with the object in the low bits; a row for each size of holes; changed.
        used: ``[k]``, whether anything was drawn there; changed.
    """
    cells, keys = np.empty(samples.shape[1], np.int32), np.empty(samples.shape[1], np.int64)
    for b in members:
        if not drawn[b]:
            continue
        every, side = _density(samples.shape[1], T_cam_obj[b], intrinsics[b], diameters_m[b], grid)
        taken, stream, own = samples if every == 1 else samples[:, ::every].copy(), stream_index[b], nearest[side - 1]
        used[side - 1] = True
        _place(taken, entries(T_cam_obj[b]), lens(intrinsics[b]), (first[stream, 0], first[stream, 1]), stream * grid.rows, grid, cells, keys)
        for i in range(taken.shape[1]):
            cell = np.uint64(cells[i])
            own[cell] = min(own[cell], keys[i] + b)


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
def _place(
    samples: Array,
    pose: Numbers,
    intrinsics: Numbers,
    first: Numbers,
    rows_before: int,
    grid: GridSettings,
    cells: Array,
    keys: Array,
) -> None:
    """Cells of surface samples, and their depths in whole steps above the bits for an object, several at once; nothing behind the camera."""
    points_x, points_y, points_z = samples[0], samples[1], samples[2]
    for i in range(samples.shape[1]):
        x, y, z = placed(pose, points_x[i], points_y[i], points_z[i])
        inverse = inverse_depth(z)
        cells[i] = _cell(x * inverse * intrinsics[0] + intrinsics[2], y * inverse * intrinsics[1] + intrinsics[3], first, rows_before, grid)
        keys[i] = np.int64(z * grid.steps_per_m) << grid.object_bits if z > grid.least_depth_m else grid.nothing


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
    nearest: Array,
    hidden: Array,
) -> None:
    """Mark points in the image behind a surface in the depth buffer, there and a cell to each side of their contour.

    Args:
        points_cam, pixels, normals: ``[b, 3, m]``, ``[b, 2, m]``, ``[b, 2, m]``; ``mask [b, m]``.
        exact: ``[b]``, objects that their own surface does not count for.
        margin_m: ``[b]``, how far behind it is hidden.
        nearest: ``[p]``, as :func:`draw` has them.
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
                owner, steps = nearest[cell] & ((1 << grid.object_bits) - 1), nearest[cell] >> grid.object_bits
                behind = behind and (not exact[b] or owner != b) and farthest_m > steps / grid.steps_per_m
            hidden[b, i] = hidden[b, i] or behind


@accelerates(depth_buffer.hidden_in_buffer)
def hidden_in_buffer_numba(scene: Scene, contours: Contours, drawn: Bool[Tensor, "b"], exact: Bool[Tensor, "b 1"]) -> Bool[Tensor, "b m"]:
    """Sample by sample and point by point."""
    streams, height, width = scene.image_shape
    hidden, margin_m, first = torch.zeros_like(contours.mask), depth_buffer.DEPTH_MARGIN * scene.diameters_m, np.empty((streams, 2))
    points_cam, pixels, normals, mask = as_arrays(
        *(value.transpose(1, 2) for value in (contours.points_cam, contours.pixels, contours.normals)), contours.mask
    )
    T_cam_obj, intrinsics, stream_index, diameters_m = as_arrays(scene.T_cam_obj, scene.intrinsics, scene.stream_index, scene.diameters_m)
    cell_px = float(depth_buffer.DEPTH_CELL_PX)
    rows, columns = around(pixels, mask, stream_index, cell_px, height, width, first)
    depths = depth_buffer.DEPTH_STEPS_PER_M, MIN_DEPTH_M, depth_buffer.OBJECT_BITS, depth_buffer.NOTHING
    squares = depth_buffer.SAMPLES_PER_CELL, depth_buffer.SAMPLES_PER_SQUARE, depth_buffer.MOST_CELLS
    settings = GridSettings(rows, columns, cell_px, height, width, *depths, *squares)
    of_each = np.full((depth_buffer.MOST_CELLS, streams * rows * columns), depth_buffer.NOTHING)
    used, is_drawn = np.zeros(len(of_each), np.bool_), drawn.numpy()
    for model in scene.models:
        of_model = arrays_of(model)
        draw(of_model.members, is_drawn, of_model.surface, T_cam_obj, intrinsics, diameters_m, stream_index, first, settings, of_each, used)
    nearest = of_each[0]
    for row in used[1:].nonzero()[0] + 1:
        close(of_each[row].reshape(streams, rows, columns), row + 1)
        np.minimum(nearest, of_each[row], out=nearest)
    hide_in_buffer(points_cam, pixels, normals, mask, *as_arrays(exact[:, 0], margin_m), stream_index, first, settings, nearest, hidden.numpy())
    return hidden
