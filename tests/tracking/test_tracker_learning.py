"""The tracker as a module of a network: gradients through it, and what PyTorch does with modules."""

import multiprocessing
import pickle
from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, random_twist
from states import changed
from torch import nn
from torch.utils.data import DataLoader, Dataset
from tracked_boxes import assert_same, moving_box, started, windows

from torchtrack import Status, Tracker, TrackerConfig
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import AssociationConfig, SolverConfig
from torchtrack.core.camera import project
from torchtrack.core.lie import cayley, se3_exp, se3_log, transform_points
from torchtrack.tracking.estimation.robust_loss import robust_loss

# One round that converges: its problem is that of the whole window.
ONE_ROUND = TrackerConfig(
    association=AssociationConfig(gates_px=(3.0,), concentration=False, polarity=False),
    solver=SolverConfig(iterations=20),
    relocalization=RelocalizationConfig(hypotheses=0),
)


class ByAge(nn.Module):
    """Believes observations by their age: a network of two numbers."""

    def __init__(self, slope=0.0, offset=20.0):
        super().__init__()
        self.slope, self.offset = nn.Parameter(torch.tensor(slope)), nn.Parameter(torch.tensor(offset))

    def forward(self, inputs):
        return torch.sigmoid(self.offset + self.slope * 1e3 * inputs.observations.age_s)


def weighing(weighting_network, config=None, dtype=torch.float64, count=5):
    """A tracker with a weighting network in the middle of a motion, and its next window."""
    plain, state, _, window, _ = started(dtype, config, count)
    tracker = Tracker([box_model()], SMALL_CAMERA, config, dtype=dtype, weighting_network=weighting_network)
    tracker.load_state_dict(plain.state_dict(), strict=False)
    return tracker, state, window


def with_pose(state, T_cam_obj):
    return changed(state, T_cam_obj=T_cam_obj)


def seen_from(T_cam_obj):
    """A number that hangs on the whole pose."""
    return (T_cam_obj[:, :3] * torch.arange(12.0, dtype=T_cam_obj.dtype).view(3, 4)).sum()


# ---- weights


def test_full_trust_changes_nothing(dtype):
    plain, state, _, window, _ = started(dtype)
    tracker, _, _ = weighing(ByAge(offset=100.0), dtype=dtype)
    with torch.no_grad():
        assert_same(tracker.step(state, *window), plain.step(state, *window))


def test_without_trust_there_is_nothing_to_go_by_and_no_gradient():
    tracker, state, window = weighing(ByAge(offset=-100.0))
    state = changed(state, T_cam_obj=state.T_cam_obj.clone().requires_grad_())
    next_state, result = tracker.step(state, *window)
    assert result.status.tolist() == [int(Status.TOO_FEW_EVENTS)]
    by_offset, by_pose = torch.autograd.grad(seen_from(next_state.T_cam_obj), [tracker.weighting_network.offset, state.T_cam_obj], allow_unused=True)
    assert (by_offset is None or by_offset == 0) and torch.isfinite(by_pose).all()


def test_trust_decides_what_is_followed():
    tracker, state, window = weighing(ByAge())
    tracker.weighting_network.offset.data, tracker.weighting_network.slope.data = torch.tensor(6.0).double(), torch.tensor(-4.0).double()
    plain = started(torch.float64)[0]
    with torch.no_grad():
        assert not torch.equal(tracker.step(state, *window)[0].T_cam_obj, plain.step(state, *window)[0].T_cam_obj)


@pytest.mark.parametrize("shape", [(), (1, 3), (2, 1)])
def test_a_weigher_must_judge_every_observation(shape):
    class Wrong(nn.Module):
        def forward(self, inputs):
            return torch.ones(shape)

    tracker, state, window = weighing(Wrong())
    with pytest.raises(ValueError, match=r"one number for each observation, shape \[1, \d+\]; got"):
        tracker.step(state, *window)


def test_a_weigher_sees_the_time_surface():
    actual = []

    class Looking(nn.Module):
        def forward(self, inputs):
            actual.append((inputs.age_s(inputs.observations.pixels), inputs.observations))
            return torch.ones_like(inputs.observations.age_s)

    tracker, state, (events, end_us) = weighing(Looking())
    tracker.step(state, events, end_us)
    age_s, observations = actual[-1]
    # The newest event of a pixel is not older than any that was observed there.
    assert (age_s <= observations.age_s + 1e-9)[observations.mask].all() and (age_s >= 0).all()
    assert (age_s == observations.age_s)[observations.mask].float().mean() > 0.5


