"""Whole steps by kernels: equal to those without, under every setting; where kernels are used, and where not."""

from dataclasses import replace

import pytest
import torch
from both_ways import ROUNDINGS
from helpers import SMALL_CAMERA, bevelled_model, box_model, pose
from states import changed
from tracked_boxes import SCENES, WIDE_CAMERA, assert_same, follow, merged, moving_box, poses_of, started, tensors_of, windows

from torchtrack import Tracker
from torchtrack.baselines import tracker_class
from torchtrack.config.presets import preset
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch
from torchtrack.errors import EventDataError
from torchtrack.run.runner import run, track
from torchtrack.tracking import graphs
from torchtrack.tracking.frontend.tiles import NearbyEvents

pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
from torchtrack.backends.alignment import knows

SETTINGS = {
    "default": {},
    "no subcell lookup": {"disabled": ["subcell_lookup"]},
    "no concentration": {"association": {"concentration": False}},
    "no polarity": {"association": {"polarity": False}},
    "no compensation": {"association": {"motion_compensation": False}},
    "one gate": {"association": {"gates_px": (5.0,)}},
    "nothing in common": {"disabled": ["common_error"]},
    "no texture polarity": {"disabled": ["texture_polarity"]},
    "no dark shift": {"disabled": ["dark_shift"]},
    "corners": {"corners": {"max_corners": 64}},
    "guided": {"corners": {"max_corners": 64}, "association": {"search": "guided"}},
    "learned trust": {"association": {"weighting_network": "all"}},
    "no velocity": {"disabled": ["velocity_in_window"]},
    "damped": {"solver": {"damping": 0.1}},
    "no hidden": {"contours": {"remove_hidden": False}},
    "no gathering": {"disabled": ["inlier_ratio"]},
    "hold": {"motion": {"model": "hold", "without_events": "hold"}},
    "steps": {"solver": {"iterations": 3, "loss": "huber"}},
    "refreshed": {"contours": {"source": "splat"}},
    "no prior": {"solver": {"prior": False}},
}


def both_steps(config, count=6, dtype=torch.float64, model=None):
    """Results of every window, each from the same state, by kernels and without."""
    _, events = moving_box(pose(), count)
    model = model or box_model()
    plain = Tracker([model], SMALL_CAMERA, config, dtype=dtype, kernels=False)
    fast = Tracker([model], SMALL_CAMERA, config, dtype=dtype)
    state, pairs = plain.init(pose()[None], 0), []
    with torch.inference_mode():
        for of_window, end_us in windows(events, count):
            pairs.append((fast.step(state, of_window, end_us)[1], plain.step(state, of_window, end_us)[1]))
            state, _ = plain.step(state, of_window, end_us)
    return pairs


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_a_step_is_the_same_by_kernels(settings):
    for ours, theirs in both_steps(TrackerConfig.model_validate(settings)):
        torch.testing.assert_close(ours.T_cam_obj, theirs.T_cam_obj, rtol=0, atol=ROUNDINGS[torch.float64])
        torch.testing.assert_close(ours.covariance, theirs.covariance, rtol=1e-6, atol=1e-12)
        torch.testing.assert_close(ours.quality, theirs.quality, rtol=0, atol=1e-6)
        assert torch.equal(ours.status, theirs.status)
        assert torch.equal(ours.observation_count, theirs.observation_count)


def test_a_step_is_the_same_in_few_digits():
    for ours, theirs in both_steps(TrackerConfig(), dtype=torch.float32):
        torch.testing.assert_close(ours.T_cam_obj, theirs.T_cam_obj, rtol=0, atol=ROUNDINGS[torch.float32])


def test_a_step_of_a_smooth_object_is_the_same():
    for ours, theirs in both_steps(TrackerConfig(), model=bevelled_model()):
        torch.testing.assert_close(ours.T_cam_obj, theirs.T_cam_obj, rtol=0, atol=ROUNDINGS[torch.float64])


@pytest.mark.parametrize("name", ["paper", "guided", "nns", "learned"])
def test_a_step_of_other_presets_is_the_same(name):
    for ours, theirs in both_steps(preset(name), count=3):
        torch.testing.assert_close(ours.T_cam_obj, theirs.T_cam_obj, rtol=0, atol=ROUNDINGS[torch.float64])


@pytest.mark.parametrize("model", [box_model, bevelled_model])
@pytest.mark.parametrize("scene", SCENES)
def test_scenes_of_several_objects_and_streams_are_the_same(scene, model):
    starts, streams, cameras, of_windows = scene(6)
    tracker = Tracker([model()] * len(starts), cameras, stream_index=streams, dtype=torch.float64)
    state = tracker.init(torch.stack(starts), 0)
    with torch.inference_mode():
        _, ours = follow(tracker, state, of_windows)
        tracker.kernels = False
        _, theirs = follow(tracker, state, of_windows)
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine.T_cam_obj, other.T_cam_obj, rtol=0, atol=1e-7)


# ---- where kernels are used


@pytest.mark.parametrize("name", ["steps", "refreshed", "no prior"])
def test_settings_that_the_kernel_does_not_know_go_without_it(name):
    assert knows(TrackerConfig())
    assert not knows(TrackerConfig.model_validate(SETTINGS[name]))
    assert not knows(preset("paper"))


def test_where_gradients_are_recorded_there_are_no_kernels():
    assert not dispatch.may_accelerate(torch.zeros(1))
    with torch.no_grad():
        assert dispatch.may_accelerate(torch.zeros(1))


