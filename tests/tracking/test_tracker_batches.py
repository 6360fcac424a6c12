"""Many objects and streams at once: batches that equal loops, cameras of different sizes, and failed neighbours."""

from functools import cache

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors, random_events
from states import changed
from tracked_boxes import (
    SAME_POSE,
    WIDE_CAMERA,
    WINDOW_US,
    follow,
    merged,
    moving_box,
    poses_of,
    windows,
)

from torchtrack import Tracker
from torchtrack.core.events import concatenate
from torchtrack.tracking import step
from torchtrack.tracking.validation.status import Status


@cache
def two_boxes(count):
    """Two boxes side by side in one wide image, far enough apart not to see each other's events."""
    starts = torch.stack([pose((0.5, 0.6, 0.1), (-0.17, 0.0, 0.5)), pose((0.4, -0.7, 0.3), (0.17, 0.0, 0.5))])
    left = moving_box(starts[0], count, WIDE_CAMERA, seed=1)
    right = moving_box(starts[1], count, WIDE_CAMERA, seed=2, turn=(0.5, 1.0, -0.7), move=(0.1, -0.1, 0.1))
    return starts, (left[0], right[0]), merged(left[1], right[1])


def test_objects_of_one_stream_are_tracked_as_each_alone(dtype):
    starts, trajectories, events = two_boxes(6)
    together = Tracker([box_model(), box_model()], WIDE_CAMERA, dtype=dtype)
    _, results = follow(together, together.init(starts, 0), windows(events, 6))
    for number in range(2):
        alone = Tracker([box_model()], WIDE_CAMERA, dtype=dtype)
        _, single = follow(alone, alone.init(starts[number : number + 1], 0), windows(events, 6))
        torch.testing.assert_close(poses_of(results, number), poses_of(single), rtol=0, atol=SAME_POSE[dtype])
        assert [int(r.status[number]) for r in results] == [int(r.status) for r in single]
        assert [int(r.observation_count[number]) for r in results] == pytest.approx([int(r.observation_count) for r in single], abs=2)
        degrees, millimetres = pose_errors(poses_of(results, number)[-1], trajectories[number].at(results[-1].t_us)[0])
        assert float(degrees) < 0.8
        assert float(millimetres) < 2.0


@cache
def streams_of_boxes(count, cameras):
    """A box in each of several streams, each from its own pose, and the batch of all events."""
    starts = torch.stack([pose((0.5, 0.6, 0.1)), pose((0.4, -0.7, 0.3), (0.02, 0.01, 0.45)), pose((-0.5, 0.5, 0.2), (0.0, 0.0, 0.4))])
    starts = starts[: len(cameras)]
    moving = [moving_box(T, count, camera, seed=s, stream=s) for s, (T, camera) in enumerate(zip(starts, cameras, strict=True))]
    return starts, [trajectory for trajectory, _ in moving], [events for _, events in moving]


def joint_windows(streams, count):
    """Windows of all streams at once."""
    cut = [windows(events, count) for events in streams]
    return [(concatenate([stream[k][0] for stream in cut]), (k + 1) * WINDOW_US) for k in range(count)]


@pytest.mark.parametrize("cameras", [(SMALL_CAMERA,) * 3, (SMALL_CAMERA, WIDE_CAMERA, SMALL_CAMERA)], ids=["same", "different"])
def test_streams_are_tracked_as_each_alone(cameras, dtype):
    starts, trajectories, streams = streams_of_boxes(6, cameras)
    together = Tracker([box_model()] * 3, cameras, stream_index=[0, 1, 2], dtype=dtype)
    _, results = follow(together, together.init(starts, 0), joint_windows(streams, 6))
    for number, camera in enumerate(cameras):
        alone = Tracker([box_model()], camera, dtype=dtype)
        own = streams[number].of_stream(0)
        _, single = follow(alone, alone.init(starts[number : number + 1], 0), windows(own, 6))
        torch.testing.assert_close(poses_of(results, number), poses_of(single), rtol=0, atol=SAME_POSE[dtype])
        assert [int(r.status[number]) for r in results] == [int(r.status) for r in single]
        assert float(pose_errors(poses_of(results, number)[-1], trajectories[number].at(results[-1].t_us)[0])[0]) < 0.3


def test_objects_may_come_in_any_order_and_number_per_stream():
    starts, _, streams = streams_of_boxes(6, (SMALL_CAMERA,) * 2)
    in_order = Tracker([box_model(), box_model((0.1, 0.1, 0.1)), box_model()], [SMALL_CAMERA] * 2, stream_index=[0, 0, 1])
    other = Tracker([box_model(), box_model(), box_model((0.1, 0.1, 0.1))], [SMALL_CAMERA] * 2, stream_index=[1, 0, 0])
    T = torch.stack([starts[0], pose(translation=(0.15, 0.0, 0.5)), starts[1]])
    first = follow(in_order, in_order.init(T, 0), joint_windows(streams, 3))[1][-1]
    second = follow(other, other.init(T[[2, 0, 1]], 0), joint_windows(streams, 3))[1][-1]
    torch.testing.assert_close(first.T_cam_obj[[2, 0, 1]], second.T_cam_obj, rtol=0, atol=1e-5)


