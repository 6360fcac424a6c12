"""The tracker in other precisions, on other devices, saved and loaded, and with other settings."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors, random_events
from tracked_boxes import HOLD, SAME_POSE, WINDOW_US, assert_same, follow, moving_box, poses_of, started, tracker_of, windows

from torchtrack import Tracker, preset
from torchtrack.config.tracker import (
    AssociationConfig,
    ContourConfig,
    CornerConfig,
    MotionConfig,
    SolverConfig,
    TrackerConfig,
)
from torchtrack.config.validation import ValidationConfig
from torchtrack.object_model import contour_source
from torchtrack.tracking.validation.status import Status

# ---- precision, devices, saved settings


def test_both_precisions_agree():
    _, _, single, _, _ = started(torch.float32, count=8)
    _, _, double, _, _ = started(torch.float64, count=8)
    degrees, millimetres = pose_errors(single.T_cam_obj, double.T_cam_obj)
    assert float(degrees) < 0.02
    assert float(millimetres) < 0.1


@pytest.mark.parametrize("to", [torch.float32, torch.float64])
def test_a_tracker_can_be_cast(to):
    _, events = moving_box(pose(), 5)
    cast = tracker_of(dtype=torch.float32).to(to)
    made = tracker_of(dtype=to)
    runs = [follow(tracker, tracker.init(pose()[None], 0), windows(events, 5))[1] for tracker in (cast, made)]
    assert runs[0][-1].contours.pixels.dtype == to
    torch.testing.assert_close(poses_of(runs[0]), poses_of(runs[1]), rtol=0, atol=SAME_POSE[to] * 10)


def test_every_device_gives_the_same(device):
    _, _, expected, _, _ = started()
    _, events = moving_box(pose(), 6)
    tracker = tracker_of().to(device)
    state, results = follow(tracker, tracker.init(pose()[None], 0), [(batch.to(device), end) for batch, end in windows(events, 5)])
    assert state.T_cam_obj.device.type == device.type
    torch.testing.assert_close(results[-1].T_cam_obj.cpu(), expected.T_cam_obj, rtol=0, atol=1e-4)


def test_a_tracker_can_be_saved_and_loaded(tmp_path):
    tracker, state, _, (events, end_us), _ = started()
    expected = tracker.step(state, events, end_us)[1]
    torch.save(tracker.state_dict(), tmp_path / "tracker.pt")
    other = Tracker([box_model()], replace(SMALL_CAMERA, fx=222.0, cx=90.0))
    assert not torch.equal(other.step(state, events, end_us)[1].T_cam_obj, expected.T_cam_obj)
    missing, unexpected = other.load_state_dict(torch.load(tmp_path / "tracker.pt", weights_only=True))
    assert not missing
    assert not unexpected
    assert_same(other.step(state, events, end_us)[1], expected)


# ---- settings


@pytest.mark.parametrize(
    "config",
    [
        TrackerConfig(corners=CornerConfig(max_corners=32)),
        TrackerConfig(solver=SolverConfig(prior=False, iterations=2)),
        TrackerConfig(solver=SolverConfig(loss="huber")),
        TrackerConfig(contours=ContourConfig(remove_hidden=False)),
        TrackerConfig(association=AssociationConfig(gates_px=(4.0, 2.0))),
        preset("guided"),
        preset("nns"),
        TrackerConfig(motion=MotionConfig(model="hold")),
    ],
    ids=["corners", "no_prior", "huber", "all_contours", "two_rounds", "guided", "nns", "held"],
)
def test_a_box_is_tracked_with_other_settings(config):
    assert_tracked(config)


def test_a_box_is_tracked_with_hidden_contours_removed_by_a_depth_buffer(monkeypatch):
    monkeypatch.setattr(contour_source, "EXACT_FACES", 0)
    assert_tracked(TrackerConfig())


def assert_tracked(config):
    trajectory, events = moving_box(pose(), 10)
    tracker = tracker_of(config=config)
    _, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, 10))
    assert all(int(result.status) <= Status.UNCERTAIN for result in results)
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, trajectory.at(results[-1].t_us))
    assert float(degrees) < 0.6
    assert float(millimetres) < 1.5


def test_without_events_beside_the_corners_the_corners_are_all_that_is_observed():
    validation = ValidationConfig(min_observations=6)
    config = TrackerConfig(corners=CornerConfig(max_corners=32), association=AssociationConfig(max_events=0), validation=validation)
    _, _, result, _, _ = started(config=config)
    assert 6 <= int(result.observation_count) <= int(result.corners.mask.sum())


def test_matches_count_once_also_where_both_coordinates_do():
    """In a single round the matches are the same, whatever is then made of them."""
    _, events = moving_box(pose(), 8)
    paper, counts = preset("paper"), {}
    for residual in ("normal", "point"):
        config = paper.model_copy(update={"association": paper.association.model_copy(update={"residual": residual, "gates_px": (8.0,)})})
        tracker = tracker_of(config=config)
        counts[residual] = int(tracker.step(tracker.init(pose()[None], 0), events.slice_time(0, 25_000), 25_000)[1].observation_count)
    assert counts["normal"] > 6
    assert counts["point"] == counts["normal"]


@pytest.mark.parametrize("residual", ["point", "normal"])
def test_the_papers_settings_run(residual, dtype):
    settings = preset("paper")
    settings = settings.model_copy(update={"association": settings.association.model_copy(update={"residual": residual})})
    _, _, result, _, _ = started(dtype, settings, count=10)
    assert torch.isfinite(result.T_cam_obj).all()
    assert (result.contours.pixels.dtype, result.corners.mask.shape[0]) == (dtype, 1)
    assert Status(int(result.status)) in Status
    assert result.corners.has_flow.any()


def test_noise_alone_moves_a_pose_hardly():
    tracker = tracker_of(config=HOLD)
    state = tracker.init(pose()[None], 0)
    for k in range(5):
        noise = random_events(400, width=200, height=150, duration_us=WINDOW_US, seed=k)
        state, result = tracker.step(state, replace(noise, t_us=noise.t_us + k * WINDOW_US), (k + 1) * WINDOW_US)
    degrees, millimetres = pose_errors(result.T_cam_obj, pose()[None])
    assert float(degrees) < 3
    assert float(millimetres) < 8
