"""Corners cell by cell: :func:`torchtrack.tracking.frontend.corners.detect_corners`."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import RegionArrays, as_arrays, region_arrays
from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.backends.numba.corner_response import corner_responses
from torchtrack.backends.numba.parameters import CornerSettings
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.frontend import corners as reference
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.frontend.sensor_view import SensorView
from torchtrack.tracking.frontend.time_surface import Regions


class Surfaces(NamedTuple):
    """Surfaces and their responses, ``[b, h, w]``, and what a surface is above at pixels that may be corners, ``[s]``."""

    values: Array
    responses: Array
    least: Array


class Maps(NamedTuple):
    """Ends of the windows ``[s]``, newest events ``[s, h, w]``, bursts ``[s, 2, h, w]``, and tables of undistortion ``[s, h, w, 2]``."""

    t_us: Array
    newest_us: Array
    bursts: Array
    ideal_pixels: Array


class CornerArrays(NamedTuple):
    """Corners: pixels on the sensor and ideal ones ``[b, n, 2]``, ages (s), mask and polarity ``[b, n]``."""

    pixels: Array
    ideal: Array
    age_s: Array
    mask: Array
    polarity: Array


@kernel()
def choose(surfaces: Surfaces, regions: RegionArrays, maps: Maps, settings: CornerSettings, corners: CornerArrays) -> None:
    """Choose the corners of each object, in the order of their cells.

    Args:
        corners: zero so far; filled from the front.
    """
    (values, responses, least), (origin, extent, stream_index), (now_us, newest, bursts, ideal_pixels) = surfaces, regions, maps
    pixels, ideal, ages_s, mask, polarity = corners
    cells = (responses.shape[1] // settings.cell_px) * (responses.shape[2] // settings.cell_px)
    best, places = np.empty(cells, responses.dtype), np.empty((cells, 2), np.int32)
    for b in range(len(responses)):
        response, stream = responses[b], stream_index[b]
        _keep_own(response, values[b], least[stream], extent[b], settings.reach_px)
        count = _best_of_cells(response, settings, best, places)
        chosen, newest_us = 0, newest[stream]
        for i in range(count):
            row, column = places[i, 0], places[i, 1]
            u, v = column + origin[b, 0], row + origin[b, 1]
            on_sensor = 0 <= u < newest_us.shape[1] and 0 <= v < newest_us.shape[0]
            if not on_sensor or not _is_largest(response, row, column, best[i], settings):
                continue
            u, v = _newest_around(newest_us, u, v, settings.snap_px)
            pixels[b, chosen, 0], pixels[b, chosen, 1], mask[b, chosen] = u, v, True
            ideal[b, chosen, 0], ideal[b, chosen, 1] = ideal_pixels[stream, v, u, 0], ideal_pixels[stream, v, u, 1]
            ages_s[b, chosen] = min(max(now_us[stream] - newest_us[v, u], 0), settings.oldest_us) * 1e-6
            polarity[b, chosen] = 1 if bursts[stream, 1, v, u] < bursts[stream, 0, v, u] else -1
            chosen += 1


@kernel()
def _keep_own(response: Array, surface: Array, least: float, extent: Array, reach: int) -> None:
    """Make the response zero where it depends on what lies outside the object's own region, and where the surface is too old."""
    height, width = response.shape
    first_u, end_u = min(reach, width), min(extent[0] - reach, width)
    for v in range(height):
        of_row, ages = response[v], surface[v]
        if not reach <= v < extent[1] - reach or end_u <= first_u:
            of_row[:] = 0
            continue
        of_row[:first_u], of_row[end_u:] = 0, 0
        own, ages = of_row[first_u:end_u], ages[first_u:end_u]
        for u in range(len(own)):
            own[u] = own[u] if ages[u] > least else 0


