"""Predictions: how uncertain contours are in the image, copies and moves, and how wide that opens the first gate."""

import pytest
import torch
from helpers import SMALL_CAMERA, generator, pose
from predicted_boxes import CENTRE_OBJ, CONTOURS, boxes
from tracked_boxes import started

from torchtrack.config.components import Component
from torchtrack.config.tracker import AssociationConfig, TrackerConfig
from torchtrack.core.camera import project
from torchtrack.core.image_velocity import object_plane_velocity, pixel_velocity
from torchtrack.core.lie import retract_about, transform_points
from torchtrack.tracking.estimation.rounds import gate_scale_of
from torchtrack.tracking.expectation import predicted_after


def random_covariance(count=1, scale=1e-6, seed=0):
    root = torch.randn((count, 12, 24), generator=generator(seed), dtype=torch.float64)
    units = torch.tensor([5.0] * 3 + [1.0] * 3 + [500.0] * 3 + [100.0] * 3, dtype=torch.float64)
    return scale * units[:, None] * (root @ root.transpose(1, 2)) / 24 * units


# ---- how uncertain contours are in the image


def test_the_deviation_in_the_image_is_that_of_drawn_poses():
    prediction = boxes(pose()[None], random_covariance())
    contours = prediction.objects.contours(prediction.T_cam_obj, CONTOURS)
    count = 2000
    root = torch.linalg.cholesky(prediction.covariance[0, :6, :6])
    drawn = torch.randn((count, 6), generator=generator(1), dtype=torch.float64) @ root.T
    poses = retract_about(prediction.T_cam_obj.expand(count, 4, 4), drawn, CENTRE_OBJ.expand(count, 3))
    points, normals = (value[0][contours.mask[0]][::5] for value in (contours.points_obj, contours.normals))
    moved = project(transform_points(poses, points.expand(count, -1, 3)), SMALL_CAMERA.intrinsics(torch.float64).expand(count, 4))
    still = project(transform_points(prediction.T_cam_obj, points[None]), prediction.objects.intrinsics)
    expected = ((moved - still) * normals).sum(-1).square().mean().sqrt()
    # Some sixty points stand for all.
    assert float(prediction.sigma_px(contours)) == pytest.approx(float(expected), rel=0.1)
    assert float(expected) > 0.2


def test_the_deviation_grows_with_that_of_the_pose_and_falls_with_distance(dtype):
    covariance = torch.diag_embed(torch.tensor([0.0] * 3 + [1e-3, 1e-3, 0.0] + [0.0] * 6, dtype=torch.float64).square())
    sigma = []
    for scale, depth_m in ((1, 0.5), (2, 0.5), (1, 1.0)):
        prediction = boxes(pose(translation=(0.0, 0.0, depth_m))[None], scale**2 * covariance[None], dtype=dtype)
        sigma.append(float(prediction.sigma_px(prediction.objects.contours(prediction.T_cam_obj, CONTOURS))))
    # A millimetre at half a metre is half a pixel.
    assert sigma[0] == pytest.approx(0.5, rel=0.15)
    assert sigma[1] == pytest.approx(2 * sigma[0], rel=1e-4)
    assert sigma[2] == pytest.approx(0.5 * sigma[0], rel=0.15)


def test_what_is_certain_has_no_deviation_and_neither_has_what_is_not_seen():
    prediction = boxes(torch.stack([pose(), pose(translation=(0.0, 0.0, -0.5))]), torch.cat([torch.zeros(1, 12, 12).double(), random_covariance()]))
    contours = prediction.objects.contours(prediction.T_cam_obj, CONTOURS)
    assert not contours.mask[1].any()
    assert prediction.sigma_px(contours).tolist() == [0, 0]


# ---- velocities


