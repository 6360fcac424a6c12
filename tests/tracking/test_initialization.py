"""How fast an object can be that has not been found yet."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, random_events
from tracked_boxes import WINDOW_US, follow, merged, moving_box, tracker_of, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.tracker import MotionConfig, TrackerConfig
from torchtrack.core.lie import rotation_angle_deg
from torchtrack.tracking.frontend.window_events import WindowEvents
from torchtrack.tracking.initialization import largest_speed, limit_speed, unknown_speed
from torchtrack.tracking.motion.model import initial_covariance
from torchtrack.tracking.validation.status import Status

DIAMETER_M = torch.tensor([0.2, 0.1])
COVARIANCE = initial_covariance(DIAMETER_M, MotionConfig(initial_speed_m_s=0.6))


def events_at(pixels):
    pixels = torch.as_tensor(pixels)[None]
    age_s = torch.zeros(pixels.shape[:2])
    return WindowEvents(pixels, age_s, age_s, torch.ones_like(age_s, dtype=torch.bool))


def test_unknown_speed_is_that_of_the_rim():
    # As much by turning as by moving.
    torch.testing.assert_close(unknown_speed(COVARIANCE, DIAMETER_M), torch.full((2,), 0.6 * 2**0.5, dtype=torch.float64))


def test_a_limit_is_on_what_moves_across_the_image():
    limited = limit_speed(COVARIANCE, torch.tensor([0.06 * 2**0.5, torch.inf]), DIAMETER_M, torch.tensor([0.5, 0.5]))
    share = (limited / COVARIANCE.where(COVARIANCE != 0, torch.inf))[0].diagonal().sqrt()
    # Along the line of sight, five times as much for an object five times as far away as its half width.
    expected = torch.tensor([1.0] * 6 + [0.1] * 5 + [0.5], dtype=torch.float64)
    torch.testing.assert_close(share, expected, rtol=1e-5, atol=0)
    assert torch.equal(limited[1], COVARIANCE[1])
    assert bool((torch.linalg.eigvalsh(limited) > 0).all())


def test_a_limit_that_is_stated_again_limits_no_further():
    """Also where one direction stays as unknown as it was, and others are far within the limit."""
    once = limit_speed(COVARIANCE, torch.tensor([0.06, 0.2]), DIAMETER_M, torch.tensor([2.0, 0.5]))
    again = limit_speed(once, torch.tensor([0.06, 0.3]), DIAMETER_M, torch.tensor([2.0, 0.5]))
    torch.testing.assert_close(again, once, rtol=1e-12, atol=0)


def test_the_largest_speed_grows_with_the_events_before_the_object():
    objects, T = tracker_of().objects, pose()[None].float()
    before, neighbours = torch.full((400, 2), 100.0), torch.full((4000, 2), 5.0)
    seen = (before[:200], before, torch.cat([before, neighbours]))
    speed = [float(largest_speed(objects, T, events_at(pixels), torch.tensor([0.005]))) for pixels in seen]
    assert speed[1] == pytest.approx(2 * speed[0])
    assert speed[2] == speed[1]


def test_without_events_some_speed_is_left():
    objects, T = tracker_of().objects, pose()[None].float()
    assert float(largest_speed(objects, T, events_at(torch.zeros(0, 2)), torch.tensor([0.005]))) > 0.01


@pytest.mark.parametrize("held_back", [True, False])
def test_an_object_that_has_not_been_found_is_held_back(held_back):
    _, events = moving_box(pose(), 2, move=(0.02, 0.0, 0.0), turn=(0.0, 0.0, 0.0))
    tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig(disabled=frozenset() if held_back else {Component.SPEED_FROM_EVENTS}))
    few = events[torch.arange(len(events)) % 20 == 0]
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(few, 1))
    assert (float(state.motion.covariance[0, 9, 9].sqrt()) < 0.3) == held_back


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
