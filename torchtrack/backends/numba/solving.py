"""Levenberg-Marquardt of :func:`tracking.estimation.levenberg_marquardt.solve_pose`, object by object, and the parts of a step that rounds share."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.alignment import DampingSettings, damping_settings
from torchtrack.backends.numba.arrays import SolutionArrays, as_arrays
from torchtrack.backends.numba.cholesky import factorise, solve
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, centre_of, entries, inverse_depth, is_finite, lens, turn, turned
from torchtrack.backends.numba.parameters import SolvingSettings
from torchtrack.config.tracker import SolverConfig
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.estimation import levenberg_marquardt as lm
from torchtrack.tracking.estimation.robust_loss import LOSSES
from torchtrack.tracking.estimation.terms import Linearisation, PoseProblem, WindowTerms

# Sums of products run along as many observations at a time: what they need stays in the fastest memory.
_ALONG = FAST | {"reassoc"}
# Unknowns of a pose; beside it there may be as many of its velocity.
_POSE = 6


class ProblemArrays(NamedTuple):
    """Problems to solve: :class:`torchtrack.tracking.estimation.terms.PoseProblem` by its fields.

    Args:
        age_s, velocity: of what is unknown beside the pose; not read where there is nothing.
    """

    points_obj: Array
    targets: Array
    directions: Array
    weights: Array
    age_s: Array
    velocity: Array
    intrinsics: Array
    centre_obj: Array
    scale_px: Array
    information: Array


@kernel()
def _problem_of(problems: ProblemArrays, b: int) -> ProblemArrays:
    """The problem of one object."""
    p = problems
    observed = p.points_obj[b], p.targets[b], p.directions[b], p.weights[b], p.age_s[b], p.velocity[b]
    return ProblemArrays(*observed, p.intrinsics[b], p.centre_obj[b], p.scale_px[b], p.information[b])


@kernel()
def solution_of(solutions: SolutionArrays, b: int) -> SolutionArrays:
    """The solution of one object."""
    return SolutionArrays(solutions.T_cam_obj[b], solutions.offset[b], solutions.gradient[b], solutions.hessian[b])


@kernel()
def solve_poses(problems: ProblemArrays, settings: SolvingSettings, damping: DampingSettings, solutions: SolutionArrays) -> None:
    """Solve each problem, from where the search starts; the solutions are changed to where it ends."""
    problems, solutions = ProblemArrays(*problems), SolutionArrays(*solutions)
    count, unknowns, dtype = problems.weights.shape[1], solutions.offset.shape[1], problems.weights.dtype
    rows, robust, step = np.empty((unknowns + 1, count), dtype), np.empty(count, dtype), np.empty(unknowns)
    (pose, next_pose), (offset, next_offset) = np.empty((2, 4, 4)), np.empty((2, unknowns))
    tried = SolutionArrays(next_pose, next_offset, np.empty(unknowns), np.empty((unknowns, unknowns)))
    for b in range(len(problems.weights)):
        problem, solution = _problem_of(problems, b), solution_of(solutions, b)
        best = SolutionArrays(pose, offset, solution.gradient, solution.hessian)
        pose[:], offset[:] = solution.T_cam_obj, solution.offset
        cost, damped = _look(problem, best, settings.loss, rows, robust), damping.damping
        for _ in range(settings.iterations - 1):
            next_pose[:], next_offset[:] = pose, offset
            possible = damped_step(best, damped, damping, step)
            move(next_pose, problem.centre_obj, next_offset, step)
            next_cost = _look(problem, tried, settings.loss, rows, robust)
            # Near the optimum, rounding must not decide.
            if possible and next_cost <= cost * (1.0 + settings.rounding):
                cost, damped = next_cost, damped * settings.decay
                pose[:], offset[:], best.gradient[:], best.hessian[:] = next_pose, next_offset, tried.gradient, tried.hessian
            else:
                damped = max(damped, settings.least_raised) * settings.growth
        damped_step(best, damped, damping, step)
        move(pose, problem.centre_obj, offset, step)
        solution.T_cam_obj[:], solution.offset[:] = pose, offset


@kernel(fastmath=FAST)
def _look(problem: ProblemArrays, solution: SolutionArrays, loss: int, rows: Array, robust: Array) -> float:
    """Gradient and Hessian at a solution's pose and offset from the prior, filled, and the cost there."""
    points, targets, directions, weights, age_s, velocity, _, centre_obj, scale_px, information = problem
    pose, offset, _, _ = solution
    intrinsics, unknowns, centre, cost, used, velocity_offset = lens(problem.intrinsics), len(offset), np.empty(3), 0.0, 0, np.zeros(_POSE)
    centre_of(pose, centre_obj, centre)
    numbers, c, middle = entries(pose), (centre_obj[0], centre_obj[1], centre_obj[2]), (centre[0], centre[1], centre[2])
    if unknowns > _POSE:
        velocity_offset[:] = offset[_POSE:] - velocity
    for i in range(len(weights)):
        if not weights[i] > 0:
            continue
        nu, nv = directions[i, 0], directions[i, 1]
        there = (targets[i, 0] - intrinsics[2]) * nu + (targets[i, 1] - intrinsics[3]) * nv
        from_centre = points[i, 0] - c[0], points[i, 1] - c[1], points[i, 2] - c[2]
        row, residual = row_of(numbers, from_centre, middle, intrinsics, (nu, nv), there)
        for k in range(_POSE):
            rows[k, used] = row[k]
        if unknowns > _POSE:
            # Linear in all that is unknown beside the pose; the targets have been moved with one velocity already.
            for k in range(_POSE):
                rows[_POSE + k, used] = -row[k] * age_s[i]
                residual += rows[_POSE + k, used] * velocity_offset[k]
        weight, lost = robustly(residual, scale_px, loss)
        cost += weights[i] * lost
        rows[unknowns, used], robust[used] = residual, weights[i] * weight
        used += 1
    return cost + 0.5 * normal_equations(rows, robust, used, information, solution)


