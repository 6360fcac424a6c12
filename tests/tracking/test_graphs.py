"""Steady windows by compiled graphs: what is handed to them, when what they give counts, and that a compiler takes them as they are."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import SMALL_CAMERA, bevelled_model, box_model, pose
from states import changed
from tracked_boxes import PREDICT, WIDE_CAMERA, follow, merged, moving_box, tensors_of, windows

from torchtrack import Tracker
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import ConfigError
from torchtrack.run.runner import run
from torchtrack.tracking import graphs as room
from torchtrack.tracking.adaptation import learned_contours
from torchtrack.tracking.frontend.tiles import NearbyEvents, SensorTiles

TESTS = Path(__file__).resolve().parents[1] / "support"
COUNT = 12


@pytest.fixture
def often_learning(monkeypatch):
    """Something is learned of every object, in one window of three."""
    for name, value in {"FIRST_WINDOWS": 0, "EVERY": 3, "UP_TO_RATIO": 1.0}.items():
        monkeypatch.setattr(learned_contours, name, value)


class Graphs:
    """In the place of compiled graphs: functions that read nothing, as graphs do not, and say how often they were asked."""

    def __init__(self, monkeypatch):
        self.calls, self.dropped, self.compiled_for = [], 0, []
        monkeypatch.setattr(room, "compiled", self._graph_of)

    def _graph_of(self, function, device):
        if function.__name__ == "_tiles_near":
            return self._reading_nothing(function)
        number = len(self.calls)
        self.calls.append(0)

        def graph(*args):
            if not self.calls[number]:
                self.compiled_for.append(args[0])
            self.calls[number] += 1
            *done, wrong = self._reading_nothing(function)(*args)
            self.dropped += bool(wrong)
            return *done, wrong

        return graph

    @staticmethod
    def _reading_nothing(function):
        def graph(*args):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(host_sync, "read_at_once", lambda values: False)
                return function(*args)

        return graph


@pytest.fixture
def graphs(monkeypatch):
    return Graphs(monkeypatch)


def both_ways(config=None, streams=1, count=COUNT, mode=torch.inference_mode, model=box_model):
    """Results of a box per stream without graphs and with them, and the last states."""
    parts = [moving_box(pose(), count, SMALL_CAMERA, seed=stream, stream=stream)[1] for stream in range(streams)]
    cut = [(concatenate([window[0] for window in step]), step[0][1]) for step in zip(*(windows(events, count) for events in parts), strict=True)]
    actual = []
    for is_compiled in (False, True):
        tracker = Tracker([model()] * streams, [SMALL_CAMERA] * streams, config, list(range(streams)), compiled=is_compiled)
        with mode():
            state = tracker.init(pose().expand(streams, 4, 4), 0)
            tracker.prepare(state)
            actual.append(follow(tracker, state, cut))
    return actual


@pytest.mark.usefixtures("often_learning")
@pytest.mark.parametrize("streams", [1, 2])
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_poses_are_those_of_a_step(graphs, streams, mode):
    (state, expected), (compiled_state, actual) = both_ways(TrackerConfig(), streams, mode=mode)
    assert sum(graphs.calls) >= COUNT // 3
    for single, other in zip(expected, actual, strict=True):
        torch.testing.assert_close(other.T_cam_obj, single.T_cam_obj, rtol=0, atol=1e-6)
        assert torch.equal(other.status, single.status)
    assert torch.equal(compiled_state.maps.last_event_us, state.maps.last_event_us)
    assert torch.equal(compiled_state.maps.burst_age_us, state.maps.burst_age_us)
    assert compiled_state.appearance.learned.windows == state.appearance.learned.windows == COUNT
    assert actual[-1].T_cam_obj.is_inference() == (mode is torch.inference_mode)


@pytest.mark.usefixtures("often_learning")
def test_each_tensor_of_the_state_that_a_graph_is_compiled_for_is_one_alone(graphs):
    """The compiler takes one tensor in two places for one in both, whatever comes later."""
    both_ways(TrackerConfig())
    for state in graphs.compiled_for:
        places = [tensor.data_ptr() for tensor in tensors_of(state) if tensor.numel()]
        assert len(set(places)) == len(places) > 20


@pytest.mark.usefixtures("often_learning")
def test_poses_of_a_smooth_object_are_those_of_a_step(graphs):
    (state, _), (compiled_state, _) = both_ways(TrackerConfig(), model=bevelled_model)
    assert sum(graphs.calls) >= COUNT // 3
    # What lies halfway between two pixels is counted at one or the other.
    torch.testing.assert_close(compiled_state.T_cam_obj, state.T_cam_obj, rtol=0, atol=1e-4)
    assert torch.equal(compiled_state.maps.last_event_us, state.maps.last_event_us)


@pytest.mark.usefixtures("often_learning")
def test_windows_that_are_learned_from_are_taken_without_a_graph(graphs):
    (state, _), (compiled_state, _) = both_ways(TrackerConfig())
    # One call prepares the graph.
    assert graphs.calls == [1 + sum(window % 3 > 0 for window in range(5, COUNT))]
    expected, actual = (vars(owner.appearance.learned) for owner in (state, compiled_state))
    for name, value in expected.items():
        assert torch.equal(actual[name], value) if torch.is_tensor(value) else actual[name] == value


def test_the_graph_of_one_stream_is_prepared(graphs):
    tracker = Tracker([box_model()], SMALL_CAMERA, compiled=True)
    state = tracker.init(pose()[None], 0)
    tracker.prepare(state)
    tracker.prepare(changed(state, learned=replace(state.appearance.learned, windows=7)))
    assert graphs.calls == [2]


def test_of_several_streams_nothing_is_prepared(graphs):
    tracker = Tracker([box_model()] * 2, [SMALL_CAMERA] * 2, stream_index=[0, 1], compiled=True)
    tracker.prepare(tracker.init(pose().expand(2, 4, 4), 0))
    assert graphs.calls == []


def test_a_window_that_is_not_steady_is_taken_without_a_graph(graphs):
    _, events = moving_box(pose(), COUNT)
    cut = windows(events, COUNT)
    results = []
    for is_compiled in (False, True):
        tracker = Tracker([box_model()], SMALL_CAMERA, compiled=is_compiled)
        with torch.inference_mode():
            state, _ = follow(tracker, tracker.init(pose()[None], 0), cut[:-1])
            uncertain = state.motion.covariance.clone()
            uncertain[:, :6, :6] += torch.eye(6) * 0.05**2
            before = graphs.dropped
            results.append(tracker.step(changed(state, covariance=uncertain), *cut[-1])[1])
    assert graphs.dropped == before + 1
    torch.testing.assert_close(results[1].T_cam_obj, results[0].T_cam_obj, rtol=0, atol=1e-5)


def test_of_many_events_those_far_from_all_objects_are_left_out(graphs, monkeypatch):
    _, events = moving_box(pose(), COUNT, WIDE_CAMERA)
    t_us = torch.arange(1, 5_000 * COUNT, 5)
    far = EventBatch(torch.full_like(t_us, 319).int(), (t_us % 150).int(), t_us, t_us % 2 > 0, torch.zeros_like(t_us))
    cut = windows(merged(events, far), COUNT)
    kept, keep, results = [], SensorTiles.keep, []
    monkeypatch.setattr(SensorTiles, "keep", lambda *args: kept.append(keep(*args)) or kept[-1])
    for most, is_compiled in ((0, False), (10**6, True), (0, True)):
        kept.clear()
        monkeypatch.setattr(room, "_MANY", most)
        # Searches for a new object would be steps without a graph.
        tracker = Tracker([box_model()], WIDE_CAMERA, TrackerConfig(relocalization=RelocalizationConfig(new_below=0)), compiled=is_compiled)
        with torch.inference_mode():
            results.append(follow(tracker, tracker.init(pose()[None], 0), cut)[1][-1])
    assert kept and all(len(nearby.events) < 0.5 * len(window[0]) for nearby, window in zip(kept, cut[-len(kept) :], strict=True))
    for result in results[1:]:
        torch.testing.assert_close(result.T_cam_obj, results[0].T_cam_obj, rtol=0, atol=1e-6)


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_event_is_no_work_for_a_graph(graphs, count):
    _, events = moving_box(pose(), COUNT)
    tracker = Tracker([box_model()], SMALL_CAMERA, PREDICT, compiled=True)
    with torch.inference_mode():
        state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, COUNT))
        before = sum(graphs.calls)
        few = events[:count]
        tracker.step(state, replace(few, t_us=few.t_us + 5_000 * COUNT), 5_000 * (COUNT + 1))
    assert sum(graphs.calls) == before


def test_gradients_are_not_taken_through_graphs(graphs):
    _, events = moving_box(pose(), COUNT)
    cut = windows(events, COUNT)
    tracker = Tracker([box_model()], SMALL_CAMERA, compiled=True)
    with torch.inference_mode():
        state, _ = follow(tracker, tracker.init(pose()[None], 0), cut[:-1])
    before = sum(graphs.calls)
    plain = tracker.init(state.T_cam_obj.clone(), state.t_us.clone())
    tracker.step(plain, *cut[-1])
    assert sum(graphs.calls) == before


@pytest.mark.parametrize("streams", [1, 2])
@pytest.mark.parametrize("count", [2, 3, 100, 1000, 1001])
def test_events_are_filled_up_with_some_of_no_stream(count, streams):
    random = torch.Generator().manual_seed(0)
    x, y = (torch.randint(0, 90, (count,), generator=random, dtype=torch.int32) for _ in range(2))
    stream = torch.arange(count) * streams // count
    events = EventBatch(x, y, torch.arange(count), torch.ones(count, dtype=torch.bool), stream)
    filled = room._filled(NearbyEvents(events), streams)
    assert len(filled.events) % 64 == 0
    assert count <= len(filled.events) < 1.25 * count + 64
    assert (filled.events.stream_index[count:] == streams).all()
    assert torch.equal(filled.events.stream_index[:count], stream)
    assert torch.equal(filled.events.x[:count], x)
    if streams == 1:
        assert torch.equal(filled.number, torch.arange(len(filled.events)))
    else:
        # Numbers are of each stream's own, as without a graph.
        assert filled.number is None
    # Few sizes for many counts: a GPU holds a graph for each.
    sizes = {room._rounded_up(n) for n in range(1000, 2000)}
    assert len(sizes) <= 6


def test_a_compiler_that_fails_is_told(monkeypatch, folder, tmp_path):
    def without_compiler(*args):
        raise RuntimeError("No working C++ compiler found\nand more")

    monkeypatch.setattr(room, "compiled", lambda function, device: without_compiler)
    with pytest.raises(ConfigError, match=r"could not be compiled: No working C\+\+ compiler found\. It needs a C\+\+ compiler"):
        run(RunConfig(source=folder / "one.npz", compiled=True, output=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_methods_without_graphs_are_told(folder, tmp_path):
    config = RunConfig(source=folder / "one.npz", preset="line", compiled=True, output=tmp_path / "out")
    with pytest.raises(ConfigError, match="compiled: the method 'line' cannot be compiled"):
        run(config)
    assert not (tmp_path / "out").exists()


def test_a_run_is_the_same_with_graphs(graphs, folder, tmp_path):
    outputs = []
    for is_compiled in (False, True):
        output = tmp_path / str(is_compiled)
        run(RunConfig(source=folder / "one.npz", compiled=is_compiled, output=output, overlay={"enabled": False}))
        outputs.append(sorted(path.name for path in output.iterdir()))
    assert sum(graphs.calls) > 0
    assert outputs[0] == outputs[1]


def in_own_process(script, *args):
    """What a script of a tracker that is compiled says, in a process in which no types are checked."""
    path = os.pathsep.join([str(TESTS.parents[1]), str(TESTS)])
    command = [sys.executable, "-W", "error::UserWarning", str(TESTS / script), *args]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_a_step_is_one_graph_and_its_compiled_poses_are_those_of_a_step():
    """Without a C++ compiler it is made a graph all the same, which runs as it is."""
    has_compiler = shutil.which("g++") or shutil.which("clang++")
    stated = in_own_process("compiled_boxes.py", "inductor" if has_compiler else "eager", str(COUNT), "cpu")
    assert stated["prepared"] == stated["graphs"] == 1
    assert stated["took"] >= COUNT // 4
    assert stated["apart"] < (1e-5 if has_compiler else 1e-6)
    assert stated["status"] == 0


def test_the_graph_of_a_gpu_is_one_and_holds_the_kernels_of_its_backend():
    pytest.importorskip("triton", reason="needs Triton: pip install triton")
    stated = in_own_process("compiled_lane.py")
    assert stated["graphs"] == 1
    assert stated["operations"] == [["torchtrack.nearest_contours.default", "torchtrack.rounds.default"]]
    assert stated["apart"] < 1e-4


@pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch sees no GPU here")
def test_poses_of_cuda_graphs_are_those_of_the_cpu():
    stated = in_own_process("compiled_boxes.py", "inductor", str(COUNT), "cuda")
    assert stated["graphs"] == 1
    assert stated["took"] >= COUNT // 4
    assert stated["apart"] < 1e-4
    assert stated["status"] == 0


def test_torch_compile_leaves_a_tracker_as_it_is_and_says_so():
    """In a process of its own, without checks of types, which a compiler would compile."""
    code = """
import warnings
import torch
from helpers import SMALL_CAMERA, box_model, pose
from tracked_boxes import moving_box, windows
from torchtrack import Tracker
from torchtrack.errors import TorchtrackWarning

events, end_us = windows(moving_box(pose(), 3)[1], 3)[0]
tracker = Tracker([box_model()], SMALL_CAMERA)
state = tracker.init(pose(), 0)
with torch.inference_mode(), warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always", TorchtrackWarning)
    result = torch.compile(tracker)(events, state, end_us)[1]
    print(torch.equal(result.T_cam_obj, tracker.step(state, events, end_us)[1].T_cam_obj))
print(*[warning.message for warning in caught if warning.category is TorchtrackWarning])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=TESTS)
    assert done.returncode == 0, done.stderr
    same, message = done.stdout.splitlines()
    assert same == "True"
    assert message.startswith("torch.compile leaves a tracker as it is:") and "use Tracker(..., compiled=True)" in message
