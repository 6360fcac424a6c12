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
    count, reach = around.shape[1], around.max()
    points, known_us = np.empty((4, count)), settings.long_ago_us - settings.cut_off_us
    height, width = ages_us.shape[2], ages_us.shape[3]
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
            own_x, own_y = ideal[v, u, 0], ideal[v, u, 1]
            is_within = reach <= u < width - reach and reach <= v < height - reach
            for k in range(count):
                column, row = u + around[0, k], v + around[1, k]
                if not is_within and (column < 0 or column >= width or row < 0 or row >= height):
                    continue
                age_us = np.int32(of_polarity[row, column])
                # Written whether it counts or not: a processor would guess many of these branches wrong.
                points[0, used], points[1, used] = ideal[row, column, 0] - own_x, ideal[row, column, 1] - own_y
                points[2, used] = (own_us - age_us) * 1e-6
                used += 1 if (age_us < known_us) & (abs(own_us - age_us) <= settings.span_us) else 0
            if used >= settings.min_pixels:
                flow[b, i, 0], flow[b, i, 1], valid[b, i] = _plane(points, used, settings)


@kernel(fastmath=FAST | {"reassoc"})
def _plane(points: Array, count: int, settings: ArrivalSettings) -> tuple[float, float, bool]:
    """The flow by a plane fitted to times, and whether there is one: :func:`torchtrack.tracking.frontend.arrival_flow.plane_flow`.

    Args:
        points: ``[4, k]``, offsets (px), times (s), and room for weights; so many of them count.
    """
    x, y, t, weights = points[0], points[1], points[2], points[3]
    weights[:count] = 1.0
    for iteration in range(settings.iterations + 1):
        total, sum_x, sum_y, sum_t = 0.0, 0.0, 0.0, 0.0
        sum_xx, sum_xy, sum_yy, sum_xt, sum_yt = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(count):
            weight = weights[k]
            wx, wy = weight * x[k], weight * y[k]
            total, sum_x, sum_y, sum_t = total + weight, sum_x + wx, sum_y + wy, sum_t + weight * t[k]
            sum_xx, sum_xy, sum_yy = sum_xx + wx * x[k], sum_xy + wx * y[k], sum_yy + wy * y[k]
            sum_xt, sum_yt = sum_xt + wx * t[k], sum_yt + wy * t[k]
        share = 1.0 / max(total, 1e-6)
        mean_x, mean_y, mean_t = sum_x * share, sum_y * share, sum_t * share
        xx, xy, yy = sum_xx * share - mean_x * mean_x, sum_xy * share - mean_x * mean_y, sum_yy * share - mean_y * mean_y
        xt, yt = sum_xt * share - mean_x * mean_t, sum_yt * share - mean_y * mean_t
        determinant = xx * yy - xy * xy
        per = 1.0 / max(determinant, 1e-4)
        a, b = (yy * xt - xy * yt) * per, (xx * yt - xy * xt) * per
        c, absolute, square = mean_t - a * mean_x - b * mean_y, 0.0, 0.0
        for k in range(count):
            residual = abs(t[k] - c - a * x[k] - b * y[k])
            absolute, square = absolute + weights[k] * residual, square + weights[k] * residual * residual
        total = max(total, 1.0)
        if iteration == settings.iterations:
            slope2, spread_px2, used = a * a + b * b, max(min(xx, yy), settings.least_spread_px2), (weights[:count] > 0).sum()
            exact = slope2 * total * spread_px2 > settings.slope_sigmas**2 * square / total
            if used >= settings.min_pixels and determinant > settings.least_determinant and exact and slope2 > settings.least_slope2:
                return a / slope2, b / slope2, True
            return 0.0, 0.0, False
        per_bound = 1.0 / (settings.bound * max(absolute / total, settings.least_scale_s))
        for k in range(count):
            along = a * x[k] + b * y[k]
            relative = (t[k] - c - along) * per_bound
            weight = max(1.0 - relative * relative, 0.0)
            weights[k] = weight * weight if abs(along) < settings.plane_s else 0.0
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
