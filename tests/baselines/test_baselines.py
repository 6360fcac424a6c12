"""The comparison methods: that they track what they are made for, and say what they are not made for."""

import pytest
import torch
import trimesh
from helpers import SMALL_CAMERA, box_model, contours_at, pose, pose_errors, random_events, upright_line
from states import changed
from tracked_boxes import WINDOW_US, assert_same, follow, moving_box, poses_of, windows

from torchtrack import Tracker, preset
from torchtrack.baselines import LeastSquaresTracker, LineTracker, tracker_class, unsuitable
from torchtrack.baselines.event_lines import nearest_lines
from torchtrack.baselines.line import corrected, predicted_covariance
from torchtrack.core import dispatch
from torchtrack.errors import EventDataError, ModelError, PoseError
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation.terms import Linearisation
from torchtrack.tracking.validation.status import Status

COUNT = 8


def ball():
    return ObjectModel.from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.05), name="ball")


def tracker_for(name, models, **kwargs):
    return tracker_class(name)(models, SMALL_CAMERA, preset(name), **kwargs)


# Corners are few in an image this small: they alone say less than the events.
@pytest.mark.parametrize(("name", "most_deg", "most_mm"), [("line", 0.6, 2.5), ("ls", 0.6, 2.5), ("nns", 1.0, 3.0)])
def test_a_box_is_tracked(name, most_deg, most_mm):
    truth, events = moving_box(pose(), COUNT)
    tracker = tracker_for(name, [box_model()])
    _, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, COUNT))
    at_ends = truth.at(torch.tensor([(k + 1) * WINDOW_US for k in range(COUNT)]))
    rotation_deg, translation_mm = pose_errors(poses_of(results), at_ends)
    assert rotation_deg.mean() < most_deg and translation_mm.mean() < most_mm
    # The first windows have to confirm the pose.
    assert all(int(result.status[0]) == Status.TRACKING for result in results[3:])


@pytest.mark.parametrize("name", ["line", "ls"])
def test_objects_do_not_disturb_each_other(name):
    _, events = moving_box(pose(), 2)
    alone, neighbours = tracker_for(name, [box_model()]), tracker_for(name, [box_model(), box_model((0.1, 0.1, 0.1))], stream_index=[0, 0])
    away = pose((0.1, 0.2, 0.3), (0.0, 5.0, 1.0))
    _, first = follow(alone, alone.init(pose()[None], 0), windows(events, 2))
    state = neighbours.init(pose().expand(2, 4, 4), 0)
    state = changed(state, T_cam_obj=torch.stack([pose(), away]))
    _, both = follow(neighbours, state, windows(events, 2))
    torch.testing.assert_close(poses_of(both), poses_of(first), rtol=0, atol=1e-5)
    assert int(both[-1].status[1]) == Status.OUT_OF_VIEW


@pytest.mark.parametrize("name", ["line", "ls"])
def test_a_step_is_pure(name):
    _, events = moving_box(pose(), 1)
    tracker = tracker_for(name, [box_model()])
    state = tracker.init(pose()[None], 0)
    assert_same(tracker.step(state, events, WINDOW_US), tracker.step(state, events, WINDOW_US))


@pytest.mark.parametrize("name", ["line", "ls"])
def test_events_out_of_order_are_refused(name):
    _, events = moving_box(pose(), 1)
    tracker = tracker_for(name, [box_model()])
    with pytest.raises(EventDataError, match="time goes back"):
        tracker.step(tracker.init(pose()[None], 0), events[torch.arange(len(events)).flip(0)], WINDOW_US)


@pytest.mark.parametrize("name", ["line", "ls"])
def test_no_kernels_means_none(name, monkeypatch):
    _, events = moving_box(pose(), 1)
    taken, trackers = [], [tracker_for(name, [box_model()], kernels=kernels) for kernels in (True, False)]
    state = trackers[0].init(pose()[None], 0)
    with torch.inference_mode():
        # The first step loads the kernels.
        trackers[0].step(state, events, WINDOW_US)
        for operation in dispatch.OPERATIONS.values():
            for body in operation.bodies.values():
                monkeypatch.setattr(body, "supports", lambda *_, **__: taken.append(1))
        trackers[1].step(state, events, WINDOW_US)
        assert not taken
        trackers[0].step(state, events, WINDOW_US)
        assert bool(taken) == dispatch.backend_is_installed()


@pytest.mark.parametrize("name", ["line", "ls"])
def test_without_events_the_motion_is_carried_on(name):
    _, events = moving_box(pose(), COUNT)
    tracker = tracker_for(name, [box_model()])
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, COUNT))
    nothing = random_events(0)
    after, result = tracker.step(state, nothing, (COUNT + 1) * WINDOW_US)
    assert int(result.status[0]) == Status.TOO_FEW_EVENTS
    moved = (after.T_cam_obj - state.T_cam_obj)[0, :3, 3].norm()
    # 0.2 m/s for 5 ms.
    assert 0.5e-3 < float(moved) < 1.5e-3
    # Without a time of its own the window ends with the newest event: here where it began.
    assert int(tracker.step(state, nothing)[1].t_us[0]) == COUNT * WINDOW_US


def test_a_prediction_behind_the_camera_is_not_followed():
    tracker = tracker_for("ls", [box_model()])
    state = tracker.init(pose()[None], 0)
    velocity = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, -1000.0]])
    state = changed(state, velocity=velocity)
    after, _ = tracker.step(state, random_events(0), WINDOW_US)
    assert torch.allclose(after.T_cam_obj, state.T_cam_obj, atol=1e-6)