def test_within_what_does_without_kernels_nothing_asks_for_them():
    with torch.inference_mode(), dispatch.backend(wanted=False), dispatch.backend(wanted=True):
        assert not dispatch.may_accelerate(torch.zeros(1))
    with torch.inference_mode():
        assert dispatch.may_accelerate(torch.zeros(1))


def test_without_numba_all_is_done_by_pytorch(monkeypatch):
    tracker, state, _, (events, end_us), _ = started(torch.float64)
    with torch.inference_mode():
        tracker.kernels = False
        _, expected = tracker.step(state, events, end_us)
        tracker.kernels = True
        monkeypatch.setattr(dispatch, "backend_is_installed", lambda device: False)
        _, actual = tracker.step(state, events, end_us)
    assert_same(actual, expected)


def test_a_run_without_kernels_gives_the_same_poses(folder, tmp_path):
    poses = []
    for kernels in (True, False):
        output = tmp_path / str(kernels)
        run(RunConfig(source=folder / "one.npz", output=output, kernels=kernels, dtype="float64", overlay={"enabled": False}))
        poses.append([[float(number) for number in line.split()] for line in next(output.glob("*.tum")).read_text().splitlines() if line[0] != "#"])
    torch.testing.assert_close(torch.tensor(poses[0]), torch.tensor(poses[1]), rtol=0, atol=1e-6)


# ---- every object for itself


def test_a_neighbour_that_fails_changes_nothing():
    starts = torch.stack([pose((0.5, 0.6, 0.1), (-0.17, 0.0, 0.5)), pose((0.4, -0.7, 0.3), (0.17, 0.0, 0.5))])
    events = merged(*(moving_box(T, 4, WIDE_CAMERA, seed=seed)[1] for seed, T in enumerate(starts)))
    tracker = Tracker([box_model(), box_model()], WIDE_CAMERA, dtype=torch.float64)
    state = tracker.init(starts, 0)
    spoilt = changed(state, T_cam_obj=state.T_cam_obj.clone(), velocity=state.velocity.clone())
    spoilt.T_cam_obj[1], spoilt.velocity[1] = torch.nan, torch.nan
    with torch.inference_mode():
        results = [follow(tracker, begin, windows(events, 4))[1] for begin in (state, spoilt)]
    torch.testing.assert_close(poses_of(results[0]), poses_of(results[1]), rtol=0, atol=1e-9)


def test_a_stream_is_tracked_by_kernels(monkeypatch):
    """The loop over windows records no gradients."""
    taken, body = [], dispatch.OPERATIONS["tracking.estimation.rounds.align_rounds"].bodies["cpu"]
    accelerated = body.accelerated
    monkeypatch.setattr(body, "accelerated", lambda *args: taken.append(args) or accelerated(*args))
    trajectory, events = moving_box(pose(), 2)
    tracker = Tracker([box_model()], SMALL_CAMERA)
    assert len(list(track([events], tracker, tracker.init(trajectory.T_cam_obj[:1], 0)))) == 2
    assert len(taken) >= 2


@pytest.mark.parametrize("streams", [[0, 1], [0, 0], [0]])
@pytest.mark.parametrize("name", ["default", "paper", "line"])
def test_what_is_compiled_is_compiled_before_the_first_window(name, streams, monkeypatch):
    asked = []
    monkeypatch.setattr(dispatch, "backend_is_installed", lambda device: not asked.append(name))
    tracker = tracker_class(name)([box_model()] * len(streams), [SMALL_CAMERA] * (max(streams) + 1), preset(name), streams)
    state = tracker.init(torch.stack([pose()] * len(streams)), 0)
    before = [tensor.clone() for tensor in tensors_of(state)]
    tracker.prepare(state)
    assert bool(asked) == (name != "line")
    for now, then in zip(tensors_of(state), before, strict=True):
        assert torch.equal(now, then)


@pytest.mark.parametrize(("x", "y"), [(SMALL_CAMERA.width, 3), (-1, 3), (3, SMALL_CAMERA.height), (3, -2)])
def test_events_outside_the_sensor_are_told_before_anything_is_written(x, y):
    tracker, state, _, (events, end_us), _ = started(torch.float64)
    spoilt = replace(events, x=events.x.clone(), y=events.y.clone())
    spoilt.x[7], spoilt.y[7] = x, y
    before = [tensor.clone() for tensor in tensors_of(state)]
    with torch.inference_mode(), pytest.raises(EventDataError, match=rf"event 7 is at \({x}, {y}\), outside the sensor of 200x150 pixels"):
        tracker.step(state, spoilt, end_us)
    assert all(torch.equal(now, then) for now, then in zip(tensors_of(state), before, strict=True))


def test_events_outside_the_sensor_are_told_before_a_compiled_graph_is_given_them():
    _, state, _, (events, end_us), _ = started(torch.float64)
    spoilt = replace(events, x=events.x.clone())
    spoilt.x[7] = SMALL_CAMERA.width
    before = state.maps.burst_age_us.clone()
    with torch.inference_mode(), pytest.raises(EventDataError, match="event 7 is at .*, outside the sensor of 200x150 pixels"):
        graphs._in_bursts(state, graphs._filled(NearbyEvents(spoilt), 1), torch.tensor([end_us]))
    assert torch.equal(state.maps.burst_age_us, before)
