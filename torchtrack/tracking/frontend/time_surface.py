"""From events to the time surface: the newest event time of every pixel, decayed exponentially (Eq. 5).

One map of newest times per stream is kept over the whole sensor; surfaces are only computed for a region per object.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerable
from torchtrack.core.events import EventBatch
from torchtrack.core.padded import bounds

# Time of a pixel that never fired: far in the past, and its age still fits int64 microseconds.
NEVER_US = -(2**62)
# Ages are clamped to this many decay constants: exp(-16) is zero to 1e-7, and exp of large negative numbers is slow.
MAX_DECAYS = 16.0
# Origins on a grid keep a subsampled filter's phase independent of the other objects' regions (px).
GRID_PX = 4


def at_pixels(maps: Shaped[Tensor, "s h w *c"], stream: Int[Tensor, "*#p"], u: Int[Tensor, "*#p"], v: Int[Tensor, "*#p"]) -> Shaped[Tensor, "..."]:
    """``maps[stream, v, u]``, as one selection of rows: several times faster than indexing with three tensors."""
    return by_number(maps, stream, torch.add(u, v, alpha=maps.shape[2]))


def by_number(maps: Shaped[Tensor, "s h w *c"], stream: Int[Tensor, "*#p"], number: Int[Tensor, "*#p"]) -> Shaped[Tensor, "..."]:
    """:func:`at_pixels` that are numbered row by row."""
    row = number + stream * (maps.shape[1] * maps.shape[2]) if len(maps) > 1 else number
    return maps.flatten(0, 2).index_select(0, row.flatten()).view(*row.shape, *maps.shape[3:])


def empty_last_event(streams: int, height: int, width: int, device: torch.device | str | None = None) -> Int[Tensor, "s h w"]:
    """The map of newest event times (µs) before any event."""
    return torch.full((streams, height, width), NEVER_US, dtype=torch.int64, device=device)


@torch.no_grad()
@accelerable
def update_last_event(last_event_us: Int[Tensor, "s h w"], events: EventBatch) -> Int[Tensor, "s h w"]:
    """The map of newest event times (µs) after ``events``; the input is left as it was.

    A maximum, not an assignment: with repeated indices the order of assignment is not defined.

    Raises:
        EventDataError: if an event is outside the sensor, where kernels are used.
    """
    streams, height, width = last_event_us.shape
    # In the type of the coordinates, which is narrower than that of an index.
    pixel = torch.add(events.x, events.y, alpha=width).long()
    if streams > 1:
        pixel += events.stream_index * (height * width)
    updated = last_event_us.clone()
    # In place on the copy: out of place, the whole map is copied twice.
    updated.view(-1).scatter_reduce_(0, pixel, events.t_us, "amax")
    return updated


@dataclass(frozen=True)
class Regions:
    """One rectangle of the sensor per object, all of one size; each object owns the first ``extent`` of its own.

    Args:
        origin: sensor pixel (u, v) of the upper left corner; may lie outside the sensor.
        extent: width and height that the object itself needs (px).
        size: (height, width) common to all.
        stream_index: the stream of each object.
    """

    origin: Int[Tensor, "b 2"]
    extent: Int[Tensor, "b 2"]
    size: tuple[int, int]
    stream_index: Int[Tensor, "b"]


def object_regions(
    pixels: Float[Tensor, "b m 2"],
    mask: Bool[Tensor, "b m"],
    stream_index: Int[Tensor, "b"],
    sensor_size: tuple[int, int],
    margin_px: int,
    largest_px: int,
) -> Regions:
    """Rectangles around the contours ``pixels`` (sensor px) with a margin, clipped to the sensor of (height, width).

    Objects without a contour in the image get the smallest rectangle, at the origin.

    Args:
        largest_px: on a GPU, the side of all rectangles, where that is smaller than the sensor: their size cannot hang on
            what is seen. Of a larger object, the middle is taken.
    """
    limit = constant((sensor_size[1] - 1, sensor_size[0] - 1), pixels.dtype, pixels.device)
    inside = mask & ((pixels >= 0) & (pixels <= limit)).all(-1)
    low, high = bounds(pixels, inside)
    empty = ~inside.any(1, keepdim=True)
    low = torch.where(empty, torch.zeros_like(low), low).floor().long() - margin_px
    high = torch.where(empty, torch.zeros_like(high), high).ceil().long() + margin_px
    low = torch.div(low, GRID_PX, rounding_mode="floor") * GRID_PX
    extent = high - low + 1
    if host_sync.read_at_once(extent):
        return regions_of(low, extent, stream_index)
    height, width = (-(-min(side + 2 * margin_px + GRID_PX, largest_px) // 16) * 16 for side in sensor_size)
    room = constant((width, height), extent.dtype, extent.device)
    too_large = (extent - room).clamp(min=0)
    low = low + torch.div(too_large, 2 * GRID_PX, rounding_mode="floor") * GRID_PX
    return Regions(low, torch.minimum(extent, room), (height, width), stream_index)


def regions_of(origin: Int[Tensor, "b 2"], extent: Int[Tensor, "b 2"], stream_index: Int[Tensor, "b"]) -> Regions:
    """Rectangles of a size that all of them fit in."""
    width, height = (-(-extent.amax(0) // 16) * 16).tolist()
    return Regions(origin, extent, (height, width), stream_index)


@accelerable
def time_surface(
    last_event_us: Int[Tensor, "s h w"], t_us: Int[Tensor, "s"], regions: Regions, tau_s: float, dtype: torch.dtype
) -> Float[Tensor, "b rh rw"]:
    """Exponentially decayed surface (Eq. 5) of each object's region at ``t_us``; zero outside the sensor."""
    _, height, width = last_event_us.shape
    rows = regions.origin[:, 1, None] + torch.arange(regions.size[0], device=t_us.device)
    columns = regions.origin[:, 0, None] + torch.arange(regions.size[1], device=t_us.device)
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None, :]
    stream = regions.stream_index[:, None, None]
    newest_us = at_pixels(last_event_us, stream, columns.clamp(0, width - 1)[:, None, :], rows.clamp(0, height - 1)[:, :, None])
    max_age_us = int(MAX_DECAYS * tau_s * 1e6)
    age_us = (t_us[stream] - newest_us).to(dtype).clamp_(0, max_age_us)
    return (age_us * (-1e-6 / tau_s)).exp_().mul_(inside & (age_us < max_age_us))
