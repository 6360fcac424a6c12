"""Small matrices of the filter: functions of :mod:`torchtrack.motion`, object by object."""

import numpy as np

from torchtrack.kernels.cholesky import factorise, solve
from torchtrack.kernels.compiler import Array, kernel
from torchtrack.kernels.motion import inverse_depth

# Variances are taken to be no less.
_LEAST = 1e-30


@kernel()
def invert(matrices: Array, inverses: Array) -> None:
    """Inverses of symmetric positive definite ``[b, k, k]``, taken with a unit diagonal; infinite on the diagonal where one is not."""
    size = matrices.shape[1]
    scale, scaled, factor, column = np.empty(size), np.empty((size, size)), np.empty((size, size)), np.empty(size)
    for b in range(len(matrices)):
        for j in range(size):
            scale[j] = 1.0 / np.sqrt(max(matrices[b, j, j], _LEAST))
        for j in range(size):
            for k in range(size):
                scaled[j, k] = matrices[b, j, k] * scale[j] * scale[k]
        good = factorise(scaled, factor)
        for j in range(size):
            column[:] = 0.0
            column[j] = 1.0
            if good:
                solve(factor, column)
            for k in range(size):
                inverses[b, k, j] = column[k] * scale[k] * scale[j] if good else (np.inf if k == j else 0.0)


@kernel()
def predict(covariance: Array, acceleration: Array, dt_s: Array, diameter_m: Array, most_uncertain: float, predicted: Array) -> None:
    """Covariance of pose and velocity after a while: :func:`torchtrack.motion.predict_covariance`.

    Args:
        covariance: ``[b, 12, 12]``.
        acceleration: ``[b, 6]``, standard deviation of it.
        most_uncertain: what would be less certain than this (rad, and diameters) is left as it is.
        predicted: filled.
    """
    for b in range(len(covariance)):
        P, new, dt = covariance[b], predicted[b], dt_s[b]
        for j in range(6):
            for k in range(6):
                both = P[j, 6 + k] + dt * P[6 + j, 6 + k]
                new[j, k] = P[j, k] + dt * P[6 + j, k] + dt * both
                new[j, 6 + k], new[6 + j, k] = both, P[6 + j, k] + dt * P[6 + j, 6 + k]
                new[6 + j, 6 + k] = P[6 + j, 6 + k]
            # An acceleration adds half its square of the time to the pose, and its time to the velocity.
            way, gain = 0.5 * dt * dt * acceleration[b, j], dt * acceleration[b, j]
            new[j, j] += way * way
            new[j, 6 + j] += way * gain
            new[6 + j, j] += way * gain
            new[6 + j, 6 + j] += gain * gain
        for j in range(6):
            if np.sqrt(new[j, j]) > most_uncertain * (1.0 if j < 3 else diameter_m[b]):
                new[:] = P
                break


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
        depth_m, turning, moving = np.float64(T_cam_obj[b, 2, 3]), 0.0, 0.0
        for k in range(3):
            depth_m += T_cam_obj[b, 2, k] * centre_obj[b, k]
            turning += covariance[b, 6 + k, 6 + k] / 3.0
            moving += covariance[b, 9 + k, 9 + k] / 3.0
        place = 0.5 * (covariance[b, 3, 3] + covariance[b, 4, 4])
        px_per_m = focal_px[b] * inverse_depth(depth_m)
        unknown_px[b] = np.sqrt(moving + turning * (0.5 * diameter_m[b]) ** 2) * window_s[b] * px_per_m
        sigma_px[b] = np.sqrt(place) * px_per_m
