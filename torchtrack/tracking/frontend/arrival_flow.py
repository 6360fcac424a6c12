"""Arrival flow: how fast the edge at a pixel moves across itself, by when it came to the pixels around (in place of Eq. 6-11).

In: sensor pixels and the map of bursts. Out: the normal flow (px/s). Along itself the motion of an edge does not show (the aperture
problem), so that what comes out is the part of the motion that is normal to the edge, at corners too.

An edge fires a pixel several times, and has fired those behind it more often than those that it has only just come to: by the newest
events it seems faster than it is. So each pixel counts with the first event of its last burst, of one polarity: an edge that follows
closely, of the other one, does not mix in. A plane ``t = a u + b v + c`` is fitted to these times, and the flow is ``(a, b) / (a² + b²)``.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import FlowConfig
from torchtrack.core.constants import disc
from torchtrack.core.dispatch import accelerable
from torchtrack.tracking.frontend.bursts import LONG_AGO_US
from torchtrack.tracking.frontend.sensor_view import SensorPoints, SensorView
from torchtrack.tracking.frontend.time_surface import at_pixels

# Pixels that the edge came to within this time may take part, before or after (µs); fewer than so many give no flow.
SPAN_US, MIN_PIXELS = 31_000, 6
# Those take part that it comes to within this time by the plane itself (s). Chosen by their own times alone, of slow edges those would be left
# that it came to at nearly the same time, and edges would seem too fast: upper quartiles on `ape_normal` of 1.22, not of 1.20.
PLANE_S = 0.010
# What is within this of LONG_AGO_US was cut off, and has no age (µs).
CUT_OFF_US = 1_000
# Bound of the bisquare weight, in mean absolute residuals, and their floor: events are no more exact than that (s).
BOUND, LEAST_SCALE_S = 2.8, 2e-4
# Pixels that lie this closely along a line (px⁴) do not tell a plane.
LEAST_DETERMINANT = 0.05
# A slope counts that is this many times its standard deviation, in which pixels are spread at least so far (px²). With 2, the sign is right at
# 96 to 97 % of the events of smooth objects, with 4 at 98 %, and 3 % fewer have a flow.
SLOPE_SIGMAS, LEAST_SPREAD_PX2 = 4.0, 0.05
# A slope so small is of what moves faster than a camera shows (s²/px²).
LEAST_SLOPE2 = 1e-9


@accelerable
def arrival_flow(points: SensorPoints, view: SensorView, config: FlowConfig) -> tuple[Float[Tensor, "b n 2"], Bool[Tensor, "b n"]]:
    """Normal flow (ideal px/s) at points of the sensor, and where there is one; zero elsewhere.

    Args:
        points: those whose polarity is not known have that of the newest burst.
        view: of its maps, that of bursts is looked at (:mod:`torchtrack.tracking.frontend.bursts`).
    """
    height, width = view.maps.burst_age_us.shape[2:]
    stream, (u, v) = view.stream_index[:, None], points.sensor_pixels.unbind(-1)
    # First off, then on.
    by_polarity = view.maps.burst_age_us.flatten(0, 1)
    off_us, on_us = (at_pixels(by_polarity, 2 * stream + number, u, v).int() for number in range(2))
    is_on = torch.where(points.polarity == 0, on_us < off_us, points.polarity > 0)
    own_us = torch.where(is_on, on_us, off_us)
    du, dv = disc(config.radius_px, torch.int64, u.device)
    around_u, around_v = u[..., None] + du, v[..., None] + dv
    inside = (around_u >= 0) & (around_u < width) & (around_v >= 0) & (around_v < height)
    around_u, around_v = around_u.clamp(0, width - 1), around_v.clamp(0, height - 1)
    around_us = at_pixels(by_polarity, (2 * stream + is_on)[..., None], around_u, around_v).int()
    later_us = own_us[..., None] - around_us
    own_is_known = points.mask & (own_us < LONG_AGO_US - CUT_OFF_US)
    counts = inside & (later_us.abs() <= SPAN_US) & (around_us < LONG_AGO_US - CUT_OFF_US) & own_is_known[..., None]
    offsets = at_pixels(view.ideal_pixels, stream[..., None], around_u, around_v) - at_pixels(view.ideal_pixels, stream, u, v)[..., None, :]
    return plane_flow(offsets, later_us.to(offsets.dtype) * 1e-6, counts, config.iterations)


def plane_flow(
    offsets: Float[Tensor, "*b k 2"], times_s: Float[Tensor, "*b k"], mask: Bool[Tensor, "*b k"], iterations: int
) -> tuple[Float[Tensor, "*b 2"], Bool[Tensor, "*b"]]:
    """Normal flow by a plane fitted to times, with the bisquare weights of Eq. 8; and where there is one."""
    x, y = offsets.unbind(-1)
    chosen = mask.to(times_s.dtype)
    weights = chosen
    for _ in range(iterations):
        slope, residuals, _ = _fitted_plane(x, y, times_s, weights)
        scale_s = ((residuals.abs() * weights).sum(-1) / weights.sum(-1).clamp(min=1)).clamp(min=LEAST_SCALE_S)
        weights = (1 - (residuals / (BOUND * scale_s[..., None])).square()).clamp(min=0).square() * chosen
        weights = weights * ((slope[..., None, :] * offsets).sum(-1).abs() < PLANE_S)
    slope, residuals, (determinant, spread_px2) = _fitted_plane(x, y, times_s, weights)
    total = weights.sum(-1).clamp(min=1)
    variance_s2 = (residuals.square() * weights).sum(-1) / total
    slope2 = slope.square().sum(-1)
    exact = slope2 * total * spread_px2.clamp(min=LEAST_SPREAD_PX2) > SLOPE_SIGMAS**2 * variance_s2
    valid = ((weights > 0).sum(-1) >= MIN_PIXELS) & (determinant > LEAST_DETERMINANT) & exact & (slope2 > LEAST_SLOPE2)
    return torch.where(valid[..., None], slope / slope2.clamp(min=LEAST_SLOPE2)[..., None], 0), valid


def _fitted_plane(x: Tensor, y: Tensor, times_s: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Slope of the plane ``[*b, 2]`` (s/px), residuals (s), and of where the pixels lie: determinant (px⁴) and the lesser variance (px²)."""
    total = weights.sum(-1, keepdim=True).clamp(min=1e-6)
    x, y, t = (value - (value * weights).sum(-1, keepdim=True) / total for value in (x, y, times_s))
    xx, xy, yy, xt, yt = ((p * q * weights).sum(-1) / total[..., 0] for p, q in ((x, x), (x, y), (y, y), (x, t), (y, t)))
    determinant = xx * yy - xy * xy
    bounded = determinant.clamp(min=1e-4)
    a, b = (yy * xt - xy * yt) / bounded, (xx * yt - xy * xt) / bounded
    return torch.stack([a, b], -1), t - a[..., None] * x - b[..., None] * y, (determinant, torch.minimum(xx, yy))
