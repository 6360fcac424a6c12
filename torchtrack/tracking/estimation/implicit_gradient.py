"""Gradients of poses by all that they were found from, without a record of how they were found.

A solution is where the cost has no slope, and stays so when an input moves: by the implicit function theorem it follows
the input by ``dδ = -H⁻¹ ∂g``, with the cost's gradient ``g`` and its Hessian ``H`` at the optimum. That is one step of
Newton's method of which ``g`` alone is recorded. The Hessian has to be the exact one: Gauss-Newton's leaves out how the
robust loss bends and the projection curves, which at residuals of 2 px makes the gradients wrong by a quarter.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, is_dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import SolverConfig
from torchtrack.core import host_sync
from torchtrack.core.lie import small_difference_about, step_about
from torchtrack.core.linalg import solve_positive
from torchtrack.tracking.estimation.levenberg_marquardt import robust_cost
from torchtrack.tracking.estimation.terms import Linearisation, PoseProblem, WindowTerms

# Exact Newton steps from a solution to the optimum next to it, of which the gradient is: each squares the error. Not measured alone.
NEWTON_STEPS = 1
# Relative rounding of a cost in float64, with room for the length of its sum.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class _Place:
    """A place in the space of unknowns: a pose, and the further unknowns' offsets from the prior."""

    T_cam_obj: Float[Tensor, "b 4 4"]
    further: Float[Tensor, "b f"]

    def moved(self, step: Float[Tensor, "b k"], problem: PoseProblem) -> tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b k"]]:
        """The pose after a step in the solver's chart, and the offset of all unknowns from the prior there."""
        T_cam_obj = step_about(self.T_cam_obj, step[:, :6], problem.centre_obj)
        from_prior = small_difference_about(problem.T_prior, T_cam_obj, problem.centre_obj)
        return T_cam_obj, torch.cat([from_prior, self.further + step[:, 6:]], -1)


def with_gradient(problem: PoseProblem, solution: Linearisation, config: SolverConfig) -> Linearisation:
    """The same solution, differentiable by every tensor of its problem: the values stay to the last bit.

    The gradient is that of the optimum next to the solution, which a few exact Newton steps reach. Where there is none
    (no observations, a cost that is not finite or curves downwards), it is zero. Without anything to differentiate by, nothing is done.

    Args:
        problem: whose tensors may require gradients; its ``prior_information`` and ``weights`` too.
        solution: of :func:`torchtrack.tracking.estimation.levenberg_marquardt.solve_pose`.
        config: of the solver.
    """
    if not torch.is_grad_enabled() or not any(value.requires_grad for value in _tensors_of(problem)):
        return solution
    exact: PoseProblem = _in_double(problem)
    counted = _counted(exact)
    optimum_place = _Place(solution.T_cam_obj.detach().double(), solution.from_prior.detach().double()[:, 6:])
    optimum = _optimum(counted, optimum_place, config)
    step, _ = newton_step(exact, optimum.T_cam_obj, optimum.further, config.loss, counted)
    step = torch.where(torch.isfinite(solution.gradient), step, 0)
    T_cam_obj, from_prior = optimum_place.moved(step - step.detach(), exact)
    followed = (from_prior - from_prior.detach()).to(solution.from_prior.dtype)
    return replace(solution, T_cam_obj=T_cam_obj.to(solution.T_cam_obj.dtype), from_prior=solution.from_prior.detach() + followed)


def newton_step(
    problem: PoseProblem, T_cam_obj: Float[Tensor, "b 4 4"], further: Float[Tensor, "b f"], loss: str, bent_by: PoseProblem | None = None
) -> tuple[Float[Tensor, "b k"], Bool[Tensor, "b"]]:
    """One Newton step from a place, of which the gradient is recorded and the exact Hessian is not; zero where it is not one.

    Args:
        further: offset from the prior of what is unknown beside the pose; of no width without.
        bent_by: the same problem where it has fewer rows, for the Hessian.

    Returns:
        The step in the solver's chart, and where the Hessian is positive definite.
    """
    place = _Place(T_cam_obj, further)
    nothing = torch.zeros_like(problem.prior_information[..., 0])
    gradient = _gradient_of(problem, place, loss)
    with torch.no_grad():
        hessian = _rows_of_hessian(_gradient_of(bent_by or problem, place, loss), nothing)
    step, good = solve_positive(hessian, -gradient(nothing)[..., None])
    return step.squeeze(-1), good


