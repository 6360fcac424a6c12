"""Contours at a pose: which edges are drawn, how evenly, with which normals; smooth silhouettes, texture, segments, batches."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh
from helpers import BOX_EXTENTS_M, SMALL_CAMERA, box_model, generator, pose, random_pose

from torchtrack.config.tracker import ContourConfig
from torchtrack.core import host_sync
from torchtrack.core.camera import project
from torchtrack.core.lie import transform_points
from torchtrack.core.padded import select_ranked, take_points
from torchtrack.object_model import ObjectModel, contour_source
from torchtrack.object_model.contour_source import ContourKind, ContourModel, group_by_model
from torchtrack.tracking.contours.points import image_normals, reproject
from torchtrack.tracking.contours.sampling import RESOLVED_PX, SPACING_PX, mesh_contours, px_per_m_across

CONFIG = ContourConfig(remove_hidden=False)
INTRINSICS = SMALL_CAMERA.intrinsics(torch.float64)
# Poses of the box that show one, two and three faces.
VIEWS = {"one face": pose((0.0, 0.0, 0.3)), "two faces": pose((0.0, 0.8, 0.0)), "three faces": pose()}


def contours_of(models, T, config=CONFIG, dtype=torch.float64):
    """Contours of one model per pose of ``T [b, 4, 4]``."""
    models = [models] * len(T) if isinstance(models, ObjectModel) else models
    groups = [group.to(dtype) for group in group_by_model(models, config)]
    return mesh_contours(groups, T.to(dtype), INTRINSICS.to(dtype).expand(len(T), 4), config)


def box_edges(T, extents_m=BOX_EXTENTS_M):
    """Edges of the box, each as the set of its two faces (axis, side), and the faces that look at the camera."""
    camera = -T[:3, :3].T @ T[:3, 3]
    front = {(axis, side) for axis in range(3) for side in (-1, 1) if side * float(camera[axis]) > extents_m[axis] / 2}
    edges = {frozenset([(a, side_a), (b, side_b)]) for a, b in ((0, 1), (0, 2), (1, 2)) for side_a in (-1, 1) for side_b in (-1, 1)}
    return edges, front


def edges_with_points(points, extents_m=BOX_EXTENTS_M):
    """The edge of the box on which each point lies."""
    half = torch.tensor(extents_m, dtype=points.dtype) / 2
    on_face = (points.abs() - half).abs() < 1e-5
    assert (on_face.sum(-1) >= 2).all()
    return [frozenset((axis, 1 if point[axis] > 0 else -1) for axis in range(3) if on[axis]) for point, on in zip(points, on_face, strict=True)]


def visible(contours, number=0):
    """Points, pixels, normals and kinds of one object, without the padding."""
    mask = contours.mask[number]
    return contours.points_obj[number][mask], contours.pixels[number][mask], contours.normals[number][mask], contours.kind[number][mask]


def cube_with_prints(points_per_face=40):
    """The box with dots on every face as its texture."""
    half = torch.tensor(BOX_EXTENTS_M) / 2
    points, normals, tangents = [], [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            spots = (torch.rand(points_per_face, 3, generator=generator(axis)) - 0.5) * half
            spots[:, axis] = side * half[axis]
            points.append(spots)
            normals.append(side * torch.eye(3)[axis].expand(points_per_face, 3))
            tangents.append(torch.eye(3)[(axis + 1) % 3].expand(points_per_face, 3))
    return replace(box_model(), texture_points=torch.cat(points), texture_normals=torch.cat(normals), texture_tangents=torch.cat(tangents))


# ---- which edges


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_every_edge_of_a_face_that_looks_at_the_camera_is_drawn(view):
    edges, front = box_edges(view)
    points, _, _, kind = visible(contours_of(box_model(), view[None]))
    assert set(edges_with_points(points)) >= {edge for edge in edges if edge & front}
    assert all(edge & front for edge in edges_with_points(points))
    assert (kind == int(ContourKind.CREASE)).all()


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_without_creases_only_the_silhouette_is_drawn(view):
    edges, front = box_edges(view)
    points, *_ = visible(contours_of(box_model(), view[None], ContourConfig(creases=False)))
    on_one_edge = [edge for edge in edges_with_points(points) if len(edge) == 2]
    assert set(on_one_edge) == {edge for edge in edges if len(edge & front) == 1}


def test_the_silhouette_of_three_faces_has_six_edges_and_three_creases_inside():
    edges, front = box_edges(VIEWS["three faces"])
    assert len(front) == 3
    assert (sum(len(edge & front) == 1 for edge in edges), sum(len(edge & front) == 2 for edge in edges)) == (6, 3)


# ---- where on them


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
@pytest.mark.parametrize("close", [1.0, 0.4])
def test_points_are_spread_evenly_in_the_image(view, close):
    T = view.clone()
    T[2, 3] *= close
    points, pixels, _, _ = visible(contours_of(box_model(), T[None]))
    gaps = []
    names = edges_with_points(points)
    for edge in set(names):
        on_edge = pixels[[name == edge for name in names]]
        if len(on_edge) > 2:
            gaps.append(torch.diff(sorted_along(on_edge), dim=0).norm(dim=-1))
    gaps = torch.cat(gaps)
    assert float((gaps / gaps.median() - 1).abs().max()) < 0.2


def sorted_along(pixels):
    """Pixels on a line in their order along it."""
    direction = pixels[(pixels - pixels[0]).norm(dim=-1).argmax()] - pixels[0]
    return pixels[(pixels @ direction).argsort()]


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_normals_are_perpendicular_to_the_projected_edges(view, dtype):
    points, _, normals, _ = visible(contours_of(box_model(), view[None], dtype=dtype))
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals), dtype=dtype), rtol=1e-5, atol=0)
    half = torch.tensor(BOX_EXTENTS_M) / 2
    for point, normal, edge in zip(points, normals, edges_with_points(points), strict=True):
        if len(edge) != 2:
            continue
        (axis,) = {0, 1, 2} - {face[0] for face in edge}
        ends = point.double().repeat(2, 1)
        ends[:, axis] = torch.tensor([-1.0, 1.0]) * half[axis]
        start, end = project((ends @ view[:3, :3].T + view[:3, 3])[None], INTRINSICS[None])[0]
        direction = (end - start) / (end - start).norm()
        assert abs(float(normal.double() @ direction)) < 1e-4


def test_pixels_are_the_projections_of_the_points(dtype):
    T = random_pose(5)
    contours = contours_of(box_model(), T, dtype=dtype)
    expected = project(contours.points_obj.double() @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3], INTRINSICS.expand(5, 4))
    tolerance = 1e-3 if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(contours.pixels.double()[contours.mask], expected[contours.mask], rtol=0, atol=tolerance)
    assert contours.pixels.dtype == dtype


@pytest.mark.parametrize("count", [16, 100, 300])
def test_as_many_points_as_asked_for(count):
    contours = contours_of(box_model(), pose()[None], ContourConfig(max_edge_points=count, remove_hidden=False))
    assert contours.mask.shape == (1, count)
    assert contours.mask.all()


def test_any_number_of_points_may_be_asked_for():
    near = pose(translation=(0.0, 0.0, 0.15))
    contours = contours_of(box_model(), near[None], ContourConfig(max_edge_points=2500, remove_hidden=False))
    assert int(contours.mask.sum()) == 2500


def test_texture_points_are_thinned_where_they_would_lie_closer():
    near, far = (contours_of(cube_with_prints(), pose(translation=(0.0, 0.0, depth_m))[None]) for depth_m in (0.3, 6.0))
    counts = [int((contours.mask & (contours.kind == int(ContourKind.TEXTURE))).sum()) for contours in (near, far)]
    assert 0 < 3 * counts[1] < counts[0]


def test_points_lie_no_closer_than_half_a_pixel_and_as_each_object_needs():
    near, far = pose()[None], pose(translation=(0.0, 0.0, 2.0))[None]
    config = ContourConfig(max_edge_points=3000, remove_hidden=False)
    both = contours_of(box_model(), torch.cat([near, far]), config)
    counts = both.mask.sum(1)
    assert counts[0] == both.mask.shape[1] < config.max_edge_points
    assert 3 * counts[1] < counts[0]
    for number, T in enumerate((near, far)):
        alone = contours_of(box_model(), T, config)
        torch.testing.assert_close(both.pixels[number][both.mask[number]], alone.pixels[0][alone.mask[0]], rtol=0, atol=1e-3)
        steps = torch.diff(alone.pixels[0], dim=0).norm(dim=-1)
        assert 0.45 < float(steps.median()) <= 0.5005


# ---- smooth bodies


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.4), (0.08, -0.05, 0.4)])
def test_the_smooth_silhouette_of_a_sphere_lies_on_its_outline(place):
    radius_m = 0.05
    model = ObjectModel.from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=radius_m), name="ball")
    T = pose((0.3, 0.2, 0.1), place)
    points, pixels, _, kind = visible(contours_of(model, T[None]))
    assert (kind == int(ContourKind.SMOOTH)).all()
    centre = torch.tensor(place, dtype=torch.float64)
    outline = torch.asin(radius_m / centre.norm())
    rays = torch.cat([(pixels - INTRINSICS[2:]) / INTRINSICS[:2], torch.ones_like(pixels[:, :1])], -1)
    angle = torch.acos((rays @ centre) / rays.norm(dim=-1) / centre.norm())
    # Half a pixel, seen from the camera.
    assert float((angle - outline).abs().max()) < 0.5 / SMALL_CAMERA.fx
    around = torch.atan2(*(pixels - pixels.mean(0)).T)
    assert float(torch.diff(around.sort().values).max()) < 0.1
    assert float((points.norm(dim=-1) / radius_m).min()) > 0.995


def test_the_smooth_silhouette_of_a_sphere_on_the_axis_is_a_circle():
    radius_m, depth_m = 0.05, 0.4
    model = ObjectModel.from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=radius_m), name="ball")
    _, pixels, normals, _ = visible(contours_of(model, pose((0.0, 0.0, 0.0), (0.0, 0.0, depth_m))[None]))
    offset = pixels - INTRINSICS[2:]
    expected = SMALL_CAMERA.fx * radius_m / (depth_m**2 - radius_m**2) ** 0.5
    torch.testing.assert_close(offset.norm(dim=-1), torch.full((len(offset),), expected, dtype=torch.float64), rtol=0, atol=0.3)
    across = (normals * offset).sum(-1).abs() / offset.norm(dim=-1)
    assert float(across.median()) > 0.9


# ---- texture and segments


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_texture_is_drawn_on_the_faces_that_look_at_the_camera(view):
    _, front = box_edges(view)
    points, _, _, kind = visible(contours_of(cube_with_prints(), view[None]))
    half = torch.tensor(BOX_EXTENTS_M, dtype=torch.float64) / 2
    printed = points[kind == int(ContourKind.TEXTURE)]
    faces = {
        (axis, 1 if point[axis] > 0 else -1) for point in printed for axis in range(3) if abs(abs(float(point[axis])) - float(half[axis])) < 1e-6
    }
    assert faces == front
    assert len(printed) == 40 * len(front)


@pytest.mark.parametrize(("turn_rad", "is_drawn"), [(0.16, True), (0.135, False)])
def test_texture_is_left_out_only_where_it_is_seen_edge_on(turn_rad, is_drawn):
    """At two degrees texture still fires; at one it is nothing but an edge."""
    T = pose((0.0, -turn_rad, 0.0), (0.0, 0.0, 0.5))
    _, front = box_edges(T)
    assert (0, 1) in front or (0, -1) in front
    points, _, _, kind = visible(contours_of(cube_with_prints(), T[None]))
    printed = points[kind == int(ContourKind.TEXTURE)]
    on_the_side = (printed[:, 2].abs() - BOX_EXTENTS_M[2] / 2).abs() > 1e-6
    assert bool(on_the_side.any()) == is_drawn


def test_there_are_places_for_all_texture_that_looks_at_a_camera(monkeypatch):
    """On a GPU, it cannot be counted first: with as many places as there can be need of, nothing is left out."""
    model, T = cube_with_prints(), random_pose(20)
    counted = contours_of(model, T)
    monkeypatch.setattr(host_sync, "read_at_once", lambda values: False)
    bounded = contours_of(model, T)
    assert bounded.mask.shape[1] < CONFIG.max_edge_points + len(model.texture_points)
    for number in range(len(T)):
        for single, other in zip(visible(counted, number), visible(bounded, number), strict=True):
            assert torch.equal(single, other)


def test_texture_can_be_switched_off_and_is_thinned(monkeypatch):
    model = cube_with_prints()
    kinds = visible(contours_of(model, pose()[None], ContourConfig(texture=False)))[3]
    assert int(ContourKind.TEXTURE) not in kinds
    monkeypatch.setattr(contour_source, "MAX_TEXTURE_POINTS", 50)
    thinned = contours_of(model, pose()[None], ContourConfig(max_edge_points=100))
    assert 100 < int(thinned.mask.sum()) < 150


def striped_plate(gap_m, *, is_opposite=True):
    """Lines on a plane, along x and so far apart, of which every second one has its brighter side above; or all of them."""
    x, y = torch.meshgrid(torch.linspace(-0.02, 0.02, 21), gap_m * torch.arange(-3, 4), indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], -1).flatten(0, 1)
    tangents, normals = torch.zeros_like(points), torch.zeros_like(points)
    tangents[:, 0], normals[:, 2] = 1.0, -1.0
    tangents.view(21, 7, 3)[:, 1::2] *= -1 if is_opposite else 1
    return replace(box_model(), texture_points=points, texture_tangents=tangents, texture_normals=normals)


# The lines are 1.8 px apart at the first depth, seen from the front. Turned about their own direction they come nearer, about the other they do not.
@pytest.mark.parametrize(
    ("rotation", "depth_m", "gap_px"),
    [
        ((0.0, 0.0, 0.0), 0.5, 1.8),
        ((0.0, 0.0, 0.0), 0.9, 1.0),
        ((math.pi / 3, 0.0, 0.0), 0.5, 0.9),
        ((0.0, math.pi / 3, 0.0), 0.5, 1.8),
        ((0.0, 0.0, math.pi / 3), 0.5, 1.8),
    ],
)
def test_texture_is_resolved_as_far_as_the_image_shows_opposite_edges_apart(rotation, depth_m, gap_px, dtype):
    plate, T = striped_plate(1.8 * 0.5 / SMALL_CAMERA.fx), pose(rotation, (0.0, 0.0, depth_m))[None]
    for model, resolved in ((plate, min(gap_px / RESOLVED_PX, 1.0)), (striped_plate(1e-4, is_opposite=False), 1.0)):
        contours = contours_of(model, T, dtype=dtype)
        is_print = contours.kind == int(ContourKind.TEXTURE)
        # A little more where the plate is nearer.
        torch.testing.assert_close(contours.resolved[is_print & contours.mask].mean(), torch.tensor(resolved, dtype=dtype), rtol=0.03, atol=0)
        assert (contours.resolved[~is_print & contours.mask] == 1).all()


def gaps_of(model):
    return ContourModel(model, [0], CONFIG).texture_gaps_m


def test_the_next_opposite_edge_is_looked_for_beside_each_point_on_faces_that_look_the_same_way():
    plate, same = striped_plate(0.003), striped_plate(0.003, is_opposite=False)
    torch.testing.assert_close(gaps_of(plate), torch.full((147,), 0.003))
    assert gaps_of(same).isinf().all()
    # On the other side of a thin plate, and beyond the lines' ends, opposite edges do not count.
    behind = replace(same, texture_points=same.texture_points - 1e-4, texture_tangents=-same.texture_tangents, texture_normals=-same.texture_normals)
    beyond = replace(same, texture_points=same.texture_points + torch.tensor([0.1, 1e-4, 0.0]), texture_tangents=-same.texture_tangents)
    names = ("texture_points", "texture_tangents", "texture_normals")
    for other in (behind, beyond):
        assert gaps_of(replace(same, **{name: torch.cat([getattr(same, name), getattr(other, name)]) for name in names})).isinf().all()
    assert len(gaps_of(box_model())) == 0


def test_how_far_apart_lines_of_texture_are_is_what_their_pixels_say(dtype):
    """Far from the image's middle, too, and seen from the side."""
    T, gap_m = pose((0.5, 0.3, 0.2), (0.12, -0.08, 0.5)).to(dtype), torch.tensor(1e-4, dtype=dtype)
    point, tangent, brighter, normal = (torch.tensor([[way]], dtype=dtype) for way in ([0.01, 0.0, 0.0], [1.0, 0, 0], [0.0, 1, 0], [0.0, 0, 1]))
    intrinsics = INTRINSICS.to(dtype)[None]
    ends = torch.cat([point, point + gap_m * brighter, point + gap_m * tangent], 1)
    here, across, along = project(transform_points(T[None], ends), intrinsics)[0].double()
    along = (along - here) / (along - here).norm()
    expected = ((across - here)[0] * along[1] - (across - here)[1] * along[0]).abs() / gap_m
    actual = px_per_m_across(point, tangent, normal, T[None], intrinsics)[0, 0]
    torch.testing.assert_close(actual.double(), expected, rtol=1e-3 if dtype == torch.float64 else 0.2, atol=0)


