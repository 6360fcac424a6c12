"""Hidden contours: behind the object's own faces, or behind any surface of its stream.

A model of few faces is tested against each of them, exactly: a coarse buffer would hide the long thin faces that such
objects show when they turn. Dense meshes, and objects in front of one another, share one depth buffer per stream.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.camera import MIN_DEPTH_M, project
from torchtrack.core.dispatch import accelerable
from torchtrack.core.lie import affine, transform_points
from torchtrack.core.padded import bounds
from torchtrack.object_model.contour_source import ContourModel
from torchtrack.tracking.contours.points import Contours

# Cell of the depth buffer (px), and by how much of an object's diameter what hides a contour is nearer than it. Both were set with the first
# buffer, and not measured alone; without hidden contours removed at all, errors are 0.31° / 0.74 mm instead of 0.30° / 0.71 mm (docs/results.md).
DEPTH_CELL_PX, DEPTH_MARGIN = 4, 0.06
# A point this far behind a face's plane is behind it, not on it (diameters).
ON_FACE = 2e-3
# Tests of points against triangles that are made at once: larger temporaries page-fault on the CPU.
_MOST_TESTS = 2**19
# Depths are compared in whole micrometres, with the object's number in the low bits.
DEPTH_STEPS_PER_M, _OBJECT_BITS = 1e6, 20
NOTHING = 2**62
# Images that are farther apart than this have no cell in common.
OVERLAP_CELLS = 2
# So many surface samples for each cell of the square around an object leave no holes: its outline fills half of it, seen from both sides.
SAMPLES_PER_CELL = 8


@dataclass(frozen=True)
class Scene:
    """The objects of all streams at their poses.

    Args:
        models: the distinct models, with the objects that have each.
        T_cam_obj: pose of each object.
        intrinsics: ``[fx, fy, cx, cy]`` of each object's camera.
        stream_index: stream of each object.
        diameters_m: diameter of each object.
        image_shape: streams, height and width of the image.
        shared: whether any stream has more than one object.
    """

    models: Sequence[ContourModel]
    T_cam_obj: Float[Tensor, "b 4 4"]
    intrinsics: Float[Tensor, "b 4"]
    stream_index: Int[Tensor, "b"]
    diameters_m: Float[Tensor, "b"]
    image_shape: tuple[int, int, int]
    shared: bool


def hidden_by_faces(
    points_cam: Float[Tensor, "b m 3"], triangles_cam: Float[Tensor, "b f 3 3"], normals_cam: Float[Tensor, "b f 3"], tolerance_m: Float[Tensor, "b"]
) -> Bool[Tensor, "b m"]:
    """Which points lie behind one of the triangles, as the camera sees them.

    The line of sight to a point crosses a triangle when it is on one side of the three planes through the camera and
    an edge; all tests of all points and triangles are one matrix product.
    """
    sides = torch.linalg.cross(triangles_cam, triangles_cam.roll(-1, 2), dim=-1)
    turn = (sides[:, :, 0] * triangles_cam[:, :, 2]).sum(-1)[..., None, None].sign()
    plane = (normals_cam * triangles_cam[:, :, 0]).sum(-1)
    away = plane.sign()[..., None] * normals_cam
    limits = torch.nn.functional.pad(-(plane.abs() + tolerance_m[:, None])[..., None], (3, 0))
    tests = torch.cat([torch.cat([sides * turn, away[:, :, None]], 2), limits[..., None]], 3).flatten(1, 2)
    rows = torch.nn.functional.pad(points_cam.transpose(1, 2), (0, 0, 0, 1), value=1.0)
    at_once = max(_MOST_TESTS // (tests.shape[1] * points_cam.shape[1] + 1), 1) if host_sync.read_at_once(points_cam) else len(points_cam)
    return torch.cat([_hidden_by(*part) for part in zip(tests.split(at_once), rows.split(at_once), strict=True)])


def _hidden_by(tests: Float[Tensor, "b t 4"], points: Float[Tensor, "b 4 m"]) -> Bool[Tensor, "b m"]:
    """Which points pass all four tests of one of the triangles: they lie within its edges, and behind its plane by its limit."""
    if host_sync.on_gpu(points):
        # One test after the other: of the whole product, memory is written and read four times as much, and by a compiler all of it.
        of_each = (affine(test[..., :3], points[:, :3], test[..., 3:]) for test in tests.unflatten(1, (-1, 4)).unbind(2))
        return reduce(torch.minimum, of_each).amax(1) > 0
    return torch.bmm(tests, points).unflatten(1, (-1, 4)).amin(2).amax(1) > 0


@accelerable
def hidden_by_self(scene: Scene, contours: Contours) -> Tensor:
    """Points of objects with few faces that these hide."""
    hidden = torch.zeros_like(contours.mask)
    for model in scene.models:
        if len(model.triangles):
            # All objects, where all have the model: a list of them would be looked up.
            members = slice(None) if len(scene.models) == 1 else model.members
            T_cam_obj = scene.T_cam_obj[members]
            places = _places_in_use(contours.mask[members]) if len(scene.models) > 1 else contours.mask.shape[1]
            corners = model.triangles.flatten(0, 1).expand(len(T_cam_obj), -1, -1)
            triangles = transform_points(T_cam_obj, corners).unflatten(1, (-1, 3))
            normals = model.triangle_normals @ T_cam_obj[:, :3, :3].transpose(1, 2)
            points_cam = contours.points_cam[members][:, :places]
            hidden[members, :places] = hidden_by_faces(points_cam, triangles, normals, ON_FACE * scene.diameters_m[members])
    return hidden


def _places_in_use(mask: Bool[Tensor, "b m"]) -> int:
    """How many places there are up to the last one with a point: others have more contours. On a GPU, which would have to be waited for, all."""
    if not host_sync.read_at_once(mask):
        return mask.shape[1]
    used = mask.any(0).nonzero()
    return int(used[-1]) + 1 if len(used) else 0


@dataclass(frozen=True)
class DepthGrid:
    """The cells of a depth buffer: of each stream's part of the image as many; what lies outside falls into the outermost.

    Args:
        first: the first cell (column, row) of each stream's part; cell (0, 0) is centred at pixel (0, 0).
        size: rows and columns.
        cell_px: side of a cell.
    """

    first: Float[Tensor, "s 2"]
    size: tuple[int, int]
    cell_px: int

    @classmethod
    def whole(cls, scene: Scene, cell_px: int) -> "DepthGrid":
        """The whole image, with a border."""
        streams, height, width = scene.image_shape
        first = torch.full((streams, 2), -1.0, dtype=scene.intrinsics.dtype, device=scene.intrinsics.device)
        return cls(first, (-(-height // cell_px) + 3, -(-width // cell_px) + 3), cell_px)

    @classmethod
    def around(cls, scene: Scene, pixels: Float[Tensor, "b m 2"], mask: Bool[Tensor, "b m"], cell_px: int) -> "DepthGrid":
        """What is asked for at some pixels, and a cell beside them; on a GPU, where sizes cannot hang on values, the whole image."""
        if not host_sync.read_at_once(mask):
            return cls.whole(scene, cell_px)
        streams, (low, high) = scene.stream_index[:, None].expand(-1, 2), bounds(pixels, mask)
        none = pixels.new_full((scene.image_shape[0], 2), torch.inf)
        low, high = none.scatter_reduce(0, streams, low, "amin"), (-none).scatter_reduce(0, streams, high, "amax")
        # Beside the pixels, and one more that takes what lies outside.
        first, last = (low / cell_px).floor() - 2, (high / cell_px).ceil() + 2
        columns, rows = (last - first).clamp(min=0).amax(0).tolist()
        return cls(torch.where(first.isfinite(), first, 0), (int(rows) + 1, int(columns) + 1), cell_px)

    def cell(self, pixels: Float[Tensor, "b *n 2"], stream_index: Int[Tensor, "b"]) -> Int[Tensor, "b *n"]:
        """Number of the cell, among those of all streams, that each pixel falls into."""
        rows, columns = self.size
        to_all = (-1, *[1] * (pixels.dim() - 2))
        # Clamped before the conversion: a far-off pixel does not fit an integer, nor does what is not a number.
        u, v = ((pixels / self.cell_px).round() - self.first[stream_index].view(*to_all, 2)).nan_to_num_(0.0).unbind(-1)
        row = v.clamp(0, rows - 1).long() + (stream_index * rows).view(to_all)
        return row * columns + u.clamp(0, columns - 1).long()


def depth_buffer(scene: Scene, grid: DepthGrid, drawn: Bool[Tensor, "b"] | None = None) -> tuple[Float[Tensor, "p"], Int[Tensor, "p"]]:
    """Least depth (m) of any surface sample in each cell of all streams, and the object it belongs to; without samples, infinitely far.

    Args:
        drawn: the objects whose samples are taken; all when not given.
    """
    cells, keys = [], []
    for model in scene.models:
        for members, samples, taken in _samples(model, drawn, scene, grid.cell_px):
            points = transform_points(scene.T_cam_obj[members], samples.expand(len(members), -1, -1))
            cells.append(grid.cell(project(points, scene.intrinsics[members]), scene.stream_index[members]).flatten())
            key = ((points[..., 2] * DEPTH_STEPS_PER_M).long() << _OBJECT_BITS) + members[:, None]
            keys.append(torch.where((points[..., 2] > MIN_DEPTH_M) & taken, key, NOTHING).flatten())
    rows, columns = grid.size
    nearest = torch.full((len(grid.first) * rows * columns,), NOTHING, device=scene.T_cam_obj.device)
    if cells:
        nearest.scatter_reduce_(0, torch.cat(cells), torch.cat(keys), "amin")
    depth_m = (nearest >> _OBJECT_BITS).to(scene.T_cam_obj.dtype) / DEPTH_STEPS_PER_M
    return depth_m, nearest & ((1 << _OBJECT_BITS) - 1)


def _samples(model: ContourModel, drawn: Tensor | None, scene: Scene, cell_px: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """The objects that have a model and are drawn, its surface samples, and which of them count.

    Of objects that are small in the image, every second, fourth and so on does. On a GPU, which would have to be waited for to know
    how small they are, the others are carried along.
    """
    members, points = model.members if drawn is None else model.members[drawn[model.members]], model.surface_points
    halvings = _halvings(model, members, scene, cell_px)
    if not host_sync.read_at_once(halvings):
        number = torch.arange(len(points), device=points.device)
        yield members, points, number & ((1 << halvings) - 1)[:, None] == 0
        return
    all_of_them = torch.ones(1, 1, dtype=torch.bool, device=points.device)
    for times in sorted(set(halvings.tolist())):
        yield members[halvings == times], points[:: 2**times], all_of_them


def _halvings(model: ContourModel, members: Int[Tensor, "k"], scene: Scene, cell_px: int) -> Int[Tensor, "k"]:
    """How many times the surface samples of some objects of a model are halved, as few will do where the objects are small in the image."""
    depth_m = scene.T_cam_obj[members, 2, 3].clamp(min=MIN_DEPTH_M)
    size_cells = scene.diameters_m[members] * scene.intrinsics[members, 0] / depth_m / cell_px
    spare = len(model.surface_points) / (SAMPLES_PER_CELL * size_cells.square()).clamp(min=1)
    return spare.log2().long().clamp(min=0)


@accelerable
def hidden_in_buffer(scene: Scene, contours: Contours, drawn: Bool[Tensor, "b"], exact: Bool[Tensor, "b 1"]) -> Bool[Tensor, "b m"]:
    """Points behind another surface in the depth buffer; an object's own counts where it has too many faces for the exact test.

    Beside the silhouette of a curved surface that surface is nearer, in the same cell even; beyond it, it ends. So a point is
    hidden only where it is also behind what lies a cell to each side of its contour.

    Args:
        drawn: objects whose surface is drawn.
        exact: objects that are tested against their own faces.
    """
    cell_px = DEPTH_CELL_PX
    _, height, width = scene.image_shape
    u, v = contours.pixels.unbind(-1)
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    grid = DepthGrid.around(scene, contours.pixels, contours.mask & inside, cell_px)
    depth_m, owner = depth_buffer(scene, grid, drawn if host_sync.read_at_once(drawn) else None)
    sides = torch.stack([contours.pixels + side * contours.normals for side in (0, -cell_px, cell_px)], 1)
    cell = grid.cell(sides, scene.stream_index)
    other = owner.take(cell) != torch.arange(len(drawn), device=drawn.device)[:, None, None]
    farthest_m = contours.points_cam[..., 2] - DEPTH_MARGIN * scene.diameters_m[:, None]
    behind = (farthest_m[:, None] > depth_m.take(cell)) & (other | ~exact[:, None])
    return inside & behind.all(1)


@accelerable
def may_overlap_others(scene: Scene, contours: Contours, cell_px: int) -> Bool[Tensor, "b"]:
    """Which objects may share a cell with another one of their stream: where the boxes around their outlines meet."""
    low, high = bounds(contours.pixels, contours.mask)
    low = low - OVERLAP_CELLS * cell_px
    # The outline of what reaches behind the camera is not all in its image; then no point is farther away than the diameter.
    close = torch.where(contours.mask, contours.points_cam[..., 2], torch.inf).amin(1) < scene.diameters_m
    meet = ((low[:, None] <= high) & (low <= high[:, None])).all(-1) | close[:, None] | close
    stream, itself = scene.stream_index, torch.eye(len(close), dtype=torch.bool, device=close.device)
    return (meet & (stream[:, None] == stream) & ~itself).any(1)


def _tested_exactly(scene: Scene) -> Tensor:
    """Which objects are tested against their own faces: a column."""
    exact = torch.zeros(len(scene.T_cam_obj), 1, dtype=torch.bool, device=scene.T_cam_obj.device)
    for model in scene.models:
        # By `exact[members] = ...`, the value would be copied to a GPU each time, and waited for.
        exact.index_fill_(0, model.members, len(model.triangles) > 0)
    return exact


def remove_hidden(contours: Contours, scene: Scene) -> Contours:
    """Contours without the points that the object itself or another one of its stream hides."""
    hidden = hidden_by_self(scene, contours)
    needs_buffer = scene.shared or any(len(model.triangles) == 0 for model in scene.models)
    if needs_buffer:
        exact = _tested_exactly(scene)
        drawn = ~exact[:, 0]
        if scene.shared:
            drawn = drawn | may_overlap_others(scene, contours, DEPTH_CELL_PX)
        if not host_sync.none_of(drawn):
            hidden = hidden | hidden_in_buffer(scene, contours, drawn, exact)
    return replace(contours, mask=contours.mask & ~hidden)
