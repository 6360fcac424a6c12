"""Numba kernels that light the samples found by :mod:`torchtrack.sim.rasterizer` and gather them into pixels (extra ``sim``)."""

from typing import NamedTuple

import numpy as np

from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.sim.drawing import Picture
from torchtrack.sim.rasterizer import Faces, Samples, View

Triple = tuple[float, float, float]

# No "nnan" and no "ninf": comparisons must keep their meaning for numbers that are not finite.
_FAST = {"contract", "arcp", "nsz", "reassoc"}

# What is called for every pixel takes arrays out of a tuple where it reads them: references to those kept under a name are counted each time.


class Surface(NamedTuple):
    """Faces, and the look of each; everything float32 but for the indices."""

    faces: Faces
    uv: Array  # [f, 3, 2] texture coordinates of the corners, v downwards
    albedo: Array  # [f, 3] reflectance of the corners, which multiplies the texture
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


class Pixel(NamedTuple):
    """A pixel of the region, and the unit vector halfway between its directions to the light and to the camera."""

    row: int
    col: int
    half: Triple


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
def _coordinates(f: int, weights: Triple, uv: Array) -> tuple[float, float]:
    """Texture coordinates of a face at barycentric ``weights``."""
    w0, w1, w2 = weights
    return w0 * uv[f, 0, 0] + w1 * uv[f, 1, 0] + w2 * uv[f, 2, 0], w0 * uv[f, 0, 1] + w1 * uv[f, 1, 1] + w2 * uv[f, 2, 1]


@kernel(fastmath=_FAST)
def _albedo(f: int, weights: Triple, albedo: Array) -> float:
    """Reflectance of a face at barycentric ``weights``, its texture apart."""
    w0, w1, w2 = weights
    return w0 * albedo[f, 0] + w1 * albedo[f, 1] + w2 * albedo[f, 2]


@kernel(fastmath=_FAST)
def _reflectance(f: int, weights: Triple, surface: Surface) -> float:
    """Diffuse reflectance of a face at barycentric ``weights``: corner values times texture."""
    value, texture = _albedo(f, weights, surface.albedo), surface.texture
    offset, width, height = texture[f, 0], texture[f, 1], texture[f, 2]
    if width * height == 1:
        return value * surface.texels[offset]
    u, v = _coordinates(f, weights, surface.uv)
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
def _vote(faces: Array, inverse_depth: Array, face_object: Array) -> tuple[int, float]:
    """Number of the object that holds most samples of a pixel, and its depth; -1 and infinite for the background.

    Inverse depth is affine, so its mean is that of the centre.
    """
    best, most, inverse = -1, 0, 0.0
    for s in range(len(faces)):
        # Who comes after this many others cannot hold more.
        if len(faces) - s <= most:
            break
        owner = face_object[faces[s]] if faces[s] >= 0 else -1
        count, total = 0, 0.0
        for q in range(len(faces)):
            if (face_object[faces[q]] if faces[q] >= 0 else -1) == owner:
                count += 1
                total += inverse_depth[q]
        if count > most:
            best, most, inverse = owner, count, total
    return best, most / inverse


@kernel(fastmath=_FAST)
def _light(f: int, weights: Triple, half: Triple, surface: Surface, lighting: Lighting) -> tuple[float, float]:
    """Diffuse light and highlight on a face at barycentric ``weights`` (Blinn 1977)."""
    nx, ny, nz = _normal(f, weights, surface.faces.normals, surface.is_flat)
    light = lighting.direction
    lambert = max(nx * light[0] + ny * light[1] + nz * light[2], 0.0)
    shine = max(nx * half[0] + ny * half[1] + nz * half[2], 0.0)
    for _ in range(5):  # to the power of 32
        shine *= shine
    return lighting.ambient + lighting.diffuse * lambert, surface.gloss[f] * shine


