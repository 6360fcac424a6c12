"""The solver: convergence to the truth, derivatives against autograd, rejected steps, priors, isolation of bad elements."""

from dataclasses import replace

import pytest
import torch
from helpers import generator, perturbed, pose_errors, random_pose, random_twist
from pose_problems import LOSSES, cost_of, far_off, problem_at, tensors_of
from torch.autograd import gradcheck

from torchtrack.config.tracker import SolverConfig
from torchtrack.core import dispatch
from torchtrack.core.camera import project
from torchtrack.core.image_velocity import pose_jacobian
from torchtrack.core.lie import retract_about, se3_exp, small_difference_about, transform_points
from torchtrack.core.linalg import solve_positive
from torchtrack.tracking.estimation import levenberg_marquardt
from torchtrack.tracking.estimation.levenberg_marquardt import robust_cost, solve_pose
from torchtrack.tracking.estimation.robust_loss import robust_loss, robust_weight
from torchtrack.tracking.estimation.terms import Place, PoseProblem

pytestmark = pytest.mark.usefixtures("way")
THOROUGH = SolverConfig(iterations=20)
# How far from the truth a solution may be: degrees, and millimetres.
EXACT = {torch.float32: (2e-3, 2e-2), torch.float64: (1e-9, 1e-8)}


def rows_of(problem, rows):
    return PoseProblem(**{name: value[rows] for name, value in tensors_of(problem).items()})


# ---- robust losses


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_have_their_values(loss):
    residuals = torch.tensor([[0.0, 1.0, -1.0, 2.0, 3.0, -30.0]], dtype=torch.float64)
    scale = torch.tensor([2.0], dtype=torch.float64)
    value, weight = robust_loss(residuals, scale, loss), robust_weight(residuals, scale, loss)
    expected = {
        "none": ([0, 0.5, 0.5, 2, 4.5, 450], [1, 1, 1, 1, 1, 1]),
        "huber": ([0, 0.5, 0.5, 2, 4, 58], [1, 1, 1, 1, 2 / 3, 1 / 15]),
        "tukey": ([0, 4 / 6 * (1 - 0.75**3), 4 / 6 * (1 - 0.75**3), 4 / 6, 4 / 6, 4 / 6], [1, 0.5625, 0.5625, 0, 0, 0]),
    }[loss]
    assert value[0].tolist() == pytest.approx(expected[0])
    assert weight[0].tolist() == pytest.approx(expected[1])


@pytest.mark.parametrize("loss", LOSSES)
def test_the_weight_is_the_slope_of_the_loss(loss):
    residuals = (10 * torch.randn((3, 40), generator=generator(), dtype=torch.float64)).requires_grad_()
    scale = torch.tensor([1.0, 4.0, 20.0], dtype=torch.float64)
    value, weight = robust_loss(residuals, scale, loss), robust_weight(residuals, scale, loss)
    (slope,) = torch.autograd.grad(value.sum(), residuals)
    torch.testing.assert_close(weight.detach() * residuals.detach(), slope, rtol=1e-9, atol=1e-12)
    assert gradcheck(lambda r: robust_loss(r, scale, loss), residuals)


# ---- derivatives


def linearised(problem, T, loss):
    """The problem at a pose: what the first step is taken by."""
    return solve_pose(problem, T, SolverConfig(iterations=1, loss=loss))


def cost_at(problem, T, loss):
    """The robust cost by the solver itself."""
    return robust_cost(problem, T, small_difference_about(problem.T_prior, T, problem.centre_obj), loss)


