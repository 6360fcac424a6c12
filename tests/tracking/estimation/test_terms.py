"""Terms of the cost: a third one, made here from known pairs of points and pixels, is solved with no change to the solver."""

from dataclasses import dataclass, replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, generator, perturbed, pose, pose_errors, random_pose
from jaxtyping import Float
from pose_problems import LOSSES, problem_at
from torch import Tensor
from torch.autograd import gradcheck
from tracked_boxes import assert_same, follow, in_motion, moving_box, windows
from window_problems import windowed

from torchtrack import Tracker, preset
from torchtrack.baselines import tracker_class
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import SolverConfig, TrackerConfig
from torchtrack.core import dispatch
from torchtrack.core.camera import project
from torchtrack.core.image_velocity import pose_jacobian
from torchtrack.core.lie import affine, move_about, retract_about, transform_points, turned
from torchtrack.tracking import initialization
from torchtrack.tracking import tracker as tracker_module
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.estimation.implicit_gradient import newton_step, with_gradient
from torchtrack.tracking.estimation.levenberg_marquardt import offset_from_prior, robust_cost, solve_pose
from torchtrack.tracking.estimation.rounds import Start, align, gate_scale_of, index_for
from torchtrack.tracking.estimation.terms import ContourDistance, CostTerm, LinearisedTerm, Place, Prior
from torchtrack.tracking.validation.status import Status

THOROUGH = SolverConfig(iterations=20)


@dataclass(frozen=True)
class PointPairs:
    """Distances (px) between known points of an object, seen from its centre (m), and the pixels where they were observed."""

    arms: Float[Tensor, "b 3 n"]
    pixels: Float[Tensor, "b 2 n"]
    weights: Float[Tensor, "b n"]
    intrinsics: Float[Tensor, "b 4"]
    scale_px: Float[Tensor, "b"] | None = None

    def linearise(self, place: Place) -> LinearisedTerm:
        arms = affine(place.rotation, self.arms)
        x, y, z = (arms + place.centre_cam).unbind(1)
        fx, fy, cx, cy = (value[:, None] for value in self.intrinsics.unbind(1))
        nothing = torch.zeros_like(z)
        across, down = (fx / z, nothing, -fx * x / z**2), (nothing, fy / z, -fy * y / z**2)
        residuals = torch.cat([fx * x / z + cx - self.pixels[:, 0], fy * y / z + cy - self.pixels[:, 1]], 1)
        rows = torch.cat([pose_jacobian(arms, across), pose_jacobian(arms, down)], 2)
        return LinearisedTerm(residuals, rows, self.weights.repeat(1, 2), self.scale_px)


def pairs_at(T_true, problem, count=12, *, noise_px=0.0, outliers=0, weight=1.0, scale_px=None, seed=5):
    """Pairs of a body of 0.1 m seen at ``T_true``, about the centre of ``problem``; the last are outliers."""
    rng, dtype = generator(seed), problem.targets.dtype
    points = 0.05 * torch.randn((len(T_true), count, 3), generator=rng, dtype=torch.float64)
    intrinsics = SMALL_CAMERA.intrinsics(torch.float64).expand(len(T_true), 4)
    pixels = project(transform_points(T_true.double(), points), intrinsics)
    pixels = pixels + noise_px * torch.randn(pixels.shape, generator=rng, dtype=torch.float64)
    pixels[:, count - outliers :] += 40
    arms = (points - problem.centre_obj.double()[:, None]).transpose(1, 2)
    values = arms, pixels.transpose(1, 2), torch.full((len(T_true), count), weight, dtype=torch.float64), intrinsics
    return PointPairs(*(value.to(dtype) for value in values), None if scale_px is None else torch.full((len(T_true),), scale_px, dtype=dtype))


def unseen(problem):
    """The problem without its contours."""
    return replace(problem, weights=torch.zeros_like(problem.weights))


def with_pairs(T_true, *, window=False, prior=1e-6, dtype=torch.float64, noise_px=0.0, scale_px=None):
    """Contours and pairs of a body, which do not quite agree where there is noise."""
    faster = torch.zeros(6, dtype=torch.float64)
    if window:
        problem = windowed(T_true, count=40, faster=faster, noise_px=noise_px, prior=prior, dtype=dtype)
    else:
        problem = problem_at(T_true, 40, noise_px=noise_px, prior=prior, dtype=dtype)
    return replace(problem, extra_terms=(pairs_at(T_true, problem, noise_px=noise_px, scale_px=scale_px),))


