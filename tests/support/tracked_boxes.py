"""Boxes that are tracked from exact events, for the tests of the tracker."""

from dataclasses import fields, is_dataclass, replace
from functools import cache

import torch
from helpers import SMALL_CAMERA, box_model, drifting, edge_events, pose
from states import changed

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.tracker import (
    MotionConfig,
    TrackerConfig,
)
from torchtrack.core.camera import Camera
from torchtrack.core.events import concatenate, pad_streams
from torchtrack.core.lie import retract_about
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.estimation.rounds import Start, align, gate_scale_of, index_for
from torchtrack.tracking.expectation import predicted_after
from torchtrack.tracking.validation.scored_fit import score_fit

WINDOW_US = 5_000
WIDE_CAMERA = Camera(fx=250.0, fy=250.0, cx=159.5, cy=74.5, width=320, height=150)
SAME_POSE = {torch.float32: 1e-5, torch.float64: 1e-9}
HOLD = TrackerConfig(motion=MotionConfig(without_events="hold"))
PREDICT = TrackerConfig(motion=MotionConfig(without_events="predict"))


def merged(*batches):
    """Events of one stream in time order."""
    events = concatenate(batches)
    return events[events.t_us.sort(stable=True).indices]


def windows(events, count, start_us=0):
    return [(events.slice_time(start_us + k * WINDOW_US, start_us + (k + 1) * WINDOW_US), start_us + (k + 1) * WINDOW_US) for k in range(count)]


def follow(tracker, state, stream_windows):
    """The last state, and the result of every window."""
    results = []
    for events, end_us in stream_windows:
        state, result = tracker.step(state, events, end_us)
        results.append(result)
    return state, results


def poses_of(results, number=0):
    return torch.stack([result.T_cam_obj[number] for result in results])


def tensors_of(value):
    """All tensors of nested dataclasses, in order."""
    if torch.is_tensor(value):
        return [value]
    return [tensor for field in fields(value) for tensor in tensors_of(getattr(value, field.name))] if is_dataclass(value) else []


def assert_same(first, second):
    for ours, theirs in zip(tensors_of(first), tensors_of(second), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0, equal_nan=True)


def moving_box(T_start, count, camera=SMALL_CAMERA, *, seed=0, stream=0, **motion):
    """True poses and events of a box over ``count`` windows."""
    trajectory = drifting(T_start, count * WINDOW_US, **motion)
    return trajectory, edge_events(trajectory, camera, seed=seed, stream=stream)


def started(dtype=torch.float32, config=None, count=5):
    """A tracker in full motion: it, its state and its last result, the next window's events, and the true poses."""
    return _started(dtype, config, count, (config or TrackerConfig()).uses(Component.UNCONFIRMED))


@cache
def _started(dtype, config, count, takes_look):
    """Kept apart by whether tests of the caller's folder take the look before a pose is confirmed (``takes_look``), which is patched."""
    trajectory, events = moving_box(pose(), count + 1)
    tracker = Tracker([box_model()], SMALL_CAMERA, config, dtype=dtype)
    state, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, count))
    return tracker, state, results[-1], windows(events, count + 1)[-1], trajectory


def in_motion(config=None, displaced=None, dtype=torch.float32):
    """A box in full motion, whose pose may be displaced: tracker, prediction, events, found alone, and the true pose."""
    if displaced is not None and config is None:
        # Looked up by cells, as the tracker does with what may be far off.
        config = TrackerConfig(disabled={Component.SUBCELL_LOOKUP})
    tracker, state, _, (events, end_us), trajectory = started(dtype, config)
    if displaced is not None:
        state = changed(state, T_cam_obj=retract_about(state.T_cam_obj, displaced, tracker.centre_obj.double()))
    prediction = predicted_after(tracker, state, torch.tensor([5e-3], dtype=dtype))
    seen = tracker.sensors.seen(pad_streams(events, 1, torch.tensor([end_us])))
    contours = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours)
    tight = gate_scale_of(torch.zeros(1, dtype=dtype), tracker.config)
    index = index_for(contours, tracker.image_size, tracker.config, tight)
    observations = select_events(seen, index, prediction.moving(compensated=True), 1000)
    fit = align(Start(prediction, contours, index, tight), observations, tracker.config)
    scored = score_fit(prediction, fit, tracker.config, torch.ones(1, dtype=dtype))
    return tracker, prediction, seen, scored, trajectory.at(torch.tensor([end_us]))


def tracker_of(count=1, **kwargs):
    return Tracker([box_model()] * count, SMALL_CAMERA, **kwargs)


# ---- scenes: initial poses, stream of each object, cameras, and windows


def one_box_scene(count):
    _, events = moving_box(pose(), count)
    return [pose()], [0], [SMALL_CAMERA], windows(events, count)


def scene_of_one_stream(count):
    starts = [pose((0.5, 0.6, 0.1), (-0.17, 0.0, 0.5)), pose((0.4, -0.7, 0.3), (0.17, 0.0, 0.5))]
    both = [moving_box(start, count, WIDE_CAMERA, seed=number)[1] for number, start in enumerate(starts)]
    return starts, [0, 0], [WIDE_CAMERA], windows(merged(*both), count)


def scene_of_streams(count):
    starts, cameras = [pose(), pose((0.4, -0.7, 0.3))], [SMALL_CAMERA, WIDE_CAMERA]
    cut = [windows(moving_box(start, count, camera, stream=s)[1], count) for s, (start, camera) in enumerate(zip(starts, cameras, strict=True))]
    together = [(concatenate([events for events, _ in pair]), torch.tensor([end_us for _, end_us in pair])) for pair in zip(*cut, strict=True)]
    return starts, [0, 1], cameras, [(replace(events, most_of_one=len(events)), ends) for events, ends in together]


SCENES = [one_box_scene, scene_of_one_stream, scene_of_streams]