@kernel()
def _best_of_cells(response: Array, settings: CornerSettings, best: Array, places: Array) -> int:
    """Fill in the largest response of each cell, and where it is, of cells that are strong enough, and of no more than asked for: how many."""
    cell, largest, count = settings.cell_px, response.dtype.type(0), 0
    columns, nothing = response.shape[1] // cell, response.dtype.type(0)
    of_row, at = np.empty(columns, response.dtype), np.empty((columns, 2), np.int32)
    for row in range(response.shape[0] // cell):
        of_row[:] = nothing
        for v in range(row * cell, row * cell + cell):
            values = response[v]
            for u in range(columns * cell):
                if values[u] > nothing and values[u] > of_row[u // cell]:
                    of_row[u // cell], at[u // cell, 0], at[u // cell, 1] = values[u], v, u
        for column in range(columns):
            if of_row[column] > nothing:
                best[count], places[count, 0], places[count, 1] = of_row[column], at[column, 0], at[column, 1]
                largest, count = max(largest, of_row[column]), count + 1
    bound, kept = response.dtype.type(settings.relative_threshold) * largest, 0
    if count > settings.most:
        bound = max(bound, -np.partition(-best[:count], settings.most)[settings.most])
    for i in range(count):
        if best[i] > bound:
            best[kept], places[kept], kept = best[i], places[i], kept + 1
    return kept


@kernel()
def _is_largest(response: Array, row: int, column: int, value: float, settings: CornerSettings) -> bool:
    """Whether no response around is larger, where cells are smaller than that neighbourhood."""
    reach = settings.largest_of_px // 2 if settings.cell_px >= settings.largest_of_px else 0
    for v in range(max(row - reach, 0), min(row + reach + 1, response.shape[0])):
        for u in range(max(column - reach, 0), min(column + reach + 1, response.shape[1])):
            if response[v, u] > value:
                return False
    return True


@kernel()
def _newest_around(newest_us: Array, u: int, v: int, reach: int) -> tuple[int, int]:
    """The pixel with the newest event so near; the first of several, row by row."""
    best_u, best_v = max(u - reach, 0), max(v - reach, 0)
    for row in range(best_v, min(v + reach + 1, newest_us.shape[0])):
        for column in range(max(u - reach, 0), min(u + reach + 1, newest_us.shape[1])):
            if newest_us[row, column] > newest_us[best_v, best_u]:
                best_u, best_v = column, row
    return best_u, best_v


@accelerates(reference.detect_corners)
def detect_corners_numba(
    surface: Float[Tensor, "b h w"], regions: Regions, view: SensorView, window_s: Float[Tensor, "s"], config: TrackerConfig
) -> Corners:
    """The response row by row, the rest cell by cell."""
    (batch, height, width), cell, maps = surface.shape, config.corners.cell_px, view.maps
    count = min(config.corners.max_corners, (height // cell) * (width // cell))
    snap_px = reference.SNAP_PX if config.uses(Component.CORNER_SNAP) else 0
    settings = filled(CornerSettings, reference, cell_px=cell, most=count, snap_px=snap_px)
    # Of no surface is anything as little as that.
    oldest = torch.exp(window_s / -config.surface.tau_s) if config.uses(Component.FRESH_CORNERS) else torch.full_like(window_s, -1.0)
    values, responses = surface.contiguous(), torch.empty(surface.shape, dtype=surface.dtype)
    corner_responses(*as_arrays(values, responses))
    pixels, ideal = torch.zeros(batch, count, 2, dtype=torch.int64), view.ideal_pixels.new_zeros(batch, count, 2)
    age_s, polarity, mask = surface.new_zeros(batch, count), surface.new_zeros(batch, count), torch.zeros(batch, count, dtype=torch.bool)
    of_maps = as_arrays(view.t_us, maps.last_event_us, maps.burst_age_us, view.ideal_pixels)
    filled_in = as_arrays(pixels, ideal, age_s, mask, polarity)
    choose(as_arrays(values, responses, oldest), region_arrays(regions), of_maps, settings, filled_in)
    return Corners(pixels, ideal, age_s, mask, torch.zeros_like(ideal), torch.zeros_like(mask), polarity)