def row_of(problem, row):
    """One object's part of a problem of poses alone."""

    def part(values):
        return {name: value[row : row + 1] for name, value in vars(values).items() if isinstance(value, Tensor)}

    terms = tuple(replace(term, **part(term)) for term in problem.extra_terms)
    return replace(problem, **part(problem), extra_terms=terms)


# ---- what a term says


def test_terms_are_added_in_their_order():
    problem = with_pairs(random_pose(2))
    terms = problem.terms()
    assert [type(term) for term in terms] == [ContourDistance, Prior, PointPairs]
    assert all(isinstance(term, CostTerm) for term in terms)
    assert replace(problem, extra_terms=()).terms()[1:] == (terms[1],)


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("window", [False, True], ids=["pose", "window"])
def test_the_rows_of_each_term_are_the_derivative_of_its_residuals(window, number):
    problem = with_pairs(random_pose(2), window=window, noise_px=1.0)
    T_cam_obj = perturbed(problem.T_prior, seed=2)
    term, place = problem.terms()[number], Place.at(T_cam_obj, problem.centre_obj, offset_from_prior(problem, T_cam_obj))

    def residuals(step):
        # Around the step of nothing, a turn by a small vector is that vector's own.
        moved = Place(turned(place.rotation, step[:, :3]), place.centre_cam + step[:, 3:6, None], place.from_prior + step)
        return term.linearise(moved).residuals

    nothing = torch.zeros_like(place.from_prior).requires_grad_()
    assert gradcheck(residuals, nothing)
    jacobian = torch.autograd.functional.jacobian(residuals, nothing).diagonal(dim1=0, dim2=2).permute(2, 1, 0)
    rows = term.linearise(place).rows
    rows = torch.eye(nothing.shape[1], dtype=torch.float64).expand(2, -1, -1) if rows is None else rows
    torch.testing.assert_close(rows, jacobian[:, : rows.shape[1]], rtol=1e-8, atol=1e-9)
    assert (jacobian[:, rows.shape[1] :] == 0).all()


@pytest.mark.parametrize("scale_px", [None, 3.0])
@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("window", [False, True], ids=["pose", "window"])
def test_the_gradient_with_a_further_term_is_that_of_the_cost(window, loss, scale_px):
    problem = with_pairs(random_pose(2), window=window, noise_px=1.0, scale_px=scale_px)
    T_cam_obj = problem.T_prior
    nothing = torch.zeros_like(problem.prior_information[:, 0]).requires_grad_()
    cost = robust_cost(problem, retract_about(T_cam_obj, nothing[:, :6], problem.centre_obj), nothing, loss)
    (expected,) = torch.autograd.grad(cost.sum(), nothing)
    at = solve_pose(problem, T_cam_obj, SolverConfig(iterations=1, loss=loss))
    torch.testing.assert_close(at.gradient, expected, rtol=1e-8, atol=1e-6)
    without = solve_pose(replace(problem, extra_terms=()), T_cam_obj, SolverConfig(iterations=1, loss=loss))
    assert float((at.gradient - without.gradient)[:, :6].abs().min()) > 1e-3
    torch.testing.assert_close(at.hessian[:, 6:], without.hessian[:, 6:], rtol=1e-9, atol=1e-9)


# ---- poses


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("window", [False, True], ids=["pose", "window"])
def test_a_pose_is_solved_for_with_the_further_term_alone(window, dtype):
    T_true = random_pose(4, seed=1)
    problem = unseen(with_pairs(T_true, window=window, prior=1e-9, dtype=dtype))
    start = perturbed(T_true, seed=1, rotation_rad=0.02, translation_m=0.002).to(dtype)
    solution = solve_pose(problem, start, THOROUGH)
    degrees, millimetres = pose_errors(solution.T_cam_obj.double(), T_true)
    assert solution.T_cam_obj.dtype == dtype
    assert float(degrees.max()) < (1e-2 if dtype == torch.float32 else 1e-6)
    assert float(millimetres.max()) < (0.1 if dtype == torch.float32 else 1e-5)


@pytest.mark.usefixtures("way")
def test_a_further_term_shows_what_contours_do_not():
    """Contours along one direction leave the vertical place open: the prior holds it, the pairs correct it."""
    T_true = random_pose(4, seed=8)
    problem = with_pairs(T_true, prior=1e-2)
    T_prior = T_true.clone()
    T_prior[:, 1, 3] += 0.01
    problem = replace(problem, T_prior=T_prior, directions=torch.tensor([1.0, 0.0], dtype=torch.float64).expand_as(problem.directions))
    errors = [pose_errors(solve_pose(each, T_prior, THOROUGH).T_cam_obj, T_true)[1] for each in (replace(problem, extra_terms=()), problem)]
    assert float(errors[0].min()) > 5
    assert float(errors[1].max()) < 0.01


