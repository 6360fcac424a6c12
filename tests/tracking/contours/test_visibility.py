"""Hidden contours against rays: behind the object's own faces, and behind other objects of the same stream."""

import numpy as np
import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, random_pose
from solid_models import ball, l_prism

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import Camera
from torchtrack.object_model import ObjectModel, contour_source
from torchtrack.object_model.contour_source import group_by_model
from torchtrack.tracking.contours import visibility
from torchtrack.tracking.contours.depth_buffer import Scene
from torchtrack.tracking.contours.sampling import mesh_contours
from torchtrack.tracking.contours.visibility import hidden_by_faces, remove_hidden
from torchtrack.tracking.validation.measures import visible_ratio

CONFIG = ContourConfig()
LARGE_CAMERA = Camera(fx=600.0, fy=600.0, cx=319.5, cy=239.5, width=640, height=480)


def extracted(models, T, *, streams=None, camera=SMALL_CAMERA, stream_count=None, config=CONFIG, dtype=torch.float64):
    """Contours of objects before and after hidden ones are removed."""
    streams = torch.tensor(streams if streams is not None else [0] * len(models))
    groups = [group.to(dtype) for group in group_by_model(models, config)]
    T, intrinsics = T.to(dtype), camera.intrinsics(dtype).expand(len(models), 4)
    diameters = torch.tensor([model.diameter_m for model in models], dtype=dtype)
    shape = (stream_count or int(streams.max()) + 1, camera.height, camera.width)
    shared = len(streams.unique()) < len(streams)
    contours = mesh_contours(groups, T, intrinsics, config)
    return contours, remove_hidden(contours, Scene(groups, T, intrinsics, streams, diameters, shape, shared))


def ray_hits(points_cam, triangles_cam):
    """Möller and Trumbore: for the ray from the camera to each point (1 at the point), depth along it and least
    barycentric coordinate of every triangle ``[n, f]``."""
    points, triangles = points_cam.double().numpy(), triangles_cam.double().numpy()
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(points[:, None], e2[None])
    determinant = (p * e1[None]).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = -(p * a[None]).sum(-1) / determinant
        q = np.cross(-a, e1)
        v = (points[:, None] * q[None]).sum(-1) / determinant
        along = (e2 * q).sum(-1)[None] / determinant
    least = np.minimum(np.minimum(u, v), 1 - u - v)
    return along, np.where(np.isfinite(least), least, -1)


# ---- the object's own faces


@pytest.mark.parametrize("seed", range(4))
def test_what_hides_behind_the_objects_own_faces_is_what_rays_say(seed, dtype):
    mesh = l_prism()
    model = ObjectModel.from_mesh(mesh, name="bracket")
    T = random_pose(4, seed=seed)
    before, after = extracted([model] * 4, T, streams=[0, 1, 2, 3], dtype=dtype)
    hidden, shown = 0, 0
    for number in range(4):
        mask = before.mask[number]
        triangles = torch.from_numpy(mesh.triangles.copy()) @ T[number, :3, :3].T + T[number, :3, 3]
        points = before.points_cam[number][mask]
        along, inside = ray_hits(points, triangles)
        # A hit well in front and well inside hides; without one even at the border, nothing does.
        clear_m = 0.01
        certain = ((inside > 1e-3) & ((1 - along) * points.double().norm(dim=-1).numpy()[:, None] > clear_m)).any(1)
        possible = ((inside > -1e-3) & (along > 0) & (along < 1 - 1e-6)).any(1)
        kept = after.mask[number][mask].numpy()
        assert not kept[certain].any()
        assert kept[~possible].all()
        hidden, shown = hidden + certain.sum(), shown + (~possible).sum()
    assert hidden > 30
    assert shown > 800


@pytest.mark.parametrize("seed", range(3))
def test_a_convex_object_hides_none_of_its_contours(seed, dtype):
    T = random_pose(6, seed=seed)
    before, after = extracted([box_model()] * 6, T, streams=list(range(6)), dtype=dtype)
    assert torch.equal(before.mask, after.mask)


def test_a_thin_face_seen_at_a_grazing_angle_keeps_its_edges(dtype):
    plate = box_model((0.12, 0.1, 0.004))
    T = torch.stack([pose((0.0, turn, 0.0)) for turn in (1.3, 1.5, 1.56)])
    before, after = extracted([plate] * 3, T, streams=[0, 1, 2], dtype=dtype)
    assert torch.equal(before.mask, after.mask)


def test_one_triangle_hides_what_is_behind_it_and_inside_its_cone(dtype):
    triangle = torch.tensor([[[[-0.1, -0.1, 0.5], [0.1, -0.1, 0.5], [0.0, 0.1, 0.5]]]], dtype=dtype)
    points = torch.tensor([[[0.0, 0.0, 0.6], [0.0, 0.0, 0.4], [0.0, 0.0, 0.5005], [0.3, 0.0, 0.9], [0.0, 0.0, -0.6], [0.0, -0.19, 1.0]]], dtype=dtype)
    for order in ([0, 1, 2], [2, 1, 0]):
        normal = torch.tensor([[[0.0, 0.0, 1.0 if order[0] == 0 else -1.0]]], dtype=dtype)
        hidden = hidden_by_faces(points, triangle[:, :, order], normal, torch.tensor([1e-3], dtype=dtype))
        assert hidden.tolist() == [[True, False, False, False, False, True]]


