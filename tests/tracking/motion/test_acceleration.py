"""Accelerations: found from a window, carried on to the next ones, left out where they hardly move anything, and what they do for fast motion."""

import math
from functools import cache

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, edge_events, generator, pose, pose_errors
from states import changed
from tracked_boxes import WINDOW_US, follow, started, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.presets import preset
from torchtrack.config.tracker import AssociationConfig, CornerConfig, MotionConfig, SolverConfig, TrackerConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.core.lie import so3_exp
from torchtrack.core.linalg import inverse
from torchtrack.sim.trajectory import Trajectory
from torchtrack.tracking.expectation import predicted_after
from torchtrack.tracking.motion.model import (
    Acceleration,
    acceleration_counts,
    acceleration_sigma,
    carried_on,
    found_acceleration,
    predict_covariance,
    window_acceleration,
)
from torchtrack.tracking.validation.status import Status

DT_S = 0.005
# Exact events, though few of them: corners are observed as well. Nothing is common to their errors.
CORNERS, EXACT = CornerConfig(max_corners=32), SolverConfig(observation_px=0.2, common_px=0.0)
# Which events count as late does not change while velocities are compared.
DATED = AssociationConfig(pixel_latency=False)
STEADY = TrackerConfig(
    corners=CORNERS, association=DATED, motion=MotionConfig(acceleration_s=0.0), solver=EXACT.model_copy(update={"acceleration_in_window": False})
)
ALWAYS = TrackerConfig(corners=CORNERS, association=DATED, motion=MotionConfig(acceleration_px=0.0), solver=EXACT)
DEFAULT = TrackerConfig(corners=CORNERS, association=DATED, solver=EXACT)
COUNT = 20
# Windows after the start.
SWINGING = slice(4, COUNT)


def numbers(*values):
    return torch.tensor(values, dtype=torch.float64)


# ---- what is found of it


def test_the_acceleration_found_is_the_mean_of_those_that_agree_with_pose_and_velocity():
    """Of many drawn motions, the acceleration regressed on where they came out."""
    config, velocity, diameter_m = MotionConfig(), numbers(3.0, -2.0, 5.0, 0.3, 0.2, -0.4)[None], numbers(0.2)
    before = torch.diag_embed(numbers(*[1e-4] * 3, *[1e-8] * 3, *[0.5] * 3, *[1e-3] * 3))[None]
    sigma = acceleration_sigma(velocity, diameter_m[:, None], config)
    covariance = predict_covariance(before, velocity, numbers(DT_S), diameter_m, config)
    count = 200_000
    start = torch.randn((count, 12), generator=generator(1), dtype=torch.float64) @ torch.linalg.cholesky(before[0]).T
    acceleration = torch.randn((count, 6), generator=generator(2), dtype=torch.float64) * sigma
    pose_offset = start[:, :6] + DT_S * start[:, 6:] + 0.5 * DT_S**2 * acceleration
    ended = torch.cat([pose_offset, start[:, 6:] + DT_S * acceleration], 1)
    expected = torch.linalg.lstsq(ended, acceleration).solution.T
    window = window_acceleration(torch.zeros_like(sigma), sigma, torch.ones_like(sigma[:, :1]), covariance, numbers(DT_S))
    information = inverse(covariance)
    for offset in 0.5 * ended[:5]:
        actual = found_acceleration(window, information, offset[None], numbers(DT_S))[0]
        assert ((actual - expected @ offset).abs() < 0.05 * sigma[0]).all()


def test_an_expected_acceleration_is_what_is_found_where_all_came_as_predicted():
    expected = numbers(10.0, -5.0, 0.0, 1.0, 2.0, -3.0)[None]
    window = Acceleration(expected, torch.ones(1, 6).double(), torch.ones(1, 6).double())
    nothing = torch.zeros(1, 12, dtype=torch.float64)
    assert torch.equal(found_acceleration(window, torch.eye(12, dtype=torch.float64)[None], nothing, numbers(DT_S)), expected)
    assert torch.equal(window.at(nothing[:, :6]), expected)


def test_a_velocity_that_was_not_known_before_was_not_gained_in_the_window():
    sigma, counts = torch.full((1, 6), 300.0).double(), torch.ones(1, 1).double()
    known = torch.diag_embed((DT_S * sigma[0]).square().repeat(2))[None]
    actual = [window_acceleration(0 * sigma, sigma, counts, scale * known, numbers(DT_S)).rate_hz for scale in (1, 1e4)]
    # All of it, within the window; and next to nothing of it.
    torch.testing.assert_close(actual[0], torch.full((1, 6), 1 / DT_S).double())
    torch.testing.assert_close(actual[1], torch.full((1, 6), 1e-4 / DT_S).double())


# ---- how far it counts


def test_it_counts_where_it_moves_contours_within_a_window():
    config, sigma = MotionConfig(acceleration_px=0.25), numbers(2, 20, 200).view(3, 1).expand(3, 6)
    counts = acceleration_counts(sigma, numbers(DT_S, DT_S, DT_S), numbers(1000.0, 1000.0, 1000.0), config)[:, 0]
    # Half of 20 m/s² times (5 ms)², at 1000 px/m: a quarter of a pixel.
    assert counts.tolist() == pytest.approx([1e-4, 0.5, 1], abs=1e-3)