@kernel(fastmath=_FAST)
def _one_face(f: int, pixel: Pixel, offsets: Array, surface: Surface, lighting: Lighting) -> float:
    """Luminance of a pixel that one face fills: light and corner values are taken at the centre, texture at every sample."""
    row, col = pixel.row, pixel.col
    centre = _weights(surface.faces.planes, f, col, row)
    diffuse, highlight = _light(f, centre, pixel.half, surface, lighting)
    offset, width, height = surface.texture[f, 0], surface.texture[f, 1], surface.texture[f, 2]
    if width * height == 1:
        return _reflectance(f, centre, surface) * diffuse + highlight
    # Inside a pixel the texture coordinates are as good as affine.
    u, v = _coordinates(f, centre, surface.uv)
    u_right, v_right = _coordinates(f, _weights(surface.faces.planes, f, col + 0.25, row), surface.uv)
    u_below, v_below = _coordinates(f, _weights(surface.faces.planes, f, col, row + 0.25), surface.uv)
    total = 0.0
    for s in range(len(offsets)):
        dx, dy = 4 * offsets[s, 0], 4 * offsets[s, 1]
        sample_u = u + (u_right - u) * dx + (u_below - u) * dy
        sample_v = v + (v_right - v) * dx + (v_below - v) * dy
        total += _texel(surface.texels, offset, width, height, sample_u, sample_v)
    return _albedo(f, centre, surface.albedo) * total / len(offsets) * diffuse + highlight


@kernel()
def _common_face(faces: Array) -> int:
    """The face that all samples of a pixel show; -1 where all show background, -2 where they differ."""
    face = faces[0]
    for s in range(1, len(faces)):
        if faces[s] != face:
            return -2
    return face


@kernel(fastmath=_FAST)
def _some_faces(faces: Array, pixel: Pixel, offsets: Array, surface: Surface, lighting: Lighting) -> tuple[float, int]:
    """Sum of the luminances of the samples that show a face, and how many there are.

    Light is taken once per face, in the middle of its samples; texture at every sample.
    """
    row, col = pixel.row, pixel.col
    total, covered = 0.0, 0
    done = np.uint64(0)
    for s in range(len(faces)):
        f = faces[s]
        if f < 0 or (done >> np.uint64(s)) & np.uint64(1):
            continue
        count, x, y = 0, 0.0, 0.0
        for q in range(s, len(faces)):
            if faces[q] == f:
                done |= np.uint64(1) << np.uint64(q)
                count += 1
                x += offsets[q, 0]
                y += offsets[q, 1]
        weights = _weights(surface.faces.planes, f, col + x / count, row + y / count)
        diffuse, highlight = _light(f, weights, pixel.half, surface, lighting)
        covered += count
        total += count * highlight
        if surface.texture[f, 1] * surface.texture[f, 2] == 1:
            total += count * diffuse * _reflectance(f, weights, surface)
            continue
        for q in range(s, len(faces)):
            if faces[q] == f:
                total += diffuse * _reflectance(f, _weights(surface.faces.planes, f, col + offsets[q, 0], row + offsets[q, 1]), surface)
    return total, covered


@kernel(fastmath=_FAST)
def shade(samples: Samples, surface: Surface, lighting: Lighting, view: View, picture: Picture) -> None:
    """Average the samples of every pixel into the picture, which holds the background."""
    inverse_depth, face_index = samples
    intrinsics, origin, offsets = view
    luminance, depth, object_index = picture
    height, width, count = face_index.shape
    for row in range(height):
        for col in range(width):
            faces = face_index[row, col]
            common = _common_face(faces)
            if common == -1:
                continue
            pixel = Pixel(row, col, _half_vector(origin[0] + col, origin[1] + row, intrinsics, lighting.direction))
            if common >= 0:
                luminance[row, col] = _one_face(common, pixel, offsets, surface, lighting)
                object_index[row, col] = surface.face_object[common]
                depth[row, col] = count / inverse_depth[row, col].sum()
                continue
            total, covered = _some_faces(faces, pixel, offsets, surface, lighting)
            luminance[row, col] = (total + (count - covered) * luminance[row, col]) / count
            object_index[row, col], depth[row, col] = _vote(faces, inverse_depth[row, col], surface.face_object)
