"""The tracker as a filter: its covariance, its usual quality, and objects that come back after an outage."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from states import changed
from tracked_boxes import PREDICT, WINDOW_US, follow, moving_box, started, tracker_of, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.tracker import MotionConfig, SolverConfig, TrackerConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import difference_about, retract_about, transform_points
from torchtrack.core.pose_covariance import left_covariance
from torchtrack.tracking.expectation import predicted_after
from torchtrack.tracking.motion.model import initial_covariance
from torchtrack.tracking.validation.status import Status


def sigmas(state):
    """Deviations of pose and velocity of the first object."""
    return state.motion.covariance[0].diagonal().sqrt()


def silent(tracker, state, count):
    """States over windows without events."""
    states = [state]
    for _ in range(count):
        states.append(tracker.step(states[-1], EventBatch.empty(), int(states[-1].t_us) + WINDOW_US)[0])
    return states


# ---- the covariance


def test_the_first_covariance_is_that_of_the_settings():
    config = TrackerConfig(motion=MotionConfig(initial_shift=0.02, initial_speed_m_s=0.7))
    tracker = tracker_of(2, config=config)
    state = tracker.init(pose().repeat(2, 1, 1), 0)
    torch.testing.assert_close(state.motion.covariance, initial_covariance(tracker.diameter_m, config.motion))
    assert state.health.score.tolist() == state.health.mean_score.tolist() == [0, 0]


def test_events_make_pose_and_velocity_certain(dtype):
    tracker, state, _, _, _ = started(dtype)
    first = initial_covariance(tracker.diameter_m, tracker.config.motion)[0].diagonal().sqrt()
    assert (sigmas(state)[6:] < 0.7 * first[6:]).all()
    assert float(sigmas(state)[:3].max()) < 0.02
    assert float(sigmas(state)[3:6].max()) < 3e-3
    # Depth is what a camera sees least of.
    assert float(sigmas(state)[5]) > 2 * float(sigmas(state)[3:5].max())


def test_without_events_nothing_gets_more_certain_and_with_them_it_does_again(dtype):
    tracker, state, _, (events, end_us), _ = started(dtype)
    states = silent(tracker, state, 4)
    for before, after in pairwise(states):
        assert (torch.linalg.eigvalsh(after.motion.covariance[0] - before.motion.covariance[0])[-6:] > 0).all()
        assert (sigmas(after) >= sigmas(before)).all()
    later = replace(events, t_us=events.t_us + int(states[-1].t_us) - end_us + WINDOW_US)
    still = changed(states[-1], T_cam_obj=state.T_cam_obj, velocity=state.velocity)
    seen, _ = tracker.step(still, later, int(states[-1].t_us) + WINDOW_US)
    assert (sigmas(seen)[:6] < sigmas(states[-1])[:6]).all()


def test_errors_are_as_large_as_the_covariance_says():
    """Over many boxes: squared errors in units of the covariance are of the order of one, and none is far beyond it."""
    ratios = []
    for seed in range(6):
        start = pose((0.4 + 0.1 * seed, 0.6 - 0.2 * seed, 0.1))
        trajectory, events = moving_box(start, 10, seed=seed)
        tracker = tracker_of()
        _, results = follow(tracker, tracker.init(start[None], 0), windows(events, 10))
        for result in results[4:]:
            error = difference_about(trajectory.at(result.t_us), result.T_cam_obj, torch.zeros(1, 3).double())
            # The box turns about its own origin, which is its centre: from the left perturbation back to it.
            centre = -transform_points(result.T_cam_obj, torch.zeros(1, 1, 3).double())[:, 0]
            covariance = left_covariance(result.covariance, centre)[0]
            ratios.append(float(error[0] @ torch.linalg.solve(covariance, error[0])) / 6)
    ratios = torch.tensor(ratios)
    assert float(ratios.mean()) < 2
    assert float(ratios.max()) < 6


def test_the_covariance_told_is_of_the_left_perturbation(dtype):
    tracker, state, result, _, _ = started(dtype)
    centre = transform_points(state.T_cam_obj, tracker.centre_obj.double()[:, None])[:, 0]
    torch.testing.assert_close(result.covariance, left_covariance(state.motion.covariance[:, :6, :6], centre))


def test_without_a_prior_there_is_no_velocity():
    _, state, _, _, _ = started(config=TrackerConfig(solver=SolverConfig(prior=False, iterations=2)))
    assert (state.velocity == 0).all()
    assert torch.isfinite(state.motion.covariance).all()


@pytest.mark.parametrize("in_window", [True, False])
def test_the_velocity_is_learned(in_window, dtype):
    config = TrackerConfig(disabled=frozenset() if in_window else {Component.VELOCITY_IN_WINDOW})
    _, state, _, _, _ = started(dtype, config, count=10)
    assert state.velocity[0].tolist() == pytest.approx([0.8, -0.5, 1.2, 0.15, 0.1, 0.1], abs=0.12)


# ---- the usual quality


def test_the_usual_score_follows_the_share_slowly(dtype):
    _, events = moving_box(pose(), 10)
    tracker = tracker_of(dtype=dtype)
    state, usual, full = tracker.init(pose()[None], 0), 0.0, 0.0
    for batch, end_us in windows(events, 10):
        state, result = tracker.step(state, batch, end_us)
        usual += 0.1 * (float(result.quality) - usual)
        full += (0.1 if float(result.quality) > full else 0.005) * (float(result.quality) - full)
        assert float(state.health.score) == float(result.quality)
        assert float(state.health.mean_score) == pytest.approx(usual, abs=1e-5)
        assert float(state.health.reference_explained_ratio) == pytest.approx(full, abs=1e-5)
    assert 0.5 < usual < float(result.quality)


def test_a_window_that_failed_does_not_change_what_is_usual():
    tracker, state, _, _, _ = started()
    after, result = tracker.step(state, EventBatch.empty(), 30_000)
    assert int(result.status) == Status.TOO_FEW_EVENTS
    assert float(after.health.mean_score) == float(state.health.mean_score)
    assert float(after.health.reference_explained_ratio) == float(state.health.reference_explained_ratio)
    assert float(after.health.score) < float(state.health.score)


# ---- back after an outage


def test_a_box_that_turned_away_during_an_outage_is_found_again(dtype):
    """It goes on for 60 ms unseen, and turns back meanwhile: what was predicted is off by several pixels."""
    count, outage = 6, 12
    first, events = moving_box(pose(), count)
    moved = first.T_cam_obj[-1] @ pose((0.10, -0.08, 0.06), (0.0, 0.0, 0.0))
    moved[:3, 3] += torch.tensor([-0.006, 0.008, 0.0], dtype=torch.float64)
    second, later = moving_box(moved, 10)
    tracker = Tracker([box_model()], SMALL_CAMERA, dtype=dtype)
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, count))
    state = silent(tracker, state, outage)[-1]
    start_us = (count + outage) * WINDOW_US
    later = replace(later, t_us=later.t_us + start_us)
    expected_deg, expected_mm = pose_errors(state.T_cam_obj, moved[None])
    assert float(expected_deg) > 5 or float(expected_mm) > 10
    _, results = follow(tracker, state, windows(later, 10, start_us))
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, second.at(results[-1].t_us - start_us))
    assert int(results[-1].status) == Status.TRACKING
    assert float(degrees) < 0.6
    assert float(millimetres) < 2.0


def test_a_share_that_is_too_small_for_so_wide_a_search_is_no_find():
    """Where an object is looked for all over, a few edges that fit are not it: the pose stays as predicted."""
    tracker, state, _, (events, end_us), _ = started(config=PREDICT)
    uncertain = changed(state, covariance=1e3 * state.motion.covariance)
    away = retract_about(state.T_cam_obj, torch.tensor([[0.0, 0.0, 0.0, 0.06, 0.05, 0.0]]).double(), tracker.centre_obj.double())
    _, result = tracker.step(changed(uncertain, T_cam_obj=away), events[torch.arange(0, len(events), 8)], end_us)
    assert int(result.status) >= Status.LOST
    prediction = predicted_after(tracker, changed(uncertain, T_cam_obj=away), torch.tensor([5e-3]))
    torch.testing.assert_close(result.T_cam_obj, prediction.T_cam_obj.double(), rtol=0, atol=1e-6)
