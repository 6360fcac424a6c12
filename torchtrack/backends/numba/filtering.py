"""Small matrices of the filter: functions of :mod:`torchtrack.tracking.motion.model`, object by object."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.cholesky import factorise, solve
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.backends.numba.geometry import depth_of, inverse_depth
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import linalg
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking import initialization
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.state import TrackerState

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


class Moving(NamedTuple):
    """Objects of which it is asked how far they move, and the stream of each."""

    covariance: Array
    T_cam_obj: Array
    centre_obj: Array
    focal_px: Array
    diameter_m: Array
    stream_index: Array


@kernel()
def find_unknown_motion(objects: Moving, elapsed_us: Array, max_unknown_px: float, most_sigma_px: float, is_unknown: Array) -> None:
    """Objects that may move far in a window beside what is known: :func:`torchtrack.tracking.initialization.of_unknown_motion`.

    Args:
        elapsed_us: ``[s]``, the window's length.
        max_unknown_px, most_sigma_px: farther than that, and of those that are not known to be anywhere.
        is_unknown: ``[b]``, filled.
    """
    covariance, T_cam_obj, centre_obj, focal_px, diameter_m, stream_index = objects
    for b in range(len(covariance)):
        turning = moving = 0.0
        for k in range(3):
            turning += covariance[b, 6 + k, 6 + k] / 3.0
            moving += covariance[b, 9 + k, 9 + k] / 3.0
        place = 0.5 * (covariance[b, 3, 3] + covariance[b, 4, 4])
        px_per_m = focal_px[b] * inverse_depth(depth_of(T_cam_obj[b], centre_obj[b]))
        unknown_px = np.sqrt(moving + turning * (0.5 * diameter_m[b]) ** 2) * elapsed_us[stream_index[b]] * 1e-6 * px_per_m
        is_unknown[b] = unknown_px > max_unknown_px and np.sqrt(place) * px_per_m <= most_sigma_px


@accelerates(linalg.inverse)
def inverse_numba(matrices: Float[Tensor, "b k k"]) -> Float[Tensor, "b k k"]:
    """Matrix by matrix."""
    inverses = torch.empty_like(matrices, memory_format=torch.contiguous_format)
    invert(*as_arrays(matrices, inverses))
    return inverses


@accelerates(initialization.moves_unknown)
def moves_unknown_numba(state: TrackerState, t_us: Int[Tensor, "s"], objects: ObjectBatch, config: TrackerConfig) -> Bool[Tensor, "b"]:
    """Object by object."""
    is_unknown = torch.empty_like(objects.stream_index, dtype=torch.bool)
    own = objects.centre_obj, objects.intrinsics[:, 0], objects.diameter_m, objects.stream_index
    moving, elapsed_us = as_arrays(state.motion.covariance, state.T_cam_obj, *own), (t_us - state.t_us).numpy()
    find_unknown_motion(moving, elapsed_us, initialization.MAX_UNKNOWN_PX, config.relocalization.wide_sigma_px, is_unknown.numpy())
    return is_unknown
