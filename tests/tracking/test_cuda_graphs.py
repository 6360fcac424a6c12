"""CUDA graphs: what they are given and give, with graphs that are called anew in the place of recorded ones; and real ones on a GPU."""

import copy
from dataclasses import dataclass
from functools import partial

import pytest
import torch
from helpers import SMALL_CAMERA, bevelled_model, box_model, pose
from states import changed
from tracked_boxes import WINDOW_US, follow, moving_box, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import AdaptationConfig, TrackerConfig
from torchtrack.core import dispatch, host_sync
from torchtrack.core.events import concatenate
from torchtrack.core.lie import retract_about
from torchtrack.tracking import cuda_graphs, graphs
from torchtrack.tracking.adaptation import learned_contours
from torchtrack.tracking.cuda_graphs import CudaGraphs
from torchtrack.tracking.state import each_tensor

COUNT = 12


@pytest.fixture
def often_learning(monkeypatch):
    """Something is learned of every object in one window of three, which is taken without a graph."""
    for name, value in {"FIRST_WINDOWS": 0, "EVERY": 3, "UP_TO_RATIO": 1.0}.items():
        monkeypatch.setattr(learned_contours, name, value)


@dataclass(frozen=True)
class Pair:
    moved: torch.Tensor
    kept: torch.Tensor
    number: int = 3
    inner: "Pair | None" = None


class CalledAgain:
    """A graph that calls its function again, and writes where the function's first results are."""

    def __init__(self, function, held, results):
        self.function, self.held, self.results, self.starts = function, held, results, 0

    def replay(self):
        self.starts += 1
        values = self.function(*self.held)
        for place, value in zip(cuda_graphs._tensors(*self.results), cuda_graphs._tensors(*values), strict=True):
            place.copy_(value)
        for place, value in zip(self.results, values, strict=True):
            if isinstance(place, graphs.InPlace):
                place._window = value._window


@pytest.fixture
def recorded(monkeypatch):
    """All that is recorded, without a GPU."""
    made = []

    def record(self, values):
        held = tuple(each_tensor(cuda_graphs._held, value) for value in values)
        results = self._function(*held)
        reads = list(cuda_graphs._tensors(*held))
        numbers = {id(tensor): number for number, tensor in enumerate(reads)}
        passed_on = [numbers.get(id(tensor)) for tensor in cuda_graphs._tensors(*results)]
        made.append(CalledAgain(self._function, held, results))
        return cuda_graphs._Recorded(made[-1].replay, reads, reads, results, passed_on)

    monkeypatch.setattr(CudaGraphs, "_record", record)
    return made


def advance(pair, by):
    """Moves what moves, and passes on the rest."""
    inner = Pair(pair.inner.moved - by, pair.inner.kept)
    return Pair(pair.moved + by, pair.kept, pair.number, inner), (pair.moved > 0).any()


def pair_of(random, size=4):
    single, two, three, four = (torch.randn(size, 3, generator=random) for _ in range(4))
    return Pair(single, two.T.contiguous().T, 5, Pair(three.double(), four > 0))


def test_what_a_graph_gives_is_what_the_function_does(recorded):
    random, graphs = torch.Generator().manual_seed(0), CudaGraphs(advance)
    pair = pair_of(random)
    earlier = []
    for _ in range(3):
        by = torch.randn((), generator=random)
        (expected, any_positive), (actual, stated) = advance(pair, by), graphs(pair, by)
        assert stated == any_positive
        assert actual.number == 5
        for name in ("moved", "kept"):
            assert torch.equal(getattr(actual, name), getattr(expected, name))
            assert torch.equal(getattr(actual.inner, name), getattr(expected.inner, name))
        # Nothing that was given out is written to again.
        assert all(torch.equal(value, copy) for value, copy in earlier)
        earlier += [(value, value.clone()) for value in cuda_graphs._tensors(actual)]
        pair = actual
    assert recorded[0].starts == 3


