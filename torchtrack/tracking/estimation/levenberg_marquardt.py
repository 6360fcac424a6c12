"""From matches to the pose: batched Levenberg-Marquardt on SE(3) (Eq. 12-17). The one solver loop of the package.

It knows no term of the cost by name: it adds up what :mod:`torchtrack.tracking.estimation.terms` give, in their order.
The unknown of each object is a rotation about its centre and a move of its centre, in the camera's axes
(:func:`torchtrack.core.lie.turned`). The step is ``Δξ = -(JᵀWJ + Λ + λD)⁻¹ (JᵀWr + Λδ)``: the minus signs of the
paper's Eq. 16 and 17 cancel, which cannot be meant.
"""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import SolverConfig
from torchtrack.core import host_sync
from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerable
from torchtrack.core.field_values import field_values
from torchtrack.core.lie import small_difference_about
from torchtrack.core.linalg import solve_factored, solve_positive
from torchtrack.tracking.estimation.robust_loss import robust_loss, robust_weight
from torchtrack.tracking.estimation.terms import CostTerm, Linearisation, LinearisedTerm, Place, PoseProblem

# Damping after the first rejected step, and how it grows and shrinks (Nielsen's simple rule).
DAMPING_START, DAMPING_GROWTH, DAMPING_DECAY = 1e-4, 10.0, 0.1


# What is added to a Hessian's diagonal beside its damping: so much, and this share of its largest entry.
LEAST_DIAGONAL, _LEAST_SHARE = 1e-12, 1e-9


# Unknowns of a pose alone. With those of a window and the residual there are 13 rows: a CPU takes half the time for products of 16.
_POSE, _PADDED_ROWS = 6, 16


# A cost, which is a long sum, is known to this many units of rounding.
ROUNDINGS = 8


def robust_cost(problem: PoseProblem, T_cam_obj: Float[Tensor, "b 4 4"], from_prior: Float[Tensor, "b k"], loss: str) -> Float[Tensor, "b"]:
    """Robust cost of ``problem`` at a pose, and at an offset of all unknowns from the prior (Eq. 12)."""
    place = Place.at(T_cam_obj, problem.centre_obj, from_prior)
    return _sum([_cost(term.linearise(place), loss) for term in problem.terms()])


def offset_from_prior(problem: PoseProblem, T_cam_obj: Tensor) -> Tensor:
    """Offset of a pose from the prior; whatever else is unknown is as predicted."""
    moved = small_difference_about(problem.T_prior, T_cam_obj, problem.centre_obj)
    return torch.nn.functional.pad(moved, (0, problem.prior_information.shape[-1] - moved.shape[-1]))


def _cost(term: LinearisedTerm, loss: str, robust: Tensor | None = None) -> Float[Tensor, "b"]:
    """A term's part of the robust cost, with the ``robust`` weight of each residual where that is known."""
    if term.rows is None:
        return 0.5 * torch.linalg.vecdot(term.residuals, _pull(term))
    loss_of_each = 0.5 * term.residuals.square() if term.scale is None else robust_loss(term.residuals, term.scale, loss, robust)
    return torch.linalg.vecdot(loss_of_each, term.weights)


def _pull(term: LinearisedTerm) -> Float[Tensor, "b k"]:
    """Gradient of the cost of a term whose residuals are the unknowns' offsets."""
    return torch.bmm(term.weights, term.residuals[..., None])[..., 0]


def _robust(term: LinearisedTerm, loss: str) -> Float[Tensor, "b n"] | None:
    """Robust weight of each residual; None where squares count as they are."""
    return None if term.scale is None else robust_weight(term.residuals, term.scale, loss)


