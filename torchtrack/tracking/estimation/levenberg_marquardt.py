"""From matches to the pose: batched Levenberg-Marquardt on SE(3) (Eq. 12-17). The one solver loop of the package.

The unknown of each object is a rotation about its centre and a move of its centre, in the camera's axes
(:func:`torchtrack.core.lie.turned`). The step is ``Δξ = -(JᵀWJ + Λ + λD)⁻¹ (JᵀWr + Λδ)``: the minus signs of the
paper's Eq. 16 and 17 cancel, which cannot be meant.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import SolverConfig
from torchtrack.core import host_sync
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerable
from torchtrack.core.image_velocity import pose_jacobian
from torchtrack.core.lie import affine, small_difference_about, turned
from torchtrack.core.linalg import solve_factored, solve_positive
from torchtrack.tracking.estimation.robust_loss import robust_loss, robust_weight
from torchtrack.tracking.estimation.terms import Linearisation, PoseProblem, WindowTerms

# Damping after the first rejected step, and how it grows and shrinks (Nielsen's simple rule).
DAMPING_START, DAMPING_GROWTH, DAMPING_DECAY = 1e-4, 10.0, 0.1


# What is added to a Hessian's diagonal beside its damping: so much, and this share of its largest entry.
LEAST_DIAGONAL, _LEAST_SHARE = 1e-12, 1e-9


# A cost, which is a long sum, is known to this many units of rounding.
ROUNDINGS = 8


@dataclass(frozen=True)
class _Rows:
    """A problem laid out for speed: a row per component, so that every operation runs along contiguous observations.

    ``arms`` are the points as seen from the object's centre, ``slope`` is the direction times the focal lengths, and
    ``offset`` the target's place along the direction: the residual is ``slope · (x/z, y/z) - offset``.
    ``padding`` makes up for the 16 rows whose products a CPU takes in half the time of those of 14.
    """

    arms: Float[Tensor, "b 3 n"]
    slope: Float[Tensor, "b 2 n"]
    offset: Float[Tensor, "b n"]
    padding: Float[Tensor, "b 2 n"]


def _as_rows(problem: PoseProblem) -> _Rows:
    """The constant parts of a problem, laid out by component."""
    directions = problem.directions.transpose(1, 2)
    focal, principal = problem.intrinsics[:, :2, None], problem.intrinsics[:, 2:, None]
    offset = ((problem.targets.transpose(1, 2) - principal) * directions).sum(1)
    arms = (problem.points_obj.transpose(1, 2) - problem.centre_obj[..., None]).contiguous()
    slope = directions * focal
    return _Rows(arms, slope, offset, torch.zeros_like(slope))


@dataclass(frozen=True)
class _Place:
    """A place in the space of unknowns: the pose as a rotation and the place of the centre, and the offset from the prior."""

    rotation: Float[Tensor, "b 3 3"]
    centre_cam: Float[Tensor, "b 3 1"]
    from_prior: Float[Tensor, "b k"]

    @classmethod
    def of(cls, problem: PoseProblem, T_cam_obj: Tensor, from_prior: Tensor) -> "_Place":
        """The place of a pose."""
        rotation = T_cam_obj[:, :3, :3]
        return cls(rotation, affine(rotation, problem.centre_obj[..., None], T_cam_obj[:, :3, 3:]), from_prior)

    def moved(self, step: Float[Tensor, "b k"]) -> "_Place":
        """The place that a step leads to: steps add up to the offset from the prior, to second order."""
        return _Place(turned(self.rotation, step[:, :3]), self.centre_cam + step[:, 3:6, None], self.from_prior + step)

    def pose(self, problem: PoseProblem) -> Float[Tensor, "b 4 4"]:
        """The pose as a matrix."""
        translation = torch.baddbmm(self.centre_cam, self.rotation, problem.centre_obj[..., None], alpha=-1)
        return torch.cat([torch.cat([self.rotation, translation], 2), problem.T_prior[:, 3:]], 1)


@dataclass(frozen=True)
class _Seen:
    """The matched points as a pose shows them: residuals (px), and rows of their Jacobian by all unknowns, of them again, and of padding."""

    residuals: Float[Tensor, "b n"]
    rows: Float[Tensor, "b k n"]


def _see(problem: PoseProblem, rows: _Rows, place: _Place) -> _Seen:
    """Project the matched points, and take residuals and gradients ``g = dπᵀ n`` of them."""
    arms = affine(place.rotation, rows.arms)
    x, y, z = (arms + place.centre_cam).unbind(1)
    inverse_depth = z.clamp(min=MIN_DEPTH_M).reciprocal()
    gx, gy = (rows.slope * inverse_depth[:, None]).unbind(1)
    along = torch.addcmul(gx * x, gy, y)
    jacobian = pose_jacobian(arms, (gx, gy, (along * inverse_depth).neg_()))
    residuals = (along - rows.offset)[:, None]
    if problem.window is None:
        return _Seen(residuals[:, 0], torch.cat([jacobian, residuals], 1))
    # Linear in all that is unknown beside the pose; the targets have been moved with one velocity already.
    further = torch.cat([jacobian * _ways_s(problem.window), problem.window.outward[:, None]], 1)
    beside = place.from_prior[:, None, 6:] - torch.nn.functional.pad(problem.window.velocity, (0, 1))[:, None]
    residuals = torch.baddbmm(residuals, beside, further)
    return _Seen(residuals[:, 0], torch.cat([jacobian, further, residuals, rows.padding], 1))


def _ways_s(window: WindowTerms) -> Float[Tensor, "b 6 n"]:
    """How far an observation was from where it is at the pose, for each unit of velocity beyond the predicted one (s)."""
    age_s = window.age_s[:, None]
    return torch.addcmul(-age_s, age_s.square(), window.rate_hz[..., None], value=0.5)


def robust_cost(problem: PoseProblem, T_cam_obj: Float[Tensor, "b 4 4"], from_prior: Float[Tensor, "b k"], loss: str) -> Float[Tensor, "b"]:
    """Robust cost of ``problem`` at a pose, and at an offset of all unknowns from the prior (Eq. 12)."""
    seen = _see(problem, _as_rows(problem), _Place.of(problem, T_cam_obj, from_prior))
    return _cost(problem, robust_loss(seen.residuals, problem.scale_px, loss), from_prior, _pull(problem, from_prior))


def offset_from_prior(problem: PoseProblem, T_cam_obj: Tensor) -> Tensor:
    """Offset of a pose from the prior; whatever else is unknown is as predicted."""
    moved = small_difference_about(problem.T_prior, T_cam_obj, problem.centre_obj)
    return torch.nn.functional.pad(moved, (0, problem.prior_information.shape[-1] - moved.shape[-1]))


def _pull(problem: PoseProblem, from_prior: Tensor) -> Tensor:
    """Gradient of the prior's part of the cost."""
    return torch.bmm(problem.prior_information, from_prior[..., None])[..., 0]


