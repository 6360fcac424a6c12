"""Gradients of poses by their inputs: against finite differences of the converged optimum, and where there is none."""

from dataclasses import replace

import pytest
import torch
from helpers import generator, perturbed, pose, random_pose
from pose_problems import cost_of, problem_at, tensors_of
from torch.autograd import gradcheck
from window_problems import windowed

from torchtrack.config.tracker import SolverConfig
from torchtrack.core.lie import cayley, move_about, retract_about, se3_exp
from torchtrack.tracking.estimation import implicit_gradient
from torchtrack.tracking.estimation.implicit_gradient import newton_step, with_gradient
from torchtrack.tracking.estimation.levenberg_marquardt import robust_cost, solve_pose
from torchtrack.tracking.estimation.terms import PoseProblem

# Scales at which residuals of 2 px lie where the loss bends.
SCALES_PX = {"tukey": 9.0, "huber": 2.5, "none": 1.0}
INPUTS = ["weights", "targets", "directions", "points_obj", "T_prior", "intrinsics", "scale_px", "prior_information"]
CASES = [(name, loss, True) for name in INPUTS for loss in SCALES_PX if (name, loss) != ("scale_px", "none")]
CASES += [(name, "tukey", False) for name in INPUTS]


def noisy(loss="tukey", *, window=False, batch=1, seed=0, count=40, T_true=None):
    """Residuals of 2 px against a prior that counts, which lies beside the truth."""
    T_true = random_pose(batch, seed=seed) if T_true is None else T_true
    if window:
        problem = windowed(T_true, count=count, noise_px=2.0, seed=seed, faster=0.3 * torch.ones(6, dtype=torch.float64))
        information = [30.0] * 3 + [3e3] * 3 + [1e-2] * 3 + [1.0] * 3
    else:
        problem = problem_at(T_true, count, noise_px=2.0, seed=seed)
        information = [30.0] * 3 + [3e3] * 3
    return replace(
        problem,
        prior_information=torch.tensor(information, dtype=torch.float64).diag().repeat(batch, 1, 1),
        scale_px=torch.full_like(problem.scale_px, SCALES_PX[loss]),
        T_prior=perturbed(T_true, rotation_rad=0.005),
    )


@pytest.fixture(autouse=True)
def _steps_to_the_optimum(monkeypatch):
    """More than a tracker takes: what is compared here is the gradient at the optimum, to many digits."""
    monkeypatch.setattr(implicit_gradient, "NEWTON_STEPS", 4)


def settings(loss, iterations=15):
    return SolverConfig(loss=loss, iterations=iterations)


def measure(T_cam_obj, further, seed=3):
    """A number that hangs on all that is unknown."""
    weights = torch.randn(T_cam_obj.shape, generator=generator(seed), dtype=T_cam_obj.dtype)
    return (T_cam_obj * weights).sum() + further.sum()


@torch.no_grad()
def measured_optimum(problem, loss):
    """The measure where the cost is least, to rounding."""
    actual = solve_pose(problem, problem.T_prior, settings(loss))
    T_cam_obj, further = actual.T_cam_obj, actual.from_prior[:, 6:]
    for _ in range(4):
        step, good = newton_step(problem, T_cam_obj, further, loss)
        T_cam_obj, further = move_about(T_cam_obj, cayley(step[:, :3]), step[:, 3:6], problem.centre_obj), further + step[:, 6:]
        assert good.all()
    return measure(T_cam_obj, further)


def changed(problem, name, amount):
    """The problem with one input moved along a direction."""
    value = getattr(problem, name)
    direction = torch.randn(value.shape, generator=generator(7), dtype=value.dtype)
    if name == "T_prior":
        return replace(problem, T_prior=se3_exp(0.1 * amount * direction[:, 0].repeat(1, 2)[:, :6]) @ value)
    if name == "prior_information":
        direction = value * direction.diagonal(dim1=1, dim2=2)[..., None]
    return replace(problem, **{name: value + amount * direction})