def test_outliers_of_a_term_with_a_scale_do_not_count():
    T_true = random_pose(3, seed=2)
    problem = problem_at(T_true, 40)
    errors = []
    for scale_px in (None, 5.0):
        pairs = pairs_at(T_true, problem, outliers=2, scale_px=scale_px)
        solution = solve_pose(replace(problem, extra_terms=(pairs,)), perturbed(T_true), THOROUGH)
        errors.append(pose_errors(solution.T_cam_obj, T_true)[1])
    assert float(errors[0].min()) > 0.1
    assert float(errors[1].max()) < 1e-6


@pytest.mark.parametrize("loss", LOSSES)
def test_a_batch_is_its_elements(loss, dtype):
    T_true = random_pose(5, seed=6)
    problem = with_pairs(T_true, noise_px=0.5, prior=100.0, scale_px=4.0, dtype=dtype)
    start, config = perturbed(T_true, seed=2).to(dtype), SolverConfig(iterations=5, loss=loss)
    together = solve_pose(problem, start, config)
    for row in range(5):
        alone = solve_pose(row_of(problem, row), start[row : row + 1], config)
        torch.testing.assert_close(together.T_cam_obj[row], alone.T_cam_obj[0], rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-10)
        torch.testing.assert_close(together.hessian[row], alone.hessian[0], rtol=1e-4, atol=1.0)


def test_what_is_not_a_number_stays_with_its_object():
    T_true = random_pose(3, seed=4)
    problem, start = with_pairs(T_true, noise_px=0.3, prior=1.0), perturbed(T_true)
    (pairs,) = problem.extra_terms
    spoilt = pairs.pixels.clone()
    spoilt[1] = torch.nan
    expected = solve_pose(problem, start, THOROUGH)
    solution = solve_pose(replace(problem, extra_terms=(replace(pairs, pixels=spoilt),)), start, THOROUGH)
    torch.testing.assert_close(solution.T_cam_obj[::2], expected.T_cam_obj[::2], rtol=0, atol=1e-12)
    assert torch.equal(solution.T_cam_obj[1], start[1])


# ---- gradients


@torch.no_grad()
def optimum(problem):
    """The pose where the cost is least, to rounding."""
    T_cam_obj = solve_pose(problem, problem.T_prior, THOROUGH).T_cam_obj
    for _ in range(4):
        step, good = newton_step(problem, T_cam_obj, T_cam_obj.new_zeros(len(T_cam_obj), 0), THOROUGH.loss)
        T_cam_obj = move_about(
            T_cam_obj, turned(torch.eye(3, dtype=step.dtype).expand(len(step), 3, 3), step[:, :3]), step[:, 3:6], problem.centre_obj
        )
        assert good.all()
    return T_cam_obj


@pytest.mark.parametrize("name", ["arms", "pixels", "weights", "intrinsics", "scale_px"])
def test_poses_follow_every_input_of_a_further_term(name):
    problem = with_pairs(random_pose(2, seed=3), noise_px=1.5, prior=10.0, scale_px=6.0)
    (pairs,) = problem.extra_terms
    value = getattr(pairs, name)
    direction = torch.randn(value.shape, generator=generator(7), dtype=torch.float64)
    weights = torch.randn((2, 4, 4), generator=generator(3), dtype=torch.float64)

    def changed(amount):
        return replace(problem, extra_terms=(replace(pairs, **{name: value + amount * direction}),))

    amount = torch.zeros((), dtype=torch.float64, requires_grad=True)
    solution = solve_pose(problem, problem.T_prior, THOROUGH)
    followed = with_gradient(changed(amount), solution, THOROUGH)
    assert torch.equal(followed.T_cam_obj, solution.T_cam_obj)
    (ours,) = torch.autograd.grad((followed.T_cam_obj * weights).sum(), amount)
    small = 3e-6
    theirs = ((optimum(changed(small)) - optimum(changed(-small))) * weights).sum() / (2 * small)
    assert abs(float(theirs)) > 1e-7
    assert abs(float(ours - theirs)) <= 1e-3 * abs(float(theirs))


# ---- kernels, and rounds


