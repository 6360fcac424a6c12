"""Solutions with symmetric positive definite matrices, from their Cholesky factors."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core import host_sync


def solve_factored(right: Float[Tensor, "b n k"], factor: Float[Tensor, "b n n"]) -> Float[Tensor, "b n k"]:
    """The ``x`` of ``L Lᵀ x = right``, for lower triangular ``L``.

    On a GPU, :func:`torch.cholesky_solve` leaves several matrices to a library that waits, and that CUDA graphs cannot hold: there,
    two triangular systems are solved.
    """
    if not host_sync.on_gpu(right):
        return torch.cholesky_solve(right, factor)
    halfway = torch.linalg.solve_triangular(factor, right, upper=False)
    return torch.linalg.solve_triangular(factor.mT, halfway, upper=True)