@kernel(fastmath=FAST)
def row_of(pose: Numbers, from_centre: Numbers, centre: Numbers, intrinsics: Numbers, direction: Numbers, there: float) -> tuple[Numbers, float]:
    """The Jacobian of a residual by the pose, and the residual: :func:`torchtrack.core.image_velocity.pose_jacobian`.

    Args:
        from_centre: the point from the object's centre, in the object's axes.
        direction: along which the distance counts.
        there: where the target is along it, from the principal point.
    """
    ax, ay, az = turned(pose, from_centre[0], from_centre[1], from_centre[2])
    inverse = inverse_depth(az + centre[2])
    gx, gy = direction[0] * intrinsics[0] * inverse, direction[1] * intrinsics[1] * inverse
    along = gx * (ax + centre[0]) + gy * (ay + centre[1])
    gz = -along * inverse
    return (ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx, gx, gy, gz), along - there


@kernel(fastmath=FAST)
def robustly(residual: float, scale_px: float, loss: int) -> tuple[float, float]:
    """Weight and loss of a residual: :mod:`torchtrack.tracking.estimation.robust_loss`, of none (0), Huber (1) and Tukey (2)."""
    size = abs(residual)
    if loss == 0 or (loss == 1 and size <= scale_px):
        return 1.0, 0.5 * residual * residual
    if loss == 1:
        return scale_px / size, scale_px * (size - 0.5 * scale_px)
    relative = residual / scale_px
    inside = 1.0 - relative * relative
    # Not the other way round: what is not a number stays that.
    if inside < 0.0:
        inside = 0.0
    return inside * inside, scale_px * scale_px / 6.0 * (1.0 - inside * inside * inside)