def test_the_jacobian_is_the_derivative_of_the_residuals():
    problem = problem_at(random_pose(3))
    T = perturbed(random_pose(3))
    points_cam = transform_points(T, problem.points_obj)
    x, y, z = points_cam.unbind(-1)
    fx, fy = problem.intrinsics[:, 0, None], problem.intrinsics[:, 1, None]
    gx, gy = problem.directions[..., 0] * fx / z, problem.directions[..., 1] * fy / z
    centre_cam = transform_points(T, problem.centre_obj[:, None])[:, 0]
    jacobian = pose_jacobian((points_cam - centre_cam[:, None]).transpose(1, 2), (gx, gy, -(gx * x + gy * y) / z))

    def residuals(delta):
        pixels = project(transform_points(retract_about(T, delta, problem.centre_obj), problem.points_obj), problem.intrinsics)
        return ((pixels - problem.targets) * problem.directions).sum(-1)

    for axis in range(6):
        step = torch.zeros(3, 6, dtype=torch.float64)
        step[:, axis] = 1e-6
        numeric = (residuals(step) - residuals(-step)) / 2e-6
        torch.testing.assert_close(jacobian[:, axis], numeric, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_gradient_is_that_of_the_cost(loss):
    problem = problem_at(random_pose(3), outliers=10, noise_px=1.0)
    problem = replace(problem, weights=torch.rand(problem.weights.shape, generator=generator(5), dtype=torch.float64))
    T = perturbed(random_pose(3), seed=3)
    delta = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    cost = cost_of(problem, retract_about(T, delta, problem.centre_obj), loss)
    (expected,) = torch.autograd.grad(cost.sum(), delta)
    at = linearised(problem, T, loss)
    torch.testing.assert_close(cost_at(problem, T, loss), cost.detach(), rtol=1e-10, atol=0)
    torch.testing.assert_close(at.gradient, expected, rtol=1e-8, atol=1e-6)
    assert float(expected.abs().max()) > 1


def test_the_gradient_of_the_prior_is_that_of_the_cost_near_it():
    problem = problem_at(random_pose(3), prior=1e4)
    T = retract_about(problem.T_prior, random_twist(3, rotation_rad=1e-3, translation_m=1e-3), problem.centre_obj)
    delta = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    cost = cost_of(problem, retract_about(T, delta, problem.centre_obj), "tukey")
    (expected,) = torch.autograd.grad(cost.sum(), delta)
    at = linearised(problem, T, "tukey")
    torch.testing.assert_close(cost_at(problem, T, "tukey"), cost.detach(), rtol=1e-10, atol=0)
    assert float((at.gradient - expected).abs().max()) < 1e-2 * float(expected.abs().max())


def test_the_hessian_is_that_of_a_cost_without_residuals():
    T_true = random_pose(1)
    problem = problem_at(T_true, 12, prior=500.0)
    expected = torch.autograd.functional.hessian(
        lambda delta: cost_of(problem, retract_about(T_true, delta, problem.centre_obj), "none").sum(), torch.zeros(1, 6, dtype=torch.float64)
    )
    hessian = linearised(problem, T_true, "none").hessian
    torch.testing.assert_close(hessian[0], expected[0, :, 0], rtol=1e-7, atol=1e-5)


# ---- convergence


@pytest.mark.parametrize("batch", [1, 6])
@pytest.mark.parametrize("count", [12, 60, 400])
def test_the_truth_is_found_from_nearby(batch, count, dtype):
    T_true = random_pose(batch, seed=count)
    problem = problem_at(T_true, count, dtype=dtype)
    start = perturbed(T_true, seed=1, rotation_rad=0.02, translation_m=0.002)
    actual = solve_pose(problem, start.to(dtype), THOROUGH).T_cam_obj
    degrees, millimetres = pose_errors(actual.double(), T_true)
    assert actual.dtype == dtype
    assert float(degrees.max()) < EXACT[dtype][0]
    assert float(millimetres.max()) < EXACT[dtype][1]


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_outliers_do_not_move_the_solution(share, dtype):
    T_true = random_pose(5, seed=2)
    problem = problem_at(T_true, 200, outliers=int(200 * share), noise_px=0.1, dtype=dtype)
    start = perturbed(T_true, seed=1, rotation_rad=0.01, translation_m=0.001).to(dtype)
    errors = {}
    for loss in LOSSES:
        actual = solve_pose(problem, start, replace_config(loss=loss)).T_cam_obj
        errors[loss] = max(float(error.max()) for error in pose_errors(actual.double(), T_true))
    assert errors["tukey"] < 0.7
    assert errors["tukey"] < errors["huber"] < errors["none"]


def replace_config(**settings):
    return THOROUGH.model_copy(update=settings)


def test_noise_is_averaged_out():
    T_true = random_pose(20, seed=3)
    few = solve_pose(problem_at(T_true, 20, noise_px=0.5), T_true, THOROUGH).T_cam_obj
    many = solve_pose(problem_at(T_true, 2000, noise_px=0.5), T_true, THOROUGH).T_cam_obj
    for worse, better in zip(pose_errors(few, T_true), pose_errors(many, T_true), strict=True):
        assert float(better.mean()) < 0.2 * float(worse.mean())


def test_weights_count_as_repetitions():
    T_true = random_pose(3, seed=4)
    problem = problem_at(T_true, 40, noise_px=1.0)
    doubled = replace(problem, weights=torch.cat([torch.full((3, 20), 2.0), torch.ones(3, 20)], 1).double())
    index = torch.cat([torch.arange(20), torch.arange(40)])
    repeated = replace(problem, **{name: getattr(problem, name)[:, index] for name in ("points_obj", "targets", "directions", "weights")})
    actual = [solve_pose(each, T_true, THOROUGH).T_cam_obj for each in (doubled, repeated)]
    torch.testing.assert_close(actual[0], actual[1], rtol=0, atol=1e-8)


def test_padding_does_not_count(dtype):
    T_true = random_pose(3, seed=5)
    problem = problem_at(T_true, 40, noise_px=0.3, dtype=dtype)
    padded = replace(
        problem,
        points_obj=torch.cat([problem.points_obj, torch.zeros(3, 25, 3, dtype=dtype)], 1),
        targets=torch.cat([problem.targets, torch.full((3, 25, 2), 1e4, dtype=dtype)], 1),
        directions=torch.cat([problem.directions, torch.ones(3, 25, 2, dtype=dtype)], 1),
        weights=torch.cat([problem.weights, torch.zeros(3, 25, dtype=dtype)], 1),
    )
    start = perturbed(T_true).to(dtype)
    actual = [solve_pose(each, start, THOROUGH).T_cam_obj for each in (problem, padded)]
    torch.testing.assert_close(actual[0], actual[1], rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-8)


@pytest.mark.parametrize("loss", LOSSES)
def test_a_batch_is_its_elements(loss, dtype):
    T_true = random_pose(7, seed=6)
    problem = problem_at(T_true, 80, outliers=10, noise_px=0.5, prior=100.0, dtype=dtype)
    start = perturbed(T_true, seed=2).to(dtype)
    config = SolverConfig(iterations=5, loss=loss)
    together = solve_pose(problem, start, config)
    for row in range(7):
        alone = solve_pose(rows_of(problem, slice(row, row + 1)), start[row : row + 1], config)
        torch.testing.assert_close(together.T_cam_obj[row], alone.T_cam_obj[0], rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-10)
        torch.testing.assert_close(together.hessian[row], alone.hessian[0], rtol=1e-4, atol=1.0)


def test_no_input_is_changed(dtype):
    T_true = random_pose(2)
    problem = problem_at(T_true, outliers=5, dtype=dtype)
    start = perturbed(T_true).to(dtype)
    copies, start_copy = [value.clone() for value in tensors_of(problem).values()], start.clone()
    solve_pose(problem, start, THOROUGH)
    assert all(torch.equal(value, copy) for value, copy in zip(tensors_of(problem).values(), copies, strict=True))
    assert torch.equal(start, start_copy)


# ---- rejected steps


def before_the_last_step(problem, start, config):
    """The pose that the solver's last step, which nothing judges, is taken from."""
    places = []

    class Watched(Place):
        def moved(self, step):
            places.append(self)
            return Watched(**vars(super().moved(step)))

    # Kernels cannot be watched; tests/test_kernels_solver.py has that they go the same way.
    with pytest.MonkeyPatch.context() as patch, dispatch.backend(wanted=False):
        patch.setattr(levenberg_marquardt, "Place", Watched)
        solve_pose(problem, start, config)
    return places[-1].pose(problem)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("iterations", [2, 3, 9])
def test_no_step_but_the_last_raises_the_cost(loss, iterations):
    problem, start = far_off()
    actual = before_the_last_step(problem, start, SolverConfig(iterations=iterations, loss=loss, damping=0))
    before, after = cost_of(problem, start, loss), cost_of(problem, actual, loss)
    assert (after <= before * (1 + 1e-9)).all()
    assert (after < before).any()


@pytest.mark.parametrize("loss", ["huber", "none"])
def test_a_rejected_step_is_undone_and_damping_finds_a_better_one(loss):
    problem, start = far_off()
    once, often = (before_the_last_step(problem, start, SolverConfig(iterations=n, loss=loss, damping=0)) for n in (2, 9))
    rejected = ((once - start).abs() < 1e-12).flatten(1).all(1)
    assert 5 < int(rejected.sum()) < 50
    assert (cost_of(problem, often, loss) < cost_of(problem, start, loss))[rejected].all()


# ---- priors, and directions that nothing observes


def blind(T_true, prior, dtype):
    """Observations of the horizontal place alone: the vertical move is not seen."""
    problem = problem_at(T_true, 80, prior=prior, dtype=dtype)
    return replace(problem, directions=torch.tensor([1.0, 0.0], dtype=dtype).expand_as(problem.directions))


def test_the_prior_holds_what_nothing_observes(dtype):
    T_true = random_pose(4, seed=8)
    problem = blind(T_true, 1e-2, dtype)
    T_prior = T_true.clone()
    T_prior[:, 1, 3] += 0.01
    T_prior[:, 0, 3] += 0.002
    problem = replace(problem, T_prior=T_prior.to(dtype))
    actual = solve_pose(problem, T_prior.to(dtype), THOROUGH).T_cam_obj.double()
    # What is seen goes to the truth, what is not stays with the prior: turning about the line of sight moves y too.
    centre = transform_points(actual, problem.centre_obj.double()[:, None])[:, 0]
    prior_centre = transform_points(T_prior, problem.centre_obj.double()[:, None])[:, 0]
    true_centre = transform_points(T_true, problem.centre_obj.double()[:, None])[:, 0]
    assert float((centre - true_centre)[:, 0].abs().max()) < 2e-4
    assert float((centre - prior_centre)[:, 1].abs().max()) < 2e-4


def test_without_a_prior_what_nothing_observes_stays_finite(dtype):
    T_true = random_pose(4, seed=8)
    problem = blind(T_true, 0.0, dtype)
    single = replace(problem, points_obj=torch.zeros_like(problem.points_obj))
    for each in (problem, single, replace(problem, weights=torch.zeros_like(problem.weights))):
        actual = solve_pose(each, perturbed(T_true).to(dtype), THOROUGH).T_cam_obj
        assert torch.isfinite(actual).all()
        assert float((actual.double() - T_true).abs().max()) < 0.2


def test_without_observations_the_pose_goes_to_the_prior(dtype):
    T_true = random_pose(4, seed=9)
    problem = problem_at(T_true, prior=1e4, dtype=dtype)
    problem = replace(problem, weights=torch.zeros_like(problem.weights))
    actual = solve_pose(problem, perturbed(T_true).to(dtype), THOROUGH).T_cam_obj.double()
    degrees, millimetres = pose_errors(actual, T_true)
    assert float(degrees.max()) < 1e-2
    assert float(millimetres.max()) < 1e-2


def test_without_anything_the_pose_stays(dtype):
    T_true = random_pose(4, seed=9).to(dtype)
    problem = replace(problem_at(T_true, dtype=dtype), weights=torch.zeros(4, 60, dtype=dtype))
    start = perturbed(T_true)
    at = solve_pose(problem, start, THOROUGH)
    torch.testing.assert_close(at.T_cam_obj, start, rtol=0, atol=1e-6)
    assert (at.gradient == 0).all()


def test_a_stronger_prior_holds_more():
    T_true = random_pose(4, seed=10)
    T_prior = se3_exp(torch.tensor([0.0, 0, 0, 0.002, 0, 0], dtype=torch.float64)) @ T_true
    moved = []
    for prior in (1.0, 1e7, 1e11):
        problem = replace(problem_at(T_true, prior=prior), T_prior=T_prior)
        moved.append(float(pose_errors(solve_pose(problem, T_prior, THOROUGH).T_cam_obj, T_prior)[1].max()))
    assert moved[0] > 1.9
    assert moved[0] > moved[1] > moved[2]
    assert moved[2] < 0.01


def test_rounds_that_carry_the_offset_from_the_prior_are_as_one(dtype):
    T_true = random_pose(4, seed=10)
    T_prior = perturbed(T_true, seed=4)
    problem = replace(problem_at(T_true, noise_px=0.5, prior=1e4, dtype=dtype), T_prior=T_prior.to(dtype))
    config = SolverConfig(iterations=1, loss="none", damping=0)
    at = solve_pose(problem, T_prior.to(dtype), config)
    for _ in range(2):
        carried, measured = solve_pose(problem, at.T_cam_obj, config, at.from_prior), solve_pose(problem, at.T_cam_obj, config)
        torch.testing.assert_close(carried.T_cam_obj, measured.T_cam_obj, rtol=0, atol=1e-5)
        at = carried
    together = solve_pose(problem, T_prior.to(dtype), config.model_copy(update={"iterations": 3}))
    torch.testing.assert_close(at.T_cam_obj, together.T_cam_obj, rtol=0, atol=1e-5)
    expected = small_difference_about(problem.T_prior, at.T_cam_obj, problem.centre_obj)
    torch.testing.assert_close(at.from_prior, expected, rtol=0, atol=1e-4)


# ---- bad elements


@pytest.mark.parametrize("where", ["points_obj", "targets", "intrinsics", "prior_information", "start"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_bad_element_harms_no_neighbour_and_stays_where_it_was(where, value, dtype):
    T_true = random_pose(3, seed=11)
    problem = problem_at(T_true, 50, noise_px=0.5, prior=10.0, dtype=dtype)
    start = perturbed(T_true).to(dtype)
    expected = solve_pose(problem, start, THOROUGH)
    if where == "start":
        start = start.clone()
        start[1, 0, 3] = value
    else:
        broken = getattr(problem, where).clone()
        broken[1, ..., 0] = value
        problem = replace(problem, **{where: broken})
    at = solve_pose(problem, start, THOROUGH)
    for name in ("T_cam_obj", "gradient", "hessian"):
        torch.testing.assert_close(getattr(at, name)[[0, 2]], getattr(expected, name)[[0, 2]], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(at.T_cam_obj[1], start[1], equal_nan=True)


def test_an_object_behind_the_camera_gives_finite_numbers(dtype):
    T_true = random_pose(2, seed=12)
    problem = problem_at(T_true, dtype=dtype)
    start = T_true.to(dtype).clone()
    start[1, 2, 3] = -0.4
    at = solve_pose(problem, start, THOROUGH)
    assert torch.isfinite(at.T_cam_obj).all()
    assert float(pose_errors(at.T_cam_obj[:1].double(), T_true[:1])[0]) < 2e-3


# ---- positive definite systems


def positive_matrices(batch, dtype):
    root = torch.randn((batch, 6, 8), generator=generator(), dtype=torch.float64)
    return (root @ root.transpose(1, 2)).to(dtype)


def test_positive_systems_are_solved(dtype):
    matrix, right = positive_matrices(5, dtype), torch.randn((5, 6, 2), generator=generator(1), dtype=torch.float64).to(dtype)
    solution, good = solve_positive(matrix, right)
    assert good.all()
    torch.testing.assert_close(matrix @ solution, right, rtol=1e-3, atol=1e-3 if dtype == torch.float32 else 1e-9)


def test_systems_that_cannot_be_solved_are_told_and_harm_no_neighbour(dtype):
    matrix, right = positive_matrices(6, dtype), torch.ones(6, 6, 1, dtype=dtype)
    expected, _ = solve_positive(matrix, right)
    matrix[1] = -matrix[1]
    matrix[2, 3, 3] = torch.nan
    matrix[3] = 0
    right[4, 2] = torch.inf
    solution, good = solve_positive(matrix, right)
    assert good.tolist() == [True, False, False, False, False, True]
    assert (solution[1:5] == 0).all()
    torch.testing.assert_close(solution[[0, 5]], expected[[0, 5]])


def test_gradients_are_finite_where_a_system_cannot_be_solved():
    matrix = positive_matrices(4, torch.float64)
    matrix[1] = -matrix[1]
    matrix[2] = 0
    matrix[3, 0, 0] = torch.nan
    matrix.requires_grad_()
    right = torch.ones(4, 6, 1, dtype=torch.float64, requires_grad=True)
    solution, _ = solve_positive(matrix, right)
    gradients = torch.autograd.grad(solution.sum(), (matrix, right))
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert (gradients[0][1:] == 0).all()


def test_gradients_of_a_solved_system_are_right():
    matrix = positive_matrices(2, torch.float64).requires_grad_()
    right = torch.randn((2, 6, 2), generator=generator(2), dtype=torch.float64).requires_grad_()
    # The factorisation reads one triangle: symmetrise, so that numeric differences move both.
    assert gradcheck(lambda m, r: solve_positive(0.5 * (m + m.transpose(1, 2)), r)[0], (matrix, right), atol=1e-4)
