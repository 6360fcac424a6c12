"""Numba kernels that find the nearest face at every sample (extra ``sim``); :mod:`torchtrack.sim.render` prepares their arrays.

Triangles are drawn in homogeneous coordinates (Olano & Greer 1997, *Triangle scan conversion using 2D homogeneous
coordinates*): with the corners ``A B C`` of a triangle in the camera frame and the ray ``d = ((u-cx)/fx, (v-cy)/fy, 1)``,
``[a b c] = [A B C]⁻¹ d`` are affine in the pixel, their sum is the inverse depth, and divided by it they are the
perspective-correct barycentric coordinates. Triangles that cross the camera plane need no clipping.

Samples of a pixel lie beside one another in memory, sample ``s`` at ``offsets[s]`` from the pixel's centre: a small face touches
few cache lines, and a pixel's samples are tested in one go. Coordinates are float64 up to the pixel's centre, float32 from there.
"""

from typing import NamedTuple

import numpy as np

from torchtrack.backends.numba.compiler import Array, kernel

# A triangle is seen edge-on, or is a sliver, when its volume with the camera is below this share of its corners' distances.
_SLIVER = 1e-13


class Faces(NamedTuple):
    """All faces in the camera frame.

    Args:
        corners: ``[f, 3, 3]`` (m).
        normals: ``[f, 3, 3]`` unit normals of the corners, float32.
        is_seen: ``[f]`` whether it is no back of a closed surface.
        planes: ``[f, 3, 3]`` coefficients of the barycentric coordinates over the inverse depth, affine in the pixel of a region.
    """

    corners: Array
    normals: Array
    is_seen: Array
    planes: Array


class View(NamedTuple):
    """The region of the image that is drawn.

    Args:
        intrinsics: ``fx, fy, cx, cy`` (px), and the depth that nothing is drawn before (m).
        origin: ``[2]`` its first column and row.
        offsets: ``[s, 2]`` of the samples from the centre of their pixel (px).
    """

    intrinsics: Array
    origin: Array
    offsets: Array


class Samples(NamedTuple):
    """What the samples of a region show.

    Args:
        inverse_depth: ``[h, w, s]`` (1/m), float32.
        face_index: ``[h, w, s]``; -1 where there is none.
    """

    inverse_depth: Array
    face_index: Array


@kernel()
def place(corners_obj: Array, normals_obj: Array, face_object: Array, pose: Array, is_closed: Array, faces: Faces) -> None:
    """Move all faces to the camera frame; normals are turned towards the camera, and backs of closed surfaces marked as unseen.

    Args:
        corners_obj, normals_obj: ``[f, 3, 3]``, each in the frame of its object.
        face_object: ``[f]`` number of the object.
        pose: ``[o, 4, 4]``.
        is_closed: ``[o]``.
        faces: all but its planes are filled.
    """
    corners, normals, is_seen, _ = faces
    for f in range(len(corners_obj)):
        T = pose[face_object[f]]
        for k in range(3):
            x, y, z = corners_obj[f, k, 0], corners_obj[f, k, 1], corners_obj[f, k, 2]
            for i in range(3):
                corners[f, k, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3]
        faces_camera = _determinant(corners[f, 0], corners[f, 1], corners[f, 2]) < 0
        is_seen[f] = faces_camera or not is_closed[face_object[f]]
        sign = 1.0 if faces_camera else -1.0
        for k in range(3):
            x, y, z = sign * normals_obj[f, k, 0], sign * normals_obj[f, k, 1], sign * normals_obj[f, k, 2]
            for i in range(3):
                normals[f, k, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z


@kernel()
def _determinant(a: Array, b: Array, c: Array) -> float:
    """Six times the volume between three points and the camera; negative where they go round counterclockwise, seen from there."""
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])


