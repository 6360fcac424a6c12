"""Where objects are looked for that were not seen well for long: around the pose that they had then."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose
from lost_states import moved_away, uncertain, unseen
from states import changed
from tracked_boxes import PREDICT, WINDOW_US, follow, in_motion, moving_box, started, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.lie import retract_about
from torchtrack.tracking.relocalization import last_seen
from torchtrack.tracking.relocalization.last_seen import LastSeen, anywhere, less_certain, with_drift
from torchtrack.tracking.state import joined
from torchtrack.tracking.validation import verdict
from torchtrack.tracking.validation.status import Status

CONFIG = TrackerConfig()
# A fifth of the image's diagonal.
_WIDEST_PX = 0.2 * (SMALL_CAMERA.width**2 + SMALL_CAMERA.height**2) ** 0.5


# ---- where


def test_the_longer_it_was_not_seen_the_farther_it_is_looked_for_and_one_look_after_the_other():
    tracker, state, *_ = started()
    sigma = [
        LastSeen.from_state(unseen(state, time_since_validated_s, looks=torch.tensor([look])), tracker.objects, CONFIG)
        .covariance[0]
        .diagonal()
        .sqrt()
        for time_since_validated_s, look in ((0.1, 0), (0.1, 1), (0.1, 2), (0.2, 5), (5.0, 2))
    ]
    assert [float(values[0]) for values in sigma[:3]] == pytest.approx([1 / 3, 2 / 3, 1.0])
    px_per_m = float(tracker.objects.px_per_m(state.health.T_last_validated.float()))
    assert [float(values[3]) * px_per_m for values in sigma[2:]] == pytest.approx([40.0, _WIDEST_PX, _WIDEST_PX], rel=1e-5)
    assert float(sigma[2][5]) == pytest.approx(0.1 * float(tracker.objects.depth_m(state.health.T_last_validated.float())), rel=1e-6)


def test_what_is_lost_rests_where_it_was_seen_well_and_its_neighbour_goes_on():
    tracker = Tracker([box_model()] * 2, SMALL_CAMERA)
    _, state, *_ = started()
    both = joined([unseen(state), state])
    both = replace(both, t_us=state.t_us, maps=state.maps)
    both = changed(both, T_cam_obj=moved_away(tracker, both, 0.4), velocity=both.velocity + 1)
    last_seen = LastSeen.from_state(both, tracker.objects, CONFIG)
    after = last_seen.in_place_of(both, torch.tensor([True, False]))
    assert torch.equal(after.T_cam_obj[0], both.health.T_last_validated[0]) and torch.equal(after.T_cam_obj[1], both.T_cam_obj[1])
    assert not after.velocity[0].any() and torch.equal(after.velocity[1], both.velocity[1])
    assert torch.equal(after.motion.covariance[1], both.motion.covariance[1]) and torch.equal(after.motion.covariance[0], last_seen.covariance[0])


def test_an_object_that_may_be_anywhere_has_a_covariance_without_bounds_of_its_own():
    _, state, *_ = started()
    assert torch.equal(anywhere(state.motion.covariance, torch.tensor([False])), state.motion.covariance)
    assert torch.equal(anywhere(state.motion.covariance, torch.tensor([True]))[0], torch.eye(12, dtype=torch.float64))


# ---- how far what drifts may be


def drifting(prediction, drift_s):
    return with_drift(prediction, torch.tensor([True]), torch.tensor([drift_s]))


def test_who_drifts_off_is_the_less_certain_the_longer_it_lasts(monkeypatch):
    monkeypatch.setattr(last_seen, "_DRIFT_DIAMETERS_S", 100)
    _, prediction, _, scored, _ = in_motion()
    contours = scored.fit.contours
    grown = [drifting(prediction, t) for t in (0.05, 0.1, 0.4, 1.0, 5.0)]
    sigma_px = [float(grown_for.sigma_px(contours)) for grown_for in grown]
    # Turning and moving together carry contours farther than either.
    assert all(20 * n < px < 40 * n for px, n in zip(sigma_px[:3], (0.5, 1, 4), strict=True))
    # In the end it may be rotated anyhow, but it is not looked for in another place.
    rotated_rad, moved_m = (torch.stack([grown_for.covariance[0, k, k].sqrt() for grown_for in grown[2:]]) for k in (0, 3))
    torch.testing.assert_close(rotated_rad[1:] / rotated_rad[0], torch.full((2,), 2.5, dtype=torch.float64), atol=0.01, rtol=0)
    torch.testing.assert_close(moved_m, moved_m[:1].expand(3))


def test_what_is_small_in_the_image_drifts_no_faster_for_its_size():
    """At 80 px, a box may drift off by one and a half diameters a second: less than 200 px."""
    _, prediction, _, scored, _ = in_motion()
    sigma_px = float(drifting(prediction, 0.2).sigma_px(scored.fit.contours))
    size_px = float(prediction.objects.size_px(prediction.T_cam_obj))
    assert 1.5 * size_px < 200
    assert 0.3 * size_px < sigma_px < 0.6 * size_px


def test_a_drift_is_one_velocity_that_explains_where_the_pose_is():
    _, prediction, _, _, _ = in_motion()
    lasted_s = 0.25
    added = drifting(prediction, lasted_s).covariance - prediction.covariance
    pose_part, both, rate = added[0, :6, :6], added[0, :6, 6:], added[0, 6:, 6:]
    torch.testing.assert_close(pose_part, lasted_s**2 * rate)
    torch.testing.assert_close(both, lasted_s * rate)


def test_others_are_as_certain_as_before():
    _, prediction, _, _, _ = in_motion()
    assert torch.equal(with_drift(prediction, torch.tensor([False]), torch.tensor([0.2])).covariance, prediction.covariance)


def test_of_what_slipped_all_is_less_certain_alike():
    _, prediction, *_ = in_motion()
    wider = less_certain(prediction, torch.tensor([0.5]), torch.tensor([2.5])).covariance
    torch.testing.assert_close(wider, 25 * prediction.covariance)


# ---- all together


LOST = {"lost": {"turn_rad": 0.45, "metres": 0.3, "sideways_m": 2.0}, "small, far behind": {"turn_rad": 0.01, "metres": 0.35, "sideways_m": 0.0}}


@pytest.mark.parametrize("name", LOST)
def test_an_object_that_ran_off_is_found_again_where_it_was_seen_well(name):
    """Its pose has left the image, or is that of a small thing behind it; a box that was never lost stays as it was."""
    lost = LOST[name]
    trajectory, events = moving_box(pose(), 30)

    @torch.no_grad()
    def after(*disabled):
        tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig(disabled=frozenset(disabled)))
        state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 8))
        away = moved_away(tracker, state, lost["metres"])
        away[:, 0, 3] += lost["sideways_m"]
        gone = unseen(state, T_cam_obj=away, covariance=uncertain(state, lost["turn_rad"]), velocity=torch.zeros_like(state.velocity))
        state, results = follow(tracker, gone, windows(events, 30)[8:])
        true = trajectory.at(torch.tensor([150_000]))[0]
        return float((results[-1].T_cam_obj[0] - true)[:3, 3].norm()), int(results[-1].status[0])

    found_m, status = after()
    assert found_m < 5e-3 and status == Status.TRACKING
    assert after(Component.AROUND_LAST_SEEN)[0] > 0.05


def test_an_object_that_holds_on_to_other_edges_is_found_again_where_it_was_seen_well(monkeypatch):
    """Sure of a pose forty degrees off, as near as it was: nowhere else is it looked for so far away."""
    monkeypatch.setattr(verdict, "DRIFT_BELOW", 0)
    disabled = {Component.LOW_SCORE}
    trajectory, events = moving_box(pose(), 30)

    @torch.no_grad()
    def after(not_validated_below):
        search = RelocalizationConfig(not_validated_below=not_validated_below, slow_drift_below=0)
        tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig(relocalization=search, disabled=disabled))
        state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 8))
        turned = retract_about(state.T_cam_obj, torch.tensor([[0.0, 0.3, 0.6, 0.0, 0.0, 0.0]], dtype=torch.float64), tracker.centre_obj.double())
        state, results = follow(tracker, unseen(state, T_cam_obj=turned), windows(events, 30)[8:])
        true = trajectory.at(torch.tensor([150_000]))[0]
        return float((results[-1].T_cam_obj[0] - true)[:3, :3].norm())

    assert after(0.75) < 0.02
    assert after(0.0) > 0.2


@torch.no_grad()
def test_where_an_object_was_last_seen_well_is_remembered_and_not_where_it_was_not():
    tracker, trajectory, events = Tracker([box_model()], SMALL_CAMERA, PREDICT), *moving_box(pose(), 8)
    state = tracker.init(pose()[None], 0)
    assert torch.equal(state.health.T_last_validated, state.T_cam_obj)
    state, results = follow(tracker, state, windows(events, 8))
    assert int(results[-1].status) == Status.TRACKING
    assert torch.equal(state.health.T_last_validated, state.T_cam_obj)
    later, results = follow(tracker, state, windows(events[:0], 2, 8 * WINDOW_US))
    assert int(results[-1].status) == Status.TOO_FEW_EVENTS
    assert float(state.health.time_since_validated_s) == 0 and float(later.health.time_since_validated_s) == pytest.approx(0.01)
    assert torch.equal(later.health.T_last_validated, state.health.T_last_validated) and not torch.equal(later.T_cam_obj, state.T_cam_obj)
    assert trajectory.at(state.t_us).shape == state.health.T_last_validated.shape