def test_what_is_passed_on_is_not_copied(recorded, monkeypatch):
    copied, copy = [], cuda_graphs._copy
    monkeypatch.setattr(cuda_graphs, "_copy", lambda to, values: copied.append(len(values)) or copy(to, values))
    pair, by, graphs = pair_of(torch.Generator().manual_seed(0)), torch.tensor(1.0), CudaGraphs(advance)
    for _ in range(2):
        result, _ = graphs(pair, by)
        assert result.kept is pair.kept
        assert result.inner.kept is pair.inner.kept
        pair = result
    # All five that it reads, the three that it makes; then the two of these that come back.
    assert copied == [5, 3, 2, 3]


def test_there_is_a_graph_for_each_size(recorded):
    random, graphs = torch.Generator().manual_seed(0), CudaGraphs(advance)
    for size in (4, 5, 4):
        graphs(pair_of(random, size), torch.tensor(1.0))
    assert len(graphs) == len(recorded) == 2


@pytest.mark.usefixtures("often_learning")
@pytest.mark.parametrize("streams", [1, 2])
def test_a_tracker_finds_the_same_poses_by_graphs(recorded, monkeypatch, streams):
    parts = [moving_box(pose(), COUNT, SMALL_CAMERA, seed=stream, stream=stream)[1] for stream in range(streams)]
    cut = [(concatenate([window[0] for window in step]), step[0][1]) for step in zip(*(windows(events, COUNT) for events in parts), strict=True)]
    actual = []
    for by_graphs in (False, True):
        tracker = Tracker([box_model()] * streams, [SMALL_CAMERA] * streams, TrackerConfig(), list(range(streams)))
        if by_graphs:
            # As on a GPU: there is a graph, and nothing is read back within it.
            by_learning = {learns: CudaGraphs(_as_there(partial(_lane_in_place, tracker, learns=learns))) for learns in (False, True)}
            _take_windows_by(monkeypatch, lambda self, filled, learns, lanes=by_learning: lanes[learns])
        with torch.inference_mode():
            actual.append(follow(tracker, tracker.init(pose().expand(streams, 4, 4), 0), cut)[1])
    assert sum(graph.starts for graph in recorded) >= COUNT // 3
    for single, other in zip(*actual, strict=True):
        torch.testing.assert_close(other.T_cam_obj, single.T_cam_obj, rtol=0, atol=1e-6)


def test_trackers_that_are_copied_or_moved_begin_without_graphs():
    tracker = Tracker([box_model()], SMALL_CAMERA)
    tracker.graphs._lanes[None, False] = graphs.steady_lane
    copied = copy.deepcopy(tracker)
    assert copied.graphs._tracker is copied
    assert (len(tracker.graphs), len(copied.graphs)) == (1, 0)
    assert len(tracker.to("cpu").graphs) == 0


def test_with_a_weigher_of_ones_own_graphs_have_to_be_asked_for(monkeypatch):
    plain, judged = (
        Tracker([box_model()], SMALL_CAMERA, weighting_network=weighting_network).graphs for weighting_network in (None, torch.nn.Identity())
    )
    t_us = torch.zeros(1, dtype=torch.int64)
    assert not plain._are_for(t_us)
    monkeypatch.setattr(host_sync, "on_gpu", lambda values: True)
    assert plain._are_for(t_us)
    assert not judged._are_for(t_us)
    assert Tracker([bevelled_model()], SMALL_CAMERA).graphs._are_for(t_us)


# ---- objects that are lost


def _as_there(function):
    """As on a GPU: nothing is read back within a graph, and there are no kernels for the CPU in it."""

    def graph(*args):
        with pytest.MonkeyPatch.context() as patch, dispatch.backend(wanted=False):
            patch.setattr(host_sync, "read_at_once", lambda values: False)
            return function(*args)

    return graph


