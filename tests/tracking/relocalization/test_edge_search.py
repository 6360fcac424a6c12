"""Poses that are pulled onto the events: how far that reaches, and what it leaves alone."""

import pytest
import torch
from both_ways import both_ways
from helpers import SMALL_CAMERA, pose_errors
from torch.nn.functional import avg_pool2d
from tracked_boxes import in_motion

from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.relocalization.edge_search import FAR_PX, NEAR_PX, pulled, strongest_along_normals
from torchtrack.tracking.relocalization.event_image import event_density
from torchtrack.tracking.relocalization.view_sphere import outlines_at

IMAGE_SIZE = (SMALL_CAMERA.height, SMALL_CAMERA.width)
LOOSE = torch.diag(torch.tensor([0.3] * 3 + [0.05] * 3, dtype=torch.float64).square())[None]


def of_box(dtype=torch.float32):
    """A prediction of a box in motion, the image of its events, and its true pose."""
    _, prediction, seen, _, T_true = in_motion(dtype=dtype)
    density = event_density(prediction.carried(seen.pixels, seen.age_s), seen.mask, IMAGE_SIZE)
    return prediction, avg_pool2d(density.clamp(max=3), 3, 1, 1), T_true


def displaced(prediction, *offsets):
    return prediction.poses_at(torch.tensor(offsets, dtype=prediction.T_cam_obj.dtype))


def pulled_twice(prediction, T_cam_obj, image):
    for reaches_px in (FAR_PX, NEAR_PX):
        T_cam_obj = pulled(prediction, T_cam_obj, outlines_at(prediction, T_cam_obj, TrackerConfig()), image, LOOSE, reaches_px)
    return T_cam_obj


def test_poses_farther_off_than_events_look_for_contours_are_pulled_near(dtype):
    prediction, image, T_true = of_box(dtype)
    poses = displaced(prediction, [0.12, -0.1, 0.12, 0.01, -0.01, 0.01], [-0.1, 0.15, 0.0, -0.015, 0.01, -0.02], [0.0, 0.0, -0.2, 0.02, 0.015, 0.0])
    ends = pulled_twice(prediction, poses, image)
    assert ends.dtype == dtype
    before, after = (pose_errors(at.double(), T_true.expand(3, 4, 4)) for at in (poses, ends))
    assert float(before[0].min()) > 9
    assert float(after[0].max()) < 4
    assert float(after[1].max()) < 10


def test_without_events_only_the_prediction_pulls():
    prediction, image, _ = of_box()
    poses = displaced(prediction, [0.1, 0.0, 0.0, 0.01, 0.0, 0.0])
    ends = pulled_twice(prediction, poses, torch.zeros_like(image))
    torch.testing.assert_close(ends, prediction.T_cam_obj, atol=2e-3, rtol=0)


@pytest.mark.parametrize("bad", [torch.nan, -3.0])
def test_a_pose_that_is_none_or_behind_the_camera_spoils_no_other(bad):
    prediction, image, _ = of_box()
    poses = displaced(prediction, [0.1, 0.0, 0.0, 0.01, 0.0, 0.0], [0.0, 0.1, 0.0, 0.0, 0.01, 0.0])
    spoilt = torch.cat([poses[:1], poses[:1], poses[1:]])
    spoilt[1, 2, 3] = bad
    ends = pulled_twice(prediction, spoilt, image)
    assert torch.equal(ends[[0, 2]], pulled_twice(prediction, poses, image))


def test_contour_points_find_events_the_same_by_a_kernel(dtype):
    prediction, image, _ = of_box(dtype)
    poses = displaced(prediction, [0.1, 0.0, 0.0, 0.01, 0.0, 0.0], [0.0, 0.1, 0.2, 0.0, 0.01, 0.0])
    outlines = outlines_at(prediction, poses, TrackerConfig())
    outlines.pixels[0, 3], outlines.pixels[1, 5], outlines.mask[1, 7] = torch.nan, 1e12, False
    (targets, weights), (expected, counts) = both_ways(lambda: strongest_along_normals(outlines, image, FAR_PX[0]))
    torch.testing.assert_close(weights, counts, rtol=1e-5, atol=1e-5)
    assert not weights[1, 7] and float(weights.max()) > 1
    # Of places with as much, one way may take the one and the other the other.
    there = counts > 0
    there[0, 3] = there[1, 5] = False
    assert ((targets - expected)[there].norm(dim=-1) < 1e-3).double().mean() > 0.97
