"""What a GPU needs: that a step never waits for it, and that its poses are those of the CPU."""

import warnings
from dataclasses import replace

import pytest
import torch
from helpers import bevelled_model, box_model, pose_errors
from host_reads import host_reads
from tracked_boxes import SCENES, follow

from torchtrack import Tracker
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import AdaptationConfig, TrackerConfig
from torchtrack.core import host_sync
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.graphs import CompiledStep
from torchtrack.tracking.step import steady_lane
from torchtrack.tracking.validation.status import Status

COUNT = 8
# All objects are searched for in all windows.
SEARCHED = TrackerConfig(relocalization=RelocalizationConfig(trigger_sigma_px=1e-3, hypotheses=4, rotations=10))
# What is new is not looked for elsewhere, and nothing is learned: windows are steady.
ONE_POSE = TrackerConfig(relocalization=RelocalizationConfig(new_below=0), adaptation=AdaptationConfig(learned_points=0))


@pytest.fixture
def cuda():
    if not torch.cuda.is_available():
        pytest.skip("PyTorch sees no GPU here")
    return torch.device("cuda")


@pytest.fixture
def sync_is_an_error(cuda):
    """Whatever makes the CPU wait for the GPU raises, within ``torch.cuda.set_sync_debug_mode('error')``."""
    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings():
        # That it does not find all.
        warnings.filterwarnings("ignore", "Synchronization debug mode is a prototype feature")
        yield lambda: torch.cuda.set_sync_debug_mode("error")
        torch.cuda.set_sync_debug_mode(before)


def on_device(stream_windows, device):
    """The windows on a device, with their ends as tensors."""
    return [(events.to(device), torch.as_tensor(end_us, device=device).view(-1)) for events, end_us in stream_windows]


def set_up(scene, device, config=None, model=box_model):
    """A tracker of a scene, the state that it begins with, and the windows."""
    starts, stream_index, cameras, stream_windows = scene(COUNT)
    tracker = Tracker([model()] * len(starts), cameras, config, stream_index).to(device)
    return tracker, tracker.init(torch.stack(starts), 0), on_device(stream_windows, device)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("by_graph", [True, False])
def test_a_step_never_waits_for_the_gpu(cuda, sync_is_an_error, scene, by_graph, monkeypatch):
    tracker, state, ready = set_up(scene, cuda, ONE_POSE)
    if not by_graph:
        monkeypatch.setattr(CompiledStep, "__call__", lambda *args: None)
    with torch.inference_mode():
        # The first steps load kernels and record graphs, and may wait.
        state, _ = follow(tracker, state, ready[:-1])
        tracker.step(state, *ready[-1])
        assert (len(tracker.graphs) > 0) == by_graph
        torch.cuda.synchronize(cuda)
        sync_is_an_error()
        _, result = tracker.step(state, *ready[-1])
        torch.cuda.set_sync_debug_mode("default")
    assert (result.status == int(Status.TRACKING)).all()


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("mode", [torch.enable_grad, torch.inference_mode], ids=["without graphs", "by graphs"])
def test_the_gpu_finds_the_poses_of_the_cpu(cuda, scene, mode):
    poses = []
    for device in (torch.device("cpu"), cuda):
        tracker, state, ready = set_up(scene, device)
        with mode():
            _, results = follow(tracker, state, ready)
        assert (len(tracker.graphs) > 0) == (device == cuda and mode is torch.inference_mode)
        poses.append(torch.stack([result.T_cam_obj.cpu() for result in results]))
    degrees, millimetres = pose_errors(poses[1], poses[0])
    assert float(degrees.max()) < 0.02
    assert float(millimetres.max()) < 0.1


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize(
    "wait",
    [
        lambda x: x.sum().item(),
        lambda x: int(x.sum()),
        lambda x: float(x[0]),
        lambda x: bool((x > 0).all()),
        lambda x: x.tolist(),
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: torch.tensor([1.0, 2.0]),
        lambda x: x.new_tensor([1.0, 2.0]),
        lambda x: torch.bincount(x.long()),
        lambda x: torch.equal(x, x),
        lambda x: x.repeat_interleave(x.long()),
        lambda x: torch.linalg.cholesky(torch.diag(x)),
        lambda x: torch.linalg.solve(torch.diag(x), x),
        lambda x: torch.linalg.inv(torch.diag(x)),
        lambda x: x.clone().__setitem__(torch.tensor([0, 2]).clone(), 1.0),
    ],
)
def test_what_waits_is_found(wait, mode):
    with mode(), host_reads() as reads:
        wait(torch.ones(3))
    assert len(reads) >= 1


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_what_does_not_wait_is_not_found(mode):
    x, places = torch.ones(3), torch.tensor([0, 2])
    with mode(), host_reads() as reads:
        y = torch.where(x > 0, x, 0.5).clamp(min=0)[places]
        y[0] = 2.0
        y = y.new_zeros(3).scatter_reduce(0, torch.zeros(2, dtype=torch.int64, device=y.device), y, "amax") + torch.arange(3)
        torch.linalg.cholesky_ex(torch.eye(3).repeat_interleave(1, 0))
    assert reads == []


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("config", [None, SEARCHED], ids=["steady", "searched"])
def test_a_step_reads_nothing_back(monkeypatch, scene, config):
    """On the CPU, where it can be watched, as it is done on a GPU; but for what is asked for early and looked at late."""
    monkeypatch.setattr(host_sync, "read_at_once", lambda values: False)
    tracker, state, ready = set_up(scene, torch.device("cpu"), config)
    with torch.inference_mode():
        state, _ = follow(tracker, state, ready[:-1])
        with host_reads() as reads:
            _, result = tracker.step(state, *ready[-1])
    assert reads == []
    assert (result.status == int(Status.TRACKING)).all()


@pytest.mark.parametrize("scene", SCENES)
def test_the_ways_of_a_gpu_lead_to_the_poses_of_the_cpu(monkeypatch, scene):
    """On the CPU: sums in the place of thin products, triangular systems, sizes that hang on no value."""
    poses = []
    for as_on_gpu in (False, True):
        tracker, state, ready = set_up(scene, torch.device("cpu"))
        monkeypatch.setattr(host_sync, "on_gpu", lambda values, answer=as_on_gpu: answer)
        monkeypatch.setattr(host_sync, "read_at_once", lambda values, answer=as_on_gpu: not answer)
        _, results = follow(tracker, state, ready)
        poses.append(torch.stack([result.T_cam_obj for result in results]))
    degrees, millimetres = pose_errors(poses[1], poses[0])
    assert float(degrees.max()) < 0.02
    assert float(millimetres.max()) < 0.1


@pytest.mark.parametrize("model", [box_model, bevelled_model])
@pytest.mark.parametrize("scene", SCENES)
def test_the_window_of_a_graph_asks_for_nothing_however_uncertain_objects_are(monkeypatch, scene, model):
    monkeypatch.setattr(host_sync, "read_at_once", lambda values: False)
    tracker, state, ready = set_up(scene, torch.device("cpu"), model=model)
    events, end_us = ready[-1]
    with torch.inference_mode():
        state, _ = follow(tracker, state, ready[:-1])
        unseen_s = torch.ones_like(state.health.time_since_validated_s)
        state = replace(state, health=replace(state.health, time_since_validated_s=unseen_s))
        monkeypatch.setattr(host_sync.AsyncValue, "to", None)
        # Constants are made before a graph is recorded.
        steady_lane(tracker, state, NearbyEvents(events), end_us.expand(tracker.streams))
        with host_reads() as reads:
            steady_lane(tracker, state, NearbyEvents(events), end_us.expand(tracker.streams))
    assert reads == []
