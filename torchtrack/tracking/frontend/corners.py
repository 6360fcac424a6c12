"""From the time surface to corners: guided filter, Harris response, even selection, newest event.

Region borders wide enough for their support keep every object's corners
independent of the other objects of the batch.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.config.components import Component
from torchtrack.config.tracker import CornerConfig, TrackerConfig
from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerable
from torchtrack.tracking.frontend.filters import FILTER_SIZE_PX, corner_response
from torchtrack.tracking.frontend.sensor_view import SensorPoints, SensorView
from torchtrack.tracking.frontend.time_surface import Regions, at_pixels

# Least Harris response of a corner, as a share of the region's largest: set with the first corners, and not measured alone.
RELATIVE_THRESHOLD = 1e-3
# A corner is moved to the newest event this near (px): its 3x3 pixels.
SNAP_PX = 1
# The guided filter's two sums, and beside them Sobel, Harris window and local maximum, reach this far into a region from its border (px).
REACH_PX = 2 * (FILTER_SIZE_PX // 2) + 6
# Longer than anything that is looked at (µs).
OLDEST_US = 10**9
# Where cells are smaller than the neighbourhood that a corner is the largest of (px), one in each is asked for, and no more.
LARGEST_OF_PX = 5


@dataclass(frozen=True)
class Corners:
    """Corners on the sensor, padded.

    Args:
        sensor_pixels: integer sensor pixels (u, v).
        pixels: the same in ideal pixels.
        age_s: time from the newest event at the corner to the window's end (s).
        mask: which entries are corners.
        flow: velocity (px/s); zero where there is none.
        has_flow: where the flow was estimated.
        polarity: of the edge that came there last: +1 where it got brighter, -1 where darker.
    """

    sensor_pixels: Int[Tensor, "b n 2"]
    pixels: Float[Tensor, "b n 2"]
    age_s: Float[Tensor, "b n"]
    mask: Bool[Tensor, "b n"]
    flow: Float[Tensor, "b n 2"]
    has_flow: Bool[Tensor, "b n"]
    polarity: Float[Tensor, "b n"]

    @property
    def points(self) -> SensorPoints:
        """Where they are on the sensor, and when."""
        return SensorPoints(self.sensor_pixels, self.age_s, self.polarity, self.mask)


def select_corners(response: Float[Tensor, "b h w"], regions: Regions, config: CornerConfig) -> tuple[Int[Tensor, "b n 2"], Bool[Tensor, "b n"]]:
    """The strongest local maxima, at most one per cell: pixels within the region, and which of them are corners."""
    _, height, width = response.shape
    cell = config.cell_px
    rows, columns = height // cell, width // cell
    own = _own_area(response, regions, REACH_PX)
    # Rows first: along them, what is compared lies side by side in memory.
    score = own[:, : rows * cell, : columns * cell].unflatten(1, (rows, cell)).amax(2).unflatten(2, (columns, cell)).amax(3).flatten(1)
    best, chosen = score.topk(min(config.max_corners, score.shape[1]))
    first_u, first_v = chosen % columns * cell, torch.div(chosen, columns, rounding_mode="floor") * cell
    step = torch.arange(cell, device=response.device)
    within = _values_around(own, first_u, first_v, step).argmax(-1)
    u, v = first_u + within % cell, first_v + torch.div(within, cell, rounding_mode="floor")
    strong = best > RELATIVE_THRESHOLD * best[:, :1]
    corners = strong & (best > 0)
    if cell >= LARGEST_OF_PX:
        reach = LARGEST_OF_PX // 2
        corners &= best >= _values_around(own, u, v, torch.arange(-reach, reach + 1, device=response.device)).amax(-1)
    return torch.stack([u, v], -1), corners


def _own_area(response: Tensor, regions: Regions, reach: int) -> Tensor:
    """The response, zero where it depends on what lies outside the object's own region."""
    height, width = response.shape[-2:]
    last = (regions.extent - reach)[..., None]
    u, v = torch.arange(width, device=response.device), torch.arange(height, device=response.device)
    columns, rows = (u >= reach) & (u < last[:, 0]), (v >= reach) & (v < last[:, 1])
    return torch.where(rows[:, :, None] & columns[:, None], response, 0)


