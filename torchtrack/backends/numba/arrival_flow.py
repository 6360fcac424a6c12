"""Arrival flow pixel by pixel: :func:`torchtrack.tracking.frontend.arrival_flow.arrival_flow`."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.parameters import ArrivalSettings, filled
from torchtrack.config.tracker import FlowConfig
from torchtrack.core.constants import disc
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.frontend import arrival_flow, bursts


@kernel(fastmath=FAST)
def flow_at(
    pixels: Array,
    polarity: Array,
    mask: Array,
    ages_us: Array,
    stream_index: Array,
    ideal_pixels: Array,
    around: Array,
    settings: ArrivalSettings,
    flow: Array,
    valid: Array,
) -> None:
    """Fill ``flow [b, n, 2]`` and ``valid [b, n]``, which are zero so far; ``around [2, k]`` are the offsets of the pixels that take part."""
    count = around.shape[1]
    x, y, t = np.empty(count, flow.dtype), np.empty(count, flow.dtype), np.empty(count, flow.dtype)
    height, width, known_us = ages_us.shape[2], ages_us.shape[3], settings.long_ago_us - settings.cut_off_us
    for b in range(len(pixels)):
        ages, ideal = ages_us[stream_index[b]], ideal_pixels[stream_index[b]]
        for i in range(pixels.shape[1]):
            u, v = pixels[b, i, 0], pixels[b, i, 1]
            if not mask[b, i]:
                continue
            is_on = ages[1, v, u] < ages[0, v, u] if polarity[b, i] == 0 else polarity[b, i] > 0
            of_polarity = ages[1 if is_on else 0]
            own_us, used = np.int32(of_polarity[v, u]), 0
            if own_us >= known_us:
                continue
            for k in range(count):
                column, row = u + around[0, k], v + around[1, k]
                if column < 0 or column >= width or row < 0 or row >= height:
                    continue
                age_us = np.int32(of_polarity[row, column])
                if age_us >= known_us or abs(own_us - age_us) > settings.span_us:
                    continue
                x[used], y[used] = ideal[row, column, 0] - ideal[v, u, 0], ideal[row, column, 1] - ideal[v, u, 1]
                t[used], used = (own_us - age_us) * 1e-6, used + 1
            if used >= settings.min_pixels:
                flow[b, i, 0], flow[b, i, 1], valid[b, i] = _plane(x[:used], y[:used], t[:used], settings)


@kernel(fastmath=FAST)
def _plane(x: Array, y: Array, t: Array, settings: ArrivalSettings) -> tuple[float, float, bool]:
    """The flow by a plane fitted to times, and whether there is one: :func:`torchtrack.tracking.frontend.arrival_flow.plane_flow`."""
    weights = np.ones(len(x), x.dtype)
    for iteration in range(settings.iterations + 1):
        total, mean_x, mean_y, mean_t = 0.0, 0.0, 0.0, 0.0
        for k in range(len(x)):
            weight = weights[k]
            total += weight
            mean_x, mean_y, mean_t = mean_x + weight * x[k], mean_y + weight * y[k], mean_t + weight * t[k]
        total = max(total, 1e-6)
        mean_x, mean_y, mean_t = mean_x / total, mean_y / total, mean_t / total
        xx, xy, yy, xt, yt = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(len(x)):
            dx, dy, dt, weight = x[k] - mean_x, y[k] - mean_y, t[k] - mean_t, weights[k]
            xx, xy, yy, xt, yt = xx + weight * dx * dx, xy + weight * dx * dy, yy + weight * dy * dy, xt + weight * dx * dt, yt + weight * dy * dt
        xx, xy, yy, xt, yt = xx / total, xy / total, yy / total, xt / total, yt / total
        determinant = xx * yy - xy * xy
        bounded = max(determinant, 1e-4)
        a, b = (yy * xt - xy * yt) / bounded, (xx * yt - xy * xt) / bounded
        absolute, square = 0.0, 0.0
        for k in range(len(x)):
            residual = t[k] - mean_t - a * (x[k] - mean_x) - b * (y[k] - mean_y)
            absolute, square = absolute + weights[k] * abs(residual), square + weights[k] * residual * residual
        total = max(total, 1.0)
        if iteration == settings.iterations:
            slope2, spread_px2, used = a * a + b * b, max(min(xx, yy), settings.least_spread_px2), (weights > 0).sum()
            exact = slope2 * total * spread_px2 > settings.slope_sigmas**2 * square / total
            if used >= settings.min_pixels and determinant > settings.least_determinant and exact and slope2 > settings.least_slope2:
                return a / slope2, b / slope2, True
            return 0.0, 0.0, False
        bound = settings.bound * max(absolute / total, settings.least_scale_s)
        for k in range(len(x)):
            relative = (t[k] - mean_t - a * (x[k] - mean_x) - b * (y[k] - mean_y)) / bound
            weights[k] = max(1.0 - relative * relative, 0.0) ** 2 * (abs(a * x[k] + b * y[k]) < settings.plane_s)
    return 0.0, 0.0, False


@accelerates(arrival_flow.arrival_flow)
def arrival_flow_numba(
    sensor_pixels: Int[Tensor, "b n 2"],
    polarity: Float[Tensor, "b n"],
    mask: Bool[Tensor, "b n"],
    burst_age_us: Int[Tensor, "s 2 h w"],
    stream_index: Int[Tensor, "b"],
    ideal_pixels: Float[Tensor, "s h w 2"],
    config: FlowConfig,
) -> tuple[Float[Tensor, "b n 2"], Bool[Tensor, "b n"]]:
    """Pixel by pixel."""
    flow, valid = torch.zeros(*mask.shape, 2, dtype=ideal_pixels.dtype), torch.zeros_like(mask)
    around = disc(config.radius_px, torch.int64, mask.device)
    flow_at(
        *as_arrays(sensor_pixels, polarity, mask, burst_age_us, stream_index, ideal_pixels, around),
        filled(ArrivalSettings, arrival_flow, bursts, config),
        *as_arrays(flow, valid),
    )
    return flow, valid
