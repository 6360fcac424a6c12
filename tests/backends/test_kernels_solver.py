"""The solver's kernel gives what PyTorch's operations give: of any loss, in one step or many, with a window's unknowns or without."""

from dataclasses import replace

import pytest
import torch
from both_ways import assert_as_close, both_ways
from helpers import perturbed, random_pose, random_twist
from pose_problems import LOSSES, cast, far_off, problem_at, tensors_of
from window_problems import windowed

from torchtrack.config.tracker import SolverConfig
from torchtrack.tracking.estimation.levenberg_marquardt import solve_pose

pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
TOLERANCE = {torch.float32: 1e-3, torch.float64: 1e-8}


def solved_both_ways(problem, start, *from_prior, **settings):
    """A problem solved by kernels, and by PyTorch's operations."""
    return both_ways(lambda: solve_pose(problem, start, SolverConfig(**settings), *from_prior))


@pytest.mark.parametrize("damping", [0.0, 1e-6])
@pytest.mark.parametrize("iterations", [1, 2, 3, 9])
@pytest.mark.parametrize("loss", LOSSES)
def test_steps_that_are_taken_back_or_not(loss, iterations, damping):
    actual, expected = solved_both_ways(*far_off(), loss=loss, iterations=iterations, damping=damping)
    # Undamped, some of these problems are nearly singular: their roundings grow.
    torch.testing.assert_close(actual.T_cam_obj, expected.T_cam_obj, rtol=1e-6, atol=1e-6)
    assert_as_close(actual, expected, tolerance=1e-3)


@pytest.mark.parametrize("loss", LOSSES)
def test_poses_with_noise_and_a_prior(loss, dtype):
    T_true = random_pose(8, seed=5)
    problem, start = problem_at(T_true, 80, outliers=8, noise_px=0.3, prior=20.0, dtype=dtype), perturbed(T_true, seed=2).to(dtype)
    actual, expected = solved_both_ways(problem, start, loss=loss, iterations=10)
    assert actual.T_cam_obj.dtype == dtype
    torch.testing.assert_close(actual.T_cam_obj, expected.T_cam_obj, rtol=0, atol=TOLERANCE[dtype])


@pytest.mark.parametrize("iterations", [1, 3])
def test_what_is_unknown_beside_the_pose(iterations):
    T_true = random_pose(4, seed=1)
    problem = windowed(T_true, noise_px=0.2)
    terms = replace(problem.window, velocity=random_twist(4, seed=3))
    from_prior = 0.01 * torch.cat([random_twist(4, seed=5), random_twist(4, seed=6)], 1)
    actual, expected = solved_both_ways(replace(problem, window=terms), T_true, from_prior, iterations=iterations)
    assert_as_close(actual, expected, tolerance=1e-7)


def test_nothing_is_learned_of_what_nothing_shows():
    T_true = random_pose(3, seed=2)
    problem = problem_at(T_true, 30)
    problem = replace(problem, weights=problem.weights * torch.tensor([[1.0], [0.0], [1.0]]))
    actual, expected = solved_both_ways(problem, perturbed(T_true), iterations=4)
    assert_as_close(actual, expected, tolerance=1e-8)
    torch.testing.assert_close(actual.T_cam_obj[1], perturbed(T_true)[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["targets", "points_obj", "directions", "scale_px", "T_prior"])
def test_what_is_not_a_number_stays_with_its_object(name):
    T_true = random_pose(3, seed=4)
    problem = problem_at(T_true, 40, prior=1.0)
    spoilt = getattr(problem, name).clone()
    spoilt[1] = torch.nan
    actual, whole = (solve_pose(each, perturbed(T_true), SolverConfig(iterations=5)) for each in (replace(problem, **{name: spoilt}), problem))
    assert torch.equal(actual.T_cam_obj[::2], whole.T_cam_obj[::2])
    assert not actual.gradient[1].isfinite().all() or name == "scale_px"
    assert actual.from_prior[::2].isfinite().all()


def test_a_solution_shares_no_memory_with_what_was_given():
    T_true = random_pose(2)
    problem, start = cast(problem_at(T_true, 30), torch.float32), perturbed(T_true).float()
    before = start.clone()
    solve_pose(problem, start, SolverConfig(iterations=3))
    assert torch.equal(start, before)


def test_of_no_objects_nothing_is_found():
    problem = problem_at(random_pose(2), 30)
    empty = replace(problem, **{name: value[:0] for name, value in tensors_of(problem).items()})
    assert solve_pose(empty, random_pose(2)[:0], SolverConfig(iterations=3)).T_cam_obj.shape == (0, 4, 4)