def test_velocities_are_those_of_the_centre():
    velocity = torch.tensor([[0.5, -1.0, 2.0, 0.1, -0.2, 0.3]], dtype=torch.float64)
    prediction = boxes(pose()[None], velocity=velocity)
    contours = prediction.objects.contours(prediction.T_cam_obj, CONTOURS)
    centre = transform_points(pose()[None], CENTRE_OBJ[None, None])[:, 0]
    torch.testing.assert_close(prediction.centre_cam, centre)
    intrinsics = prediction.objects.intrinsics
    torch.testing.assert_close(prediction.contour_velocity(contours), pixel_velocity(contours.points_cam, velocity, centre, intrinsics))
    torch.testing.assert_close(prediction.plane_velocity(contours.pixels), object_plane_velocity(contours.pixels, velocity, centre, intrinsics))


# ---- moved, and copied


def test_a_moved_prediction_has_pose_and_velocity_moved(dtype):
    prediction = boxes(torch.stack([pose(), pose((0.1, 0.2, 0.3))]), random_covariance(2), torch.ones(2, 6), dtype)
    offset = 0.01 * torch.randn((2, 12), generator=generator(), dtype=torch.float64).to(dtype)
    moved = prediction.moved(offset)
    expected = retract_about(prediction.T_cam_obj, offset[:, :6], prediction.objects.centre_obj)
    torch.testing.assert_close(moved.T_cam_obj, expected)
    torch.testing.assert_close(moved.velocity, prediction.velocity + offset[:, 6:])
    assert moved.covariance is prediction.covariance
    assert moved.objects is prediction.objects
    # A pose alone may be moved too, where the solver has no further unknowns; and no move is none.
    torch.testing.assert_close(prediction.moved(torch.zeros(2, 12, dtype=dtype)).T_cam_obj, prediction.T_cam_obj)


def test_copies_are_of_one_object():
    prediction = boxes(torch.stack([pose(), pose((0.1, 0.2, 0.3))]), random_covariance(2), torch.arange(12.0).view(2, 6))
    copies = prediction.copies([1], 5)
    for name in ("T_cam_obj", "usable", "velocity", "covariance"):
        ours, given = getattr(copies, name), getattr(prediction, name)
        assert ours.shape == (5, *given.shape[1:])
        assert all(torch.equal(row, given[1]) for row in ours)
        assert ours.data_ptr() == given[1].data_ptr()


def test_one_prediction_takes_the_place_of_another_where_it_is_taken():
    rotations, speeds = ((0.5, 0.6, 0.1), (0.1, 0.2, 0.3)), torch.arange(12.0).view(2, 1, 6)
    own, other = (boxes(pose(rotations[row])[None], random_covariance(seed=row), speeds[row]) for row in range(2))
    three = own.copies([0], 3)
    for taken in (True, False):
        now = three.exchanged(torch.tensor([1]), other, torch.tensor([taken]))
        expected = [own, other if taken else own, own]
        for name in ("T_cam_obj", "velocity", "covariance"):
            assert torch.equal(getattr(now, name), torch.cat([getattr(p, name) for p in expected])), name


# ---- the first gate


def test_an_uncertain_prediction_opens_the_first_gate():
    config = TrackerConfig(association=AssociationConfig(gates_px=(5.0, 2.0)))
    sigma_px = torch.tensor([0.0, 1.0, 5 / 3, 2.5, 5.0, 100.0])
    assert gate_scale_of(sigma_px, config).tolist() == pytest.approx([1, 1, 1, 1.5, 3, 3.2])


def test_a_first_gate_that_is_wider_than_the_limit_stays():
    config = TrackerConfig(association=AssociationConfig(gates_px=(20.0, 2.0)))
    assert gate_scale_of(torch.tensor([0.0, 100.0]), config).tolist() == [1, 1]


def test_gates_that_are_not_to_open_stay():
    assert gate_scale_of(torch.tensor([0.0, 100.0]), TrackerConfig(disabled={Component.WIDE_GATES})).tolist() == [1, 1]


def test_in_motion_the_prediction_is_certain_to_a_pixel_or_two():
    tracker, state, _, _, _ = started()
    prediction = predicted_after(tracker, state, torch.tensor([5e-3]))
    sigma = float(prediction.sigma_px(prediction.objects.contours(prediction.T_cam_obj, CONTOURS)))
    assert 0.2 < sigma < 2.0