@pytest.mark.parametrize("exact_faces", [0, 5000], ids=["buffer", "exact"])
def test_a_part_in_front_hides_the_part_behind(monkeypatch, exact_faces):
    """Two balls in line: none of the smaller one behind is seen."""
    monkeypatch.setattr(contour_source, "EXACT_FACES", exact_faces)
    model = ObjectModel.from_mesh([ball(0.05, (0, 0, -0.06)), ball(0.03, (0, 0, 0.06))], name="balls")
    before, after = extracted([model], pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.5))[None])
    front = before.points_obj[..., 2] < 0
    assert int((before.mask & ~front).sum()) > 80
    assert not (after.mask & ~front).any()
    assert (after.mask & front).any()


@pytest.mark.parametrize("exact_faces", [0, 5000], ids=["buffer", "exact"])
def test_the_smooth_silhouette_of_a_ball_is_not_hidden(monkeypatch, exact_faces):
    monkeypatch.setattr(contour_source, "EXACT_FACES", exact_faces)
    model = ObjectModel.from_mesh(ball(0.05), name="ball")
    before, after = extracted([model] * 3, random_pose(3), streams=[0, 1, 2])
    assert (after.mask.sum(1) > 0.95 * before.mask.sum(1)).all()


# ---- other objects


def two_plates(stream_of_front=0, camera=SMALL_CAMERA, **kwargs):
    """A small box in front of the left half of a larger one; before and after."""
    models = [box_model((0.1, 0.12, 0.02)), box_model()]
    T = torch.stack([pose((0.0, 0.0, 0.0), (-0.04, 0.0, 0.35)), pose()])
    return extracted(models, T, streams=[stream_of_front, 0], camera=camera, **kwargs), T


def test_an_object_in_front_hides_what_is_behind_it(dtype):
    (before, after), T = two_plates(dtype=dtype)
    half = torch.tensor([0.05, 0.06])
    depth = 0.34
    low, high = (SMALL_CAMERA.fx * (T[0, :2, 3] + side * half) / depth + torch.tensor([SMALL_CAMERA.cx, SMALL_CAMERA.cy]) for side in (-1, 1))
    pixels, was, now = before.pixels[1], before.mask[1], after.mask[1]
    inside = ((pixels > low + 4) & (pixels < high - 4)).all(-1)
    outside = ((pixels < low - 4) | (pixels > high + 4)).any(-1)
    assert int((was & inside).sum()) > 100
    assert int((was & outside).sum()) > 100
    assert int((now & inside).sum()) <= 0.02 * int((was & inside).sum())
    assert torch.equal(now & outside, was & outside)


def test_the_nearest_object_is_not_hidden(dtype):
    (before, after), _ = two_plates(dtype=dtype)
    assert torch.equal(before.mask[0], after.mask[0])


def test_an_object_of_another_stream_hides_nothing():
    (before, after), _ = two_plates(stream_of_front=1)
    assert torch.equal(before.mask, after.mask)


def test_an_object_in_front_hides_also_where_another_stream_has_no_object():
    (_, expected), _ = two_plates()
    (_, after), _ = two_plates(stream_count=2)
    assert torch.equal(after.mask, expected.mask)


def test_an_object_behind_the_camera_hides_nothing():
    models = [box_model(), box_model((0.3, 0.3, 0.02))]
    T = torch.stack([pose(), pose((0.0, 0.0, 0.0), (0.0, 0.0, -0.2))])
    before, after = extracted(models, T)
    assert torch.equal(before.mask[0], after.mask[0])
    assert not after.mask[1].any()


def test_a_large_object_in_front_hides_all_that_is_behind_it():
    """A plate of 450x375 pixels before a small box."""
    models = [box_model((0.45, 0.375, 0.02)), box_model((0.1, 0.08, 0.05))]
    T = torch.stack([pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.6)), pose((0.5, 0.6, 0.1), (0.0, 0.0, 1.0))])
    before, after = extracted(models, T, camera=LARGE_CAMERA)
    assert int(before.mask[1].sum()) > 100
    assert int(after.mask[1].sum()) < 0.05 * int(before.mask[1].sum())


def test_polylines_hide_nothing_and_are_hidden_by_others():
    line = ObjectModel.from_polylines([[[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]]])
    models = [line, box_model((0.05, 0.05, 0.02))]
    behind = torch.stack([pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.5)), pose((0.0, 0.0, 0.0), (0.04, 0.0, 0.3))])
    _, after = extracted(models, behind)
    x = after.points_obj[0, :, 0][after.mask[0]]
    assert float(x.max()) < 0.04
    assert float(x.min()) < -0.045
    in_front = behind.clone()
    in_front[0, 2, 3] = 0.2
    before, after = extracted(models, in_front)
    assert torch.equal(before.mask, after.mask)


