"""Events that are pushed in give the results that a whole stream gives."""

import numpy as np
import pytest
import torch
from tiny_sequence import CAMERA, write_tiny_sequence

import torchtrack
from torchtrack.config.tracker import TrackerConfig, WindowConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.windows import clipped
from torchtrack.errors import ConfigError, EventDataError
from torchtrack.io import read_sequence
from torchtrack.run.stepping import cut_windows, steps
from torchtrack.tracking.tracker import Tracker

CONFIG = TrackerConfig()
START_US = 2_000


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return read_sequence(write_tiny_sequence(tmp_path_factory.mktemp("sequence"), duration_us=30_000))


@pytest.fixture(scope="module")
def tracker(sequence):
    return Tracker([torchtrack.ObjectModel.from_file(sequence.objects[0].model_path())], sequence.camera, CONFIG)


@pytest.fixture
def state(sequence, tracker):
    return tracker.init(sequence.objects[0].ground_truth.at(torch.tensor([START_US])), START_US)


@pytest.fixture(scope="module")
def events(sequence) -> EventBatch:
    return next(iter(clipped(sequence.events.chunks(), START_US)))


@pytest.fixture(scope="module")
def whole(sequence, tracker, events):
    """Results of the stream at once."""
    start = tracker.init(sequence.objects[0].ground_truth.at(torch.tensor([START_US])), START_US)
    return [step.result for step in steps(cut_windows([events], START_US, CONFIG.window), tracker, start)]


def cuts_of(events: EventBatch, size: int) -> list[EventBatch]:
    return [events[at : at + size] for at in range(0, len(events), size)]


def assert_same_results(results, expected):
    assert [int(result.t_us[0]) for result in results] == [int(result.t_us[0]) for result in expected]
    for result, other in zip(results, expected, strict=True):
        assert torch.equal(result.T_cam_obj, other.T_cam_obj) and torch.equal(result.status, other.status)


@pytest.mark.parametrize("size", [37, 100_000])
def test_results_are_those_of_the_whole_stream(tracker, state, events, whole, size):
    stream = torchtrack.Stream(tracker, state)
    results = [result for part in cuts_of(events, size) for result in stream.push(part)]
    assert len(results) == len(whole) - 1
    assert stream.push(EventBatch.empty()) == []
    results += stream.finish()
    assert_same_results(results, whole)
    assert torch.equal(stream.state.T_cam_obj, whole[-1].T_cam_obj) and int(stream.state.t_us) == int(whole[-1].t_us)


def test_a_window_is_given_as_soon_as_an_event_after_its_end_is_there(tracker, state, events):
    stream = torchtrack.Stream(tracker, state)
    end_us = START_US + CONFIG.window.duration_us
    assert stream.push(events.slice_time(START_US, end_us)) == []
    (result,) = stream.push(events.slice_time(end_us, end_us + 500))
    assert int(result.t_us) == end_us


