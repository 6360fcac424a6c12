"""Arrival flow pixel by pixel: :func:`torchtrack.tracking.frontend.arrival_flow.arrival_flow`."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.backends.filling import filled
from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.parameters import ArrivalSettings
from torchtrack.config.tracker import FlowConfig
from torchtrack.core.constants import disc
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.frontend import arrival_flow, bursts
from torchtrack.tracking.frontend.sensor_view import SensorPoints, SensorView

# Pixels whose planes are fitted side by side, and of the pixels around them so many at once: a compiler takes several fits in one step, and their
# sums stay near. Indices are unsigned, or it would look whether each is negative: four times slower.
LANES, AT_ONCE = np.uint64(16), np.uint64(6)
# What is known of each fit, in rows of that length.
_ROWS = 17
_TOTAL, _X, _Y, _T, _XX, _XY, _YY, _XT, _YT, _A, _B, _C, _DETERMINANT, _SPREAD, _ABSOLUTE, _SQUARE, _USED = (
    np.uint64(row) * LANES for row in range(_ROWS)
)


class PointArrays(NamedTuple):
    """Pixels that flow is asked for at, ``[b, n, 2]``; polarities, where known, and which exist: ``[b, n]``."""

    pixels: Array
    polarity: Array
    mask: Array


class SensorArrays(NamedTuple):
    """What sensors of a size know: ages of bursts ``[s, 2, h*w]``, pixels without distortion ``[s, h*w*2]``; and the stream of each object."""

    size: tuple[int, int]
    ages_us: Array
    ideal_pixels: Array
    stream_index: Array


class Fitted(NamedTuple):
    """What planes are fitted to, in rows of :data:`LANES`: offsets (px), times (s), 1 for those that take part, and weights."""

    x: Array
    y: Array
    times_s: Array
    counts: Array
    weights: Array


class Around(NamedTuple):
    """The pixels around another one: how far each is from it, ``[k]``, and which of them are on the sensor."""

    steps: Array
    inside: Array


class Offsets(NamedTuple):
    """Where offsets of pixels, and how much later the edge came there (µs), are written, every :data:`LANES`-th place."""

    x: Array
    y: Array
    later_us: Array


@kernel(fastmath=FAST)
def flow_at(points: PointArrays, sensors: SensorArrays, around: Array, settings: ArrivalSettings, flow: Array, valid: Array) -> None:
    """Fill ``flow [b, n, 2]`` and ``valid [b, n]``, which are zero so far.

    Args:
        around: ``[2, k]``, offsets of the pixels that take part.
    """
    (pixels, polarity, mask), ((height, width), ages_us, ideal_pixels, stream_index), count = points, sensors, around.shape[1]
    places = -(-count // int(AT_ONCE)) * int(AT_ONCE * LANES)
    dtype, later_us = ideal_pixels.dtype, np.full(places, settings.long_ago_us, np.int32)
    fitted = Fitted(np.zeros(places, dtype), np.zeros(places, dtype), np.empty(places), np.empty(places), np.empty(places))
    number, fits, reach, steps = np.empty(LANES, np.int64), np.empty(_ROWS * LANES), around.max(), around[1] * width + around[0]
    everywhere, inside = np.ones(count, np.int64), np.empty(count, np.int64)
    for b in range(len(pixels)):
        ages, ideal, lanes = ages_us[stream_index[b]], ideal_pixels[stream_index[b]], 0
        for i in range(pixels.shape[1]):
            if mask[b, i]:
                u, v = pixels[b, i, 0], pixels[b, i, 1]
                own, is_within = v * width + u, reach <= u < width - reach and reach <= v < height - reach
                if not is_within:
                    for k in range(count):
                        inside[k] = 0 <= u + around[0, k] < width and 0 <= v + around[1, k] < height
                is_on = ages[1, own] < ages[0, own] if polarity[b, i] == 0 else polarity[b, i] > 0
                offsets = Offsets(fitted.x[lanes:], fitted.y[lanes:], later_us[lanes:])
                _look_around(own, Around(steps, everywhere if is_within else inside), ages[1 if is_on else 0], ideal, settings, offsets)
                number[lanes], lanes = i, lanes + 1
            if lanes == LANES or (lanes > 0 and i == pixels.shape[1] - 1):
                for k in range(places):
                    fitted.times_s[k], fitted.counts[k] = later_us[k] * 1e-6, abs(later_us[k]) <= settings.span_us
                _fit(fitted, fits, settings)
                for lane in range(lanes):
                    flow[b, number[lane], 0], flow[b, number[lane], 1], valid[b, number[lane]] = _normal_flow(fits[lane:], settings)
                lanes = 0


@kernel(fastmath=FAST)
def _look_around(own: int, around: Around, ages_us: Array, ideal: Array, settings: ArrivalSettings, offsets: Offsets) -> None:
    """Offsets of the pixels around one, and how much later the edge came to it than to them; longer than any that counts where it did not.

    Args:
        ages_us, ideal: ``[h*w]`` and ``[h*w*2]``.
    """
    (steps, inside), (x, y, later_us) = around, offsets
    known_us, own_us, own_x, own_y = settings.long_ago_us - settings.cut_off_us, np.int32(ages_us[own]), ideal[2 * own], ideal[2 * own + 1]
    for k in range(np.uint64(len(steps))):
        place, at = np.uint64(own + steps[k] * inside[k]), k * LANES
        age_us = np.int32(ages_us[place])
        x[at], y[at] = ideal[place + place] - own_x, ideal[place + place + np.uint64(1)] - own_y
        later_us[at] = own_us - age_us if (age_us < known_us) & (own_us < known_us) & (inside[k] > 0) else settings.long_ago_us


@kernel(fastmath=FAST)
def _fit(fitted: Fitted, fits: Array, settings: ArrivalSettings) -> None:
    """Planes fitted to times: :func:`torchtrack.tracking.frontend.arrival_flow.plane_flow`.

    Args:
        fitted: its weights are filled.
        fits: what is known of each fit, filled.
    """
    fitted.weights[:] = fitted.counts
    for iteration in range(settings.iterations + 1):
        _sum(fitted, fits)
        _solve(fits)
        _sum_residuals(fitted, fits)
        if iteration < settings.iterations:
            _weigh(fitted, fits, settings)


@kernel(fastmath=FAST)
def _sum(fitted: Fitted, fits: Array) -> None:
    """Weighted sums of all that a plane is solved from."""
    x, y, times_s, _, weights = fitted
    fits[: _YT + LANES] = 0.0
    for first in range(np.uint64(0), np.uint64(len(x)), AT_ONCE * LANES):
        for lane in range(LANES):
            total, sum_x, sum_y, sum_t = fits[_TOTAL + lane], fits[_X + lane], fits[_Y + lane], fits[_T + lane]
            xx, xy, yy, xt, yt = fits[_XX + lane], fits[_XY + lane], fits[_YY + lane], fits[_XT + lane], fits[_YT + lane]
            for k in range(AT_ONCE):
                at = first + k * LANES + lane
                t, weight = times_s[at], weights[at]
                wx, wy = weight * x[at], weight * y[at]
                total, sum_x, sum_y, sum_t = total + weight, sum_x + wx, sum_y + wy, sum_t + weight * t
                xx, xy, yy, xt, yt = xx + wx * x[at], xy + wx * y[at], yy + wy * y[at], xt + wx * t, yt + wy * t
            fits[_TOTAL + lane], fits[_X + lane], fits[_Y + lane], fits[_T + lane] = total, sum_x, sum_y, sum_t
            fits[_XX + lane], fits[_XY + lane], fits[_YY + lane], fits[_XT + lane], fits[_YT + lane] = xx, xy, yy, xt, yt


@kernel(fastmath=FAST)
def _solve(fits: Array) -> None:
    """The plane ``t = a x + b y + c`` of each fit, and how far its points are spread."""
    for lane in range(LANES):
        share = 1.0 / max(fits[_TOTAL + lane], 1e-6)
        mean_x, mean_y, mean_t = fits[_X + lane] * share, fits[_Y + lane] * share, fits[_T + lane] * share
        xx, xy = fits[_XX + lane] * share - mean_x * mean_x, fits[_XY + lane] * share - mean_x * mean_y
        yy, xt = fits[_YY + lane] * share - mean_y * mean_y, fits[_XT + lane] * share - mean_x * mean_t
        yt = fits[_YT + lane] * share - mean_y * mean_t
        determinant = xx * yy - xy * xy
        per = 1.0 / max(determinant, 1e-4)
        a, b = (yy * xt - xy * yt) * per, (xx * yt - xy * xt) * per
        fits[_A + lane], fits[_B + lane], fits[_C + lane] = a, b, mean_t - a * mean_x - b * mean_y
        fits[_DETERMINANT + lane], fits[_SPREAD + lane] = determinant, min(xx, yy)


@kernel(fastmath=FAST)
def _sum_residuals(fitted: Fitted, fits: Array) -> None:
    """Weighted sums of residuals and of their squares, and how many points have a weight."""
    x, y, times_s, _, weights = fitted
    fits[_ABSOLUTE:] = 0.0
    for first in range(np.uint64(0), np.uint64(len(x)), AT_ONCE * LANES):
        for lane in range(LANES):
            a, b, c = fits[_A + lane], fits[_B + lane], fits[_C + lane]
            absolute, square, used = fits[_ABSOLUTE + lane], fits[_SQUARE + lane], fits[_USED + lane]
            for k in range(AT_ONCE):
                at = first + k * LANES + lane
                residual, weight = abs(times_s[at] - c - a * x[at] - b * y[at]), weights[at]
                absolute, square = absolute + weight * residual, square + weight * residual * residual
                used += 1.0 if weight > 0 else 0.0
            fits[_ABSOLUTE + lane], fits[_SQUARE + lane], fits[_USED + lane] = absolute, square, used


@kernel(fastmath=FAST)
def _weigh(fitted: Fitted, fits: Array, settings: ArrivalSettings) -> None:
    """Bisquare weights of the residuals, zero for what the plane passes too early or too late."""
    (x, y, times_s, counts, weights), bound, least_scale_s, plane_s = fitted, settings.bound, settings.least_scale_s, settings.plane_s
    for first in range(np.uint64(0), np.uint64(len(x)), AT_ONCE * LANES):
        for lane in range(LANES):
            a, b, c = fits[_A + lane], fits[_B + lane], fits[_C + lane]
            per_bound = 1.0 / (bound * max(fits[_ABSOLUTE + lane] / max(fits[_TOTAL + lane], 1.0), least_scale_s))
            for k in range(AT_ONCE):
                at = first + k * LANES + lane
                along = a * x[at] + b * y[at]
                relative = (times_s[at] - c - along) * per_bound
                weight = max(1.0 - relative * relative, 0.0)
                weights[at] = counts[at] * (weight * weight if abs(along) < plane_s else 0.0)


@kernel(fastmath=FAST)
def _normal_flow(fit: Array, settings: ArrivalSettings) -> tuple[float, float, bool]:
    """The flow by one fit, of every ``LANES``-th place, and whether there is one."""
    a, b, total, square = fit[_A], fit[_B], max(fit[_TOTAL], 1.0), fit[_SQUARE]
    slope2, spread_px2 = a * a + b * b, max(fit[_SPREAD], settings.least_spread_px2)
    exact = slope2 * total * spread_px2 > settings.slope_sigmas**2 * square / total
    if fit[_USED] >= settings.min_pixels and fit[_DETERMINANT] > settings.least_determinant and exact and slope2 > settings.least_slope2:
        return a / slope2, b / slope2, True
    return 0.0, 0.0, False


@accelerates(arrival_flow.arrival_flow)
def arrival_flow_numba(points: SensorPoints, view: SensorView, config: FlowConfig) -> tuple[Float[Tensor, "b n 2"], Bool[Tensor, "b n"]]:
    """Pixel by pixel."""
    mask, burst_age_us = points.mask, view.maps.burst_age_us
    flow, valid = torch.zeros(*mask.shape, 2, dtype=view.ideal_pixels.dtype), torch.zeros_like(mask)
    around = disc(config.radius_px, torch.int64, mask.device)
    size, of_sensors = burst_age_us.shape[2:], as_arrays(burst_age_us.flatten(2), view.ideal_pixels.flatten(1), view.stream_index)
    flow_at(
        as_arrays(points.sensor_pixels, points.polarity, mask),
        (tuple(size), *of_sensors),
        around.numpy(),
        filled(ArrivalSettings, arrival_flow, bursts, config),
        *as_arrays(flow, valid),
    )
    return flow, valid