def _cost(problem: PoseProblem, loss_of_each: Tensor, from_prior: Tensor, pull: Tensor) -> Tensor:
    """Robust cost of each object, prior included."""
    return torch.add(torch.linalg.vecdot(loss_of_each, problem.weights), torch.linalg.vecdot(from_prior, pull), alpha=0.5)


def _normal_equations(problem: PoseProblem, seen: _Seen, robust: Tensor, pull: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient of the cost, and its Gauss-Newton Hessian, with the ``robust`` weight of each residual."""
    unknowns = pull.shape[-1]
    # The residuals are the last row: both in one product.
    product = torch.bmm(seen.rows * (robust * problem.weights)[:, None], seen.rows.transpose(1, 2))[:, :unknowns]
    return pull + product[..., unknowns], problem.prior_information + product[..., :unknowns]


def least_share(hessian: Tensor) -> float:
    """Share of the largest entry that is added to a diagonal.

    It keeps directions that nothing observes solvable: their step is zero, as their gradient is, but for rounding. Poses alone
    may have no prior that holds them: then it has to be above that.
    """
    return max(_LEAST_SHARE, torch.finfo(hessian.dtype).eps) if hessian.shape[-1] == 6 else _LEAST_SHARE


def _damped(hessian: Tensor, damping: Tensor) -> Tensor:
    """The Hessian, damped along its diagonal."""
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    floor = torch.add(constant((LEAST_DIAGONAL,), hessian.dtype, hessian.device), diagonal[:, :6].amax(-1, keepdim=True), alpha=least_share(hessian))
    damped = hessian.clone()
    damped.diagonal(dim1=-2, dim2=-1).add_(torch.addcmul(floor, diagonal, damping[:, None]))
    return damped


def _judged_step(gradient: Tensor, hessian: Tensor, damping: Tensor) -> Tensor:
    """The Levenberg-Marquardt step; wrong where the Hessian is not positive definite, which its cost will show."""
    return -solve_factored(gradient[..., None], torch.linalg.cholesky_ex(_damped(hessian, damping)).L)[..., 0]


def _last_step(gradient: Tensor, hessian: Tensor, damping: Tensor) -> Tensor:
    """The Levenberg-Marquardt step; none where the Hessian is not positive definite."""
    return -solve_positive(_damped(hessian, damping), gradient[..., None])[0][..., 0]


@torch.no_grad()
@accelerable
def solve_pose(
    problem: PoseProblem, T_start: Float[Tensor, "b 4 4"], config: SolverConfig, from_prior: Float[Tensor, "b k"] | None = None
) -> Linearisation:
    """Minimise each object's cost from ``T_start``: Levenberg-Marquardt with a damping of its own per object.

    The next linearisation judges a step: where the cost rose, the object goes back and its damping is raised; its
    neighbours are not affected. The last step is not judged: what comes after it, another round of matches or the test of
    the pose's quality, does so with more than the cost.

    Nothing is recorded: :mod:`torchtrack.tracking.estimation.implicit_gradient` gives gradients of the solution.

    Args:
        from_prior: offset of ``T_start`` from the prior's pose, where it is known.

    Returns:
        The last linearisation, with the pose that its step led to.
    """
    if from_prior is None:
        from_prior = offset_from_prior(problem, T_start)
    rows = _as_rows(problem)
    damping = torch.full_like(problem.scale_px, config.damping)
    place = _Place.of(problem, T_start, from_prior)
    gradient, hessian, cost = _look(problem, rows, place, config.loss, judged=config.iterations > 1)
    for _ in range(config.iterations - 1):
        next_place = place.moved(_judged_step(gradient, hessian, damping))
        *next_equations, next_cost = _look(problem, rows, next_place, config.loss, judged=True)
        # Near the optimum, rounding must not decide.
        better = next_cost <= cost * (1 + ROUNDINGS * torch.finfo(cost.dtype).eps)
        damping = torch.where(better, damping * DAMPING_DECAY, damping.clamp(min=DAMPING_START) * DAMPING_GROWTH)
        new, old = ((*vars(at).values(), *rest) for at, rest in ((next_place, (*next_equations, next_cost)), (place, (gradient, hessian, cost))))
        *where, gradient, hessian, cost = _choose(better, new, old)
        place = _Place(*where)
    found = place.moved(_last_step(gradient, hessian, damping))
    return Linearisation(found.pose(problem), gradient, hessian, found.from_prior)


def _look(problem: PoseProblem, rows: _Rows, place: _Place, loss: str, *, judged: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient and Hessian at a place, and the cost there, where a step is going to be judged by it."""
    seen = _see(problem, rows, place)
    robust, pull = robust_weight(seen.residuals, problem.scale_px, loss), _pull(problem, place.from_prior)
    cost = _cost(problem, robust_loss(seen.residuals, problem.scale_px, loss, robust), place.from_prior, pull) if judged else problem.scale_px
    return *_normal_equations(problem, seen, robust, pull), cost


def _choose(first: Tensor, of_first: Iterable[Tensor], of_second: Iterable[Tensor]) -> Iterable[Tensor]:
    """One of two values for each object."""
    if host_sync.read_at_once(first) and bool(first.all()):
        # As it mostly is.
        return of_first
    return [torch.where(first.view(-1, *[1] * (a.dim() - 1)), a, b) for a, b in zip(of_first, of_second, strict=True)]