def leaves(problem):
    """The problem with every tensor of numbers to be differentiated by, and these."""
    tensors = {name: value.clone().requires_grad_() for name, value in tensors_of(problem).items()}
    return PoseProblem(**tensors, window=problem.window), tensors


# ---- the optimum and its gradients


@pytest.mark.parametrize("loss", SCALES_PX)
def test_newton_steps_lead_to_where_the_cost_has_no_slope(loss):
    problem = noisy(loss, batch=3)
    T_cam_obj = solve_pose(problem, problem.T_prior, settings(loss)).T_cam_obj
    for _ in range(4):
        step, good = newton_step(problem, T_cam_obj, T_cam_obj.new_zeros(3, 0), loss)
        T_cam_obj = move_about(T_cam_obj, cayley(step[:, :3]), step[:, 3:], problem.centre_obj)
    nothing = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    cost = cost_of(problem, retract_about(T_cam_obj, nothing, problem.centre_obj), loss)
    assert good.all() and torch.autograd.grad(cost.sum(), nothing)[0].abs().max() < 1e-8


@pytest.mark.parametrize(("name", "loss", "window"), CASES)
def test_gradients_are_those_of_the_converged_optimum(name, loss, window):
    problem = noisy(loss, window=window)
    amount = torch.zeros((), dtype=torch.float64, requires_grad=True)
    moved = changed(problem, name, amount)
    actual = with_gradient(moved, solve_pose(moved, problem.T_prior, settings(loss)), settings(loss))
    (ours,) = torch.autograd.grad(measure(actual.T_cam_obj, actual.from_prior[:, 6:]), amount)
    small = 3e-5
    theirs = (measured_optimum(changed(problem, name, small), loss) - measured_optimum(changed(problem, name, -small), loss)) / (2 * small)
    assert abs(ours - theirs) <= 1e-3 * abs(theirs)


def test_gradients_do_not_need_a_solution_that_has_converged(monkeypatch):
    monkeypatch.setattr(implicit_gradient, "NEWTON_STEPS", 6)
    problem, tensors = leaves(noisy("tukey"))
    gradients = []
    for iterations in (2, 15):
        solution = solve_pose(problem, problem.T_prior.detach(), settings("tukey", iterations))
        actual = with_gradient(problem, solution, SolverConfig())
        gradients.append(torch.autograd.grad(actual.T_cam_obj[:, :3].sum(), tensors["targets"])[0])
    assert (gradients[0] - gradients[1]).norm() < 1e-2 * gradients[1].norm()


def test_gradcheck_of_the_cost_and_of_the_step():
    problem = noisy("huber", count=12)
    T_cam_obj = perturbed(problem.T_prior, seed=2)

    def step_by(targets, weights, points_obj):
        moved = replace(problem, targets=targets, weights=weights, points_obj=points_obj)
        return robust_cost(moved, T_cam_obj, torch.zeros(1, 6, dtype=torch.float64), "huber")

    inputs = [value.clone().requires_grad_() for value in (problem.targets, problem.weights, problem.points_obj)]
    assert gradcheck(step_by, inputs)


# ---- values, and where there is nothing to differentiate


def test_values_stay_to_the_last_bit(dtype):
    problem = noisy("tukey", window=True, batch=2)
    tensors = {name: value.to(dtype) for name, value in tensors_of(problem).items()}
    window = type(problem.window)(*(value.to(dtype) for value in vars(problem.window).values()))
    problem = PoseProblem(**tensors, window=window)
    solution = solve_pose(problem, problem.T_prior, settings("tukey", 2))
    actual = with_gradient(replace(problem, weights=problem.weights.requires_grad_()), solution, settings("tukey"))
    assert actual.T_cam_obj.requires_grad and not actual.hessian.requires_grad
    for name, value in vars(solution).items():
        assert torch.equal(getattr(actual, name), value), name