def _values_around(
    response: Float[Tensor, "b h w"], u: Int[Tensor, "b n"], v: Int[Tensor, "b n"], step: Int[Tensor, "k"]
) -> Float[Tensor, "b n k*k"]:
    """Values in the square of steps from each pixel, row by row; at the border, the nearest value stands for what is beyond."""
    height, width = response.shape[-2:]
    columns = (u[..., None, None] + step).clamp(0, width - 1)
    rows = (v[..., None, None] + step[:, None]).clamp(0, height - 1)
    return response.flatten(1).gather(1, torch.add(columns, rows, alpha=width).flatten(1)).view(*u.shape, len(step) ** 2)


def snap_to_newest(
    sensor_pixels: Int[Tensor, "b n 2"], last_event_us: Int[Tensor, "s h w"], stream_index: Int[Tensor, "b"], radius_px: int
) -> tuple[Int[Tensor, "b n 2"], Int[Tensor, "b n"]]:
    """Move each pixel to the newest event within ``radius_px``; returns the pixels and their event times (µs).

    A corner of the surface often sits on the stale tail of an edge's trail; the newest event beside it is the edge.
    """
    _, height, width = last_event_us.shape
    step = torch.arange(-radius_px, radius_px + 1, device=sensor_pixels.device)
    u = (sensor_pixels[..., 0, None] + step.repeat(len(step))).clamp(0, width - 1)
    v = (sensor_pixels[..., 1, None] + step.repeat_interleave(len(step))).clamp(0, height - 1)
    newest_us, best = at_pixels(last_event_us, stream_index[:, None, None], u, v).max(-1, keepdim=True)
    return torch.stack([u, v], -2).gather(-1, best[..., None, :].expand(-1, -1, 2, -1))[..., 0], newest_us[..., 0]


@accelerable
def detect_corners(
    surface: Float[Tensor, "b h w"], regions: Regions, view: SensorView, window_s: Float[Tensor, "s"], config: TrackerConfig
) -> Corners:
    """Corners of each object's region: filtered surface, Harris, even selection, snapped to the newest event.

    Args:
        surface: time surface of the regions.
        window_s: length of the window of each stream; only pixels that fired within it are corners.
    """
    maps, response, stream = view.maps, corner_response(surface), regions.stream_index[:, None]
    if config.uses(Component.FRESH_CORNERS):
        # Before the choice: what is too old takes no place.
        response = torch.where(surface > torch.exp(window_s / -config.surface.tau_s)[stream, None], response, 0)
    local, mask = select_corners(response, regions, config.corners)
    _, height, width = maps.last_event_us.shape
    sensor = local + regions.origin[:, None]
    on_it = torch.minimum(sensor.clamp(min=0), constant((width - 1, height - 1), sensor.dtype, sensor.device))
    mask = mask & (on_it == sensor).all(-1)
    reach_px = SNAP_PX if config.uses(Component.CORNER_SNAP) else 0
    sensor, newest_us = snap_to_newest(on_it, maps.last_event_us, regions.stream_index, reach_px)
    age_s = ((view.t_us[stream] - newest_us).clamp(0, OLDEST_US) * 1e-6).to(surface.dtype)
    pixels = at_pixels(view.ideal_pixels, stream, sensor[..., 0], sensor[..., 1])
    off_us, on_us = (at_pixels(maps.burst_age_us.flatten(0, 1), 2 * stream + number, sensor[..., 0], sensor[..., 1]) for number in range(2))
    polarity = torch.where(on_us < off_us, 1.0, -1.0).to(age_s.dtype)
    return Corners(sensor, pixels, age_s, mask, torch.zeros_like(pixels), torch.zeros_like(mask), polarity)


def no_corners(like: Float[Tensor, "b m 2"]) -> Corners:
    """Corners of nothing, for objects of the same number, type and device as ``like``."""
    none = like.new_zeros(len(like), 0, 2)
    mask = torch.zeros(len(like), 0, dtype=torch.bool, device=like.device)
    return Corners(none.long(), none, none[..., 0], mask, none, mask, none[..., 0])
