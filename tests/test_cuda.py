"""What a GPU needs: that a step never waits for it, and that its poses are those of the CPU."""

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from host_reads import host_reads
from tracked_boxes import follow, moving_box, windows

from torchtrack import Tracker
from torchtrack.quality import Status

COUNT = 8


@pytest.fixture
def cuda():
    if not torch.cuda.is_available():
        pytest.skip("PyTorch sees no GPU here")
    return torch.device("cuda")


@pytest.fixture
def sync_is_an_error(cuda):
    """Whatever makes the CPU wait for the GPU raises, within ``torch.cuda.set_sync_debug_mode('error')``."""
    before = torch.cuda.get_sync_debug_mode()
    yield lambda: torch.cuda.set_sync_debug_mode("error")
    torch.cuda.set_sync_debug_mode(before)


def on_device(stream_windows, device):
    return [(events.to(device), torch.tensor([end_us], device=device)) for events, end_us in stream_windows]


def test_a_step_never_waits_for_the_gpu(cuda, sync_is_an_error):
    _, events = moving_box(pose(), COUNT)
    tracker = Tracker([box_model()], SMALL_CAMERA).to(cuda)
    ready = on_device(windows(events, COUNT), cuda)
    with torch.inference_mode():
        # The first steps load kernels, and may wait.
        state, _ = follow(tracker, tracker.init(pose()[None], 0), ready[:-1])
        torch.cuda.synchronize(cuda)
        sync_is_an_error()
        _, result = tracker.step(state, *ready[-1])
        torch.cuda.set_sync_debug_mode("default")
    assert Status(int(result.status[0])) == Status.TRACKING


def test_the_gpu_finds_the_poses_of_the_cpu(cuda):
    _, events = moving_box(pose(), COUNT)
    found = []
    for device in (torch.device("cpu"), cuda):
        tracker = Tracker([box_model()], SMALL_CAMERA).to(device)
        _, results = follow(tracker, tracker.init(pose()[None], 0), on_device(windows(events, COUNT), device))
        found.append(torch.stack([result.T_cam_obj[0].cpu() for result in results]))
    degrees, millimetres = pose_errors(found[1], found[0])
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
    ],
)
def test_what_waits_is_found(wait, mode):
    with mode(), host_reads() as found:
        wait(torch.ones(3))
    assert len(found) >= 1


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_what_does_not_wait_is_not_found(mode):
    x, places = torch.ones(3), torch.tensor([0, 2])
    with mode(), host_reads() as found:
        y = torch.where(x > 0, x, 0.5).clamp(min=0)[places]
        y[0] = 2.0
        y = y.new_zeros(3).scatter_reduce(0, torch.zeros(2, dtype=torch.int64, device=y.device), y, "amax") + torch.arange(3)
        torch.linalg.cholesky_ex(torch.eye(3).repeat_interleave(1, 0))
    assert found == []


@pytest.mark.xfail(reason="sizes of regions and of the index, and which objects are searched for, are read back", strict=False)
def test_a_step_reads_nothing_back():
    """On the CPU, where it can be watched."""
    _, events = moving_box(pose(), COUNT)
    tracker = Tracker([box_model()], SMALL_CAMERA)
    ready = on_device(windows(events, COUNT), torch.device("cpu"))
    with torch.inference_mode():
        state, _ = follow(tracker, tracker.init(pose()[None], 0), ready[:-1])
        with host_reads() as found:
            tracker.step(state, *ready[-1])
    assert found == []
