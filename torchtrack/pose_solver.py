"""From matches to the pose: batched Levenberg-Marquardt on SE(3) (Eq. 12-17). The one solver loop of the package.

The unknown of each object is a rotation about its centre and a move of its centre, in the camera's axes
(:func:`torchtrack.lie.move_about`). The step is ``Δξ = -(JᵀWJ + Λ + λD)⁻¹ (JᵀWr + Λδ)``: the minus signs of the
paper's Eq. 16 and 17 cancel, which cannot be meant.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.camera import MIN_DEPTH_M
from torchtrack.config.tracker import SolverConfig
from torchtrack.lie import cayley, move_about, small_difference_about

# Damping after the first rejected step, and how it grows and shrinks (Nielsen's simple rule).
_DAMPING_START, _DAMPING_GROWTH, _DAMPING_DECAY = 1e-4, 10.0, 0.1


@dataclass(frozen=True)
class WindowTerms:
    """What observations tell of beside the pose, which the solver then finds with it.

    An observation that is older than the pose tells of the velocity: the two are found together, so that a velocity
    that was predicted wrong neither biases the pose nor is learned one window late. And all limbs of an object may stand
    out of its outline, or within it, by one unknown way, as smooth shading makes them: without it, depth would be
    believed to be seen far better than it is.

    Args:
        age_s: time from each observation to the pose (s).
        velocity: offset from the predicted velocity that the targets were moved with (rad/s, m/s).
        outward: 1 where the outline's swelling counts along the direction, 0 where not.
    """

    age_s: Float[Tensor, "b n"]
    velocity: Float[Tensor, "b 6"]
    outward: Float[Tensor, "b n"]


@dataclass(frozen=True)
class PoseProblem:
    """Observations and prior of each object.

    Args:
        points_obj: matched contour points in the object's frame (m).
        targets: ideal pixels where they were observed.
        directions: unit directions along which the distance counts.
        weights: weight of each observation; 0 for padding.
        intrinsics: ``[fx, fy, cx, cy]``.
        centre_obj: centre of rotation in the object's frame (m).
        scale_px: scale of the robust loss, per object.
        T_prior: pose the prior draws to.
        prior_information: information of the prior in the solver's chart; zero for no prior.
        window: further unknowns; then the chart is ``[pose 6, velocity 6, swelling (px) 1]`` instead of the pose alone.
    """

    points_obj: Float[Tensor, "b n 3"]
    targets: Float[Tensor, "b n 2"]
    directions: Float[Tensor, "b n 2"]
    weights: Float[Tensor, "b n"]
    intrinsics: Float[Tensor, "b 4"]
    centre_obj: Float[Tensor, "b 3"]
    scale_px: Float[Tensor, "b"]
    T_prior: Float[Tensor, "b 4 4"]
    prior_information: Float[Tensor, "b k k"]
    window: WindowTerms | None = None


@dataclass(frozen=True)
class Linearisation:
    """The problem at a pose, in the solver's chart.

    Args:
        T_cam_obj: the pose.
        cost: robust cost, prior included.
        gradient, hessian: of the cost; the Hessian is Gauss-Newton's.
        from_prior: offset from the prior: rotation and move of the centre, and the further unknowns where there are.
    """

    T_cam_obj: Float[Tensor, "b 4 4"]
    cost: Float[Tensor, "b"]
    gradient: Float[Tensor, "b k"]
    hessian: Float[Tensor, "b k k"]
    from_prior: Float[Tensor, "b k"]


def robust_loss(residuals: Float[Tensor, "b n"], scale: Float[Tensor, "b"], loss: str) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"]]:
    """Loss ``ρ(r)`` and weight ``ρ'(r) / r``; both equal least squares (``r²/2``, 1) near zero.

    ``loss`` is ``"tukey"`` (zero weight beyond ``scale``), ``"huber"`` or ``"none"``.
    """
    if loss == "none":
        return 0.5 * residuals.square(), torch.ones_like(residuals)
    c = scale[:, None]
    if loss == "huber":
        size = residuals.abs().clamp(min=1e-12)
        weight = (c / size).clamp(max=1)
        return torch.where(size <= c, 0.5 * residuals.square(), c * (size - 0.5 * c)), weight
    inside = (1 - (residuals / c).square()).clamp(min=0)
    weight = inside.square()
    return c.square() / 6 * (1 - weight * inside), weight


@dataclass(frozen=True)
class _Rows:
    """A problem laid out for speed: a row per component, so that every operation runs along contiguous observations.

    ``slope`` is the direction times the focal lengths, ``offset`` the target's place along the direction: the residual
    is ``slope · (x/z, y/z) - offset``.
    """

    points: Float[Tensor, "b 3 n"]
    slope: Float[Tensor, "b 2 n"]
    offset: Float[Tensor, "b n"]


def _as_rows(problem: PoseProblem) -> _Rows:
    """The constant parts of a problem, laid out by component."""
    directions = problem.directions.transpose(1, 2)
    focal, principal = problem.intrinsics[:, :2, None], problem.intrinsics[:, 2:, None]
    offset = ((problem.targets.transpose(1, 2) - principal) * directions).sum(1)
    return _Rows(problem.points_obj.transpose(1, 2).contiguous(), directions * focal, offset)


def pose_jacobian(
    points_cam: Float[Tensor, "b 3 n"], centre_cam: Float[Tensor, "b 3"], gradient: tuple[Float[Tensor, "b n"], ...]
) -> Float[Tensor, "b 6 n"]:
    """Columns ``[(P - c) × g, g]`` with ``g = dπᵀ n``: the paper's Eq. 15 as one vector product.

    Written out: along this axis the library's vector product takes five times as long.
    """
    x, y, z = (points_cam - centre_cam[:, :, None]).unbind(1)
    gx, gy, gz = gradient
    turning = (torch.addcmul(a * d, b, c, value=-1) for a, b, c, d in ((y, z, gy, gz), (z, x, gz, gx), (x, y, gx, gy)))
    return torch.stack([*turning, gx, gy, gz], 1)


@dataclass(frozen=True)
class _Seen:
    """The matched points as a pose shows them: gradients ``g = dπᵀ n`` of the residuals, and the residuals."""

    points_cam: Tensor
    centre_cam: Tensor
    gradient: tuple[Tensor, Tensor, Tensor]
    residuals: Tensor

    @cached_property
    def jacobian(self) -> Tensor:
        """Of the residuals, by the pose."""
        return pose_jacobian(self.points_cam, self.centre_cam, self.gradient)


def _see(problem: PoseProblem, rows: _Rows, T_cam_obj: Tensor, from_prior: Tensor) -> _Seen:
    """Project the matched points and take their residuals."""
    rotation, translation = T_cam_obj[:, :3, :3], T_cam_obj[:, :3, 3:]
    points_cam = torch.baddbmm(translation, rotation, rows.points)
    inverse_depth = points_cam[:, 2].clamp(min=MIN_DEPTH_M).reciprocal()
    gx, gy = (rows.slope * inverse_depth[:, None]).unbind(1)
    along = torch.addcmul(gx * points_cam[:, 0], gy, points_cam[:, 1])
    centre_cam = torch.baddbmm(translation, rotation, problem.centre_obj[..., None])[..., 0]
    seen = _Seen(points_cam, centre_cam, (gx, gy, -along * inverse_depth), along - rows.offset)
    if problem.window is None:
        return seen
    faster = (from_prior[:, None, 6:12] - problem.window.velocity[:, None]) @ seen.jacobian
    further = problem.window.outward * from_prior[:, 12:] - problem.window.age_s * faster[:, 0]
    return replace(seen, residuals=seen.residuals + further)


def _chart_jacobian(problem: PoseProblem, seen: _Seen) -> Tensor:
    """Jacobian of the residuals by all unknowns."""
    if problem.window is None:
        return seen.jacobian
    return torch.cat([seen.jacobian, -problem.window.age_s[:, None] * seen.jacobian, problem.window.outward[:, None]], 1)


def robust_cost(problem: PoseProblem, T_cam_obj: Float[Tensor, "b 4 4"], from_prior: Float[Tensor, "b k"], loss: str) -> Float[Tensor, "b"]:
    """Robust cost of ``problem`` at a pose, and at an offset of all unknowns from the prior (Eq. 12)."""
    return _cost(problem, _as_rows(problem), T_cam_obj, from_prior, loss)


def _cost(problem: PoseProblem, rows: _Rows, T_cam_obj: Tensor, from_prior: Tensor, loss: str) -> Tensor:
    """Robust cost at a pose, prior included."""
    value, _ = robust_loss(_see(problem, rows, T_cam_obj, from_prior).residuals, problem.scale_px, loss)
    return _with_prior(problem, value, from_prior)[0]


def _with_prior(problem: PoseProblem, value: Tensor, from_prior: Tensor) -> tuple[Tensor, Tensor]:
    """Cost of each object from its observations' losses and the prior, and the prior's gradient."""
    pull = (problem.prior_information @ from_prior[..., None]).squeeze(-1)
    return (value * problem.weights).sum(-1) + 0.5 * (from_prior * pull).sum(-1), pull


def linearise(problem: PoseProblem, T_cam_obj: Float[Tensor, "b 4 4"], loss: str) -> Linearisation:
    """Cost, gradient and Gauss-Newton Hessian of ``problem`` at a pose."""
    return _linearise(problem, _as_rows(problem), T_cam_obj, _from_prior(problem, T_cam_obj), loss)


def _from_prior(problem: PoseProblem, T_cam_obj: Tensor) -> Tensor:
    """Offset of a pose from the prior; whatever else is unknown is as predicted."""
    moved = small_difference_about(problem.T_prior, T_cam_obj, problem.centre_obj)
    return torch.nn.functional.pad(moved, (0, problem.prior_information.shape[-1] - moved.shape[-1]))


def _linearise(problem: PoseProblem, rows: _Rows, T_cam_obj: Tensor, from_prior: Tensor, loss: str) -> Linearisation:
    """:func:`linearise`, given what does not change from one iteration to the next."""
    seen = _see(problem, rows, T_cam_obj, from_prior)
    jacobian = _chart_jacobian(problem, seen)
    value, robust = robust_loss(seen.residuals, problem.scale_px, loss)
    weighted = jacobian * (robust * problem.weights)[:, None]
    cost, pull = _with_prior(problem, value, from_prior)
    gradient = (weighted @ seen.residuals[..., None]).squeeze(-1) + pull
    hessian = weighted @ jacobian.transpose(1, 2) + problem.prior_information
    return Linearisation(T_cam_obj, cost, gradient, hessian, from_prior)


def solve_positive(matrix: Float[Tensor, "b n n"], right: Float[Tensor, "b n k"]) -> tuple[Float[Tensor, "b n k"], Bool[Tensor, "b"]]:
    """Solve with symmetric positive definite matrices; where one is not, zero and False.

    The matrix is made sane before it is factorised: masking afterwards would leave gradients that are not finite.
    """
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    # A sum is finite only where every entry is.
    sane = torch.isfinite(matrix.sum((-1, -2)) + right.sum((-1, -2)))
    with torch.no_grad():
        good = sane & (torch.linalg.cholesky_ex(torch.where(sane[:, None, None], matrix, eye)).info == 0)
    factor = torch.linalg.cholesky_ex(torch.where(good[:, None, None], matrix, eye)).L
    return torch.cholesky_solve(torch.where(good[:, None, None], right, 0), factor), good


def _damped_step(at: Linearisation, damping: Tensor) -> Tensor:
    """The Levenberg-Marquardt step, damped along the Hessian's diagonal."""
    diagonal = at.hessian.diagonal(dim1=-2, dim2=-1)
    # A floor keeps directions that nothing observes solvable: their step is zero, as their gradient is.
    floor = 1e-9 * diagonal[:, :6].amax(-1, keepdim=True) + 1e-12
    damped = at.hessian + torch.diag_embed(diagonal * damping[:, None] + floor)
    return solve_positive(damped, -at.gradient[..., None])[0].squeeze(-1)


