"""Small matrices of the filter: functions of :mod:`torchtrack.motion`, object by object."""

import numpy as np

from torchtrack.kernels.cholesky import factorise, solve
from torchtrack.kernels.compiler import Array, kernel
from torchtrack.kernels.motion import depth_of, inverse_depth

# Variances are taken to be no less.
_LEAST = 1e-30


@kernel()
def invert(matrices: Array, inverses: Array) -> None:
    """Inverses of symmetric positive definite ``[b, k, k]``, taken with a unit diagonal; infinite on the diagonal where one is not."""
    for b in range(len(matrices)):
        inverse(matrices[b], inverses[b])


@kernel()
def inverse(matrix: Array, into: Array) -> None:
    """:func:`invert` of one matrix ``[k, k]``."""
    size = len(matrix)
    scale, scaled, factor, column = np.empty(size), np.empty((size, size)), np.empty((size, size)), np.empty(size)
    for j in range(size):
        scale[j] = 1.0 / np.sqrt(max(matrix[j, j], _LEAST))
    for j in range(size):
        for k in range(size):
            scaled[j, k] = matrix[j, k] * scale[j] * scale[k]
    good = factorise(scaled, factor)
    for j in range(size):
        column[:] = 0.0
        column[j] = 1.0
        if good:
            solve(factor, column)
        for k in range(size):
            into[k, j] = column[k] * scale[k] * scale[j] if good else (np.inf if k == j else 0.0)


@kernel()
def unknown_motion(
    covariance: Array, T_cam_obj: Array, centre_obj: Array, focal_px: Array, diameter_m: Array, window_s: Array, unknown_px: Array, sigma_px: Array
) -> None:
    """How far objects may move in a window beside what is known, and where they may be: of :mod:`torchtrack.window_parts` and ``speed_limit``.

    Args:
        covariance: ``[b, 12, 12]``.
        focal_px, diameter_m, window_s: ``[b]``.
        unknown_px, sigma_px: ``[b]``, filled.
    """
    for b in range(len(covariance)):
        turning = moving = 0.0
        for k in range(3):
            turning += covariance[b, 6 + k, 6 + k] / 3.0
            moving += covariance[b, 9 + k, 9 + k] / 3.0
        place = 0.5 * (covariance[b, 3, 3] + covariance[b, 4, 4])
        px_per_m = focal_px[b] * inverse_depth(depth_of(T_cam_obj[b], centre_obj[b]))
        unknown_px[b] = np.sqrt(moving + turning * (0.5 * diameter_m[b]) ** 2) * window_s[b] * px_per_m
        sigma_px[b] = np.sqrt(place) * px_per_m