@kernel(fastmath=_ALONG)
def normal_equations(rows: Array, weights: Array, used: int, information: Array, solution: SolutionArrays) -> float:
    """Gradient of the cost at a solution, and its Gauss-Newton Hessian, prior included, filled; and twice the prior's part of the cost.

    Args:
        rows: ``[k + 1, n]`` of the Jacobian, and the residuals.
    """
    _, offset, gradient, hessian = solution
    unknowns, weighted, priors = len(offset), np.empty(used, rows.dtype), 0.0
    for j in range(unknowns + 1):
        row = rows[j]
        for i in range(used):
            weighted[i] = weights[i] * row[i]
        for k in range(min(j + 1, unknowns)):
            other, total = rows[k], rows.dtype.type(0)
            for i in range(used):
                total += weighted[i] * other[i]
            if j == unknowns:
                gradient[k] = total
            else:
                hessian[j, k] = hessian[k, j] = total
    for j in range(unknowns):
        pull = 0.0
        for k in range(unknowns):
            pull += information[j, k] * offset[k]
            hessian[j, k] += information[j, k]
        gradient[j] += pull
        priors += offset[j] * pull
    return priors


@kernel()
def damped_step(solution: SolutionArrays, damped: float, damping: DampingSettings, step: Array) -> bool:
    """The damped step from a solution to the optimum, filled, and whether there is one; none where the Hessian is not positive definite."""
    unknowns = len(step)
    matrix, factor, largest = solution.hessian.astype(np.float64), np.empty((unknowns, unknowns)), 0.0
    for k in range(_POSE):
        largest = max(largest, matrix[k, k])
    for k in range(unknowns):
        matrix[k, k] += damping.least_diagonal + damping.least_share * largest + damped * matrix[k, k]
        step[k] = -solution.gradient[k]
    if factorise(matrix, factor):
        solve(factor, step)
        if is_finite(step):
            return True
    step[:] = 0.0
    return False


@kernel()
def move(T_cam_obj: Array, centre_obj: Array, offset: Array, step: Array) -> None:
    """Take a step: turn about the object's centre, and move the centre."""
    rotation, into, centre = T_cam_obj[:3, :3].astype(np.float64), np.empty((3, 3)), np.empty(3)
    centre_of(T_cam_obj, centre_obj, centre)
    turn(rotation, step, into)
    for j in range(3):
        back = into[j, 0] * centre_obj[0] + into[j, 1] * centre_obj[1] + into[j, 2] * centre_obj[2]
        T_cam_obj[j, 3] = centre[j] + step[3 + j] - back
        for k in range(3):
            T_cam_obj[j, k] = into[j, k]
    for k in range(len(step)):
        offset[k] += step[k]


@accelerates(lm.solve_pose, supports=lambda problem, T_start, config, from_prior=None: not problem.extra_terms)
def solve_pose_numba(
    problem: PoseProblem, T_start: Float[Tensor, "b 4 4"], config: SolverConfig, from_prior: Float[Tensor, "b k"] | None = None
) -> Linearisation:
    """Object by object."""
    from_prior = lm.offset_from_prior(problem, T_start) if from_prior is None else from_prior
    window = problem.window or _no_window(problem)
    T_cam_obj, offset = (value.detach().clone(memory_format=torch.contiguous_format) for value in (T_start, from_prior))
    gradient, hessian = torch.empty_like(offset), torch.empty_like(problem.prior_information, memory_format=torch.contiguous_format)
    observed = problem.points_obj, problem.targets, problem.directions, problem.weights, window.age_s
    of_objects = window.velocity, problem.intrinsics, problem.centre_obj, problem.scale_px, problem.prior_information
    problems = as_arrays(*(value.detach() for value in (*observed, *of_objects)))
    rounding = lm.ROUNDINGS * torch.finfo(T_start.dtype).eps
    settings = SolvingSettings(config.iterations, LOSSES.index(config.loss), rounding, lm.DAMPING_START, lm.DAMPING_GROWTH, lm.DAMPING_DECAY)
    solve_poses(problems, settings, damping_settings(config, hessian), as_arrays(T_cam_obj, offset, gradient, hessian))
    return Linearisation(T_cam_obj, gradient, hessian, offset)


def _no_window(problem: PoseProblem) -> WindowTerms:
    """What stands for terms that a problem has not."""
    nothing, no_motion = problem.weights.new_empty(len(problem.weights), 0), problem.weights.new_empty(len(problem.weights), 6)
    return WindowTerms(nothing, no_motion)