def _normal_equations(term: LinearisedTerm, unknowns: int, robust: Tensor | None) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k k"]]:
    """Gradient of a term's cost, and its Gauss-Newton Hessian, with the ``robust`` weight of each residual."""
    if term.rows is None:
        return _pull(term), term.weights
    batch, given, count = term.rows.shape
    # By what a term leaves out, it does not change.
    unmoved = term.rows.new_zeros(batch, unknowns - given, count)
    padding = term.rows.new_zeros(batch, max(_PADDED_ROWS - unknowns - 1, 0) if unknowns > _POSE else 0, count)
    # The residuals follow the rows: both in one product.
    rows = torch.cat([term.rows, unmoved, term.residuals[:, None], padding], 1)
    weights = term.weights if robust is None else robust * term.weights
    product = torch.bmm(rows * weights[:, None], rows.transpose(1, 2))[:, :unknowns]
    return product[..., unknowns], product[..., :unknowns]


def _sum(parts: Sequence[Tensor]) -> Tensor:
    """What all terms come to, in their order."""
    total, *further = parts
    for part in further:
        total = total + part
    return total


def least_share(hessian: Tensor) -> float:
    """Share of the largest entry that is added to a diagonal.

    It keeps directions that nothing observes solvable: their step is zero, as their gradient is, but for rounding. Poses alone
    may have no prior that holds them: then it has to be above that.
    """
    return max(_LEAST_SHARE, torch.finfo(hessian.dtype).eps) if hessian.shape[-1] == _POSE else _LEAST_SHARE


def _damped(hessian: Tensor, damping: Tensor) -> Tensor:
    """The Hessian, damped along its diagonal."""
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    floor = torch.add(
        constant((LEAST_DIAGONAL,), hessian.dtype, hessian.device), diagonal[:, :_POSE].amax(-1, keepdim=True), alpha=least_share(hessian)
    )
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
    terms = problem.terms()
    damping = torch.full_like(problem.scale_px, config.damping)
    place = Place.at(T_start, problem.centre_obj, from_prior)
    gradient, hessian, cost = _look(terms, place, config.loss, judged=config.iterations > 1)
    for _ in range(config.iterations - 1):
        next_place = place.moved(_judged_step(gradient, hessian, damping))
        *next_equations, next_cost = _look(terms, next_place, config.loss, judged=True)
        # Near the optimum, rounding must not decide.
        better = next_cost <= cost * (1 + ROUNDINGS * torch.finfo(cost.dtype).eps)
        damping = torch.where(better, damping * DAMPING_DECAY, damping.clamp(min=DAMPING_START) * DAMPING_GROWTH)
        new, old = (
            (*field_values(at).values(), *rest) for at, rest in ((next_place, (*next_equations, next_cost)), (place, (gradient, hessian, cost)))
        )
        *where, gradient, hessian, cost = _choose(better, new, old)
        place = Place(*where)
    last_place = place.moved(_last_step(gradient, hessian, damping))
    return Linearisation(last_place.pose(problem), gradient, hessian, last_place.from_prior)


def _look(terms: Sequence[CostTerm], place: Place, loss: str, *, judged: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient and Hessian at a place, and the cost there, where a step is going to be judged by it."""
    seen = [term.linearise(place) for term in terms]
    robust = [_robust(term, loss) for term in seen]
    gradients, hessians = zip(
        *(_normal_equations(term, place.from_prior.shape[-1], weight) for term, weight in zip(seen, robust, strict=True)), strict=True
    )
    gradient = _sum(gradients)
    cost = _sum([_cost(term, loss, weight) for term, weight in zip(seen, robust, strict=True)]) if judged else gradient[:, 0]
    return gradient, _sum(hessians), cost


def _choose(first: Tensor, of_first: Iterable[Tensor], of_second: Iterable[Tensor]) -> Iterable[Tensor]:
    """One of two values for each object."""
    if host_sync.read_at_once(first) and bool(first.all()):
        # As it mostly is.
        return of_first
    return [torch.where(first.view(-1, *[1] * (a.dim() - 1)), a, b) for a, b in zip(of_first, of_second, strict=True)]
