"""What is known of an object's motion before its first window, and that it may begin whenever it likes."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, pose, random_events
from tracked_boxes import WINDOW_US, follow, merged, moving_box, tracker_of, windows

from torchtrack.config.tracker import MotionConfig
from torchtrack.core.lie import rotation_angle_deg
from torchtrack.tracking.initialization import unknown_speed
from torchtrack.tracking.motion.model import initial_covariance
from torchtrack.tracking.validation.status import Status

DIAMETER_M = torch.tensor([0.2, 0.1])
COVARIANCE = initial_covariance(DIAMETER_M, MotionConfig(initial_speed_m_s=0.6))


def test_unknown_speed_is_that_of_the_rim():
    # As much by turning as by moving.
    torch.testing.assert_close(unknown_speed(COVARIANCE, DIAMETER_M), torch.full((2,), 0.6 * 2**0.5, dtype=torch.float64))


@pytest.mark.parametrize("noise", [0, 30])
@pytest.mark.parametrize("still", [4, 40])
def test_an_object_that_stands_still_at_first_is_tracked_once_it_moves(still, noise):
    trajectory, events = moving_box(pose(), 20)
    events = replace(events, t_us=events.t_us + still * WINDOW_US)
    if noise:
        size = {"width": SMALL_CAMERA.width, "height": SMALL_CAMERA.height}
        events = merged(random_events(noise * (still + 20), duration_us=(still + 20) * WINDOW_US, **size), events)
    tracker = tracker_of()
    _, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, still + 20))
    truth = trajectory.at(torch.tensor([20 * WINDOW_US]))
    assert float(rotation_angle_deg(results[-1].T_cam_obj[:, :3, :3], truth[:, :3, :3])) < 0.5
    assert int(results[-1].status[0]) == Status.TRACKING
