"""Objects to look at, made by code: metres, origin at the centre, faces wound outwards.

``make_mesh(name)`` gives one of :data:`SHAPES`. Textured ones carry an atlas image with UVs (trimesh ``TextureVisuals``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from numpy import ndarray
from PIL import Image as PillowImage
from scipy.spatial import Delaunay

from torchtrack.errors import ConfigError
from torchtrack.sim import curved, textures
from torchtrack.sim.textures import Image

# Faces of a box in the order -x +x -y +y -z +z: their corners (outwards, counterclockwise) as signs.
_BOX_FACES = np.array(
    [
        [[-1, 1, -1], [-1, -1, -1], [-1, -1, 1], [-1, 1, 1]],
        [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]],
        [[-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1]],
        [[1, 1, -1], [-1, 1, -1], [-1, 1, 1], [1, 1, 1]],
        [[-1, 1, -1], [1, 1, -1], [1, -1, -1], [-1, -1, -1]],
        [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]],
    ],
    dtype=np.float64,
)
_QUAD_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
# Patches of an atlas are kept apart by this many copies of their border, so that look-ups do not mix them.
_ATLAS_MARGIN = 4


@dataclass(frozen=True)
class _Box:
    """A box with one atlas patch per face (-x +x -y +y -z +z)."""

    extents: tuple[float, float, float]
    centre: tuple[float, float, float]
    patches: tuple[int, int, int, int, int, int]


def _atlas(patches: Sequence[Image]) -> tuple[Image, Float[ndarray, "p 2 2"]]:
    """Patches stacked in one image, and the UV of the lower left and upper right corner of each."""
    width = max(patch.shape[1] for patch in patches) + 2 * _ATLAS_MARGIN
    padded = [
        np.pad(patch, ((_ATLAS_MARGIN, _ATLAS_MARGIN), (_ATLAS_MARGIN, width - patch.shape[1] - _ATLAS_MARGIN)), mode="edge") for patch in patches
    ]
    image = np.concatenate(padded)
    tops = np.cumsum([0, *(len(patch) for patch in padded[:-1])]) + _ATLAS_MARGIN
    corners = [[[_ATLAS_MARGIN, top + len(patch)], [_ATLAS_MARGIN + patch.shape[1], top]] for top, patch in zip(tops, patches, strict=True)]
    return image, np.array(corners) / [width, len(image)] * [1, -1] + [0, 1]


def _boxes(boxes: Sequence[_Box], patches: Sequence[Image]) -> trimesh.Trimesh:
    """Boxes as one textured mesh."""
    image, corners = _atlas(patches)
    vertices, uv = [], []
    for box in boxes:
        vertices.append((_BOX_FACES * np.array(box.extents) / 2 + box.centre).reshape(-1, 3))
        low, high = corners[list(box.patches), 0], corners[list(box.patches), 1]
        uv.append((low[:, None] + _QUAD_UV * (high - low)[:, None]).reshape(-1, 2))
    quads = np.arange(24 * len(boxes)).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=PillowImage.fromarray(image).convert("RGB"), metallicFactor=0.0, roughnessFactor=0.6
    )
    visual = trimesh.visual.TextureVisuals(uv=np.concatenate(uv), material=material)
    return trimesh.Trimesh(np.concatenate(vertices), faces, visual=visual, process=False)


def cube(size_m: float = 0.12) -> trimesh.Trimesh:
    """A cube with another print on every face."""
    return _boxes([_Box((size_m, size_m, size_m), (0.0, 0.0, 0.0), (0, 1, 2, 3, 4, 5))], [face(256) for face in textures.CUBE_FACES])


def book(width_m: float = 0.14, height_m: float = 0.2, thickness_m: float = 0.03) -> trimesh.Trimesh:
    """A closed book: printed cover and back, spine, cut edges of the pages on the other sides."""
    patches = [
        textures.text_page(768, 540, seed=0),
        textures.text_page(768, 540, seed=1, title="BACK COVER"),
        textures.spine(116, 768),
        textures.page_edges(116, 768),
        textures.page_edges(116, 540),
    ]
    # The spine and the edge opposite run along the height: their boxes' faces have the width along y.
    return _boxes([_Box((width_m, height_m, thickness_m), (0.0, 0.0, 0.0), (3, 2, 4, 4, 0, 1))], patches)


def satellite(body_m: float = 0.07, span_m: float = 0.23) -> trimesh.Trimesh:
    """A box with two solar panels on booms and an antenna mast."""
    patches = [textures.foil(192, 192), textures.solar_cells(180, 180), np.full((16, 16), textures.GREY, dtype=np.uint8)]
    boom, gap = 0.008, 0.012
    panel = (span_m - body_m) / 2 - gap
    offset = body_m / 2 + gap + panel / 2
    body = _Box((body_m, body_m, 1.3 * body_m), (0.0, 0.0, 0.0), (0,) * 6)
    panels = [_Box((panel, 0.006, 1.2 * body_m), (side * offset, 0.0, 0.0), (2, 2, 1, 1, 2, 2)) for side in (-1, 1)]
    booms = [_Box((gap, boom, boom), (side * (body_m + gap) / 2, 0.0, 0.0), (2,) * 6) for side in (-1, 1)]
    mast = _Box((boom, boom, 0.5 * body_m), (0.0, 0.0, 0.9 * body_m), (2,) * 6)
    return _boxes([body, *panels, *booms, mast], patches)


def l_bracket(width_m: float = 0.14, height_m: float = 0.10, depth_m: float = 0.07, thickness_m: float = 0.03) -> trimesh.Trimesh:
    """An L-shaped bracket with even faces: a prism over an L."""
    outline = np.array([[0, 0], [width_m, 0], [width_m, thickness_m], [thickness_m, thickness_m], [thickness_m, height_m], [0, height_m]])
    outline = outline - [width_m / 2, height_m / 2]
    count = len(outline)
    back = np.column_stack([outline, np.full(count, -depth_m / 2)])
    vertices = np.concatenate([back, back + np.array([0, 0, depth_m])])
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    side, after = np.arange(count), np.roll(np.arange(count), -1)
    walls = np.concatenate([np.column_stack([side, after, after + count]), np.column_stack([side, after + count, side + count])])
    return trimesh.Trimesh(vertices, np.concatenate([cap[:, ::-1], cap + count, walls]), process=False)


def planar_pattern(size_m: float = 0.18, thickness_m: float = 0.003) -> trimesh.Trimesh:
    """A printed card."""
    patches = [textures.planar_pattern(900), np.full((16, 16), textures.PAPER, dtype=np.uint8)]
    # The camera sees the side of -z, where the box's patches run the other way round.
    return _boxes([_Box((size_m, size_m, thickness_m), (0.0, 0.0, 0.0), (1, 1, 1, 1, 0, 1))], patches)


def wedge(length_m: float = 0.16, height_m: float = 0.1, depth_m: float = 0.06) -> trimesh.Trimesh:
    """A wedge with a square and a triangular hole through it."""
    outline = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, -0.2], [-0.5, 0.5]]) * [length_m, height_m]
    square = np.array([[-0.4, -0.35], [-0.2, -0.35], [-0.2, 0.02], [-0.4, 0.02]]) * [length_m, height_m]
    triangle = np.array([[-0.08, -0.36], [0.3, -0.36], [-0.08, -0.02]]) * [length_m, height_m]
    return _prism([outline, square, triangle], depth_m)


def bar(length_m: float = 0.5, width_m: float = 0.05, thickness_m: float = 0.02) -> trimesh.Trimesh:
    """A plain bar along y, such as one that passes before the objects."""
    return trimesh.creation.box((width_m, length_m, thickness_m))


def finger(length_m: float = 0.08, radius_m: float = 0.008) -> trimesh.Trimesh:
    """A rod with round ends along y, such as holds an object."""
    rod = trimesh.creation.capsule(height=length_m - 2 * radius_m, radius=radius_m, count=[24, 24])
    rod.apply_translation(-rod.bounds.mean(0))
    rod.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    return rod


def _prism(loops: Sequence[Float[ndarray, "_ 2"]], depth_m: float, spacing: float = 0.012) -> trimesh.Trimesh:
    """A prism over an outline with holes; each loop counterclockwise, the first around all others."""
    loops = [_subdivided(loop, spacing) for loop in loops]
    flat = np.concatenate(loops)
    # On loops as dense as these the triangulation keeps to them; what lies outside or in a hole is dropped.
    triangles = Delaunay(flat).simplices
    centres = flat[triangles].mean(1)
    inside = _contains(loops[0], centres) & ~np.any([_contains(hole, centres) for hole in loops[1:]], axis=0)
    a, b, c = flat[triangles].transpose(1, 0, 2)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    cap = np.where(area[:, None] > 0, triangles, triangles[:, ::-1])[inside & (np.abs(area) > 1e-12)]
    count, walls, start = len(flat), [], 0
    for number, loop in enumerate(loops):
        side = start + np.arange(len(loop))
        after = start + (np.arange(len(loop)) + 1) % len(loop)
        side, after = (side, after) if number == 0 else (after, side)
        walls += [np.column_stack([side, after, after + count]), np.column_stack([side, after + count, side + count])]
        start += len(loop)
    vertices = np.concatenate([np.column_stack([flat, np.full(count, z)]) for z in (-depth_m / 2, depth_m / 2)])
    return trimesh.Trimesh(vertices, np.concatenate([cap[:, ::-1], cap + count, *walls]), process=False)


def _subdivided(loop: Float[ndarray, "_ 2"], spacing: float) -> Float[ndarray, "_ 2"]:
    """A closed loop with its edges cut into pieces no longer than ``spacing`` (m)."""
    pieces = []
    for start, end in zip(loop, np.roll(loop, -1, axis=0), strict=True):
        count = int(np.ceil(np.linalg.norm(end - start) / spacing))
        pieces.append(start + np.arange(count)[:, None] / count * (end - start))
    return np.concatenate(pieces)


def _contains(loop: Float[ndarray, "_ 2"], points: Float[ndarray, "n 2"]) -> Bool[ndarray, "n"]:
    """Which points a closed loop goes around (even-odd rule)."""
    start, end = loop, np.roll(loop, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    crosses = (start[:, 1] > y) != (end[:, 1] > y)
    rise = np.where(end[:, 1] == start[:, 1], 1.0, end[:, 1] - start[:, 1])
    left = x < (end[:, 0] - start[:, 0]) * (y - start[:, 1]) / rise + start[:, 0]
    return (crosses & left).sum(1) % 2 == 1


SHAPES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "cube": cube,
    "lbracket": l_bracket,
    "satellite": satellite,
    "book": book,
    "wedge": wedge,
    "planar": planar_pattern,
    "bar": bar,
    "finger": finger,
    "torus_knot": curved.torus_knot,
    "vase": curved.vase,
    "mug": curved.mug,
    "animal": curved.animal,
    "robot": curved.robot,
    "duck": curved.duck,
}


@cache
def _made(name: str) -> trimesh.Trimesh:
    """Made once: fields of distances take a while."""
    return SHAPES[name]()


def make_mesh(name: str, scale: float = 1.0) -> trimesh.Trimesh:
    """A mesh of :data:`SHAPES`, enlarged by ``scale``.

    Raises:
        ConfigError: if there is no shape of that name.
    """
    if name not in SHAPES:
        raise ConfigError(f"unknown shape '{name}': use one of {', '.join(SHAPES)}.")
    mesh = _made(name).copy()
    mesh.apply_scale(scale)
    return mesh
