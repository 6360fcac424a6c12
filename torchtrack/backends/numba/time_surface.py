"""The time surface pixel by pixel: :func:`torchtrack.tracking.frontend.time_surface.time_surface`."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.frontend import time_surface
from torchtrack.tracking.frontend.time_surface import Regions


@kernel()
def decays(times_us: Array, t_us: Array, origin: Array, stream_index: Array, oldest_us: int, per_us: float, powers: Array) -> None:
    """Fill ``powers [b, rh, rw]`` with what each pixel decays by, as a power of e: minus infinity outside the sensor, and from an age on."""
    height, width = times_us.shape[1:]
    for b in range(len(powers)):
        power, times, now_us, (left, top) = powers[b], times_us[stream_index[b]], t_us[stream_index[b]], (origin[b, 0], origin[b, 1])
        first, end = min(max(-left, 0), power.shape[1]), max(min(width - left, power.shape[1]), 0)
        scale, never = power.dtype.type(per_us), power.dtype.type(-np.inf)
        for row in range(len(power)):
            own = power[row]
            own[:] = never
            if not 0 <= top + row < height:
                continue
            of_row = times[top + row]
            for column in range(first, end):
                age_us = now_us - of_row[left + column]
                # No branch: a processor would guess many of them wrong.
                own[column] = scale * power.dtype.type(max(age_us, 0)) if age_us < oldest_us else never


@accelerates(time_surface.time_surface)
def time_surface_numba(
    last_event_us: Int[Tensor, "s h w"], t_us: Int[Tensor, "s"], regions: Regions, tau_s: float, dtype: torch.dtype
) -> Float[Tensor, "b rh rw"]:
    """Pixel by pixel; the exponential of all at once."""
    powers = torch.empty(len(regions.origin), *regions.size, dtype=dtype)
    arrays = as_arrays(last_event_us, t_us, regions.origin, regions.stream_index)
    decays(*arrays, int(time_surface.MAX_DECAYS * tau_s * 1e6), -1e-6 / tau_s, powers.numpy())
    return powers.exp_()