@pytest.mark.parametrize("turn", [0.0, 1.2, 3.0])
def test_segments_are_drawn_from_every_side(turn):
    model = ObjectModel.from_polylines([[[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]], [[0.0, 0.02, 0.0], [0.03, 0.04, 0.01]]])
    T = pose((0.1, turn, 0.2))
    points, _, _, kind = visible(contours_of(model, T[None]))
    assert (kind == int(ContourKind.SEGMENT)).all()
    first = (points[:, 1:].abs() < 1e-9).all(-1)
    lengths = []
    for segment in model.segments.double():
        start, end = project((segment @ T[:3, :3].T + T[:3, 3])[None], INTRINSICS[None])[0]
        lengths.append(float((end - start).norm()))
    assert len(points) == math.ceil(sum(lengths) / SPACING_PX)
    assert float(first.double().mean()) == pytest.approx(lengths[0] / sum(lengths), abs=1 / sum(lengths))


# ---- poses without a picture


def test_an_object_behind_the_camera_has_no_contours():
    assert not contours_of(cube_with_prints(), pose(translation=(0.0, 0.0, -0.5))[None]).mask.any()


def test_edges_that_reach_behind_the_camera_are_left_out():
    T = pose((0.0, 0.0, 0.0), (0.1, 0.0, 0.02))
    contours = contours_of(box_model(), T[None])
    assert (contours.points_cam[..., 2][contours.mask] > 0).all()
    assert torch.isfinite(contours.pixels).all()


