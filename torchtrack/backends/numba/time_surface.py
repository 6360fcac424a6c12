"""Newest times event by event, regions of objects contour by contour, and their surfaces pixel by pixel: :mod:`tracking.frontend.time_surface`."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import RegionArrays, as_arrays, region_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.core.dispatch import accelerates
from torchtrack.core.events import EventBatch, check_on_sensor, stream_bounds
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend import time_surface
from torchtrack.tracking.frontend.history import BORDER_PX
from torchtrack.tracking.frontend.sensors import Sensors
from torchtrack.tracking.frontend.time_surface import GRID_PX, Regions, regions_of


class Frame(NamedTuple):
    """How rectangles are laid: on a sensor of that size, whose table of pixels has a border, with a margin, and in whole steps of a grid (px)."""

    height: int
    width: int
    border_px: int
    margin_px: int
    grid_px: int


@kernel()
def around(pixels: Array, mask: Array, sensor_pixels: Array, frame: Frame, regions: RegionArrays) -> None:
    """Rectangles around contours: :func:`torchtrack.tracking.frontend.time_surface.object_regions`.

    Args:
        pixels, mask: ``[b, m, 2]`` and ``[b, m]``.
        sensor_pixels: ``[s, bh, bw, 2]``.
        regions: origin and extent are filled.
    """
    (origin, extent, stream_index), (height, width, border_px, margin_px, grid_px) = regions, frame
    last_row, last_column = sensor_pixels.shape[1] - 1, sensor_pixels.shape[2] - 1
    border = pixels.dtype.type(border_px)
    for b in range(len(pixels)):
        table, left, top, right, bottom = sensor_pixels[stream_index[b]], np.inf, np.inf, -np.inf, -np.inf
        for i in range(pixels.shape[1]):
            if not mask[b, i]:
                continue
            column = int(np.rint(min(max(pixels[b, i, 0] + border, 0.0), last_column)))
            row = int(np.rint(min(max(pixels[b, i, 1] + border, 0.0), last_row)))
            u, v = table[row, column, 0], table[row, column, 1]
            if 0 <= u <= width - 1 and 0 <= v <= height - 1:
                left, top, right, bottom = min(left, u), min(top, v), max(right, u), max(bottom, v)
        if left > right:
            left, top, right, bottom = 0.0, 0.0, 0.0, 0.0
        origin[b, 0] = (int(np.floor(left)) - margin_px) // grid_px * grid_px
        origin[b, 1] = (int(np.floor(top)) - margin_px) // grid_px * grid_px
        extent[b, 0], extent[b, 1] = int(np.ceil(right)) + margin_px - origin[b, 0] + 1, int(np.ceil(bottom)) + margin_px - origin[b, 1] + 1


@accelerates(Sensors.regions)
def regions_numba(sensors: Sensors, contours: Contours, margin_px: int) -> Regions:
    """Contour by contour."""
    origin, extent = torch.empty(len(contours.mask), 2, dtype=torch.int64), torch.empty(len(contours.mask), 2, dtype=torch.int64)
    regions = as_arrays(origin, extent, sensors.stream_index)
    around(*as_arrays(contours.pixels, contours.mask, sensors.sensor_pixels), (*sensors.image_size, BORDER_PX, margin_px, GRID_PX), regions)
    return regions_of(origin, extent, sensors.stream_index)


@kernel()
def newest(x: Array, y: Array, t_us: Array, bounds: Array, times_us: Array) -> bool:
    """Bring maps of newest times ``[s, h, w]`` up, if all events are on the sensor, and tell whether they are.

    Args:
        x, y, t_us: ``[e]``, one stream after the other; ``bounds [s + 1]``, where each begins, and where the last one ends.
    """
    right, bottom, end = np.uint32(0), np.uint32(0), bounds[len(times_us)]
    # Looked at before: several events at once, and none of the writes waits for it.
    for i in range(end):
        # Unsigned, a negative number is a large one.
        right, bottom = max(right, np.uint32(x[i])), max(bottom, np.uint32(y[i]))
    if end > 0 and not (right < times_us.shape[2] and bottom < times_us.shape[1]):
        return False
    width = np.uint32(times_us.shape[2])
    for s in range(len(times_us)):
        times = times_us[s].ravel()
        for i in range(np.uint64(bounds[s]), np.uint64(bounds[s + 1])):
            place = np.uint64(np.uint32(y[i]) * width + np.uint32(x[i]))
            times[place] = max(times[place], t_us[i])
    return True


@accelerates(time_surface.update_last_event)
def update_last_event_numba(last_event_us: Int[Tensor, "s h w"], events: EventBatch) -> Int[Tensor, "s h w"]:
    """One event after the other."""
    updated = last_event_us.clone(memory_format=torch.contiguous_format)
    if not newest(*as_arrays(events.x, events.y, events.t_us, stream_bounds(events, len(updated)), updated)):
        check_on_sensor(events, width=last_event_us.shape[2], height=last_event_us.shape[1])
    return updated


@kernel()
def decays(times_us: Array, t_us: Array, regions: RegionArrays, oldest_us: int, per_us: float, powers: Array) -> None:
    """Fill ``powers [b, rh, rw]`` with what each pixel decays by, as a power of e: minus infinity outside the sensor, and from an age on."""
    (origin, _, stream_index), (height, width) = regions, times_us.shape[1:]
    for b in range(len(powers)):
        power, times, now_us, (left, top) = powers[b], times_us[stream_index[b]], t_us[stream_index[b]], (origin[b, 0], origin[b, 1])
        first, end = min(max(-left, 0), power.shape[1]), max(min(width - left, power.shape[1]), 0)
        scale, never = power.dtype.type(per_us), power.dtype.type(-np.inf)
        for row in range(len(power)):
            power[row] = never
            if not 0 <= top + row < height or end <= first:
                continue
            own, of_row = power[row, first:end], times[top + row, left + first : left + end]
            for column in range(len(own)):
                age_us = now_us - of_row[column]
                # No branch: a processor would guess many of them wrong.
                own[column] = scale * power.dtype.type(max(age_us, 0)) if age_us < oldest_us else never


@accelerates(time_surface.time_surface)
def time_surface_numba(
    last_event_us: Int[Tensor, "s h w"], t_us: Int[Tensor, "s"], regions: Regions, tau_s: float, dtype: torch.dtype
) -> Float[Tensor, "b rh rw"]:
    """Pixel by pixel; the exponential of all at once, by NumPy, which takes a third of the time where many pixels never fired."""
    powers = torch.empty(len(regions.origin), *regions.size, dtype=dtype)
    decays(*as_arrays(last_event_us, t_us), region_arrays(regions), int(time_surface.MAX_DECAYS * tau_s * 1e6), -1e-6 / tau_s, powers.numpy())
    np.exp(powers.numpy(), out=powers.numpy())
    return powers
