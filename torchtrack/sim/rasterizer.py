"""Numba kernels that find the nearest face at every sample (extra ``sim``); :mod:`torchtrack.sim.render` prepares their arrays.

Triangles are drawn in homogeneous coordinates (Olano & Greer 1997, *Triangle scan conversion using 2D homogeneous
coordinates*): with the corners ``A B C`` of a triangle in the camera frame and the ray ``d = ((u-cx)/fx, (v-cy)/fy, 1)``,
``[a b c] = [A B C]⁻¹ d`` are affine in the pixel, their sum is the inverse depth, and divided by it they are the
perspective-correct barycentric coordinates. Triangles that cross the camera plane need no clipping.

Samples: phase ``s`` holds one sample of every pixel of the region, ``offsets[s]`` from the pixel's centre.
"""

import inspect
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

Array = np.ndarray

# A triangle is seen edge-on, or is a sliver, when its volume with the camera is below this share of its corners' distances.
_SLIVER = 1e-13


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: compile with numba; the compiled code is kept on disk where there is a place for it."""

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        function = inspect.unwrap(function)  # a type checker's wrapper cannot be compiled
        try:
            return numba.njit(function, cache=True, error_model="numpy", **options)
        except RuntimeError:  # numba found no folder that it may write to (a read-only installation)
            return numba.njit(function, error_model="numpy", **options)

    return compiled


@kernel()
def _setup(corners: Array, intrinsics: Array, origin: Array, plane: Array) -> bool:
    """Affine coefficients ``plane [3, 3]`` of each barycentric coordinate over the inverse depth; whether the face can be drawn."""
    fx, fy, cx, cy, near = intrinsics
    a, b, c = corners[0], corners[1], corners[2]
    det = a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    scale = np.sqrt((a * a).sum() * (b * b).sum() * (c * c).sum())
    # Written so that a corner that is not a number fails it too.
    if not (abs(det) > _SLIVER * scale and max(a[2], b[2], c[2]) > near):
        return False
    for k in range(3):
        p, q = corners[(k + 1) % 3], corners[(k + 2) % 3]
        gx = (p[1] * q[2] - p[2] * q[1]) / det / fx
        gy = (p[2] * q[0] - p[0] * q[2]) / det / fy
        plane[k, 0] = gx
        plane[k, 1] = gy
        plane[k, 2] = (p[0] * q[1] - p[1] * q[0]) / det + gx * (origin[0] - cx) + gy * (origin[1] - cy)
    return True


@kernel()
def _row_range(corners: Array, intrinsics: Array, origin: Array, height: int) -> tuple[int, int]:
    """Rows of the region that a triangle can touch."""
    lowest, highest = 1e30, -1e30
    for k in range(3):
        if corners[k, 2] < intrinsics[4]:
            return 0, height
        v = corners[k, 1] / corners[k, 2] * intrinsics[1] + intrinsics[3] - origin[1]
        lowest, highest = min(lowest, v), max(highest, v)
    # Samples lie within half a pixel of their pixel's centre.
    first = int(min(max(np.floor(lowest - 0.5), 0.0), float(height)))
    last = int(max(min(np.ceil(highest + 0.5) + 1.0, float(height)), 0.0))
    return first, last


@kernel()
def _span(plane: Array, dx: float, row: float, width: int) -> tuple[int, int]:
    """First and last column of a row where all three barycentric coordinates are non-negative."""
    low, high = 0.0, width - 1.0
    for k in range(3):
        slope = plane[k, 0]
        value = plane[k, 1] * row + plane[k, 2] + slope * dx
        if slope > 0:
            low = max(low, np.ceil(-value / slope))
        elif slope < 0:
            high = min(high, np.floor(-value / slope))
        elif value < 0:
            return 0, -1
    if not low <= high:
        return 0, -1
    return int(low), int(high)


@kernel()
def _draw_face(
    f: int, corners: Array, intrinsics: Array, origin: Array, offsets: Array, planes: Array, inverse_depth: Array, face_index: Array
) -> None:
    """Put one face wherever it is nearer than what was drawn before."""
    samples, height, width = inverse_depth.shape
    farthest, nearest = corners[f, :, 2].max(), corners[f, :, 2].min()
    lowest, highest = 1.0 / farthest, 1.0 / max(nearest, intrinsics[4])
    plane = planes[f]
    slope_x = plane[0, 0] + plane[1, 0] + plane[2, 0]
    slope_y = plane[0, 1] + plane[1, 1] + plane[2, 1]
    constant = plane[0, 2] + plane[1, 2] + plane[2, 2]
    first_row, end_row = _row_range(corners[f], intrinsics, origin, height)
    for s in range(samples):
        dx, dy = offsets[s, 0], offsets[s, 1]
        for row in range(first_row, end_row):
            first, last = _span(plane, dx, row + dy, width)
            start = slope_y * (row + dy) + constant + slope_x * dx
            for col in range(first, last + 1):
                value = start + slope_x * col
                if nearest < intrinsics[4] and value > highest:
                    continue
                # A sliver's inverse depth is badly conditioned, but it lies between those of its corners.
                value = min(max(value, lowest), highest)
                if value > inverse_depth[s, row, col]:
                    inverse_depth[s, row, col] = value
                    face_index[s, row, col] = f


@kernel()
def draw(
    corners: Array, ranges: Array, intrinsics: Array, origin: Array, offsets: Array, planes: Array, inverse_depth: Array, face_index: Array
) -> None:
    """Find the nearest face at every sample, among the faces in ``ranges [r, 2]`` (first, end).

    Fills ``planes [f, 3, 3]`` for those faces, ``inverse_depth`` and ``face_index [s, h, w]`` (-1 where there is none).
    """
    inverse_depth[:] = 0
    face_index[:] = -1
    for r in range(len(ranges)):
        for f in range(ranges[r, 0], ranges[r, 1]):
            if _setup(corners[f], intrinsics, origin, planes[f]):
                _draw_face(f, corners, intrinsics, origin, offsets, planes, inverse_depth, face_index)