def test_a_bad_pose_gives_no_contours_and_harms_no_neighbour(dtype):
    T = torch.stack([pose(), torch.full((4, 4), torch.nan, dtype=torch.float64), pose((0.2, 0.1, 0.0))])
    together = contours_of(cube_with_prints(), T, dtype=dtype)
    assert not together.mask[1].any()
    for number in (0, 2):
        alone = contours_of(cube_with_prints(), T[number : number + 1], dtype=dtype)
        torch.testing.assert_close(together.pixels[number][together.mask[number]], alone.pixels[0][alone.mask[0]])


def test_a_tangent_along_the_line_of_sight_has_no_normal(dtype):
    points = torch.tensor([[[0.1, 0.2, 0.5], [0.1, 0.2, 0.5]]], dtype=dtype)
    tangents = torch.stack([points[0, 0] / points[0, 0].norm(), torch.tensor([1.0, 0.0, 0.0], dtype=dtype)])[None]
    normals, exists = image_normals(points, tangents, INTRINSICS.to(dtype)[None])
    assert exists.tolist() == [[False, True]]
    assert torch.isfinite(normals).all()
    assert normals[0, 1].abs().tolist() == pytest.approx([0, 1])


# ---- batches


def mixed_models():
    ball = ObjectModel.from_mesh(trimesh.creation.icosphere(subdivisions=2, radius=0.05), name="ball")
    lines = ObjectModel.from_polylines([[[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0], [0.05, 0.03, 0.01]]])
    return [box_model(), ball, cube_with_prints(), lines, box_model()]