def test_kernels_leave_further_terms_to_the_reference():
    T_true = random_pose(3, seed=5)
    problem, start = with_pairs(T_true, noise_px=0.5), perturbed(T_true)
    solution = solve_pose(problem, start, THOROUGH)
    with dispatch.backend(wanted=False):
        expected = solve_pose(problem, start, THOROUGH)
    assert torch.equal(solution.T_cam_obj, expected.T_cam_obj)
    assert float((solution.T_cam_obj - solve_pose(replace(problem, extra_terms=()), start, THOROUGH).T_cam_obj).abs().max()) > 1e-6


@pytest.mark.usefixtures("way")
def test_rounds_of_matching_take_a_further_term():
    """Pairs that are known far better than events draw a box in motion to where they say it is, by half a millimetre."""
    tracker, prediction, events, alone, T_true = in_motion(dtype=torch.float64)
    T_said = retract_about(T_true, torch.tensor([[0.0, 0, 0, 5e-4, 0, 0]], dtype=torch.float64), prediction.objects.centre_obj)
    contours = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours)
    tight = gate_scale_of(torch.zeros(1, dtype=torch.float64), tracker.config)
    index = index_for(contours, tracker.image_size, tracker.config, tight)
    observations = select_events(events, index, prediction.moving(compensated=True), 1000)
    pairs = pairs_at(T_said, replace(problem_at(T_said), centre_obj=prediction.objects.centre_obj), 40, weight=1e6)
    poses = []
    for extra_terms in ((), (pairs,)):
        with torch.inference_mode():
            fit = align(Start(prediction, contours, index, tight, extra_terms=extra_terms), observations, tracker.config)
        poses.append(fit.solution.T_cam_obj)
    torch.testing.assert_close(poses[0], alone.fit.solution.T_cam_obj, rtol=0, atol=1e-9)
    assert float(pose_errors(poses[0], T_said)[1]) > 0.2
    assert float(pose_errors(poses[1], T_said)[1]) < 0.01


# ---- a window of a tracker


@pytest.mark.parametrize("name", ["default", "line", "ls"])
def test_a_step_takes_a_further_term(name):
    """Pairs that are known far better than events say where the object is at the window's end; without them it is elsewhere."""
    trajectory, events = moving_box(pose(), 4)
    *before, (last, end_us) = windows(events, 4)
    tracker = tracker_class(name)([box_model()], SMALL_CAMERA, preset(name), dtype=torch.float64)
    with torch.inference_mode():
        state, _ = follow(tracker, tracker.init(pose()[None], 0), before)
        T_said = retract_about(trajectory.at(torch.tensor([end_us])), torch.tensor([[0.0, 0, 0, 5e-4, 0, 0]]).double(), tracker.centre_obj)
        pairs = pairs_at(T_said, replace(problem_at(T_said), centre_obj=tracker.centre_obj), 40, weight=1e6)
        results = [tracker.step(state, last, end_us, extra_terms=extra_terms)[1] for extra_terms in ((), (pairs,))]
        assert_same(results[0], tracker.step(state, last, end_us)[1])
    millimetres = [float(pose_errors(result.T_cam_obj, T_said)[1]) for result in results]
    assert millimetres[0] > 0.2 and millimetres[1] < 0.01
    assert int(results[1].status[0]) == Status.TRACKING


def test_where_a_window_is_taken_in_parts_a_further_term_is_of_its_end(monkeypatch):
    monkeypatch.setattr(initialization, "_EVENTS_OF_A_PART", 40)
    for module in (initialization, tracker_module):
        monkeypatch.setattr(module, "PARTS", 3)
    trajectory, events = moving_box(pose(), 1)
    config = TrackerConfig(relocalization=RelocalizationConfig(hypotheses=0))
    tracker = Tracker([box_model()], SMALL_CAMERA, config, dtype=torch.float64)
    start, (window,) = tracker.init(pose()[None], 0), windows(events, 1)
    assert bool(initialization.to_be_parted(start, window[0], torch.tensor([window[1]]), tracker.objects, config).all())
    T_said = retract_about(trajectory.at(torch.tensor([window[1]])), torch.tensor([[0.0, 0, 0, 5e-4, 0, 0]]).double(), tracker.centre_obj)
    pairs = pairs_at(T_said, replace(problem_at(T_said), centre_obj=tracker.centre_obj), 40, weight=1e6)
    with torch.inference_mode():
        results = [tracker.step(start, *window, extra_terms=extra_terms)[1] for extra_terms in ((), (pairs,))]
    millimetres = [float(pose_errors(result.T_cam_obj, T_said)[1]) for result in results]
    assert millimetres[0] > 0.2 and millimetres[1] < 0.01
