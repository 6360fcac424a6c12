"""Edges of a printed texture, carried to the surface through its UV map.

Coordinates of a texture: UV with v up and (0, 0) at the lower left CORNER of the image; pixels with v down and integers
at pixel centres. So ``u_px = u w - 1/2`` and ``v_px = (1 - v) h - 1/2``. UV maps may overlap (several faces printed
alike), be mirrored, and reach beyond [0, 1], where the texture repeats.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from torchtrack.object_model.image_edges import ImageEdges, image_edges
from torchtrack.object_model.mesh_edges import EdgeTable, corners_at_ends
from torchtrack.object_model.surface import Surface
from torchtrack.object_model.surface_points import NO_POINTS, SurfacePoints, check_point_count, oriented_points

# Finer detail than this fraction of the diameter is blurred away: no event camera that sees the whole object resolves it.
_BLUR_FRACTION = 0.002
_BLUR_PX = 1.5
# Nearer to the border of a UV island than this many blur widths, an edge may be that of the island itself.
_BORDER_BLURS = 2.0
# A face may show its texture this many times; beyond, its UV coordinates are taken to be broken.
_MOST_REPEATS = 256
_SUBPIXEL_BITS = 4
_SAME_UV = 1e-5
# Pairs of an edge point and a face that may show it.
_MOST_CANDIDATES = 20_000_000
# Faces that map to a line of the texture show none of its edges.
_LEAST_UV_AREA = 1e-12


def texture_edges(surface: Surface, table: EdgeTable, contrast: float) -> list[SurfacePoints]:
    """For each texture, dense points on its edges whose step is at least ``contrast`` in log luminance."""
    with np.errstate(over="ignore", invalid="ignore"):  # coordinates of a damaged file, which are left out
        borders = _uv_borders(surface, table)
        return [_edges_of_texture(surface, number, borders, contrast) for number in range(len(surface.textures))]


def why_no_edges(surface: Surface, number: int, contrast: float) -> str:
    """Why a texture gives no edges, in words."""
    uv = surface.corner_uv[surface.texture_index == number]
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.ptp(uv, axis=1).max(1) if len(uv) else np.zeros(0)
    if not ((spread > 0) & (spread < _MOST_REPEATS)).any():
        return "its texture coordinates (UV) are all the same, not finite, or hundreds of images wide. Export it with UV coordinates from 0 to 1"
    if np.ptp(surface.textures[number]) < contrast:
        return f"no two places of it differ by {contrast} in log luminance. Lower texture_contrast if fainter print is to be used"
    return "what differs in it is not on the model's faces, is at the borders of its UV islands, or is too faint, gradual or small"


@dataclass(frozen=True)
class _Placement:
    """Where faces lie in an image: ``triangles [R, 3, 2]`` px, ``face [R]``, ``border [R, 3]`` sides where an island ends."""

    triangles: np.ndarray
    face: np.ndarray
    border: np.ndarray


def _edges_of_texture(surface: Surface, number: int, borders: np.ndarray, contrast: float) -> SurfacePoints:
    image = surface.textures[number]
    placement = _place(surface, number, borders, image.shape)
    texel_m = _texel_size(surface, placement)
    if texel_m is None:
        return NO_POINTS
    image, placement, texel_m = _at_working_scale(image, placement, texel_m, surface.diameter)
    blur_px = max(1.0, _BLUR_FRACTION * surface.diameter / texel_m)
    edges = image_edges(image, blur_px, contrast)
    edges = _inside_islands(edges, placement, image.shape, _BORDER_BLURS * blur_px)
    return _lift(surface, placement, edges, texel_m)


def _uv_borders(surface: Surface, table: EdgeTable) -> np.ndarray:
    """``[F, 3]`` sides (corner k to k + 1) beyond which the UV map does not go on."""
    border = np.ones((len(surface.faces), 3), dtype=bool)
    vertices, faces = table.vertices[table.paired], table.faces[table.paired]
    corner = corners_at_ends(surface, vertices, faces)
    uv = surface.corner_uv[faces[:, :, None], corner]
    same = (surface.texture_index[faces[:, 0]] == surface.texture_index[faces[:, 1]]) & (np.abs(uv[:, 0] - uv[:, 1]).max((1, 2)) < _SAME_UV)
    # The side between two corners is named after the one that follows the third.
    side = (4 - corner.sum(2)) % 3
    border[faces[same], side[same]] = False
    return border


def _place(surface: Surface, number: int, borders: np.ndarray, shape: tuple[int, int]) -> _Placement:
    """The faces of a texture in its image, once for every repeat of the image that they touch."""
    uv = surface.corner_uv
    area = _signed_area(uv)
    face = np.flatnonzero((surface.texture_index == number) & np.isfinite(uv).all((1, 2)) & (np.abs(area) > _LEAST_UV_AREA))
    low, high = np.floor(uv[face].min(1)), np.ceil(uv[face].max(1)) - 1
    repeats = np.maximum(high - low, 0) + 1
    # Before they are whole numbers: the coordinates of a damaged file may be too large for any.
    sane = repeats.prod(1) <= _MOST_REPEATS
    face, low = face[sane], low[sane]
    across, down = repeats[sane].astype(np.int64).T
    row, step = expand_ranges(np.zeros(len(face), dtype=np.int64), across * down)
    tile = low[row] + np.stack([step % across[row], step // across[row]], 1)
    uv = uv[face[row]] - tile[:, None]
    height, width = shape
    pixels = np.stack([uv[..., 0] * width, (1 - uv[..., 1]) * height], -1) - 0.5
    # Far from zero, rounding may make a line of a face.
    wide = np.abs(_signed_area(pixels)) > 0
    return _Placement(pixels[wide], face[row][wide], borders[face[row]][wide])


def _signed_area(triangles: np.ndarray) -> np.ndarray:
    """Twice the signed area of triangles ``[n, 3, 2]``."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def expand_ranges(start: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For ranges ``start[i] ... start[i] + count[i] - 1``, one after another: the index i and the value of every element."""
    index = np.repeat(np.arange(len(start)), count)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count) + start[index]


