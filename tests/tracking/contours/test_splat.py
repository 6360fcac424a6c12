"""The paper's contours: the boundary of the projected point cloud lies on the outline, all around it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from helpers import SMALL_CAMERA, box_model, generator, pose, random_pose
from scipy.spatial import ConvexHull

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import project
from torchtrack.core.lie import transform_points
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.contour_source import ContourKind, group_by_model
from torchtrack.tracking.contours.splat import boundary_points, splat_contours

CONFIG = ContourConfig(source="splat")
INTRINSICS = SMALL_CAMERA.intrinsics(torch.float64)


def splatted(models, T, config=CONFIG, dtype=torch.float64):
    groups = [group.to(dtype) for group in group_by_model(models, config)]
    return splat_contours(groups, T.to(dtype), INTRINSICS.to(dtype).expand(len(T), 4), config)


def ball_model(radius_m=0.05):
    return ObjectModel.from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=radius_m), name="ball")


def distance_to_outline(pixels, hull_points):
    """Distance (px) of each pixel to the convex outline of ``hull_points``."""
    corners = hull_points[ConvexHull(hull_points).vertices]
    distances = []
    for start, end in zip(corners, np.roll(corners, -1, 0), strict=True):
        along = np.clip(((pixels - start) @ (end - start)) / ((end - start) ** 2).sum(), 0, 1)
        distances.append(np.linalg.norm(pixels - start - along[:, None] * (end - start), axis=1))
    return np.min(distances, 0)


def filled_disc(radius, step=0.7):
    """Points all over a disc, as a projected cloud."""
    grid = torch.arange(-radius, radius + step, step, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(grid, grid, indexing="xy"), -1).flatten(0, 1)
    return points[points.norm(dim=-1) <= radius]


def test_the_boundary_of_a_ball_is_its_outline(dtype):
    radius_m, depth_m = 0.05, 0.4
    contours = splatted([ball_model(radius_m)], pose((0.1, 0.2, 0.3), (0.0, 0.0, depth_m))[None], dtype=dtype)
    offset = (contours.pixels[0][contours.mask[0]] - INTRINSICS[2:]).double()
    outline = SMALL_CAMERA.fx * radius_m / (depth_m**2 - radius_m**2) ** 0.5
    assert len(offset) > 100
    # Points of the cloud lie inside, by at most the two pixels that the rim is wide, and rounding.
    beyond = offset.norm(dim=-1) - outline
    assert float(beyond.max()) < 0.05
    assert float(beyond.min()) > -3.5
    assert float(beyond.mean()) > -1.2
    around = torch.atan2(offset[:, 1], offset[:, 0]).sort().values
    assert float(torch.diff(around).max()) < 0.25
    radial = (contours.normals[0][contours.mask[0]].double() * offset).sum(-1).abs() / offset.norm(dim=-1)
    assert float(radial.min()) > 0.95
    assert float(radial.median()) > 0.98


@pytest.mark.parametrize("seed", range(3))
def test_the_boundary_of_a_box_is_its_silhouette(seed, dtype):
    T = random_pose(2, seed=seed, spread_m=0.02)
    contours = splatted([box_model()] * 2, T, dtype=dtype)
    corners = torch.from_numpy(trimesh.creation.box((0.12, 0.10, 0.08)).vertices.copy())
    for number in range(2):
        hull = project((corners @ T[number, :3, :3].T + T[number, :3, 3])[None], INTRINSICS[None])[0].numpy()
        pixels = contours.pixels[number][contours.mask[number]].double().numpy()
        assert len(pixels) > 100
        distances = distance_to_outline(pixels, hull)
        assert distances.max() < 4
        assert distances.mean() < 1.5
        outline = hull[ConvexHull(hull).vertices]
        for start, end in zip(outline, np.roll(outline, -1, 0), strict=True):
            for fraction in (0.25, 0.5, 0.75):
                place = start + fraction * (end - start)
                assert np.linalg.norm(pixels - place, axis=1).min() < 6


def test_contours_know_what_they_are(dtype):
    T = random_pose(2)
    contours = splatted([box_model()] * 2, T, dtype=dtype)
    assert (contours.kind == int(ContourKind.SPLAT)).all()
    assert contours.pixels.dtype == dtype
    assert contours.pixels.shape == (2, CONFIG.max_edge_points, 2)
    expected = project(contours.points_obj.double() @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3], INTRINSICS.expand(2, 4))
    torch.testing.assert_close(contours.pixels.double()[contours.mask], expected[contours.mask], rtol=0, atol=1e-3)
    lengths = contours.normals[contours.mask].norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths), rtol=1e-5, atol=0)
    half = torch.tensor([0.06, 0.05, 0.04], dtype=dtype)
    on_face = ((contours.points_obj.abs() - half).abs() < 1e-5).any(-1)
    assert on_face[contours.mask].all()


def test_points_inside_are_no_boundary_and_the_rim_is():
    disc = filled_disc(30.0)
    on_boundary, normals = boundary_points(disc[None] + 50, torch.ones(1, len(disc), dtype=torch.bool), 3)
    distance = disc.norm(dim=-1)
    assert not on_boundary[0][distance < 27].any()
    assert on_boundary[0][distance > 29.5].float().mean() > 0.9
    rim = on_boundary[0] & (distance > 28)
    assert float(((normals[0][rim] * disc[rim]).sum(-1).abs() / distance[rim]).min()) > 0.9


def test_gaps_between_points_are_closed_and_holes_are_not():
    disc = filled_disc(30.0, step=2.0)
    ring = disc[disc.norm(dim=-1) > 15]
    on_boundary, _ = boundary_points(ring[None] + 50, torch.ones(1, len(ring), dtype=torch.bool), 3)
    distance = ring.norm(dim=-1)
    assert not on_boundary[0][(distance > 19) & (distance < 26)].any()
    assert on_boundary[0][distance < 16].any()


def test_points_that_are_not_valid_do_not_count():
    disc = filled_disc(20.0)
    far = torch.cat([disc, torch.tensor([[500.0, 0.0], [1e9, 1e9]])])
    valid = torch.ones(1, len(far), dtype=torch.bool)
    valid[0, -2:] = False
    on_boundary, _ = boundary_points(far[None], valid, 3)
    expected, _ = boundary_points(disc[None], valid[:, :-2], 3)
    assert torch.equal(on_boundary[:, :-2], expected)
    assert not on_boundary[0, -2:].any()


def test_a_batch_is_its_elements(dtype):
    models, T = [box_model(), ball_model(), box_model()], random_pose(3, seed=4)
    together = splatted(models, T, dtype=dtype)
    for number, model in enumerate(models):
        alone = splatted([model], T[number : number + 1], dtype=dtype)
        assert torch.equal(together.mask[number], alone.mask[0])
        mask = alone.mask[0]
        torch.testing.assert_close(together.pixels[number][mask], alone.pixels[0][mask], rtol=1e-5, atol=1e-4)
        torch.testing.assert_close(together.normals[number][mask], alone.normals[0][mask], rtol=1e-4, atol=1e-4)


def test_objects_behind_the_camera_and_bad_poses_have_no_contours(dtype):
    T = torch.stack([pose(), pose(translation=(0.0, 0.0, -0.5)), torch.full((4, 4), torch.nan, dtype=torch.float64)])
    contours = splatted([box_model()] * 3, T, dtype=dtype)
    assert contours.mask[0].any()
    assert not contours.mask[1:].any()


def test_points_close_to_the_plane_of_the_camera_need_no_vast_image():
    """A point 2 mm before the camera's plane and 0.1 m beside its axis is projected 12,500 pixels away."""
    rng = generator(7)
    cloud = torch.rand((1000, 3), generator=rng) * torch.tensor([0.2, 0.2, 0.1]) - torch.tensor([0.1, 0.1, 0.05])
    near = torch.tensor([[0.1, 0.0, -0.498], [-0.1, 0.1, -0.498], [0.0, -1.0, -0.4989]])
    models = [replace(box_model(), surface_points=points, surface_normals=torch.zeros_like(points)) for points in (torch.cat([cloud, near]), cloud)]
    T = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.5))[None]
    assert float(project(transform_points(T, near[None].double()), INTRINSICS[None]).abs().amax(-1).min()) > 10_000
    contours, expected = (splatted([model] * 50, T.repeat(50, 1, 1)) for model in models)
    assert int(expected.mask.sum()) > 50 * 30
    assert torch.equal(contours.mask, expected.mask)
    assert torch.equal(contours.pixels[contours.mask], expected.pixels[expected.mask])


def test_what_lies_far_beside_the_image_is_no_boundary_and_what_lies_near_is():
    """Beside it by half its size at most: there the boundary still helps an object that enters."""
    models, T = [ball_model()] * 3, torch.stack([pose(translation=(x, 0.0, 0.5)) for x in (0.0, 0.25, 0.6)])
    contours = splatted(models, T)
    count = contours.mask.sum(1).tolist()
    assert count[0] > 100
    assert count[1] > 100
    assert count[2] == 0
    assert float(contours.pixels[1][contours.mask[1]][:, 0].max()) > SMALL_CAMERA.width