@pytest.mark.parametrize("recording", [True, False])
def test_nothing_is_done_where_nothing_is_asked_for(recording):
    problem = noisy()
    solution = solve_pose(problem, problem.T_prior, settings("tukey"))
    if not recording:
        problem = replace(problem, weights=problem.weights.requires_grad_())
    with torch.set_grad_enabled(recording):
        assert with_gradient(problem, solution, settings("tukey")) is solution


def test_the_solver_itself_records_nothing():
    problem, _ = leaves(noisy())
    assert not solve_pose(problem, problem.T_prior, settings("tukey")).T_cam_obj.requires_grad


@pytest.mark.parametrize("window", [False, True], ids=["pose", "window"])
@pytest.mark.parametrize("loss", SCALES_PX)
def test_gradients_are_finite_at_identity_and_for_padding(loss, window):
    eye = pose(rotation=(0, 0, 0)).repeat(2, 1, 1)
    problem = noisy(loss, window=window, batch=2, T_true=eye)
    weights, targets = problem.weights.clone(), problem.targets.clone()
    weights[:, 20:], targets[:, 30:] = 0, torch.nan
    problem, tensors = leaves(replace(problem, T_prior=eye, weights=weights, targets=targets))
    actual = with_gradient(problem, solve_pose(replace(problem, targets=targets.nan_to_num()), eye, settings(loss, 1)), settings(loss))
    gradients = torch.autograd.grad(measure(actual.T_cam_obj, actual.from_prior), list(tensors.values()), allow_unused=True)
    for name, gradient in zip(tensors, gradients, strict=True):
        assert gradient is None or torch.isfinite(gradient).all(), name
    by_targets, by_points = (gradients[list(tensors).index(name)] for name in ("targets", "points_obj"))
    assert (by_targets[:, 20:] == 0).all() and (by_points[:, 20:] == 0).all() and (by_targets[:, :20] != 0).any()


@pytest.mark.parametrize("fault", ["unseen", "infinite", "bent"])
def test_a_failed_element_has_no_gradient_and_leaves_its_neighbours_alone(fault):
    problem = noisy("tukey", batch=3)
    alone = PoseProblem(*(value[::2] for value in tensors_of(problem).values()))
    broken = {name: value.clone() for name, value in tensors_of(problem).items()}
    broken["prior_information"][1] = 0
    if fault == "unseen":
        broken["weights"][1] = 0
    elif fault == "infinite":
        broken["points_obj"][1] = torch.inf
    else:
        # Residuals beyond the bend of the loss: every direction curves downwards.
        broken["weights"][1] = -broken["weights"][1]
    gradients = []
    for each in (PoseProblem(**broken), alone):
        each, tensors = leaves(each)
        start = each.T_prior.detach()
        actual = with_gradient(each, solve_pose(each, start, settings("tukey")), settings("tukey"))
        assert torch.isfinite(actual.T_cam_obj).all()
        gradients.append(torch.autograd.grad(actual.T_cam_obj.sum(), [tensors[name] for name in ("weights", "targets", "points_obj", "T_prior")]))
    for ours, theirs in zip(*gradients, strict=True):
        assert torch.isfinite(ours).all() and (ours[1] == 0).all()
        torch.testing.assert_close(ours[::2], theirs, rtol=1e-9, atol=1e-12)


def test_the_step_can_be_mapped_over_a_further_axis():
    problems = [noisy("tukey", batch=2, seed=seed) for seed in range(3)]
    steps = torch.stack([newton_step(problem, problem.T_prior, problem.T_prior.new_zeros(2, 0), "tukey")[0] for problem in problems])
    names = list(tensors_of(problems[0]))
    stacked = tuple(torch.stack([getattr(problem, name) for problem in problems]) for name in names)

    def step(*tensors):
        problem = PoseProblem(*tensors)
        return newton_step(problem, problem.T_prior, problem.T_prior.new_zeros(2, 0), "tukey")[0]

    torch.testing.assert_close(torch.func.vmap(step)(*stacked), steps)
