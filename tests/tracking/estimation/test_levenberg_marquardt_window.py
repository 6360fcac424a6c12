"""What the solver finds beside the pose: a velocity, from the ages of observations."""

from dataclasses import replace

import pytest
import torch
from helpers import pose_errors, random_pose
from pose_problems import tensors_of
from window_problems import FASTER, WINDOW_S, windowed

from torchtrack.config.tracker import SolverConfig
from torchtrack.core.lie import retract_about
from torchtrack.tracking.estimation.levenberg_marquardt import robust_cost, solve_pose
from torchtrack.tracking.estimation.terms import PoseProblem, WindowTerms

pytestmark = pytest.mark.usefixtures("way")
THOROUGH = SolverConfig(iterations=20)


def without_window(problem):
    return replace(problem, window=None, prior_information=problem.prior_information[:, :6, :6])


# ---- what is found


def test_a_velocity_that_was_predicted_wrong_is_found_with_the_pose(dtype):
    T_true = random_pose(4, seed=1)
    problem = windowed(T_true, dtype=dtype)
    actual = solve_pose(problem, T_true.to(dtype), THOROUGH)
    degrees, millimetres = pose_errors(actual.T_cam_obj.double(), T_true)
    error = (actual.from_prior[:, 6:].double() - FASTER).abs()
    # What is left is the motion's curvature within the window.
    assert float(degrees.max()) < 0.005
    assert float(millimetres.max()) < 0.01
    assert float(error[:, :3].max()) < 0.05
    assert float(error[:, 3:].max()) < 0.01


def test_without_the_ages_the_same_motion_biases_the_pose():
    T_true = random_pose(4, seed=1)
    problem = windowed(T_true)
    biased = pose_errors(solve_pose(without_window(problem), T_true, THOROUGH).T_cam_obj, T_true)
    # Half the window's excess of motion.
    half_mm, half_deg = 1e3 * 0.5 * WINDOW_S * float(FASTER[3:].norm()), 0.5 * WINDOW_S * float(torch.rad2deg(FASTER[:3].norm()))
    assert float(biased[0].mean()) == pytest.approx(half_deg, rel=0.2)
    assert float(biased[1].mean()) > 0.5 * half_mm
    actual = pose_errors(solve_pose(problem, T_true, THOROUGH).T_cam_obj, T_true)
    assert float(actual[0].max()) < 0.05 * float(biased[0].min())


def test_noise_leaves_pose_and_velocity_unbiased():
    """The mean over many windows is far nearer to the truth than one is."""
    T_true = random_pose(1, seed=2).expand(200, 4, 4)
    actual = solve_pose(windowed(T_true, noise_px=0.5), T_true, SolverConfig(iterations=4))
    velocity = actual.from_prior[:, 6:] - FASTER
    centre = actual.from_prior[:, :6]
    for error in (velocity, centre):
        assert (error.mean(0).abs() < 4 * error.std(0) / 200**0.5 + 2e-3 * error.std(0)).all()


def test_observations_of_one_time_say_nothing_of_the_velocity():
    """With age zero the predicted velocity stays, and its prior is all that is known of it."""
    T_true = random_pose(2, seed=4)
    actual = solve_pose(windowed(T_true, age_s=0.0, noise_px=0.3, prior=1.0), T_true, THOROUGH)
    assert float(actual.from_prior[:, 6:].abs().max()) < 1e-9
    torch.testing.assert_close(actual.hessian[:, 6:, 6:], torch.eye(6, dtype=torch.float64).expand(2, 6, 6), rtol=0, atol=1e-9)


def test_a_prior_weighs_velocities_against_the_ages():
    """The stronger the prior, the less of the velocity is taken; a prior that couples pose and velocity is kept to."""
    T_true = random_pose(3, seed=5)
    taken = []
    for prior in (1e-3, 1e2, 1e7):
        problem = windowed(T_true, noise_px=0.2)
        information = problem.prior_information.clone()
        information[:, 6:, 6:] = prior * torch.eye(6, dtype=torch.float64)
        actual = solve_pose(replace(problem, prior_information=information), T_true, THOROUGH)
        taken.append(float(actual.from_prior[:, 6:9].norm(dim=-1).mean() / FASTER[:3].norm()))
    assert taken[0] == pytest.approx(1, abs=0.2)
    assert taken[0] > taken[1] > taken[2]
    assert taken[2] < 0.01


# ---- against the problem of the pose alone, and against finite differences