@kernel()
def _setup(corners: Array, intrinsics: Array, origin: Array, plane: Array) -> bool:
    """Affine coefficients ``plane [3, 3]`` of each barycentric coordinate over the inverse depth; whether the face can be drawn."""
    fx, fy, cx, cy, near = intrinsics
    a, b, c = corners[0], corners[1], corners[2]
    det = _determinant(a, b, c)
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
def _span(plane: Array, reach: Array, row: float, width: int) -> tuple[int, int]:
    """First and last column of a row where a pixel may have a sample inside the face."""
    low, high = 0.0, width - 1.0
    for k in range(3):
        slope = plane[k, 0]
        value = plane[k, 1] * row + plane[k, 2] + reach[k]
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
def _steps(plane: Array, offsets: Array, steps: Array, reach: Array) -> None:
    """How the three coordinates and their sum differ from the pixel's centre at each sample, and by how much at the most."""
    for k in range(3):
        reach[k] = 0.0
        for s in range(len(offsets)):
            step = plane[k, 0] * offsets[s, 0] + plane[k, 1] * offsets[s, 1]
            steps[k, s] = step
            reach[k] = max(reach[k], step)
    for s in range(len(offsets)):
        steps[3, s] = steps[0, s] + steps[1, s] + steps[2, s]


@kernel()
def _test(f: int, centre: tuple[float, float, float], limits: tuple[float, float, float], steps: Array, nearest: Array, faces: Array) -> None:
    """Put a face on those samples of one pixel that it covers and where it is nearer than what was drawn before."""
    a, b, c = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    total = np.float32(centre[0] + centre[1] + centre[2])
    lowest, highest, cut = np.float32(limits[0]), np.float32(limits[1]), np.float32(limits[2])
    for s in range(len(nearest)):
        value = total + steps[3, s]
        inside = (a + steps[0, s] >= 0) & (b + steps[1, s] >= 0) & (c + steps[2, s] >= 0) & (value <= cut)
        # A sliver's inverse depth is badly conditioned, but it lies between those of its corners.
        value = min(max(value, lowest), highest)
        hit = inside & (value > nearest[s])
        nearest[s] = value if hit else nearest[s]
        faces[s] = f if hit else faces[s]


@kernel()
def _draw_face(f: int, corners: Array, plane: Array, view: View, work: Array, samples: Samples) -> None:
    """Put one face wherever it is nearer than what was drawn before; ``work [4, s]`` is room for the steps."""
    inverse_depth, face_index = samples
    height, width, _ = inverse_depth.shape
    intrinsics, origin, offsets = view
    farthest, nearest = corners[:, 2].max(), corners[:, 2].min()
    highest = 1.0 / max(nearest, intrinsics[4])
    # What lies before the near plane is cut off.
    limits = (1.0 / farthest, highest, highest if nearest < intrinsics[4] else np.inf)
    reach = np.empty(3)
    _steps(plane, offsets, work, reach)
    first_row, end_row = _row_range(corners, intrinsics, origin, height)
    for row in range(first_row, end_row):
        first, last = _span(plane, reach, row, width)
        for col in range(first, last + 1):
            a = plane[0, 0] * col + plane[0, 1] * row + plane[0, 2]
            b = plane[1, 0] * col + plane[1, 1] * row + plane[1, 2]
            c = plane[2, 0] * col + plane[2, 1] * row + plane[2, 2]
            _test(f, (a, b, c), limits, work, inverse_depth[row, col], face_index[row, col])


@kernel()
def draw(faces: Faces, ranges: Array, view: View, samples: Samples) -> None:
    """Find the nearest face at every sample, among those seen in ``ranges [r, 2]`` (first, end); fills their planes, and ``samples``."""
    corners, _, is_seen, planes = faces
    intrinsics, origin, offsets = view
    samples.inverse_depth[:] = 0
    samples.face_index[:] = -1
    work = np.empty((4, len(offsets)), dtype=np.float32)
    for r in range(len(ranges)):
        for f in range(ranges[r, 0], ranges[r, 1]):
            if is_seen[f] and _setup(corners[f], intrinsics, origin, planes[f]):
                _draw_face(f, corners[f], planes[f], view, work, samples)
