"""Numba kernels of the z-buffer rasteriser (extra ``sim``); :mod:`torchtrack.sim.render` prepares their arrays.

Triangles are drawn in homogeneous coordinates (Olano & Greer 1997, *Triangle scan conversion using 2D homogeneous
coordinates*): with the corners ``A B C`` of a triangle in the camera frame and the ray ``d = ((u-cx)/fx, (v-cy)/fy, 1)``,
``[a b c] = [A B C]⁻¹ d`` are affine in the pixel, their sum is the inverse depth, and divided by it they are the
perspective-correct barycentric coordinates. Triangles that cross the camera plane need no clipping.

Samples: phase ``s`` holds one sample of every pixel of the region, ``offsets[s]`` from the pixel's centre.
"""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np

Array = np.ndarray
Triple = tuple[float, float, float]

# No "nnan" and no "ninf": comparisons must keep their meaning for numbers that are not finite.
_FAST = {"contract", "arcp", "nsz", "reassoc"}
# A triangle is seen edge-on, or is a sliver, when its volume with the camera is below this share of its corners' distances.
_SLIVER = 1e-13


class Surface(NamedTuple):
    """Look of ``f`` faces, camera frame; everything float32 but for the indices."""

    uv: Array  # [f, 3, 2] texture coordinates of the corners, v downwards
    albedo: Array  # [f, 3] reflectance of the corners, which multiplies the texture
    normals: Array  # [f, 3, 3] unit normals of the corners
    is_flat: Array  # [f] bool: the three normals are the same
    texture: Array  # [f, 3] int64: where its texture starts in ``texels``, its width and height
    texels: Array  # [n] reflectances of all textures, row by row
    face_object: Array  # [f] int64
    gloss: Array  # [f] strength of the highlight


class Lighting(NamedTuple):
    """One distant light and ambient light."""

    ambient: float
    diffuse: float
    direction: Array  # [3] unit vector towards the light, camera frame


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


@kernel(fastmath=_FAST)
def _texel(texels: Array, offset: int, width: int, height: int, u: float, v: float) -> float:
    """Bilinear look-up at texture coordinates, which repeat outside 0..1 (``v`` counts downwards here)."""
    x = (u - np.floor(u)) * width - 0.5
    y = (v - np.floor(v)) * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    x1 = x0 + 1 if x0 + 1 < width else 0
    y1 = y0 + 1 if y0 + 1 < height else 0
    x0 = x0 if x0 >= 0 else width - 1
    y0 = y0 if y0 >= 0 else height - 1
    top = texels[offset + y0 * width + x0] * (1 - fx) + texels[offset + y0 * width + x1] * fx
    bottom = texels[offset + y1 * width + x0] * (1 - fx) + texels[offset + y1 * width + x1] * fx
    return top * (1 - fy) + bottom * fy


@kernel(fastmath=_FAST)
def _reflectance(f: int, weights: Triple, surface: Surface) -> float:
    """Diffuse reflectance of a face at barycentric ``weights``: corner values times texture."""
    w0, w1, w2 = weights
    albedo, uv, texture = surface.albedo, surface.uv, surface.texture
    value = w0 * albedo[f, 0] + w1 * albedo[f, 1] + w2 * albedo[f, 2]
    offset, width, height = texture[f, 0], texture[f, 1], texture[f, 2]
    if width * height == 1:
        return value * surface.texels[offset]
    u = w0 * uv[f, 0, 0] + w1 * uv[f, 1, 0] + w2 * uv[f, 2, 0]
    v = w0 * uv[f, 0, 1] + w1 * uv[f, 1, 1] + w2 * uv[f, 2, 1]
    return value * _texel(surface.texels, offset, width, height, u, v)


@kernel(fastmath=_FAST)
def _weights(planes: Array, f: int, x: float, y: float) -> Triple:
    """Barycentric coordinates at a point of the region, kept inside the triangle."""
    w0 = planes[f, 0, 0] * x + planes[f, 0, 1] * y + planes[f, 0, 2]
    w1 = planes[f, 1, 0] * x + planes[f, 1, 1] * y + planes[f, 1, 2]
    w2 = planes[f, 2, 0] * x + planes[f, 2, 1] * y + planes[f, 2, 2]
    w0, w1, w2 = max(w0, 0.0), max(w1, 0.0), max(w2, 0.0)
    total = w0 + w1 + w2
    if not total > 0:
        return 1.0, 0.0, 0.0
    return w0 / total, w1 / total, w2 / total


@kernel(fastmath=_FAST)
def _normal(f: int, weights: Triple, normals: Array, is_flat: Array) -> Triple:
    """Unit normal of a face at barycentric ``weights``."""
    if is_flat[f]:
        return normals[f, 0, 0], normals[f, 0, 1], normals[f, 0, 2]
    w0, w1, w2 = weights
    x = w0 * normals[f, 0, 0] + w1 * normals[f, 1, 0] + w2 * normals[f, 2, 0]
    y = w0 * normals[f, 0, 1] + w1 * normals[f, 1, 1] + w2 * normals[f, 2, 1]
    z = w0 * normals[f, 0, 2] + w1 * normals[f, 1, 2] + w2 * normals[f, 2, 2]
    norm = np.sqrt(x * x + y * y + z * z)
    if not norm > 1e-6:
        return normals[f, 0, 0], normals[f, 0, 1], normals[f, 0, 2]
    return x / norm, y / norm, z / norm


