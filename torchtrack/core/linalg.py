"""Solutions with symmetric positive definite matrices, from their Cholesky factors."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.dispatch import accelerable


def solve_factored(right: Float[Tensor, "b n k"], factor: Float[Tensor, "b n n"]) -> Float[Tensor, "b n k"]:
    """The ``x`` of ``L Lᵀ x = right``, for lower triangular ``L``.

    On a GPU, :func:`torch.cholesky_solve` leaves several matrices to a library that waits, and that CUDA graphs cannot hold: there,
    two triangular systems are solved.
    """
    if not host_sync.on_gpu(right):
        return torch.cholesky_solve(right, factor)
    halfway = torch.linalg.solve_triangular(factor, right, upper=False)
    return torch.linalg.solve_triangular(factor.mT, halfway, upper=True)


@accelerable
def inverse(matrices: Float[Tensor, "b k k"]) -> Float[Tensor, "b k k"]:
    """Inverse of symmetric positive definite matrices; infinite on the diagonal where one is not.

    Taken with a unit diagonal: rotations and translations, poses and velocities differ by many orders of magnitude.
    """
    scale = matrices.diagonal(dim1=-2, dim2=-1).clamp(min=1e-30).rsqrt()
    scales = scale[:, :, None] * scale[:, None]
    factor, info = torch.linalg.cholesky_ex(matrices * scales)
    good, unknown = (info == 0)[:, None, None], torch.full_like(scale, torch.inf).diag_embed()
    eye = torch.eye(matrices.shape[-1], dtype=matrices.dtype, device=matrices.device).expand_as(matrices)
    return torch.where(good, solve_factored(eye, torch.where(good, factor, eye)) * scales, unknown)


def solve_positive(matrix: Float[Tensor, "b n n"], right: Float[Tensor, "b n k"]) -> tuple[Float[Tensor, "b n k"], Bool[Tensor, "b"]]:
    """Solve with symmetric positive definite matrices; where one is not, zero and False.

    Where gradients are recorded, the matrix is made sane and solved with again: masking alone would leave gradients that
    are not finite.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    solution = solve_factored(right, factor)
    # A sum is finite only where every entry is.
    good = (info == 0) & (solution.sum((-1, -2)).abs() < torch.inf)
    if solution.requires_grad:
        eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        factor = torch.linalg.cholesky_ex(torch.where(good[:, None, None], matrix, eye)).L
        solution = solve_factored(torch.where(good[:, None, None], right, 0), factor)
    return torch.where(good[:, None, None], solution, 0), good