def test_without_a_limit_all_count_and_without_time_none():
    sigma, px_per_m = torch.full((1, 6), 20.0).double(), numbers(1000.0)
    assert float(acceleration_counts(sigma, numbers(DT_S), px_per_m, MotionConfig(acceleration_px=0.0))) == 1
    assert float(acceleration_counts(sigma, numbers(0.0), px_per_m, MotionConfig())) == pytest.approx(0, abs=1e-12)


def test_it_dies_away():
    acceleration = torch.arange(6.0)[None]
    later = carried_on(acceleration, torch.tensor([0.03]), MotionConfig(acceleration_s=0.03))
    torch.testing.assert_close(later, acceleration / math.e)
    for config in (MotionConfig(acceleration_s=0.0), MotionConfig(model="hold")):
        assert not carried_on(acceleration, torch.tensor([DT_S]), config).any()


# ---- in the image


def test_pixels_change_their_velocity_by_the_acceleration():
    T_cam_obj, points = pose()[None], 0.05 * torch.randn((1, 20, 3), generator=generator(), dtype=torch.float64)
    velocity, acceleration = numbers(1, -2, 3, 0.1, 0.2, 0.3)[None], numbers(100, 50, -200, 2, -3, 4)[None]
    centre, intrinsics = T_cam_obj[:, :3, 3], SMALL_CAMERA.intrinsics(torch.float64)[None]
    _, slow, change = MovingObjects(T_cam_obj, velocity, centre, intrinsics, acceleration).show(points)
    _, fast, none = MovingObjects(T_cam_obj, velocity + 0.01 * acceleration, centre, intrinsics).show(points)
    torch.testing.assert_close(slow + 0.01 * change, fast)
    assert none is None


# ---- in the tracker


def swung():
    """A box that swings to and fro: about the optical axis at up to 7.5 rad/s and 225 rad/s², and along the image."""
    t_us = torch.arange(0, (COUNT + 1) * WINDOW_US, 250)
    phase = 30e-6 * t_us.double()
    nothing = torch.zeros_like(phase)
    T_cam_obj = pose().expand(len(phase), 4, 4).clone()
    T_cam_obj[:, :3, :3] = so3_exp(torch.stack([nothing, nothing, 0.25 * (1 - phase.cos())], 1)) @ T_cam_obj[:, :3, :3]
    T_cam_obj[:, 0, 3] += 0.01 * (1 - phase.cos())
    return Trajectory(t_us, T_cam_obj)


@cache
def swings(config):
    """Poses' errors, velocities and accelerations about the optical axis, and the true ones, of a swung box."""
    trajectory = swung()
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    state, states, results = tracker.init(trajectory.T_cam_obj[:1], 0), [], []
    for window in windows(edge_events(trajectory), COUNT):
        state, (result,) = follow(tracker, state, [window])
        states.append(state)
        results.append(result)
    phase = 30e-6 * torch.stack([state.t_us[0] for state in states]).double()
    errors = torch.stack([pose_errors(result.T_cam_obj, trajectory.at(result.t_us))[0][0] for result in results])
    velocity, acceleration = (torch.stack([getattr(state.motion, name)[0, 2] for state in states]).double() for name in ("velocity", "acceleration"))
    return errors, velocity - 7.5 * phase.sin(), acceleration, 225 * phase.cos()


def test_the_velocity_of_what_is_swung_does_not_lag():
    # At a constant velocity it lags by half a window's gain, 0.6 rad/s at most, and by what it takes to be believed.
    lagging, followed = (swings(config)[1][SWINGING].square().mean().sqrt() for config in (STEADY, ALWAYS))
    assert float(lagging) > 0.5
    assert float(followed) < 0.6 * float(lagging)
    assert float(swings(ALWAYS)[0][SWINGING].mean()) < float(swings(STEADY)[0][SWINGING].mean())


def test_the_acceleration_of_what_is_swung_is_found():
    _, _, actual, expected = swings(ALWAYS)
    assert float(torch.corrcoef(torch.stack([actual, expected])[:, SWINGING])[0, 1]) > 0.75


def test_slow_objects_are_followed_as_without_it():
    poses = [started(config=config)[2].T_cam_obj for config in (DEFAULT, STEADY)]
    degrees, millimetres = pose_errors(*poses)
    assert float(degrees) < 0.02
    assert float(millimetres) < 0.05


def test_what_is_not_seen_has_no_acceleration():
    tracker, state, _, _, _ = started()
    state = changed(state, acceleration=torch.full_like(state.motion.acceleration, 100.0))
    state, result = tracker.step(state, EventBatch.empty(), int(state.t_us) + WINDOW_US)
    assert int(result.status) >= int(Status.LOST)
    assert not state.motion.acceleration.any()


def test_an_object_that_is_partly_hidden_has_none_either():
    # What is hidden is also matched with an eye on polarities, if these are remembered.
    tracker, state, _, (events, end_us), _ = started(config=TrackerConfig(disabled={Component.POLARITY_PRIOR}))
    seen, hidden = (
        tracker.step(changed(state, reference_explained_ratio=torch.full_like(state.health.score, full)), events, end_us) for full in (1.0, 10.0)
    )
    assert seen[0].motion.acceleration.any()
    assert not hidden[0].motion.acceleration.any()
    assert torch.equal(seen[1].T_cam_obj, hidden[1].T_cam_obj)


def test_without_a_prior_there_is_none():
    config = preset("paper")
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    state = tracker.init(pose()[None], 0)
    assert predicted_after(tracker, state, torch.tensor([DT_S])).acceleration is None