@kernel(fastmath=_FAST)
def _half_vector(u: float, v: float, intrinsics: Array, light: Array) -> Triple:
    """Unit vector halfway between the directions to the light and to the camera (Blinn 1977)."""
    x, y = -(u - intrinsics[2]) / intrinsics[0], -(v - intrinsics[3]) / intrinsics[1]
    norm = np.sqrt(x * x + y * y + 1)
    x, y, z = x / norm + light[0], y / norm + light[1], -1 / norm + light[2]
    norm = max(np.sqrt(x * x + y * y + z * z), 1e-6)
    return x / norm, y / norm, z / norm


@kernel()
def _vote(votes: Array, background: int, depth: Array, object_index: Array, row: int, col: int) -> None:
    """Give the pixel to whoever holds most of its samples; inverse depth is affine, so its mean is that of the centre."""
    best, count = -1, float(background)
    for k in range(len(votes)):
        if votes[k, 0] > count:
            best, count = k, votes[k, 0]
    if best >= 0:
        object_index[row, col] = best
        depth[row, col] = count / votes[best, 1]


@kernel(fastmath=_FAST)
def _light(f: int, weights: Triple, half: Triple, surface: Surface, lighting: Lighting) -> tuple[float, float]:
    """Diffuse light and highlight on a face at barycentric ``weights`` (Blinn 1977)."""
    nx, ny, nz = _normal(f, weights, surface.normals, surface.is_flat)
    light = lighting.direction
    lambert = max(nx * light[0] + ny * light[1] + nz * light[2], 0.0)
    shine = max(nx * half[0] + ny * half[1] + nz * half[2], 0.0)
    for _ in range(5):  # to the power of 32
        shine *= shine
    return lighting.ambient + lighting.diffuse * lambert, surface.gloss[f] * shine


@kernel(fastmath=_FAST)
def _one_face(f: int, row: int, col: int, planes: Array, offsets: Array, half: Triple, surface: Surface, lighting: Lighting) -> float:
    """Luminance of a pixel that one face fills: light changes slowly and is taken at the centre, texture at every sample."""
    diffuse, highlight = _light(f, _weights(planes, f, col, row), half, surface, lighting)
    # Without a texture the reflectance is nearly affine, so the centre speaks for all.
    if surface.texture[f, 1] * surface.texture[f, 2] == 1:
        return _reflectance(f, _weights(planes, f, col, row), surface) * diffuse + highlight
    total = 0.0
    for s in range(len(offsets)):
        total += _reflectance(f, _weights(planes, f, col + offsets[s, 0], row + offsets[s, 1]), surface)
    return total / len(offsets) * diffuse + highlight


@kernel()
def _common_face(face_index: Array, row: int, col: int) -> int:
    """The face that all samples of a pixel show; -1 where all show background, -2 where they differ."""
    face = face_index[0, row, col]
    for s in range(1, len(face_index)):
        if face_index[s, row, col] != face:
            return -2
    return face


@kernel(fastmath=_FAST)
def shade(
    face_index: Array,
    inverse_depth: Array,
    planes: Array,
    offsets: Array,
    surface: Surface,
    lighting: Lighting,
    intrinsics: Array,
    origin: Array,
    luminance: Array,
    depth: Array,
    object_index: Array,
) -> None:
    """Average the samples of every pixel into ``luminance`` (which holds the background), ``depth`` and ``object_index [h, w]``."""
    samples, height, width = face_index.shape
    votes = np.zeros((surface.face_object.max() + 1, 2))
    for row in range(height):
        for col in range(width):
            common = _common_face(face_index, row, col)
            if common == -1:
                continue
            half = _half_vector(origin[0] + col, origin[1] + row, intrinsics, lighting.direction)
            votes[:] = 0
            covered, total = 0, 0.0
            for s in range(samples):
                f = face_index[s, row, col]
                if f < 0:
                    continue
                covered += 1
                votes[surface.face_object[f], 0] += 1
                votes[surface.face_object[f], 1] += inverse_depth[s, row, col]
                if common == -2:
                    weights = _weights(planes, f, col + offsets[s, 0], row + offsets[s, 1])
                    diffuse, highlight = _light(f, weights, half, surface, lighting)
                    total += _reflectance(f, weights, surface) * diffuse + highlight
            if common >= 0:
                total = samples * _one_face(common, row, col, planes, offsets, half, surface, lighting)
            luminance[row, col] = (total + (samples - covered) * luminance[row, col]) / samples
            _vote(votes, samples - covered, depth, object_index, row, col)