def test_a_batch_is_its_elements(dtype):
    models, T = mixed_models(), random_pose(5, seed=3)
    together = contours_of(models, T, dtype=dtype)
    for number, model in enumerate(models):
        alone = contours_of([model], T[number : number + 1], dtype=dtype)
        for ours, theirs in zip(visible(together, number), visible(alone), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-4 if dtype == torch.float32 else 1e-9)


def test_objects_of_one_model_are_one_group():
    models = mixed_models()
    groups = group_by_model(models, CONFIG)
    assert [group.members.tolist() for group in groups] == [[0, 4], [1], [2], [3]]


def test_no_input_is_changed():
    T = random_pose(2)
    copy = T.clone()
    model = ContourModel(box_model(), [0, 1], CONFIG).double()
    buffers = {name: buffer.clone() for name, buffer in model.named_buffers()}
    mesh_contours([model], T, INTRINSICS.expand(2, 4), CONFIG)
    assert torch.equal(T, copy)
    assert all(torch.equal(buffer, buffers[name]) for name, buffer in model.named_buffers())


# ---- from another pose


def test_reprojection_keeps_the_points_and_moves_their_pixels(dtype):
    T = random_pose(3, seed=1)
    moved = random_pose(3, seed=2)
    contours = contours_of(box_model(), T, dtype=dtype)
    again = reproject(contours, moved.to(dtype), INTRINSICS.to(dtype).expand(3, 4))
    assert torch.equal(again.points_obj, contours.points_obj)
    assert torch.equal(again.mask, contours.mask)
    expected = project(contours.points_obj.double() @ moved[:, :3, :3].transpose(1, 2) + moved[:, None, :3, 3], INTRINSICS.expand(3, 4))
    torch.testing.assert_close(again.pixels.double(), expected, rtol=0, atol=1e-3 if dtype == torch.float32 else 1e-9)
    back = reproject(again, T.to(dtype), INTRINSICS.to(dtype).expand(3, 4))
    torch.testing.assert_close(back.pixels, contours.pixels, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(back.normals, contours.normals, rtol=1e-5, atol=1e-5)


# ---- helpers of the batch


def test_ranked_selection_takes_all_where_they_fit_and_spreads_where_not():
    mask = torch.zeros(3, 100, dtype=torch.bool)
    mask[0, [3, 50, 99]] = True
    mask[1] = True
    index, exists = select_ranked(mask, 10)
    assert index[0][exists[0]].tolist() == [3, 50, 99]
    assert index[1][exists[1]].tolist() == list(range(0, 100, 10))
    assert not exists[2].any()
    assert index.shape == exists.shape == (3, 10)
    assert ((index >= 0) & (index < 100)).all()


@pytest.mark.parametrize("seed", range(3))
def test_ranked_selection_is_sorted_distinct_and_even(seed):
    mask = torch.rand((4, 5000), generator=generator(seed)) < 0.3
    index, exists = select_ranked(mask, 64)
    assert exists.all()
    assert mask.gather(1, index).all()
    assert (torch.diff(index) > 0).all()
    rank = mask.cumsum(1).gather(1, index) - 1
    assert int((torch.diff(rank) - (mask.sum(1) / 64)[:, None]).abs().max()) <= 1


def test_ranked_selection_does_not_depend_on_the_other_rows():
    mask = torch.rand((4, 500), generator=generator()) < torch.tensor([0.01, 0.3, 0.9, 0.0])[:, None]
    index, exists = select_ranked(mask, 40)
    for row in range(4):
        alone, there = select_ranked(mask[row : row + 1], 40)
        assert torch.equal(index[row][exists[row]], alone[0][there[0]])


@pytest.mark.parametrize("batch", [1, 4])
def test_points_are_taken_row_by_row(batch):
    values = torch.rand((batch, 20, 3), generator=generator())
    index = torch.randint(20, (batch, 7), generator=generator())
    assert torch.equal(take_points(values, index), values.gather(1, index[..., None].expand(-1, -1, 3)))


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, -0.4, 0.2), (-0.5, 0.3, 2.0), (0.2, 0.6, -3.0)])
def test_normals_of_print_point_to_its_darker_side(turn):
    """A card before the camera, dark on the left and bright on the right."""
    corners = torch.tensor([[-1, -1, 0], [0, -1, 0], [0, 1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0]]) * 0.05
    faces = [[0, 2, 1], [0, 3, 2], [1, 5, 4], [1, 2, 5]]
    shades = [[20, 20, 20, 255]] * 2 + [[230, 230, 230, 255]] * 2
    model = ObjectModel.from_mesh(trimesh.Trimesh(corners.numpy(), faces, face_colors=shades, process=False))
    T = pose(turn)
    points, pixels, normals, kind = visible(contours_of(model, T[None]))
    darker = project(transform_points(T, points - torch.tensor([1e-3, 0.0, 0.0], dtype=torch.float64))[None], INTRINSICS[None])[0]
    printed = kind == int(ContourKind.TEXTURE)
    assert int(printed.sum()) > 20
    assert (((darker - pixels) * normals).sum(-1)[printed] > 0).all()