# ---- gradients


@pytest.mark.parametrize("name", ["slope", "offset"])
def test_gradients_by_a_weigher_are_those_of_finite_differences(name):
    tracker, state, window = weighing(ByAge(slope=-0.5, offset=1.0), ONE_ROUND)
    parameter = getattr(tracker.weighting_network, name)
    (ours,) = torch.autograd.grad(seen_from(tracker.step(state, *window)[0].T_cam_obj), parameter)
    values, small = [], 1e-3
    for sign in (1, -1):
        with torch.no_grad():
            parameter += sign * small
            values.append(seen_from(tracker.step(state, *window)[0].T_cam_obj))
            parameter -= sign * small
    theirs = (values[0] - values[1]) / (2 * small)
    assert abs(theirs) > 1e-9 and abs(ours - theirs) < 1e-2 * abs(theirs)


def test_gradients_by_the_initial_pose_are_those_of_finite_differences():
    tracker, state, _, window, _ = started(torch.float64, ONE_ROUND)
    twist = random_twist(1, seed=5, rotation_rad=1.0, translation_m=0.3)
    amount = torch.zeros((), dtype=torch.float64, requires_grad=True)
    # A prior that counts, so that the pose it comes from does.
    state = changed(state, covariance=1e-3 * state.motion.covariance)

    def after(amount):
        return seen_from(tracker.step(with_pose(state, se3_exp(amount * twist) @ state.T_cam_obj), *window)[0].T_cam_obj)

    (ours,) = torch.autograd.grad(after(amount), amount)
    with torch.no_grad():
        theirs = (after(amount + 1e-7) - after(amount - 1e-7)) / 2e-7
    assert abs(theirs) > 1e-3 and abs(ours - theirs) < 2e-2 * abs(theirs)


def test_gradients_flow_through_windows_to_everything():
    trajectory, events = moving_box(pose(), 3)
    tracker = Tracker([box_model()], SMALL_CAMERA, dtype=torch.float64, weighting_network=ByAge(slope=-0.5, offset=1.0))
    wanted = {"intrinsics": tracker.intrinsics, "ideal pixels": tracker.ideal_pixels, "contour points": tracker.models[0].edges}
    for value in wanted.values():
        value.requires_grad_()
    wanted |= {"slope": tracker.weighting_network.slope, "initial pose": trajectory.T_cam_obj[:1].clone().requires_grad_()}
    state = tracker.init(wanted["initial pose"], 0)
    for batch, end_us in windows(events, 3):
        state, result = tracker(batch, state, end_us)
    gradients = torch.autograd.grad(seen_from(result.T_cam_obj) + state.velocity.sum(), list(wanted.values()))
    for name, gradient in zip(wanted, gradients, strict=True):
        assert torch.isfinite(gradient).all() and (gradient != 0).any(), name
    assert not state.motion.covariance.requires_grad


def test_recording_changes_no_value():
    plain, state, _, window, _ = started()
    recorded = plain.step(with_pose(state, state.T_cam_obj.clone().requires_grad_()), *window)
    assert recorded[0].T_cam_obj.requires_grad
    with torch.no_grad():
        assert_same(recorded, plain.step(state, *window))


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_nothing_is_recorded_where_gradients_are_off(mode):
    tracker, state, window = weighing(ByAge(slope=-0.5, offset=1.0))
    with mode():
        off = tracker.step(state, *window)
    assert not off[0].T_cam_obj.requires_grad
    recorded = tracker.step(state, *window)
    assert recorded[0].T_cam_obj.requires_grad
    assert_same(off, recorded)


# ---- what PyTorch does with functions and modules


def _pixels(twist):
    """Two points of a body 2 m away, in the image."""
    away = torch.tensor([[0.1, 0.0, 2.0], [0.0, 0.2, 3.0]], dtype=twist.dtype)
    return project(transform_points(se3_exp(0.1 * twist), away), SMALL_CAMERA.intrinsics(twist.dtype))


MAPPED = {
    "exponential": se3_exp,
    "logarithm": lambda twist: se3_log(se3_exp(twist)),
    "cayley": lambda twist: cayley(twist[..., :3]),
    "projection": _pixels,
    "tukey": lambda twist: robust_loss(twist[None], torch.ones(1, dtype=twist.dtype), "tukey")[0][0],
    "huber": lambda twist: robust_loss(twist[None], torch.ones(1, dtype=twist.dtype), "huber")[0][0],
}


