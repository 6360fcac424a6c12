"""Tentative poses: when one begins, and what it takes to be kept or taken back."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers import pose
from states import changed
from tracked_boxes import assert_same, started, tracker_of

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.events import EventBatch
from torchtrack.tracking.expectation import predicted_after
from torchtrack.tracking.relocalization.tentative import confirm_or_take_back
from torchtrack.tracking.validation.status import Status

FULL_SHARE = 0.8
WIDE, TIGHT = 3.0, 1.0


@cache
def two_boxes():
    """Two boxes that are explained by 0.8 when seen well: before a window, what was predicted, and after it."""
    tracker = tracker_of(2)
    before = changed(tracker.init(pose().expand(2, 4, 4), t_us=0), reference_explained_ratio=torch.full((2,), FULL_SHARE))
    after, result = tracker.step(before, EventBatch.empty(), 5_000)
    actual = pose((0.1, -0.2, 0.4), (0.05, 0.02, 0.6)).expand(2, 4, 4)
    after = changed(after, T_cam_obj=actual, covariance=0.1 * after.motion.covariance, velocity=torch.ones_like(after.velocity))
    return before, predicted_after(tracker, before, torch.full((2,), 5e-3)), after, replace(result, T_cam_obj=actual)


def window(before, ratios, gate_scale=TIGHT, status=Status.TRACKING, config=None):
    """One window in which the boxes are explained by ``ratios``."""
    _, prediction, after, result = two_boxes()
    result = replace(result, quality=torch.tensor(ratios), status=torch.full((2,), int(status)))
    after = changed(after, tentative=before.tentative)
    return confirm_or_take_back(before, after, result, prediction, torch.tensor([gate_scale, TIGHT]), config or TrackerConfig())


def begun(ratio=FULL_SHARE):
    """After the first box was looked for all over, and relocalized."""
    return window(two_boxes()[0], [ratio, ratio], WIDE)


def test_a_new_pose_of_an_uncertain_object_is_tentative():
    _, prediction, after, _ = two_boxes()
    state, stated = begun()
    assert state.tentative.is_tentative.tolist() == [True, False]
    torch.testing.assert_close(state.tentative.T_cam_obj[0], prediction.T_cam_obj[0].double())
    assert torch.equal(state.tentative.covariance[0], prediction.covariance[0])
    assert torch.equal(state.T_cam_obj, after.T_cam_obj) and torch.equal(state.motion.covariance, after.motion.covariance)
    assert stated.status.tolist() == [Status.TRACKING] * 2
    assert not two_boxes()[0].tentative.is_tentative.any()


def test_what_was_not_relocalized_is_not_tentative():
    state, _ = window(two_boxes()[0], [FULL_SHARE] * 2, WIDE, Status.LOST)
    assert not state.tentative.is_tentative.any()


@pytest.mark.parametrize(("ratio", "windows"), [(0.8, 8), (0.6, 8), (0.5, 13)])
def test_a_tentative_pose_that_explains_about_as_much_as_when_seen_well_is_confirmed(ratio, windows):
    state, _ = begun(ratio)
    for _ in range(windows - 2):
        state, _ = window(changed(state, reference_explained_ratio=two_boxes()[0].health.reference_explained_ratio), [ratio, 0.0])
        assert state.tentative.is_tentative[0]
    state, result = window(changed(state, reference_explained_ratio=two_boxes()[0].health.reference_explained_ratio), [ratio, 0.0])
    assert not state.tentative.is_tentative.any()
    assert torch.equal(state.T_cam_obj, two_boxes()[2].T_cam_obj)
    assert result.status.tolist() == [Status.TRACKING] * 2


@pytest.mark.parametrize(("ratio", "windows"), [(0.0, 3), (0.2, 6), (0.3, 15)])
def test_a_tentative_pose_that_explains_too_little_is_taken_back_and_its_neighbour_stays(ratio, windows):
    before, prediction, after, _ = two_boxes()
    state, _ = begun(ratio)
    for _ in range(windows - 1):
        assert state.tentative.is_tentative[0]
        state, result = window(changed(state, reference_explained_ratio=before.health.reference_explained_ratio), [ratio, ratio])
    assert not state.tentative.is_tentative.any()
    torch.testing.assert_close(state.T_cam_obj[0], prediction.T_cam_obj[0].double())
    assert torch.equal(state.motion.covariance[0], prediction.covariance[0])
    assert not state.velocity[0].any()
    assert result.status.tolist() == [Status.LOST, Status.TRACKING]
    for name in ("T_cam_obj", "covariance", "velocity"):
        assert torch.equal(getattr(state.motion, name)[1], getattr(after.motion, name)[1])


@pytest.mark.parametrize("ratio", [0.8, 0.0])
def test_what_became_of_a_tentative_pose_says_nothing_of_the_next(ratio):
    state, _ = begun(ratio)
    for _ in range(8):
        state, _ = window(changed(state, reference_explained_ratio=two_boxes()[0].health.reference_explained_ratio), [ratio, ratio])
    assert not state.tentative.is_tentative.any()
    again, _ = window(changed(state, reference_explained_ratio=two_boxes()[0].health.reference_explained_ratio), [FULL_SHARE] * 2, WIDE)
    assert torch.equal(again.tentative.evidence, begun()[0].tentative.evidence)
    assert again.tentative.is_tentative.tolist() == [True, False]


def test_a_graver_status_stays():
    state, _ = begun(0.0)
    for _ in range(2):
        state, result = window(
            changed(state, reference_explained_ratio=two_boxes()[0].health.reference_explained_ratio), [0.0, 0.0], status=Status.DIVERGED
        )
    assert result.status.tolist() == [Status.DIVERGED] * 2


def test_an_object_that_was_never_seen_well_keeps_what_it_is_given():
    state, _ = window(changed(two_boxes()[0], reference_explained_ratio=torch.zeros(2)), [0.05, 0.05], WIDE)
    for _ in range(7):
        state, _ = window(changed(state, reference_explained_ratio=torch.zeros(2)), [0.05, 0.05])
    assert not state.tentative.is_tentative.any()
    assert torch.equal(state.T_cam_obj, two_boxes()[2].T_cam_obj)


def test_switched_off_and_where_nothing_is_uncertain_a_window_is_the_same():
    config = TrackerConfig(disabled={Component.TENTATIVE})
    _, on, last, (events, end_us), _ = started()
    with_it, of_it = tracker_of().step(on, events, end_us)
    without, of_none = tracker_of(config=config).step(on, events, end_us)
    assert not with_it.tentative.is_tentative.any()
    assert torch.equal(with_it.T_cam_obj, without.T_cam_obj)
    assert_same(of_it, of_none)
    assert int(last.status[0]) == Status.TRACKING
