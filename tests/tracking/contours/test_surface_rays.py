"""Where lines of sight meet an object's faces."""

import pytest
import torch
import trimesh
from helpers import BOX_EXTENTS_M, SMALL_CAMERA, box_model, generator, pose, random_pose

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import project
from torchtrack.core.lie import se3_inverse, transform_points
from torchtrack.object_model import ObjectModel, contour_source
from torchtrack.object_model.contour_source import group_by_model
from torchtrack.tracking.contours.surface_rays import rays_of, surface_points

INTRINSICS = SMALL_CAMERA.intrinsics(torch.float64)[None]


def models_of(*models):
    return [group.double() for group in group_by_model(models, ContourConfig())]


def pixels_around(T_cam_obj, count=200):
    centre = project(T_cam_obj[:, None, :3, 3], INTRINSICS.expand(len(T_cam_obj), 4))
    return centre + 60 * (torch.rand(len(T_cam_obj), count, 2, generator=generator(), dtype=torch.float64) - 0.5)


@pytest.mark.parametrize("seed", range(3))
def test_points_lie_on_the_box_on_their_line_of_sight(seed):
    T = random_pose(2, seed=seed)
    pixels, intrinsics = pixels_around(T), INTRINSICS.expand(2, 4)
    met = surface_points(models_of(box_model(), box_model()), T, pixels, intrinsics)
    assert met.mask.any(1).all()
    torch.testing.assert_close(project(met.points_cam, intrinsics), pixels)
    points = transform_points(se3_inverse(T), met.points_cam)
    beyond = (points.abs() - torch.tensor(BOX_EXTENTS_M, dtype=torch.float64) / 2).max(-1).values[met.mask]
    torch.testing.assert_close(beyond, torch.zeros_like(beyond), rtol=0, atol=1e-7)
    torch.testing.assert_close(met.normals_cam.norm(dim=-1), met.mask.double())
    # The near side, not the far one.
    assert bool((met.points_cam[..., 2][met.mask] < T[:, 2, 3].max() + 0.1).all())


def test_the_nearest_face_is_met():
    mesh = trimesh.util.concatenate([trimesh.creation.box((0.1, 0.1, 0.01)), trimesh.creation.box((0.2, 0.2, 0.01)).apply_translation((0, 0, 0.1))])
    T = pose((0, 0, 0))[None]
    model = models_of(ObjectModel.from_mesh(mesh, name="two"))
    pixels = project(torch.tensor([[[0.0, 0.0, 0.5], [0.07, 0.0, 0.5]]], dtype=torch.float64), INTRINSICS)
    depth_m = surface_points(model, T, pixels, INTRINSICS).points_cam[0, :, 2]
    torch.testing.assert_close(depth_m, torch.tensor([0.495, 0.595], dtype=torch.float64))


def test_beside_the_object_nothing_is_met():
    met = surface_points(models_of(box_model()), pose()[None], torch.tensor([[[5.0, 5.0]]], dtype=torch.float64), INTRINSICS)
    assert met.mask.tolist() == [[False]]
    assert met.points_cam[0, 0, 2] == 1
    assert bool(torch.isfinite(met.shifted_to(torch.tensor([[[6.0, 5.0]]], dtype=torch.float64), INTRINSICS)).all())


def test_nothing_is_met_on_a_dense_mesh(monkeypatch):
    monkeypatch.setattr(contour_source, "EXACT_FACES", 0)
    T = pose()[None]
    assert not surface_points(models_of(box_model()), T, pixels_around(T), INTRINSICS).mask.any()


def test_objects_do_not_disturb_one_another():
    T = torch.stack([pose(), torch.full((4, 4), torch.nan, dtype=torch.float64)])
    pixels = pixels_around(pose()[None]).repeat(2, 1, 1)
    both = surface_points(models_of(*[box_model()] * 2), T, pixels, INTRINSICS.expand(2, 4))
    alone = surface_points(models_of(box_model()), T[:1], pixels[:1], INTRINSICS)
    torch.testing.assert_close(both.points_cam[:1], alone.points_cam)
    assert not both.mask[1].any()


def test_a_pixel_nearby_meets_the_same_plane():
    T = pose()[None]
    pixels = pixels_around(T)
    met = surface_points(models_of(box_model()), T, pixels, INTRINSICS)
    shifted = met.shifted_to(pixels + 0.5, INTRINSICS)
    off_plane = ((shifted - met.points_cam) * met.normals_cam).sum(-1)[met.mask]
    torch.testing.assert_close(off_plane, torch.zeros_like(off_plane), rtol=0, atol=1e-7)
    torch.testing.assert_close(project(shifted, INTRINSICS)[met.mask], (pixels + 0.5)[met.mask])


def test_rays_reach_a_metre():
    torch.testing.assert_close(rays_of(INTRINSICS[:, None, 2:], INTRINSICS), torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64))
