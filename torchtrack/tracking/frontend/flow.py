"""From corners and events to their flow: iteratively reweighted least squares with bisquare weights (Eq. 6-11), or arrival flow."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.config.tracker import FlowConfig
from torchtrack.core.constants import disc
from torchtrack.tracking.frontend.arrival_flow import arrival_flow
from torchtrack.tracking.frontend.sensor_view import SensorPoints, SensorView
from torchtrack.tracking.frontend.time_surface import at_pixels

# b of the bisquare weight (Eq. 8), in units of the residual's scale: the paper's.
BISQUARE_B = 4.685
# Events up to this old take part (s), and fewer than so many give no flow. Both were set with the first corners, and not measured alone.
SPAN_S, MIN_EVENTS = 0.02, 8
# Floor of the residual's scale (px): events sit on whole pixels, so no smaller scale means anything.
_MIN_SCALE_PX = 0.3


def newest_events_around(
    points: SensorPoints, view: SensorView, config: FlowConfig
) -> tuple[Float[Tensor, "b n k 2"], Float[Tensor, "b n k"], Bool[Tensor, "b n k"]]:
    """Offsets (ideal px) and times (s, at most 0) of the events around each point, relative to its own.

    The paper sums over all events of the window; we take the newest event of each pixel, which needs no search, keeps
    memory constant at any event rate, and lets slow edges look back further than the window.
    """
    last_event_us, (own_u, own_v) = view.maps.last_event_us, points.sensor_pixels.unbind(-1)
    event_us = view.t_us[view.stream_index, None] - (points.age_s.double() * 1e6).round().long()
    _, height, width = last_event_us.shape
    du, dv = disc(config.radius_px, torch.int64, last_event_us.device)
    u, v = own_u[..., None] + du, own_v[..., None] + dv
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = u.clamp(0, width - 1), v.clamp(0, height - 1)
    stream = view.stream_index[:, None, None]
    span_us = int(SPAN_S * 1e6)
    age_us = (event_us[..., None] - at_pixels(last_event_us, stream, u, v)).clamp(-1, span_us + 1)
    # Newer events belong to what follows: only the trail behind a point is its motion.
    mask = inside & (age_us >= 0) & (age_us <= span_us)
    here = at_pixels(view.ideal_pixels, stream[..., 0], own_u, own_v)
    return at_pixels(view.ideal_pixels, stream, u, v) - here[..., None, :], age_us.to(here.dtype) * -1e-6, mask


def irls_flow(
    offsets: Float[Tensor, "*b k 2"], times_s: Float[Tensor, "*b k"], mask: Bool[Tensor, "*b k"], config: FlowConfig
) -> tuple[Float[Tensor, "*b 2"], Bool[Tensor, "*b"]]:
    """Velocity (px/s) that explains the ``offsets`` of events by their ``times_s``, and where there is one.

    Eq. 11 with the weights of Eq. 8, each corner with a flow of its own (the paper's sums run over all corners). The
    paper does not say in which unit its b = 4.685 is: here, of the mean absolute residual.
    """
    weight = mask.to(offsets.dtype)
    count = weight.sum(-1)
    # A row per component: sums along a last axis of two are slow.
    offsets = offsets.transpose(-1, -2).contiguous()
    for _ in range(config.iterations):
        flow = _weighted_flow(offsets, times_s, weight)
        residual_sq = torch.addcmul(offsets, flow, times_s[..., None, :], value=-1).square().sum(-2)
        scale = torch.linalg.vecdot(residual_sq.sqrt(), weight) / weight.sum(-1).clamp(min=1e-6)
        bound_sq = (BISQUARE_B * scale.clamp(min=_MIN_SCALE_PX)).square()
        weight = (1 - residual_sq / bound_sq[..., None]).clamp(min=0).square() * mask
    flow = _weighted_flow(offsets, times_s, weight)[..., 0]
    lever = (weight * times_s.square()).sum(-1)
    valid = (count >= MIN_EVENTS) & (lever > 0) & torch.isfinite(flow).all(-1)
    return torch.where(valid[..., None], flow, 0), valid


def _weighted_flow(offsets: Float[Tensor, "*b 2 k"], times_s: Float[Tensor, "*b k"], weight: Float[Tensor, "*b k"]) -> Float[Tensor, "*b 2 1"]:
    """Closed-form solution of Eq. 9-11."""
    weighted_time = (weight * times_s)[..., None]
    lever = times_s[..., None, :] @ weighted_time
    return (offsets @ weighted_time) / lever.clamp(min=1e-12)


def estimate_flow(points: SensorPoints, view: SensorView, config: FlowConfig) -> tuple[Float[Tensor, "b n 2"], Bool[Tensor, "b n"]]:
    """Flow of each point (ideal px/s) by the model that is set, and where there is one; zero elsewhere."""
    if config.model == "arrival":
        return arrival_flow(points, view, config)
    flow, valid = irls_flow(*newest_events_around(points, view, config), config)
    has_flow = valid & points.mask
    return torch.where(has_flow[..., None], flow, 0), has_flow