@pytest.mark.parametrize("loss", ["tukey", "huber", "none"])
def test_six_and_twelve_unknowns_agree_where_the_further_ones_are_held(loss, dtype):
    T_true = random_pose(4, seed=6)
    problem = windowed(T_true, noise_px=0.8, age_s=0.0, prior=10.0, dtype=dtype)
    config = SolverConfig(iterations=5, loss=loss)
    start = retract_about(T_true, torch.full((4, 6), 2e-3, dtype=torch.float64), problem.centre_obj.double()).to(dtype)
    six, twelve = solve_pose(without_window(problem), start, config), solve_pose(problem, start, config)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(twelve.T_cam_obj, six.T_cam_obj, rtol=0, atol=tolerance)
    torch.testing.assert_close(twelve.from_prior[:, :6], six.from_prior, rtol=0, atol=tolerance)
    costs = [robust_cost(part, actual.T_cam_obj, actual.from_prior, loss) for part, actual in ((problem, twelve), (without_window(problem), six))]
    torch.testing.assert_close(*costs, rtol=1e-4 if dtype == torch.float32 else 1e-10, atol=tolerance)
    assert (twelve.from_prior[:, 6:] == 0).all()


def cost_with(problem, T_cam_obj, further):
    """Cost at a pose, with an offset of the velocity ``[b, 6]``, by the solver itself."""
    shift = replace(problem.window, velocity=problem.window.velocity - further)
    moved = replace(problem, window=shift, prior_information=torch.zeros_like(problem.prior_information))
    return robust_cost(moved, T_cam_obj, torch.zeros_like(moved.prior_information[:, 0]), "tukey")


def test_the_gradient_by_all_unknowns_is_that_of_the_cost():
    T = random_pose(2, seed=7)
    problem = windowed(T, noise_px=0.8, prior=0.0)
    at = solve_pose(problem, T, SolverConfig(iterations=1, loss="tukey"))
    for axis in range(12):
        step = 1e-6 if axis < 6 else 1e-4
        costs = []
        for sign in (1, -1):
            offset = torch.zeros(2, 12, dtype=torch.float64)
            offset[:, axis] = sign * step
            costs.append(cost_with(problem, retract_about(T, offset[:, :6], problem.centre_obj), offset[:, 6:]))
        numeric = (costs[0] - costs[1]) / (2 * step)
        torch.testing.assert_close(at.gradient[:, axis], numeric, rtol=1e-4, atol=1e-4 * float(at.gradient.abs().max()))
    assert (at.gradient.abs().amax(0) > 1e-3).all()


def test_the_hessian_by_all_unknowns_is_that_of_residuals_near_zero():
    """Without residuals the Gauss-Newton Hessian is exact: gradients of neighbouring points differ by it."""
    T = random_pose(1, seed=8)
    problem = windowed(T, faster=torch.zeros(6, dtype=torch.float64), count=40, prior=3.0)
    hessian = solve_pose(problem, T, SolverConfig(iterations=1, loss="none")).hessian[0]
    torch.testing.assert_close(hessian, hessian.T)
    for axis in range(12):
        offset = torch.zeros(1, 12, dtype=torch.float64)
        offset[0, axis] = 1e-7 if axis < 6 else 1e-4
        start = retract_about(T, offset[:, :6], problem.centre_obj)
        at = solve_pose(problem, start, SolverConfig(iterations=1, loss="none", damping=0), offset)
        torch.testing.assert_close(at.gradient[0] / offset[0, axis], hessian[axis], rtol=1e-3, atol=1e-3 * float(hessian[axis].abs().max()))


# ---- what must not happen


def test_a_batch_is_its_elements(dtype):
    T_true = random_pose(3, seed=9)
    problem = windowed(T_true, noise_px=0.5, prior=0.1, dtype=dtype)
    together = solve_pose(problem, T_true.to(dtype), THOROUGH)
    for row in range(3):
        part = slice(row, row + 1)
        window = WindowTerms(*(value[part] for value in vars(problem.window).values()))
        own = PoseProblem(**{name: value[part] for name, value in tensors_of(problem).items()}, window=window)
        alone = solve_pose(own, T_true[part].to(dtype), THOROUGH)
        torch.testing.assert_close(together.T_cam_obj[part], alone.T_cam_obj, rtol=0, atol=5e-5 if dtype == torch.float32 else 1e-10)


@pytest.mark.parametrize("where", ["age_s", "velocity"])
def test_a_bad_element_harms_no_neighbour(where, dtype):
    T_true = random_pose(3, seed=10)
    problem = windowed(T_true, noise_px=0.3, prior=1.0, dtype=dtype)
    expected = solve_pose(problem, T_true.to(dtype), THOROUGH)
    broken = getattr(problem.window, where).clone()
    broken[1, 0] = torch.nan
    at = solve_pose(replace(problem, window=replace(problem.window, **{where: broken})), T_true.to(dtype), THOROUGH)
    torch.testing.assert_close(at.T_cam_obj[[0, 2]], expected.T_cam_obj[[0, 2]], rtol=1e-5, atol=1e-5)
    assert torch.equal(at.T_cam_obj[1], T_true[1].to(dtype))
    assert (at.from_prior[1] == 0).all()
