"""The tracker: bad starts, one step, windows without events, statuses."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors, random_events
from states import changed
from tracked_boxes import (
    HOLD,
    PREDICT,
    WINDOW_US,
    assert_same,
    follow,
    moving_box,
    started,
    tensors_of,
    tracker_of,
    windows,
)

from torchtrack import Tracker, preset
from torchtrack.config.components import Component
from torchtrack.config.tracker import (
    CornerConfig,
    MotionConfig,
    TrackerConfig,
)
from torchtrack.config.validation import ValidationConfig
from torchtrack.core import dispatch
from torchtrack.core.camera import project
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import retract_about, transform_points
from torchtrack.errors import ModelError, PoseError
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.frontend.flow import estimate_flow
from torchtrack.tracking.frontend.time_surface import NEVER_US
from torchtrack.tracking.initialization import first_state
from torchtrack.tracking.motion.model import COAST_S
from torchtrack.tracking.validation.status import Status

# ---- bad set-ups


def test_a_tracker_needs_objects():
    with pytest.raises(ValueError, match="at least one object"):
        Tracker([], SMALL_CAMERA)


def test_every_object_needs_its_stream():
    with pytest.raises(ValueError, match="got 1 for 2 objects"):
        Tracker([box_model(), box_model()], SMALL_CAMERA, stream_index=[0])


@pytest.mark.parametrize("stream", [1, -1])
def test_streams_need_a_camera_each(stream):
    with pytest.raises(ValueError, match="within the 1 cameras"):
        Tracker([box_model()], SMALL_CAMERA, stream_index=[stream])


@pytest.mark.parametrize("others", [0, 1])
def test_splatted_contours_need_a_surface(others):
    line = replace(ObjectModel.from_polylines([[[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]]]), name="wire")
    models = [box_model()] * others + [line]
    with pytest.raises(ModelError, match="'wire' has no surface .*set contours.source to 'mesh'"):
        Tracker(models, SMALL_CAMERA, preset("paper"))
    assert Tracker(models, SMALL_CAMERA).object_names[-1] == "wire"


# ---- bad starts


@pytest.mark.parametrize(
    ("break_pose", "message"),
    [
        (lambda T: T * 2, "not a rotation"),
        (lambda T: T @ torch.diag(torch.tensor([1.0, 1.0, 1.1, 1.0]).double()), "not a rotation"),
        (lambda T: T @ torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]).double()), "reflection"),
        (lambda T: T * torch.nan, "NaN"),
        (lambda T: torch.cat([T[..., :3, :], torch.ones_like(T[..., 3:, :])], -2), "last row"),
        (lambda T: T[:, :3], "shape"),
        (lambda T: T.repeat(2, 1, 1), r"\[1, 4, 4\], got \[2, 4, 4\]"),
    ],
    ids=["scaled", "sheared", "reflected", "nan", "last_row", "3x4", "two_for_one"],
)
def test_what_is_no_pose_is_refused(break_pose, message):
    with pytest.raises(PoseError, match=message):
        tracker_of().init(break_pose(pose()[None]), 0)


def test_one_pose_is_that_of_the_only_object():
    state = tracker_of().init(pose(), 0)
    assert torch.equal(state.T_cam_obj, tracker_of().init(pose()[None], 0).T_cam_obj)
    with pytest.raises(PoseError, match="one initial pose per object"):
        tracker_of(2).init(pose(), 0)


@pytest.mark.parametrize("depth_m", [-0.5, 0.0])
def test_an_object_behind_the_camera_is_refused_by_name(depth_m):
    with pytest.raises(PoseError, match="'box' is behind the camera"):
        tracker_of(2).init(torch.stack([pose(), pose(translation=(0.0, 0.0, depth_m))]), 0)


def test_the_first_state_is_at_rest():
    tracker = Tracker([box_model()] * 2, [SMALL_CAMERA] * 3, stream_index=[2, 0])
    state = tracker.init(pose().repeat(2, 1, 1), 1234)
    assert state.T_cam_obj.dtype == torch.float64
    assert torch.equal(state.T_cam_obj, pose().repeat(2, 1, 1))
    assert (state.velocity == 0).all()
    assert state.t_us.tolist() == [1234] * 3
    assert state.maps.last_event_us.shape == (3, 150, 200)
    assert (state.maps.last_event_us == NEVER_US).all()
    assert tracker.init(pose().repeat(2, 1, 1), torch.tensor([1, 2, 3])).t_us.tolist() == [1, 2, 3]


def test_the_state_does_not_share_the_pose_given():
    given = pose()[None]
    state = tracker_of().init(given, 0)
    given[0, 0, 3] = 9.0
    assert torch.equal(state.T_cam_obj, pose()[None])


# ---- one step


def test_the_same_state_and_events_give_the_same_result(dtype):
    tracker, state, _, (events, end_us), _ = started(dtype)
    first, second = tracker.step(state, events, end_us), tracker.step(state, events, end_us)
    for ours, theirs in zip(first, second, strict=True):
        assert_same(ours, theirs)
    assert_same(tracker(events, state, end_us)[1], first[1])


def test_a_step_changes_neither_state_nor_events_nor_tracker(dtype):
    tracker, state, _, (events, end_us), _ = started(dtype)
    before = [tensor.clone() for tensor in (*tensors_of(state), *tensors_of(events), *tracker.buffers())]
    tracker.step(state, events, end_us)
    after = [*tensors_of(state), *tensors_of(events), *tracker.buffers()]
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(before, after, strict=True))


def test_results_have_their_shapes_and_types(dtype):
    _, state, result, _, _ = started(dtype)
    assert state.T_cam_obj.dtype == result.T_cam_obj.dtype == torch.float64
    assert result.T_cam_obj.shape == (1, 4, 4)
    assert result.covariance.shape == (1, 6, 6)
    assert result.contours.pixels.dtype == result.corners.pixels.dtype == result.quality.dtype == dtype
    assert state.motion.covariance.dtype == result.covariance.dtype == torch.float64
    assert state.velocity.dtype == state.health.score.dtype == state.health.mean_score.dtype == dtype
    assert state.motion.covariance.shape == (1, 12, 12)
    assert Status(int(result.status)) == Status.TRACKING
    assert 0.5 < float(result.quality) <= 1
    assert result.t_us.tolist() == state.t_us.tolist() == [5 * WINDOW_US]
    assert torch.equal(state.T_cam_obj, result.T_cam_obj)
    assert int(result.observation_count) > 30
    assert not result.corners.mask.any()
    assert (torch.linalg.eigvalsh(result.covariance[0]) > 0).all()
    assert (torch.linalg.eigvalsh(state.motion.covariance[0]) > 0).all()
    assert float(result.covariance[0].diagonal()[:3].sqrt().max()) < 0.015


def test_flow_that_matching_makes_no_use_of_is_estimated_where_it_is_asked_for():
    tracker, state, result, _, _ = started(config=TrackerConfig(corners=CornerConfig(max_corners=32)))
    assert result.corners.mask.any()
    assert not result.corners.has_flow.any()
    flow, has_flow = estimate_flow(result.corners.points, tracker.sensors.view(state.maps, state.t_us), tracker.config.flow)
    assert has_flow.any()
    assert (flow[has_flow].norm(dim=-1) > 0).all()


def test_contours_are_those_of_the_pose(dtype):
    _, _, result, _, _ = started(dtype)
    points = transform_points(result.T_cam_obj, result.contours.points_obj.double())
    expected = project(points, SMALL_CAMERA.intrinsics(torch.float64)[None])[result.contours.mask]
    torch.testing.assert_close(result.contours.pixels[result.contours.mask].double(), expected, rtol=0, atol=1e-2)


def test_poses_stay_rotations():
    _, events = moving_box(pose(), 30)
    tracker = tracker_of()
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 30))
    rotation = state.T_cam_obj[0, :3, :3]
    assert float((rotation @ rotation.T - torch.eye(3).double()).abs().max()) < 1e-12
    assert state.T_cam_obj[0, 3].tolist() == [0, 0, 0, 1]


def test_the_window_ends_with_its_newest_event_unless_told():
    tracker, state, _, (events, _), _ = started()
    assert tracker.step(state, events)[1].t_us.tolist() == [int(events.t_us[-1])]
    assert tracker.step(state, events, 31_000)[1].t_us.tolist() == [31_000]
    stated, as_tensor = (tracker.step(state, events, end)[1] for end in (30_000, torch.tensor([30_000])))
    assert_same(stated, as_tensor)


def test_the_newest_events_are_remembered_where_corners_are_looked_for():
    tracker, state, _, (events, end_us), _ = started(config=TrackerConfig(corners=CornerConfig(max_corners=32)))
    after, _ = tracker.step(state, events, end_us)
    last = events[-1:]
    assert int(after.maps.last_event_us[0, last.y, last.x]) == int(last.t_us)
    assert int((after.maps.last_event_us != state.maps.last_event_us).sum()) == len({*zip(events.x.tolist(), events.y.tolist(), strict=True)})


def test_nothing_is_remembered_that_nobody_asks_for():
    tracker, state, _, window, _ = started()
    assert (tracker.step(state, *window)[0].maps.last_event_us == NEVER_US).all()


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, torch.enable_grad])
def test_gradients_make_no_difference_and_none_is_recorded(mode):
    tracker, state, _, (events, end_us), _ = started()
    # Kernels round otherwise, and are used where gradients are not recorded.
    with dispatch.backend(wanted=False):
        expected = tracker.step(state, events, end_us)[1]
        with mode():
            result = tracker.step(state, events, end_us)[1]
    assert_same(result, expected)
    assert not any(tensor.requires_grad for tensor in tensors_of(result))


def test_the_state_of_inference_can_be_carried_on():
    tracker, state, _, (events, end_us), _ = started()
    with torch.inference_mode():
        after, _ = tracker.step(state, events, end_us)
    later, _ = tracker.step(after, EventBatch.empty(), end_us + WINDOW_US)
    assert later.t_us.tolist() == [end_us + WINDOW_US]


# ---- windows without events


def test_without_events_the_pose_is_held_and_the_status_says_so(dtype):
    tracker, state, _, _, _ = started(dtype, HOLD)
    after, result = tracker.step(state, EventBatch.empty(), 35_000)
    assert Status(int(result.status)) == Status.TOO_FEW_EVENTS
    assert torch.equal(result.T_cam_obj, state.T_cam_obj)
    assert (after.velocity == 0).all()
    assert after.t_us.tolist() == [35_000]
    assert int(result.observation_count) == 0
    # It is not known any more where it goes: less certain in every direction, and of its velocity by what was set aside.
    assert (torch.linalg.eigvalsh(after.motion.covariance[0, :6, :6] - state.motion.covariance[0, :6, :6]) > 0).all()
    assert torch.isfinite(result.covariance).all()
    speed_sigma = after.motion.covariance[0].diagonal()[6:].sqrt()
    assert (speed_sigma >= state.velocity[0].abs()).all()


def test_without_events_the_motion_goes_on_where_asked_for_and_dies_away(dtype):
    # What is lost for long rests where it was last seen well, unless it is never looked for there.
    config = PREDICT.model_copy(update={"disabled": frozenset({Component.AROUND_LAST_SEEN, Component.TURNS_FADE})})
    tracker, state, _, _, trajectory = started(dtype, config)
    after, result = tracker.step(state, EventBatch.empty(), 30_000)
    assert Status(int(result.status)) == Status.TOO_FEW_EVENTS
    expected = retract_about(state.T_cam_obj, 5e-3 * state.velocity.double(), torch.zeros(1, 3, dtype=torch.float64))
    torch.testing.assert_close(result.T_cam_obj, expected, rtol=0, atol=1e-6)
    degrees, millimetres = pose_errors(result.T_cam_obj, trajectory.at(result.t_us))
    held = pose_errors(state.T_cam_obj, trajectory.at(result.t_us))
    assert float(degrees) < float(held[0])
    assert float(millimetres) < float(held[1])
    assert 0 < float(after.velocity.norm()) <= float(state.velocity.norm())
    for step in range(60):
        after, result = tracker.step(after, EventBatch.empty(), 35_000 + step * WINDOW_US)
    died_away = torch.exp(torch.tensor(-61 * 5e-3 / COAST_S))
    torch.testing.assert_close(after.velocity, state.velocity * died_away, rtol=1e-4, atol=1e-6)
    after, result = tracker.step(after, EventBatch.empty(), 2_000_000)
    assert float(after.velocity.norm()) < 1e-3
    rotation = result.T_cam_obj[0, :3, :3]
    assert float((rotation @ rotation.T - torch.eye(3).double()).abs().max()) < 1e-6


def test_after_a_gap_tracking_goes_on(dtype):
    trajectory, events = moving_box(pose(), 14)
    tracker = tracker_of(dtype=dtype)
    stream_windows = windows(events, 14)
    stream_windows[6] = (EventBatch.empty(), stream_windows[6][1])
    _, results = follow(tracker, tracker.init(pose()[None], 0), stream_windows)
    assert [Status(int(result.status)) == Status.TOO_FEW_EVENTS for result in results] == [k == 6 for k in range(14)]
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, trajectory.at(results[-1].t_us))
    assert float(degrees) < 0.3
    assert float(millimetres) < 0.5


def test_too_few_events_are_none():
    tracker, state, _, (events, end_us), _ = started(config=HOLD)
    _, result = tracker.step(state, events[:5], end_us)
    assert Status(int(result.status)) == Status.TOO_FEW_EVENTS
    assert torch.equal(result.T_cam_obj, state.T_cam_obj)


def test_a_first_window_without_events_is_no_harm(dtype):
    tracker = tracker_of(dtype=dtype)
    state, result = tracker.step(tracker.init(pose()[None], 0), EventBatch.empty())
    assert Status(int(result.status)) == Status.TOO_FEW_EVENTS
    assert state.t_us.tolist() == [0]
    torch.testing.assert_close(result.T_cam_obj, pose()[None], rtol=0, atol=1e-6)


def test_contours_of_a_pose_that_is_held_are_those_of_that_pose():
    tracker, state, _, _, _ = started(config=HOLD)
    _, result = tracker.step(state, EventBatch.empty(), 60_000)
    points = transform_points(result.T_cam_obj, result.contours.points_obj.double())
    expected = project(points, SMALL_CAMERA.intrinsics(torch.float64)[None])[result.contours.mask]
    torch.testing.assert_close(result.contours.pixels[result.contours.mask].double(), expected, rtol=0, atol=1e-2)


# ---- statuses


def test_an_object_out_of_view_is_told():
    tracker = tracker_of(config=HOLD)
    T = pose(translation=(0.6, 0.0, 0.5))[None]
    state = first_state(tracker, T, torch.zeros(1, dtype=torch.int64))
    _, result = tracker.step(state, random_events(500, width=200, height=150), 10_000)
    assert Status(int(result.status)) == Status.OUT_OF_VIEW
    assert torch.equal(result.T_cam_obj, T)


def test_an_object_that_others_explain_better_is_lost():
    """A tracker that believes in a motion that no events confirm."""
    tracker, state, _, (events, end_us), _ = started()
    state = changed(state, velocity=torch.tensor([[0.0, 0.0, 0.0, 2.0, -1.5, 0.0]]))
    half = events[events.x < 95]
    _, result = tracker.step(state, half, end_us)
    assert Status(int(result.status)) >= Status.UNCERTAIN


def test_a_jump_is_told_as_diverged():
    config = TrackerConfig(validation=ValidationConfig(max_rotation_rad=1e-6, max_translation=1e-6), motion=MotionConfig(without_events="hold"))
    _, events = moving_box(pose(), 2)
    tracker = tracker_of(config=config)
    _, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, 2))
    assert Status(int(results[0].status)) == Status.DIVERGED
    assert torch.equal(results[0].T_cam_obj, pose()[None])
