"""Objects that most of can be turned unseen about an axis: poses all around it are compared until events tell which is right."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
import trimesh
from helpers import drifting, generator, pose, pose_errors
from states import changed
from tracked_boxes import WINDOW_US, follow, tensors_of, windows

from torchtrack import Camera, EventBatch, ObjectModel, Tracker
from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.events import concatenate
from torchtrack.core.lie import rotation_angle_deg, so3_exp, transform_points
from torchtrack.tracking.expectation import predicted_after
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.axis_rotation import _peaks
from torchtrack.tracking.relocalization.symmetric import RotationAxes
from torchtrack.tracking.relocalization.triggers import may_have_rotated
from torchtrack.tracking.validation.status import Status

CAMERA = Camera(fx=400.0, fy=400.0, cx=159.5, cy=119.5, width=320, height=240)
COUNT = 24
AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@cache
def can():
    """A can with a handle along x."""
    handle = trimesh.creation.box((0.03, 0.012, 0.06))
    handle.apply_translation((0.042, 0, 0.01))
    return ObjectModel.from_mesh(trimesh.util.concatenate([trimesh.creation.cylinder(0.03, 0.1, sections=48), handle]))


def turned(T_cam_obj, angle):
    """The pose turned about the axis of the can."""
    turn = torch.eye(4, dtype=T_cam_obj.dtype)
    turn[:3, :3] = so3_exp(angle * AXIS.to(T_cam_obj.dtype))
    return T_cam_obj @ turn


@cache
def scene(angle=0.0, seed=0):
    """True poses and events of the can, which moves with its handle turned by ``angle`` from where it sticks out to the right.

    Where a contour passes, pixels fire at random, as often as it moves on by one.
    """
    start = turned(pose(rotation=(1.3, 0.0, 0.0), translation=(-0.02, 0.0, 0.4)), angle)
    trajectory = drifting(start, COUNT * WINDOW_US, turn=(0.5, 0.9, 0.6), move=(0.25, 0.15, 0.0), step_us=500)
    tracker, steps = Tracker([can()], CAMERA, dtype=torch.float64), len(trajectory.t_us)
    objects, rng = tracker.objects.copies(0, steps), generator(seed)
    contours = objects.contours(trajectory.T_cam_obj, tracker.config.contours)
    later = transform_points(trajectory.T_cam_obj.roll(-1, 0), contours.points_obj)
    moved = (later[..., :2] / later[..., 2:] - contours.points_cam[..., :2] / contours.points_cam[..., 2:]) * 400.0
    fires = contours.mask & (torch.rand(contours.mask.shape, generator=rng, dtype=torch.float64) < (moved * contours.normals).sum(-1).abs() * 0.5)
    step, place = fires[:-1].nonzero(as_tuple=True)
    pixels = contours.pixels[step, place].round().long()
    t_us = trajectory.t_us[step] + torch.randint(1, 500, step.shape, generator=rng)
    t_us, order = t_us.sort(stable=True)
    polarity = torch.randint(2, t_us.shape, generator=rng)
    u, v = pixels[order].unbind(-1)
    return trajectory, EventBatch.from_numpy(u.numpy(), v.numpy(), t_us.numpy(), polarity.numpy(), 0)


def after_a_while(config=None, angle=0.0, wrong=0.0, time_since_validated_s=0.2, kernels=True, first=8):
    """The can tracked for some windows, then turned by ``wrong`` as if unseen, and tracked on: its last state, all results since, the truth."""
    trajectory, events = scene(angle)
    tracker = Tracker([can()], CAMERA, config, dtype=torch.float64, kernels=kernels)
    cut = windows(events, COUNT)
    with torch.no_grad():
        state, _ = follow(tracker, tracker.init(trajectory.T_cam_obj[:1], 0), cut[:first])
        state = changed(
            state,
            T_cam_obj=turned(state.T_cam_obj, wrong),
            time_since_validated_s=torch.full_like(state.health.time_since_validated_s, time_since_validated_s),
        )
        state, results = follow(tracker, state, cut[first:])
    return state, results, trajectory.at(state.t_us)


# ---- what is found


@pytest.mark.parametrize(("wrong", "kernels"), [(1.0, True), (2.2, True), (-1.7, True), (2.2, False)])
def test_a_can_that_turned_unseen_is_turned_back_once_it_is_seen_again(wrong, kernels):
    state, results, T_true = after_a_while(wrong=wrong, kernels=kernels)
    degrees, millimetres = pose_errors(state.T_cam_obj, T_true)
    assert float(degrees) < 2 and float(millimetres) < 3
    assert Status(int(results[0].status)) == Status.UNCERTAIN and Status(int(results[-1].status)) == Status.TRACKING


def test_it_does_not_turn_farther_than_it_can_have_spun_unseen():
    """Half round within a tenth of a second it cannot; in twice as long nearly."""
    state, _, T_true = after_a_while(wrong=2.2, time_since_validated_s=0.06, first=18)
    assert float(pose_errors(state.T_cam_obj, T_true)[0]) > 60
    state, _, T_true = after_a_while(wrong=2.2, first=18)
    assert float(pose_errors(state.T_cam_obj, T_true)[0]) < 20


def test_without_it_the_can_stays_turned_and_is_sure_of_that():
    state, results, T_true = after_a_while(TrackerConfig(relocalization=RelocalizationConfig(axis_rotation=False)), wrong=2.2)
    assert float(pose_errors(state.T_cam_obj, T_true)[0]) > 60
    assert Status(int(results[-1].status)) == Status.TRACKING


def test_what_is_right_is_confirmed_and_left():
    state, results, T_true = after_a_while()
    assert float(pose_errors(state.T_cam_obj, T_true)[0]) < 2
    assert float(state.health.time_since_validated_s) == 0
    statuses = [Status(int(result.status)) for result in results]
    assert statuses[0] == Status.UNCERTAIN and statuses[-1] == Status.TRACKING


def test_while_the_handle_is_hidden_nothing_is_told():
    """Neither that it is right, nor that it is not; what is known of it before stays."""
    state, results, T_true = after_a_while(angle=math.pi / 2, wrong=0.3)
    assert float(state.health.time_since_validated_s) > 0.25
    assert {Status(int(result.status)) for result in results} == {Status.UNCERTAIN}
    assert float(rotation_angle_deg(state.T_cam_obj[:, :3, :3], turned(T_true, 0.3)[:, :3, :3])) < 20


def test_what_was_seen_all_the_time_is_not_looked_at(monkeypatch):
    monkeypatch.setattr("torchtrack.tracking.relocalization.axis_rotation._peaks", lambda *args: pytest.fail("looked at"))
    state, _, _ = after_a_while(time_since_validated_s=0.0)
    assert float(state.health.time_since_validated_s) == 0


def test_a_neighbour_in_another_stream_is_not_disturbed():
    trajectory, events = scene()
    other = replace(events, stream_index=torch.ones_like(events.stream_index))
    both = [(concatenate([first, second]), end) for (first, end), (second, _) in zip(windows(events, COUNT), windows(other, COUNT), strict=True)]
    states = []
    for wrong in (0.0, 2.2):
        tracker = Tracker([can(), can()], [CAMERA, CAMERA], stream_index=[0, 1], dtype=torch.float64)
        with torch.no_grad():
            state, _ = follow(tracker, tracker.init(trajectory.T_cam_obj[:1].repeat(2, 1, 1), 0), both[:8])
            poses = torch.stack([state.T_cam_obj[0], turned(state.T_cam_obj[1], wrong)])
            time_since_validated_s = torch.tensor([0.0, 0.2], dtype=torch.float64)
            states.append(follow(tracker, changed(state, T_cam_obj=poses, time_since_validated_s=time_since_validated_s), both[8:])[0])
    torch.testing.assert_close(states[0].T_cam_obj[0], states[1].T_cam_obj[0])
    assert float(pose_errors(states[1].T_cam_obj[1:], trajectory.at(states[1].t_us[1:]))[0]) < 2


# ---- its parts


def predicted(dtype):
    tracker = Tracker([can()], CAMERA, dtype=dtype)
    state = tracker.init(pose(rotation=(1.1, 0.2, 0.4))[None], 0)
    state = changed(state, velocity=torch.tensor([[0.5, -1.0, 2.0, 0.1, 0.2, -0.1]], dtype=dtype))
    return tracker, predicted_after(tracker, state, torch.tensor([5e-3], dtype=dtype))


def velocity_at(prediction: Prediction, point_obj):
    """Velocity of a point of the object (m/s)."""
    point_cam = transform_points(prediction.T_cam_obj, point_obj.expand(len(prediction.T_cam_obj), 1, 3))[:, 0]
    return prediction.velocity[:, 3:] + torch.linalg.cross(prediction.velocity[:, :3], point_cam - prediction.centre_cam, dim=-1)


def test_what_is_turned_keeps_its_axis_where_it_is_and_goes(dtype):
    tracker, alone = predicted(dtype)
    axes = tracker.ambiguities.axes
    assert tracker.turns and tracker.has_turning_axis.tolist() == [True]
    angles = torch.tensor([0.0, 0.5, 3.0, -1.0], dtype=dtype)
    rows = axes.rotated(0, alone, angles)
    for point in (axes.points_obj[0], axes.points_obj[0] + 0.03 * axes.directions_obj[0]):
        places = transform_points(rows.T_cam_obj, point.expand(4, 1, 3))
        torch.testing.assert_close(places, places[:1].expand(4, 1, 3), rtol=0, atol=1e-6)
        torch.testing.assert_close(velocity_at(rows, point), velocity_at(rows, point)[:1].expand(4, 3), rtol=0, atol=1e-6)
    degrees = rotation_angle_deg(rows.T_cam_obj[:, :3, :3].double(), alone.T_cam_obj[:, :3, :3].double().expand(4, 3, 3))
    torch.testing.assert_close(degrees, angles.double().abs() * 180 / math.pi, rtol=0, atol=0.1)
    along = (alone.T_cam_obj[0, :3, :3] @ axes.directions_obj[0]).double()
    gained = (rows.covariance - alone.covariance)[1]
    assert float(along @ gained[:3, :3] @ along) == pytest.approx(0.01, rel=1e-4)
    assert float(along @ gained[6:9, 6:9] @ along) == pytest.approx(16, rel=1e-4)
    assert float(gained.trace()) == pytest.approx(16.01, rel=1e-4)


def test_the_best_turns_that_are_not_beside_better_ones():
    totals = torch.zeros(120)
    totals[[0, 3, 30, 33, 60, 118]] = torch.tensor([5.0, 9.0, 7.0, 6.0, 8.0, 9.0])
    chosen, exists = _peaks(totals, torch.ones(120, dtype=torch.bool))
    # The pose itself, whatever it is worth; what is beside it is the same.
    assert chosen[:3].tolist() == [0, 60, 30]
    assert exists[:3].all() and 33 not in chosen[exists].tolist()


def test_turns_out_of_reach_are_left_out():
    totals = torch.zeros(120)
    totals[[30, 60, 90]] = torch.tensor([7.0, 8.0, 6.0])
    chosen, exists = _peaks(totals, torch.arange(120) < 50)
    assert chosen[0] == 0 and {30} <= set(chosen[exists].tolist()) and not {60, 90} & set(chosen[exists].tolist())


def test_what_was_not_seen_for_a_while_may_have_rotated():
    has_axis, time_since_validated_s = torch.tensor([True, True, False]), torch.tensor([0.06, 0.04, 0.06])
    assert may_have_rotated(has_axis, time_since_validated_s).tolist() == [True, False, False]


@pytest.mark.parametrize("search", [{"axis_rotation": False}, {"hypotheses": 0}, {}])
def test_where_nothing_is_compared_no_axis_is_looked_for(search):
    disabled = frozenset() if search else {Component.DRIFT}
    tracker = Tracker([can()], CAMERA, TrackerConfig(relocalization=RelocalizationConfig(**search), disabled=disabled))
    assert not tracker.turns
    assert not any(value.any() for value in tensors_of(RotationAxes(tracker.turning_points, tracker.turning_directions)))
