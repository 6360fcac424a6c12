"""Runs with smoothed poses: every window once and in order, later, and nearer to the truth."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose
from tiny_sequence import CAMERA, write_tiny_sequence
from tracked_boxes import moving_box

from torchtrack import Tracker, preset
from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import SmoothingConfig, TrackerConfig
from torchtrack.core.camera import project
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import rotation_angle_deg
from torchtrack.errors import EventDataError
from torchtrack.io import read_tum
from torchtrack.io.columns import Columns
from torchtrack.io.live_source import LiveSource
from torchtrack.run.runner import run, track
from torchtrack.run.session import open_session
from torchtrack.run.smooth import SmoothedObjects, Smoother
from torchtrack.run.stepping import cut_windows
from torchtrack.run.streams import follow

LAG_S = 0.01
SMOOTHED = {"smoothing": {"lag_s": LAG_S}}


class Kept:
    """Follows a sequence and keeps its steps."""

    def __init__(self, path):
        self.session, self.steps = open_session(RunConfig(source=path)), []

    def windows(self, config):
        return cut_windows(self.session.chunks(), self.session.start_us, config)

    def add(self, step):
        self.steps.append(step)

    def finish(self):
        return len(self.steps)

    def close(self, error=None):
        pass


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"), labels=("left", "right"), duration_us=60_000)


def followed(path, **tracker):
    """The steps of a sequence."""
    kept = Kept(path)
    follow([lambda: kept], RunConfig(source=path, preset="causal", tracker=tracker))
    return kept.steps


@pytest.fixture(scope="module")
def both(path):
    """Steps of a sequence as they come, and smoothed."""
    return followed(path), followed(path, **SMOOTHED)


def test_every_window_comes_once_and_in_order(both):
    plain, smooth = both
    assert [step.window.t_end_us for step in smooth] == [step.window.t_end_us for step in plain]
    assert [len(step.window.events) for step in smooth] == [len(step.window.events) for step in plain]
    assert all(torch.equal(ours.result.status, theirs.result.status) for ours, theirs in zip(smooth, plain, strict=True))
    assert torch.equal(smooth[-1].result.status, plain[-1].result.status)
    assert float((smooth[-1].result.T_cam_obj - plain[-1].result.T_cam_obj).abs().max()) < 1e-9


def test_state_and_result_are_of_the_smoothed_pose(both):
    plain, smooth = both
    for before, after in zip(plain, smooth, strict=True):
        result = after.result
        assert torch.equal(after.state.T_cam_obj, result.T_cam_obj)
        rotation = result.T_cam_obj[:, :3, :3]
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(2, 3, 3), rtol=0, atol=1e-12)
        intrinsics = CAMERA.intrinsics().expand(2, 4)
        pixels = project(result.contours.points_cam, intrinsics)
        torch.testing.assert_close(pixels[result.contours.mask], result.contours.pixels[result.contours.mask], rtol=0, atol=1e-3)
        # What was known is known better.
        known, better = (torch.linalg.eigvalsh(step.result.covariance)[:, -1] for step in (before, after))
        assert (better <= known * (1 + 1e-9)).all()
    moved = [float((ours.result.T_cam_obj - theirs.result.T_cam_obj).abs().max()) for ours, theirs in zip(smooth, plain, strict=True)]
    assert max(moved[:-1]) > 1e-5


def test_states_are_given_on_without_maps_which_would_fill_the_memory(both):
    _, smooth = both
    for step in smooth:
        assert step.state.maps.last_event_us.numel() == step.state.maps.burst_age_us.numel() == 0
        assert step.state.maps.last_event_us.untyped_storage().nbytes() == step.state.maps.burst_age_us.untyped_storage().nbytes() == 0


def test_steps_are_held_back_for_the_lag_and_no_longer_than_twice_that(both, path):
    plain, _ = both
    session = open_session(RunConfig(source=path))
    smoother = Smoother(SmoothedObjects.from_models(session.models, session.camera), TrackerConfig(smoothing=SmoothingConfig(lag_s=LAG_S)))
    waited_us = [step.window.t_end_us - due.window.t_end_us for step in plain for due in smoother.add(step)]
    assert 1e6 * LAG_S <= min(waited_us) < max(waited_us) <= 2e6 * LAG_S
    assert len(waited_us) + len(smoother.rest()) == len(plain)
    assert smoother.rest() == []


def test_smoothed_poses_are_nearer_to_the_truth(both, path):
    truth = open_session(RunConfig(source=path)).ground_truth[0]

    def errors(steps):
        known = [step for step in steps if step.window.t_end_us <= int(truth.t_us[-1])]
        true = torch.stack([truth.at(torch.tensor([step.window.t_end_us]))[0] for step in known])
        T_estimated = torch.stack([step.result.T_cam_obj[0] for step in known])
        return [rotation_angle_deg(T_estimated[:, :3, :3], true[:, :3, :3]).mean(), (T_estimated - true)[:, :3, 3].norm(dim=-1).mean()]

    (plain_deg, plain_m), (smooth_deg, smooth_m) = (errors(steps) for steps in both)
    assert smooth_deg < 0.9 * plain_deg
    assert smooth_m < plain_m


def test_whoever_is_stopped_gets_what_was_held_back(path):
    kept, windows = Kept(path), []
    follow([lambda: kept], RunConfig(source=path, tracker=SMOOTHED), lambda: windows.append(None) or len(windows) == 5)
    assert len(kept.steps) == 5


def test_the_error_of_a_stream_is_told_and_what_was_held_back_is_given_on(path):
    kept = Kept(path)
    taken = kept.windows

    def broken(length):
        for number, window in enumerate(taken(length)):
            if number == 5:
                raise EventDataError("time goes back")
            yield window

    kept.windows = broken
    (outcome,) = follow([lambda: kept], RunConfig(source=path, tracker=SMOOTHED))
    assert "time goes back" in str(outcome)
    assert len(kept.steps) == 5


def test_an_object_left_out_altogether_is_no_matter(path):
    """A session without any object has nothing to smooth."""
    kept = Kept(path)
    kept.session = replace(kept.session, labels=(), models=(), ground_truth=(), T_cam_obj=kept.session.T_cam_obj[:0])
    assert follow([lambda: kept], RunConfig(source=path, tracker=SMOOTHED)) == [0]


def test_a_run_writes_smoothed_poses(path, tmp_path):
    summaries = [run(RunConfig(source=path, output=tmp_path / name, preset=name, overlay={"enabled": False})) for name in ("causal", "default")]
    plain, smooth = (read_tum(tmp_path / name / "trajectory_left.tum") for name in ("causal", "default"))
    assert torch.equal(plain.t_us, smooth.t_us)
    assert float((plain.T_cam_obj - smooth.T_cam_obj).abs().max()) > 1e-4
    assert summaries[1].windows == summaries[0].windows == len(smooth)
    assert load(RunConfig, tmp_path / "default" / "config.yaml").tracker.smoothing.lag_s == 0.05
    rows = list(csv.DictReader((tmp_path / "default" / "poses.csv").read_text().splitlines()))
    mean = np.mean([float(row["rotation_error_deg"]) for row in rows if row["label"] == "left" and row["rotation_error_deg"]])
    assert summaries[1].objects["left"].errors.mean_rotation_deg == pytest.approx(mean, rel=1e-4)


def test_track_gives_smoothed_results_where_the_tracker_is_set_so():
    _, events = moving_box(pose(), 12)
    results_by_preset = {}
    for name in ("causal", "default"):
        tracker = Tracker([box_model()], SMALL_CAMERA, preset(name))
        results_by_preset[name] = list(track([events], tracker, tracker.init(pose()[None], 0)))
    times = [[int(result.t_us[0]) for result in results] for results in results_by_preset.values()]
    assert times[0] == times[1] == [5000 * number for number in range(1, 13)]
    moved = [
        float((ours.T_cam_obj - theirs.T_cam_obj).abs().max())
        for ours, theirs in zip(results_by_preset["causal"], results_by_preset["default"], strict=True)
    ]
    assert max(moved[:-1]) > 1e-5
    assert moved[-1] < 1e-9


class Camera(LiveSource):
    """A live camera that has seen some events."""

    def __init__(self, events):
        super().__init__("camera", SMALL_CAMERA.width, SMALL_CAMERA.height)
        self.events = [Columns(events.t_us.numpy(), events.x.numpy(), events.y.numpy(), events.polarity.numpy())]

    def _receive(self):
        return self.events.pop() if self.events else None


def test_a_live_source_is_never_held_back():
    _, events = moving_box(pose(), 12)
    poses_of_each = []
    for name in ("causal", "default"):
        tracker = Tracker([box_model()], SMALL_CAMERA, preset(name))
        poses_of_each.append(torch.stack([result.T_cam_obj for result in track(Camera(events), tracker, tracker.init(pose()[None], 0))]))
    assert torch.equal(*poses_of_each)


def test_the_followers_of_a_live_source_get_its_steps_as_they_come(path):
    kept, windows = Kept(path), []
    kept.session = replace(kept.session, live=Camera(EventBatch.empty()))
    follow([lambda: kept], RunConfig(source=path, tracker=SMOOTHED), lambda: windows.append(len(kept.steps)) or len(windows) == 5)
    assert windows == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("lacking", [{"solver": {"prior": False}}, {"motion": {"model": "hold"}}], ids=["prior", "velocity"])
def test_what_has_no_filter_cannot_be_smoothed(lacking):
    with pytest.raises(ValueError, match="needs solver.prior true and motion.model constant_velocity"):
        TrackerConfig.model_validate({**lacking, **SMOOTHED})
    assert TrackerConfig.model_validate(lacking).smoothing.lag_s == 0