def _take_windows_by(monkeypatch, lane):
    """As on a GPU: windows are taken by its graphs."""
    monkeypatch.setattr(graphs.CompiledStep, "_are_for", lambda self, t_us: True)
    monkeypatch.setattr(graphs.CompiledStep, "_lane", lane)
    monkeypatch.setattr(graphs.CompiledStep, "_if_steady", lambda self, before, filled, t_us: self._by_lane(before, filled, t_us, learns=False))
    monkeypatch.setattr(graphs.CompiledStep, "_near", lambda self, state, events, t_us: graphs.NearbyEvents(events))


@pytest.fixture
def taken(monkeypatch):
    """Numbers of the windows that the graph took."""
    numbers = []

    def lane(self, filled, learns):
        numbers.append(len(numbers))
        return _as_there(partial(_lane_in_place, self._tracker, learns=learns))

    _take_windows_by(monkeypatch, lane)
    return numbers


def _lane_in_place(*args, **kwargs):
    return graphs._in_place(*graphs.steady_lane(*args, **kwargs))


def _with_one_lost(tracker, batches, known=6):
    """Results after the middle one of three boxes is put off its place, and made uncertain; its neighbours go on."""
    with torch.inference_mode():
        state, _ = follow(tracker, tracker.init(pose()[None].repeat(3, 1, 1), 0), batches[:known])
        T_cam_obj, covariance = state.T_cam_obj.clone(), state.motion.covariance.clone()
        off = torch.tensor([[0.09, -0.06, 0.12, 0.008, -0.006, 0.0]], dtype=torch.float64)
        T_cam_obj[1] = retract_about(T_cam_obj[1:2], off, tracker.centre_obj[1:2].double())[0]
        covariance[1] *= 100
        return follow(tracker, changed(state, T_cam_obj=T_cam_obj, covariance=covariance), batches[known:])[1]


def _three_streams(count):
    streams = [moving_box(pose(), count, seed=stream, stream=stream)[1] for stream in range(3)]
    ends = [(number + 1) * WINDOW_US for number in range(count)]
    return [(concatenate([events.slice_time(end - WINDOW_US, end) for events in streams]), end) for end in ends]


def _three_boxes(**search):
    config = TrackerConfig(
        relocalization=RelocalizationConfig(new_below=0, **search),
        adaptation=AdaptationConfig(learned_points=0),
        disabled={Component.WINDOW_PARTS},
    )
    # A GPU has no kernels of the CPU, whose roundings are others.
    return Tracker([box_model()] * 3, [SMALL_CAMERA] * 3, config, [0, 1, 2], kernels=False)


def test_a_lost_object_does_not_take_its_neighbours_out_of_the_graph(taken, monkeypatch):
    """The graph holds, the lost one is found after it, and its neighbours are what they are when nobody is looked for."""
    batches, without = _three_streams(9), []
    monkeypatch.setattr(
        Tracker, "_advance", lambda self, *args, whole=Tracker._advance, **more: without.append(args[1]) or whole(self, *args, **more)
    )
    by_graphs = _with_one_lost(_three_boxes(), batches)
    assert without == []
    assert len(taken) == len(batches)
    unsearched = _with_one_lost(_three_boxes(hypotheses=0), batches)
    for searched, alone in zip(by_graphs, unsearched, strict=True):
        for number in (0, 2):
            assert torch.equal(searched.T_cam_obj[number], alone.T_cam_obj[number])
            assert torch.equal(searched.covariance[number], alone.covariance[number])
    assert not torch.equal(by_graphs[-1].T_cam_obj[1], unsearched[-1].T_cam_obj[1])
    monkeypatch.setattr(graphs.CompiledStep, "_are_for", lambda self, t_us: False)
    for searched, plain in zip(by_graphs, _with_one_lost(_three_boxes(), batches), strict=True):
        torch.testing.assert_close(searched.T_cam_obj, plain.T_cam_obj, rtol=0, atol=1e-5)
        assert torch.equal(searched.status, plain.status)