@pytest.mark.parametrize("tracker", [LineTracker, LeastSquaresTracker])
def test_curved_objects_are_refused(tracker):
    with pytest.raises(ModelError, match=r"'ball' is curved.*use the preset default, guided or nns"):
        tracker([box_model(), ball()], SMALL_CAMERA)


def test_which_methods_suit_which_objects():
    assert [bool(unsuitable(name, ball())) for name in ("default", "paper", "line", "ls", "nns")] == [False, False, True, True, False]
    assert all(unsuitable(name, box_model()) is None for name in ("default", "line", "ls"))
    assert all(tracker_class(name) is Tracker for name in ("default", "paper", "nns"))
    assert (tracker_class("line"), tracker_class("ls")) == (LineTracker, LeastSquaresTracker)


def test_bad_starts_are_told_as_by_the_tracker():
    with pytest.raises(PoseError, match="not a rotation"):
        tracker_for("line", [box_model()]).init(2 * pose()[None], 0)


def test_the_filter_starts_with_its_own_uncertainty_and_carries_it_on():
    _, events = moving_box(pose(), COUNT)
    tracker = tracker_for("line", [box_model()])
    first = tracker.init(pose()[None], 0)
    assert first.motion.covariance[0].diagonal().sqrt().tolist() == pytest.approx([0.01] * 3 + [0.005] * 3 + [3.0] * 3 + [0.5] * 3)
    state, results = follow(tracker, first, windows(events, COUNT))
    sigma = state.motion.covariance[0].diagonal().sqrt()
    # Of events that are nearly all in common, a turn is known to a degree and a half.
    assert 0.005 < float(sigma[:3].max()) < 0.03
    assert (sigma[9:] < first.motion.covariance[0].diagonal()[9:].sqrt()).all()
    # The same, of the left perturbation: what holds of the turn about the centre holds of that.
    torch.testing.assert_close(results[-1].covariance[0, :3, :3], state.motion.covariance[0, :3, :3])
    after, _ = tracker.step(state, random_events(0), (COUNT + 1) * WINDOW_US)
    assert (torch.linalg.eigvalsh(after.motion.covariance[0, :6, :6] - state.motion.covariance[0, :6, :6]) > 0).all()


# ---- events and lines


def joined(*contours):
    return Contours(*(torch.cat([getattr(single, name) for single in contours], 1) for name in vars(contours[0])))


def test_an_event_belongs_to_a_line_within_the_gate():
    pixels = torch.tensor([[[52.9, 60.0], [53.1, 60.0], [49.0, 60.4], [50.0, 200.0]]], dtype=torch.float64)
    point, belongs = nearest_lines(pixels, upright_line(50.0), 3.0)
    assert belongs.tolist() == [[True, False, True, False]]
    assert point[0, :3].tolist() == [40, 40, 40]


def test_an_event_between_two_lines_is_of_neither():
    lines = joined(upright_line(50.0), upright_line(58.0))
    pixels = torch.tensor([[[51.0, 60.0], [53.5, 60.0], [54.5, 60.0], [57.0, 60.0]]], dtype=torch.float64)
    assert nearest_lines(pixels, lines, 5.0, apart_px=5.0)[1].tolist() == [[True, False, False, True]]
    assert nearest_lines(pixels, lines, 5.0)[1].all()


def test_hidden_lines_have_no_events():
    hidden = contours_at([[[50.0, 60.0]]], mask=[[False]])
    assert not nearest_lines(torch.tensor([[[50.0, 60.0]]], dtype=torch.float64), hidden, 5.0, apart_px=3.0)[1].any()


# ---- the filter


def test_uncertainty_grows_with_time():
    start = torch.eye(12, dtype=torch.float64)[None] * 1e-4
    short, long = (predicted_covariance(start, torch.tensor([t], dtype=torch.float64)) for t in (0.005, 0.01))
    assert torch.allclose(predicted_covariance(start, torch.zeros(1, dtype=torch.float64)), start)
    assert (long.diagonal(dim1=1, dim2=2) > short.diagonal(dim1=1, dim2=2)).all()
    assert (torch.linalg.eigvalsh(long) > 0).all()
    # Two halves are as good as the whole.
    assert torch.allclose(predicted_covariance(short, torch.tensor([0.005], dtype=torch.float64)), long)


def test_the_correction_is_that_of_a_kalman_filter():
    rng = torch.Generator().manual_seed(0)
    root = torch.randn(12, 12, generator=rng, dtype=torch.float64)
    predicted = (root @ root.T + torch.eye(12))[None]
    measured = torch.randn(20, 6, generator=rng, dtype=torch.float64)
    seen = torch.randn(20, generator=rng, dtype=torch.float64)
    # The textbook's gain, with measurements of the pose alone and unit noise.
    rows = torch.cat([measured, torch.zeros_like(measured)], 1)
    gain = predicted[0] @ rows.T @ torch.linalg.inv(rows @ predicted[0] @ rows.T + torch.eye(20))
    expected, covariance = gain @ seen, (torch.eye(12) - gain @ rows) @ predicted[0]

    information = torch.linalg.inv(predicted[:, :6, :6])
    hessian = measured.T @ measured + information
    step = torch.linalg.solve(hessian, (measured.T @ seen)[None, :, None])[..., 0]
    solution = Linearisation(torch.eye(4).double()[None], torch.zeros(1, 6).double(), hessian, step)
    correction, after = corrected(predicted, information, solution)
    assert torch.allclose(step[0], expected[:6])
    assert torch.allclose(correction[0], expected[6:])
    assert torch.allclose(after[0], covariance)