def _texel_size(surface: Surface, placement: _Placement) -> float | None:
    """Mean size of a texel on the surface (m)."""
    corners = surface.corners[placement.face]
    on_surface = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    in_image = np.abs(_signed_area(placement.triangles)).sum()
    return float(np.sqrt(on_surface / in_image)) if in_image > 0 else None


def _at_working_scale(image: np.ndarray, placement: _Placement, texel_m: float, diameter: float) -> tuple[np.ndarray, _Placement, float]:
    """Image and placement made smaller where the texture is finer than needed."""
    shrink = _BLUR_FRACTION * diameter / texel_m / _BLUR_PX
    height, width = image.shape
    size = max(round(width / shrink), 1), max(round(height / shrink), 1)
    if shrink < 2 or min(size) < 8:
        return image, placement, texel_m
    factor = np.array(size) / (width, height)
    triangles = (placement.triangles + 0.5) * factor - 0.5
    return (
        cv2.resize(image, size, interpolation=cv2.INTER_AREA),
        _Placement(triangles, placement.face, placement.border),
        texel_m / float(factor.mean()),
    )


def _inside_islands(edges: ImageEdges, placement: _Placement, shape: tuple[int, int], margin_px: float) -> ImageEdges:
    """Edges that are further than ``margin_px`` from the border of their UV island."""
    mask = np.zeros(shape, dtype=np.uint8)
    fixed = np.round(placement.triangles.clip(-1e4, 1e5) * 2**_SUBPIXEL_BITS).astype(np.int32)
    for triangle in fixed:
        cv2.fillConvexPoly(mask, triangle, 1, shift=_SUBPIXEL_BITS)
    sides = np.stack([fixed, np.roll(fixed, -1, 1)], 2)[placement.border]
    cv2.polylines(mask, list(sides), False, 0, shift=_SUBPIXEL_BITS)
    distance = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    u, v = edges.pixels.round().astype(np.int64).clip(0, [shape[1] - 1, shape[0] - 1]).T
    kept = distance[v, u] > margin_px
    return ImageEdges(edges.pixels[kept], edges.gradients[kept])


def _lift(surface: Surface, placement: _Placement, edges: ImageEdges, texel_m: float) -> SurfacePoints:
    """Edge points of the image on every face that shows them, in the image's raster order."""
    point, row = _candidates(edges.pixels, placement.triangles)
    corners = surface.corners[placement.face]
    to_weights = np.linalg.inv((placement.triangles[:, 1:] - placement.triangles[:, :1]).transpose(0, 2, 1))
    weights = np.einsum("nij,nj->ni", to_weights[row], edges.pixels[point] - placement.triangles[row, 0])
    inside = (weights >= 0).all(1) & (weights.sum(1) <= 1)
    point, row, weights = point[inside], row[inside], weights[inside]
    order = np.argsort(point, kind="stable")
    point, row, weights = point[order], row[order], weights[order]
    sides = (corners[:, 1:] - corners[:, :1])[row]
    to_surface = np.einsum("nki,nkj->nij", sides, to_weights[row])
    gradient = edges.gradients[point]
    along = np.stack([-gradient[:, 1], gradient[:, 0]], 1)
    return oriented_points(
        corners[row, 0] + np.einsum("nk,nki->ni", weights, sides),
        np.einsum("nij,nj->ni", to_surface, along),
        surface.normals[placement.face[row]],
        np.einsum("nij,nj->ni", to_surface, gradient),
        len(point) * texel_m,
    )


def _candidates(pixels: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (point, triangle) of which the triangle's bounding box, in whole cells of a grid, holds the point."""
    low, high = triangles.min(1), triangles.max(1)
    cell_px = float(np.median(high - low).clip(4, 256))
    grid = np.floor(pixels / cell_px).astype(np.int64)
    first_cell = grid.min(0) if len(grid) else np.zeros(2, dtype=np.int64)
    columns, rows = (np.ptp(grid, axis=0) + 1) if len(grid) else (1, 1)
    key = (grid[:, 1] - first_cell[1]) * columns + grid[:, 0] - first_cell[0]
    order = np.argsort(key, kind="stable")
    first = np.searchsorted(key[order], np.arange(columns * rows + 1))
    low, high = (np.floor(corner / cell_px).astype(np.int64) - first_cell for corner in (low, high))
    left, right = low[:, 0].clip(0), high[:, 0].clip(max=columns - 1)
    top, bottom = low[:, 1].clip(0), high[:, 1].clip(max=rows - 1)
    # Cells of a row follow each other, so a triangle needs one range of points for each row of cells that it touches.
    triangle, line = expand_ranges(top, np.where(right >= left, (bottom - top + 1).clip(0), 0))
    start = first[line * columns + left[triangle]]
    count = first[line * columns + right[triangle] + 1] - start
    check_point_count(int(count.sum()), _MOST_CANDIDATES)
    strip, position = expand_ranges(start, count)
    return order[position], triangle[strip]