def test_streams_may_end_their_windows_at_different_times():
    starts, _, streams = streams_of_boxes(6, (SMALL_CAMERA,) * 2)
    together = Tracker([box_model()] * 2, [SMALL_CAMERA] * 2, stream_index=[0, 1])
    state = together.init(starts, 0)
    alone = Tracker([box_model()], SMALL_CAMERA)
    single = alone.init(starts[1:], 0)
    for k in range(4):
        first = streams[0].slice_time(k * 5000, (k + 1) * 5000)
        second = streams[1].slice_time(k * 7000, (k + 1) * 7000)
        state, result = together.step(state, concatenate([first, second]), torch.tensor([(k + 1) * 5000, (k + 1) * 7000]))
        single, expected = alone.step(single, second.of_stream(0), (k + 1) * 7000)
        assert result.t_us.tolist() == [(k + 1) * 5000, (k + 1) * 7000]
        torch.testing.assert_close(result.T_cam_obj[1:], expected.T_cam_obj, rtol=0, atol=1e-5)


def test_an_object_is_looked_for_among_the_same_events_in_any_number_of_streams(monkeypatch):
    """It starts turned by 35 degrees and adrift, and events lie all over the sensor: where it is looked for, far ones matter."""
    counts, relocalize = [], step.relocalize

    def counting(window, evidence, events, *args):
        counts.append(events.counts())
        return relocalize(window, evidence, events, *args)

    monkeypatch.setattr(step, "relocalize", counting)
    _, _, streams = streams_of_boxes(6, (WIDE_CAMERA,) * 2)
    noise = [random_events(6000, width=WIDE_CAMERA.width, height=WIDE_CAMERA.height, duration_us=6 * WINDOW_US, seed=s, stream=s) for s in range(2)]
    noisy = [merged(events, more) for events, more in zip(streams, noise, strict=True)]
    turned, adrift = torch.stack([pose((0.5, 1.2, 0.1)), pose((0.4, -0.1, 0.3), (0.02, 0.01, 0.45))]), {"drift_s": torch.full((2,), 0.2)}
    together = Tracker([box_model()] * 2, [WIDE_CAMERA] * 2, stream_index=[0, 1])
    _, results = follow(together, changed(together.init(turned, 0), **adrift), joint_windows(noisy, 6))
    of_both = torch.stack(counts)
    assert len(of_both) > 1
    for number in range(2):
        counts.clear()
        alone = Tracker([box_model()], WIDE_CAMERA)
        start = changed(alone.init(turned[number : number + 1], 0), drift_s=adrift["drift_s"][:1])
        _, single = follow(alone, start, windows(noisy[number].of_stream(0), 6))
        torch.testing.assert_close(poses_of(results, number), poses_of(single), rtol=0, atol=1e-5)
        # Together, it is also asked for in windows in which the other one alone is looked for.
        counted = iter(of_both[:, number].tolist())
        assert counts and all(count in counted for count in torch.cat(counts).tolist())


def disturbed(kind, starts, state):
    """Initial state of two objects of which the second fails in some way."""
    if kind == "out of view":
        return changed(state, T_cam_obj=torch.stack([starts[0], pose(translation=(3.0, 0.0, 0.5))]))
    if kind == "far away":
        return changed(state, T_cam_obj=torch.stack([starts[0], pose(translation=(1e30, 0.0, 1e30))]))
    if kind == "behind":
        return changed(state, T_cam_obj=torch.stack([starts[0], pose(translation=(0.0, 0.0, -0.5))]))
    if kind == "beyond float32":
        return changed(state, T_cam_obj=torch.stack([starts[0], pose(translation=(0.0, 0.0, 1e300))]))
    if kind == "nan":
        return changed(state, T_cam_obj=torch.stack([starts[0], torch.full((4, 4), torch.nan, dtype=torch.float64)]))
    if kind == "wild velocity":
        return changed(state, velocity=torch.tensor([[0.0] * 6, [1e30] * 6], dtype=state.velocity.dtype))
    return state


@pytest.mark.parametrize("kind", ["no events", "out of view", "far away", "behind", "beyond float32", "nan", "wild velocity"])
@pytest.mark.parametrize("shared", [True, False], ids=["same_stream", "own_stream"])
def test_an_object_that_fails_changes_nothing_for_the_other(kind, shared):
    starts, _, events = two_boxes(6)
    own = events[events.x < 160]
    alone = Tracker([box_model()], WIDE_CAMERA)
    _, expected = follow(alone, alone.init(starts[:1], 0), windows(own, 3))
    cameras = [WIDE_CAMERA] * (1 if shared else 2)
    together = Tracker([box_model(), box_model()], cameras, stream_index=[0, 0 if shared else 1])
    state = disturbed(kind, starts, together.init(starts, 0))
    _, results = follow(together, state, windows(own, 3))
    torch.testing.assert_close(poses_of(results), poses_of(expected), rtol=0, atol=1e-5)
    assert [int(r.status[0]) for r in results] == [int(r.status) for r in expected]
    assert Status(int(results[-1].status[1])) >= Status.TOO_FEW_EVENTS


def test_an_object_out_of_view_is_told_also_where_another_camera_sees_more():
    """Beside the small image, where the wide one still would be."""
    start, outside = pose()[None], pose(translation=(0.32, 0.0, 0.5))[None]
    alone = Tracker([box_model()], SMALL_CAMERA)
    together = Tracker([box_model()], [SMALL_CAMERA, WIDE_CAMERA], stream_index=[0])
    events = random_events(500, width=200, height=150)
    expected, result = (each.step(changed(each.init(start, 0), T_cam_obj=outside), events, 10_000)[1] for each in (alone, together))
    assert Status(int(expected.status)) == Status.OUT_OF_VIEW
    assert int(result.status) == int(expected.status)