@torch.no_grad()
def solve_pose(
    problem: PoseProblem, T_start: Float[Tensor, "b 4 4"], config: SolverConfig, from_prior: Float[Tensor, "b k"] | None = None
) -> Linearisation:
    """Minimise each object's cost from ``T_start``: Levenberg-Marquardt with a damping of its own per object.

    A step that does not lower an object's cost is undone and its damping raised; its neighbours are not affected.

    Nothing is recorded: :mod:`torchtrack.implicit_gradient` gives gradients of the solution.

    Args:
        from_prior: offset of ``T_start`` from the prior's pose, where it is known.

    Returns:
        The last linearisation, with the pose that its step led to.
    """
    rows = _as_rows(problem)
    T_cam_obj, damping = T_start, torch.full_like(T_start[:, 0, 0], config.damping)
    if from_prior is None:
        from_prior = _from_prior(problem, T_start)
    for _ in range(config.iterations):
        at = _linearise(problem, rows, T_cam_obj, from_prior, config.loss)
        step = _damped_step(at, damping)
        T_next = move_about(T_cam_obj, cayley(step[:, :3]), step[:, 3:6], problem.centre_obj)
        # Steps add up to the offset from the prior, to second order.
        better = _cost(problem, rows, T_next, from_prior + step, config.loss) <= at.cost
        T_cam_obj = torch.where(better[:, None, None], T_next, T_cam_obj)
        from_prior = from_prior + torch.where(better[:, None], step, 0)
        damping = torch.where(better, damping * _DAMPING_DECAY, damping.clamp(min=_DAMPING_START) * _DAMPING_GROWTH)
    return replace(at, T_cam_obj=T_cam_obj, from_prior=from_prior)
