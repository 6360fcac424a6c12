"""Poses that are pulled onto the events: how far that reaches, and what it leaves alone."""

import pytest
import torch
from helpers import SMALL_CAMERA, pose_errors
from torch.nn.functional import avg_pool2d
from tracked_boxes import in_motion

from torchtrack.config.tracker import TrackerConfig
from torchtrack.event_image import event_density
from torchtrack.event_pull import pulled

IMAGE_SIZE = (SMALL_CAMERA.height, SMALL_CAMERA.width)
LOOSE = torch.diag(torch.tensor([0.3] * 3 + [0.05] * 3, dtype=torch.float64).square())


def of_box(dtype=torch.float32):
    """A prediction of a box in motion, the image of its events, and its true pose."""
    _, prediction, seen, _, T_true = in_motion(dtype=dtype)
    density = event_density(prediction.carried(seen.pixels, seen.age_s), seen.mask, IMAGE_SIZE)
    return prediction, avg_pool2d(density.clamp(max=3)[None], 3, 1, 1)[0], T_true


def displaced(prediction, *offsets):
    return prediction.poses_at(torch.tensor(offsets, dtype=prediction.T_cam_obj.dtype))


def test_poses_farther_off_than_events_look_for_contours_are_pulled_near(dtype):
    prediction, image, T_true = of_box(dtype)
    poses = displaced(prediction, [0.12, -0.1, 0.12, 0.01, -0.01, 0.01], [-0.1, 0.15, 0.0, -0.015, 0.01, -0.02], [0.0, 0.0, -0.2, 0.02, 0.015, 0.0])
    found = pulled(prediction, poses, image, LOOSE, TrackerConfig())
    assert found.dtype == dtype
    before, after = (pose_errors(at.double(), T_true.expand(3, 4, 4)) for at in (poses, found))
    assert float(before[0].min()) > 9
    assert float(after[0].max()) < 4
    assert float(after[1].max()) < 10


def test_without_events_only_the_prediction_pulls():
    prediction, image, _ = of_box()
    poses = displaced(prediction, [0.1, 0.0, 0.0, 0.01, 0.0, 0.0])
    found = pulled(prediction, poses, torch.zeros_like(image), LOOSE, TrackerConfig())
    torch.testing.assert_close(found, prediction.T_cam_obj, atol=2e-3, rtol=0)


@pytest.mark.parametrize("bad", [torch.nan, -3.0])
def test_a_pose_that_is_none_or_behind_the_camera_spoils_no_other(bad):
    prediction, image, _ = of_box()
    poses = displaced(prediction, [0.1, 0.0, 0.0, 0.01, 0.0, 0.0], [0.0, 0.1, 0.0, 0.0, 0.01, 0.0])
    spoilt = torch.cat([poses[:1], poses[:1], poses[1:]])
    spoilt[1, 2, 3] = bad
    found = pulled(prediction, spoilt, image, LOOSE, TrackerConfig())
    assert torch.equal(found[[0, 2]], pulled(prediction, poses, image, LOOSE, TrackerConfig()))