def test_windows_by_count_and_structured_arrays(tracker, state, events):
    array = np.zeros(len(events), [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
    array["t"], array["x"], array["y"], array["on"] = events.t_us, events.x, events.y, events.polarity
    window = WindowConfig(mode="count", count=200)
    expected = [step.result for step in steps(cut_windows([events], START_US, window), tracker, state)]
    stream = torchtrack.Stream(tracker, state, window)
    assert_same_results([*stream.push(array[:301]), *stream.push(array[301:]), *stream.finish()], expected)


def test_events_of_another_library_are_tracked_as_any(tracker, state, events, whole):
    array = {"t": events.t_us.numpy(), "x": events.x.numpy(), "y": events.y.numpy(), "p": events.polarity.numpy()}
    assert_same_results(list(torchtrack.track([array], tracker, state)), whole)
    part = {name: values[:50] for name, values in array.items()}
    _, result = tracker.step(state, part)
    assert torch.equal(result.T_cam_obj, tracker.step(state, events[:50])[1].T_cam_obj)


def test_unsorted_old_and_foreign_events_are_refused_and_change_nothing(tracker, state, events, whole):
    stream = torchtrack.Stream(tracker, state)
    half = len(events) // 2
    shuffled = events[torch.arange(len(events)).flip(0)]
    with pytest.raises(EventDataError, match=r"time goes back from \d+ to \d+ µs at event \d+. Sort"):
        stream.push(shuffled)
    with pytest.raises(EventDataError, match=f"the first is at 1500 µs, but tracking starts at {START_US} µs"):
        stream.push(EventBatch.from_numpy(*np.array([[1], [1], [1500], [1]])))
    results = stream.push(events[:half])
    with pytest.raises(EventDataError, match=rf"the events pushed: time goes back from {int(events.t_us[half - 1])} to {int(events.t_us[0])} µs"):
        stream.push(events[:half])
    with pytest.raises(EventDataError, match=r"event \d+ is at \(500, 1\), outside the sensor of 120x90"):
        stream.push(EventBatch.from_numpy(*np.array([[500], [1], [29_999], [1]])))
    with pytest.raises(EventDataError, match="of other streams than the first"):
        stream.push(EventBatch.from_numpy(*np.array([[1], [1], [29_999], [1]]), stream=1))
    with pytest.raises(EventDataError, match="got list"):
        stream.push([1, 2])
    assert_same_results([*results, *stream.push(events[half:]), *stream.finish()], whole)


def test_a_tracker_of_two_streams_is_refused(tracker, sequence):
    two = Tracker(list(tracker.object_models) * 2, [CAMERA, CAMERA], CONFIG, stream_index=[0, 1])
    start = two.init(sequence.objects[0].ground_truth.at(torch.tensor([0, 0])), 0)
    with pytest.raises(ConfigError, match="a tracker of one stream, but this one has 2"):
        torchtrack.Stream(two, start)


def test_public_objects_show_themselves_in_a_line(tracker, state, events, sequence):
    stream = torchtrack.Stream(tracker, state)
    result = stream.push(events)[0]
    shown = {name: repr(value) for name, value in {"tracker": tracker, "state": state, "result": result, "events": events, "stream": stream}.items()}
    shown |= {"model": repr(tracker.object_models[0]), "camera": repr(sequence.camera)}
    assert all(len(text) < 200 and "\n" not in text and "tensor(" not in text for text in shown.values()), shown
    assert shown["tracker"].startswith("Tracker(1 object (") and "120x90 pixels, cpu, float32" in shown["tracker"]
    assert shown["state"].startswith(f"TrackerState({START_US} µs, positions (")
    assert "UNCERTAIN" in shown["result"] and "7000 µs" in shown["result"]
    assert shown["events"] == f"EventBatch({len(events)} events, {int(events.t_us[0])} to {int(events.t_us[-1])} µs, cpu)"
    assert repr(EventBatch.empty()) == "EventBatch(no events)"
    assert "diameter 0.1755 m" in shown["model"] and "12 faces" in shown["model"]
    assert shown["camera"].startswith("Camera(fx=150.0")


def test_of_many_objects_a_few_are_shown(tracker, sequence):
    many = Tracker(list(tracker.object_models) * 6, CAMERA, CONFIG)
    start = many.init(sequence.objects[0].ground_truth.at(torch.zeros(6, dtype=torch.int64)), 0)
    assert "6 objects (" in repr(many) and ", …)" in repr(many)
    assert repr(start).endswith("and 2 more m, cpu)")


def test_a_pose_of_one_object_may_have_no_batch(tracker, sequence, state):
    T = sequence.objects[0].ground_truth.at(torch.tensor([START_US]))[0]
    assert torch.equal(tracker.init(T, START_US).T_cam_obj, state.T_cam_obj)
    from scipy.spatial.transform import RigidTransform

    torch.testing.assert_close(tracker.init(RigidTransform.from_matrix(T.numpy()), START_US).T_cam_obj, state.T_cam_obj)