# ---- poses at the border of what can be seen


@pytest.mark.parametrize("x_m", [0.25, 0.35, 0.4])
def test_contours_outside_the_image_are_not_said_to_be_hidden(x_m):
    """Else an object that leaves the image seems to be in view until it is gone."""
    model = ObjectModel.from_mesh(ball(0.1, subdivisions=4), name="ball")
    before, after = extracted([model], pose((0.0, 0.0, 0.0), (x_m, 0.0, 0.6))[None], camera=LARGE_CAMERA)
    sizes = torch.tensor([[LARGE_CAMERA.height, LARGE_CAMERA.width]])
    assert float(visible_ratio(after, sizes)) == pytest.approx(float(visible_ratio(before, sizes)), abs=0.1)


def test_a_bad_pose_harms_no_neighbour(dtype):
    model = ObjectModel.from_mesh(ball(0.05), name="ball")
    T = torch.stack([pose(), torch.full((4, 4), torch.nan, dtype=torch.float64), pose((0.2, 0.1, 0.0), (0.05, 0.0, 0.6))])
    _, together = extracted([model, model, box_model()], T, dtype=dtype)
    _, alone = extracted([model, box_model()], T[[0, 2]], dtype=dtype)
    assert not together.mask[1].any()
    assert torch.equal(together.mask[[0, 2]], alone.mask)


def test_a_batch_of_streams_is_its_elements(dtype):
    bracket = ObjectModel.from_mesh(l_prism(), name="bracket")
    balls = ObjectModel.from_mesh([ball(0.05, (0, 0, -0.06)), ball(0.03, (0, 0, 0.06))], name="balls")
    models, streams, T = [bracket, balls, box_model(), bracket], [0, 1, 1, 2], random_pose(4, seed=5)
    _, together = extracted(models, T, streams=streams, dtype=dtype)
    for stream in range(3):
        members = [number for number in range(4) if streams[number] == stream]
        _, alone = extracted([models[number] for number in members], T[members], dtype=dtype)
        width = alone.mask.shape[1]
        assert torch.equal(together.mask[members, :width], alone.mask)
        assert not together.mask[members, width:].any()


# ---- who is drawn


def places(*positions):
    """Poses of objects at these places (m)."""
    return torch.stack([pose((0.3, -0.4, 0.2), position) for position in positions])


@pytest.mark.parametrize(
    ("positions", "drawn"),
    [
        ([(-0.1, 0.0, 0.5), (0.1, 0.0, 0.5)], [False, False]),
        ([(-0.1, 0.0, 0.5), (0.1, 0.0, 0.5), (0.06, 0.02, 0.4)], [False, True, True]),
        ([(0.0, 0.0, 0.3), (0.0, 0.0, 0.7)], [True, True]),
        # Partly behind the camera: not all of its outline is in the image.
        ([(-0.1, 0.0, 0.5), (0.1, 0.0, 0.02)], [True, True]),
    ],
    ids=["apart", "two_of_three", "one_before_the_other", "at_the_camera"],
)
def test_only_objects_beside_others_are_drawn_and_nothing_else_changes(monkeypatch, positions, drawn):
    asked, models, T = [], [box_model((0.06, 0.08, 0.05))] * len(positions), places(*positions)
    may_overlap_others = visibility.may_overlap_others
    monkeypatch.setattr(visibility, "may_overlap_others", lambda *scene: asked.append(may_overlap_others(*scene)) or asked[-1])
    _, actual = extracted(models, T)
    assert asked[-1].tolist() == drawn
    monkeypatch.setattr(visibility, "may_overlap_others", lambda scene, *_: torch.ones_like(scene.stream_index, dtype=torch.bool))
    assert torch.equal(actual.mask, extracted(models, T)[1].mask)


def test_objects_of_other_streams_are_not_beside_one_another():
    models, T = [box_model()] * 2, places((0.0, 0.0, 0.3), (0.0, 0.0, 0.7))
    _, alone = extracted(models[:1], T[1:])
    _, actual = extracted([*models, box_model()], torch.cat([T, places((0.01, 0.0, 0.3))]), streams=[0, 1, 0])
    assert torch.equal(actual.mask[1, : alone.mask.shape[1]], alone.mask[0])


def test_no_input_is_changed():
    models = [box_model((0.1, 0.12, 0.02)), box_model()]
    T = torch.stack([pose((0.0, 0.0, 0.0), (-0.04, 0.0, 0.35)), pose()])
    copy = T.clone()
    before, _ = extracted(models, T)
    again, _ = extracted(models, T)
    assert torch.equal(T, copy)
    assert torch.equal(before.mask, again.mask)
