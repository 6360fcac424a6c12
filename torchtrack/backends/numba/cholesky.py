"""Cholesky's factors of small matrices, and what is solved with them."""

import numpy as np

from torchtrack.backends.numba.compiler import Array, kernel


@kernel()
def factorise(matrix: Array, factor: Array) -> bool:
    """The lower factor of a symmetric matrix ``[k, k]``; whether there is one, as it is positive definite."""
    for j in range(len(matrix)):
        for k in range(j + 1):
            total = matrix[j, k]
            for m in range(k):
                total -= factor[j, m] * factor[k, m]
            if j > k:
                factor[j, k] = total / factor[k, k]
            elif total > 0:
                factor[j, j] = np.sqrt(total)
            else:
                return False
    return True


@kernel()
def solve(factor: Array, values: Array) -> None:
    """Solve with the matrix of a factor, in place: ``values [k]`` become the solution."""
    size = len(values)
    for j in range(size):
        for m in range(j):
            values[j] -= factor[j, m] * values[m]
        values[j] /= factor[j, j]
    for j in range(size - 1, -1, -1):
        for m in range(j + 1, size):
            values[j] -= factor[m, j] * values[m]
        values[j] /= factor[j, j]