@pytest.mark.parametrize("name", MAPPED)
def test_pure_functions_can_be_mapped_and_differentiated(name):
    twists = random_twist(5, seed=2)
    twists[0] = 0
    one_by_one = torch.stack([MAPPED[name](twist) for twist in twists])
    torch.testing.assert_close(torch.func.vmap(MAPPED[name])(twists), one_by_one)
    jacobians = torch.func.vmap(torch.func.jacrev(MAPPED[name]))(twists)
    assert jacobians.shape == (*one_by_one.shape, 6) and torch.isfinite(jacobians).all()


def test_the_weigher_moves_with_the_tracker():
    tracker = Tracker([box_model()], SMALL_CAMERA, weighting_network=ByAge()).to(torch.float64)
    assert {value.dtype for value in tracker.parameters()} == {torch.float64} and len(list(tracker.parameters())) == 2
    assert all(value.dtype != torch.float32 for value in tracker.state_dict().values())


def test_its_state_can_be_kept_and_restored():
    tracker, state, window = weighing(ByAge(slope=-0.5, offset=1.0))
    other = Tracker([box_model()], replace(SMALL_CAMERA, fx=230.0), dtype=torch.float64, weighting_network=ByAge())
    other.load_state_dict(tracker.state_dict())
    with torch.no_grad():
        assert_same(other(window[0], state, window[1]), tracker.step(state, *window))


def test_autocast_leaves_the_solver_alone():
    tracker, state, window = weighing(ByAge(slope=-0.5, offset=1.0), dtype=torch.float32)
    plain = tracker.step(state, *window)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_same(tracker.step(state, *window), plain)


def send_gradient_in_parallel(store, sender):
    """The gradient of a weighting network in distributed data parallel, from a process of its own."""
    tracker, state, window = weighing(ByAge(slope=-0.5, offset=1.0))
    torch.distributed.init_process_group("gloo", init_method=f"file://{store}", rank=0, world_size=1)
    parallel = nn.parallel.DistributedDataParallel(tracker)
    seen_from(parallel(window[0], state, window[1])[0].T_cam_obj).backward()
    sender.send(float(tracker.weighting_network.slope.grad))


def test_it_learns_in_distributed_data_parallel(tmp_path):
    tracker, state, window = weighing(ByAge(slope=-0.5, offset=1.0))
    (theirs,) = torch.autograd.grad(seen_from(tracker.step(state, *window)[0].T_cam_obj), tracker.weighting_network.slope)
    # The end of a process group may wait for ever for a thread of its own that waits for Python's lock: that of the process is not waited for.
    spawn = multiprocessing.get_context("spawn")
    receiver, sender = spawn.Pipe(duplex=False)
    process = spawn.Process(target=send_gradient_in_parallel, args=(tmp_path / "store", sender))
    process.start()
    sender.close()
    try:
        assert receiver.poll(timeout=300), "no gradient after five minutes"
        assert receiver.recv() == float(theirs)
    finally:
        process.kill()
        process.join()


class Tracked(Dataset):
    """Poses after one window, from each of several starts."""

    def __init__(self, tracker, state, window, count=3):
        self.parts, self.count = (tracker, state, window), count

    def __len__(self):
        return self.count

    def __getitem__(self, number):
        tracker, state, window = self.parts
        T_cam_obj = se3_exp(random_twist(1, seed=number, rotation_rad=1e-3, translation_m=1e-4)) @ state.T_cam_obj
        with torch.no_grad():
            return tracker(window[0], with_pose(state, T_cam_obj), window[1])[1].T_cam_obj[0]


def test_it_tracks_in_the_workers_of_a_loader():
    data = Tracked(*weighing(ByAge(slope=-0.5, offset=1.0)))
    (actual,) = DataLoader(data, batch_size=3, num_workers=1)
    assert torch.equal(actual, torch.stack([data[number] for number in range(3)]))


def test_it_can_be_pickled():
    tracker, state, window = weighing(ByAge(slope=-0.5, offset=1.0))
    copy, same_state = pickle.loads(pickle.dumps((tracker, state)))
    assert_same(copy.step(same_state, *window), tracker.step(state, *window))