def _gradient_of(problem: PoseProblem, place: _Place, loss: str) -> Callable[[Tensor], Tensor]:
    """The cost's gradient by the step from a place, as a function of the step."""

    def cost(step: Tensor) -> Tensor:
        return robust_cost(problem, *place.moved(step, problem), loss).sum()

    return torch.func.grad(cost)


def _rows_of_hessian(gradient: Callable[[Tensor], Tensor], at: Tensor) -> Float[Tensor, "b k k"]:
    """The Hessian of every element, from derivatives along each axis: elements do not touch each other."""
    along = torch.func.vjp(gradient, at)[1]
    axes = torch.eye(at.shape[-1], dtype=at.dtype, device=at.device)[:, None].expand(-1, *at.shape)
    return torch.func.vmap(along, out_dims=1)(axes)[0]


@torch.no_grad()
def _optimum(problem: PoseProblem, place: _Place, config: SolverConfig) -> _Place:
    """The optimum near a place: exact Newton steps, of which those that raise an object's cost are undone."""
    nothing = torch.zeros_like(problem.prior_information[..., 0])
    for _ in range(NEWTON_STEPS):
        step, _ = newton_step(problem, place.T_cam_obj, place.further, config.loss)
        T_next, from_prior = place.moved(step, problem)
        before = robust_cost(problem, *place.moved(nothing, problem), config.loss)
        # To rounding: near the optimum, costs no longer tell a better place from a worse one, but Newton steps still do.
        better = robust_cost(problem, T_next, from_prior, config.loss) <= before * (1 + _ROUNDING)
        T_cam_obj = torch.where(better[:, None, None], T_next, place.T_cam_obj)
        place = _Place(T_cam_obj, torch.where(better[:, None], from_prior[:, 6:], place.further))
    return place


def _tensors_of(part: object) -> Iterator[Tensor]:
    """All tensors of a problem, and of its terms."""
    if isinstance(part, Tensor):
        yield part
    elif is_dataclass(part):
        for value in vars(part).values():
            yield from _tensors_of(value)
    elif isinstance(part, tuple):
        for value in part:
            yield from _tensors_of(value)


def _in_double(part: Any) -> Any:
    """A problem in float64, its terms too, with zero in the place of what is not finite: padding may hold anything."""
    if isinstance(part, Tensor):
        return part.double().nan_to_num(0.0, 0.0, 0.0) if part.is_floating_point() else part
    if isinstance(part, tuple):
        return tuple(_in_double(value) for value in part)
    if is_dataclass(part) and not isinstance(part, type):
        return replace(part, **{name: _in_double(value) for name, value in vars(part).items()})
    return part


@torch.no_grad()
def _counted(problem: PoseProblem) -> PoseProblem:
    """The problem with those observations of contours alone that have a weight, as a constant: the rest neither draws nor bends."""
    counted = problem.weights != 0
    # On a GPU, which would have to be waited for to know how many these are, all of them.
    most = int(counted.sum(-1).max()) if host_sync.read_at_once(counted) else counted.shape[1]
    rows = problem.weights.abs().topk(max(most, 1)).indices

    def of_rows(part: PoseProblem | WindowTerms, names: tuple[str, ...]) -> dict[str, Any]:
        values = {name: getattr(part, name) for name in names}
        return {name: torch.take_along_dim(value, rows if value.dim() == 2 else rows[..., None], 1) for name, value in values.items()}

    window = None if problem.window is None else replace(problem.window, **of_rows(problem.window, ("age_s",)))
    return replace(problem, **of_rows(problem, ("points_obj", "targets", "directions", "weights")), window=window)
