"""From events to what each object's camera saw: the window's events and corners with their flow, in ideal pixels.

What is remembered of the past are maps over the sensor; the lens is undone with tables, once per event.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.camera import Camera, distortion_table, stack_tables, undistortion_table
from torchtrack.core.dispatch import accelerable
from torchtrack.core.events import PaddedEvents, check_on_sensor, of_streams, pad_streams
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.bursts import update_bursts
from torchtrack.tracking.frontend.corners import Corners, detect_corners, no_corners
from torchtrack.tracking.frontend.history import BORDER_PX, History, numbers_of, on_sensor, pixel_numbers
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.sensor_view import SensorView
from torchtrack.tracking.frontend.tiles import NearbyEvents, SensorTiles
from torchtrack.tracking.frontend.time_surface import Regions, at_pixels, object_regions, time_surface
from torchtrack.tracking.frontend.window_events import ObjectEvents, WindowEvents
from torchtrack.tracking.motion.prediction import Prediction

# Border around an object's contours in which its corners are looked for (px). The filters reach 10 px into it, so that there are none there:
# 2 px more, or, where corners are matched along their flow, 6. The preset `paper` kept those when the others were made smaller, to save time.
REGION_MARGIN_PX, _ALONG_FLOW_MARGIN_PX = 12, 16
# Side of all regions on a GPU, which takes one size for all (px): of larger objects, the middle. It bounds memory, and was not measured.
_MAX_REGION_PX = 256
# The first gate of an uncertain object opens up to this (px). Not measured alone.
MAX_GATE_PX = 16.0
# A search draws poses with at least this standard deviation in the image (px). Not measured alone.
LEAST_SIGMA_PX = 3.0
# Poses that a search draws lie within this many of its least standard deviations.
_DRAWN_SIGMAS = 4.0


def sensor_tables(cameras: Sequence[Camera]) -> tuple[Float[Tensor, "s h w 2"], Float[Tensor, "s bh bw 2"], Int[Tensor, "s bh bw"]]:
    """The tables that :class:`Sensors` looks up: ideal pixels of the sensor's, sensor pixels of ideal ones, and their numbers."""
    ideal_pixels = stack_tables([undistortion_table(c) for c in cameras])
    # What lies beyond a smaller sensor lies outside it on the sensor too.
    sensor_pixels = stack_tables([distortion_table(c, BORDER_PX) for c in cameras], beyond_px=-BORDER_PX)
    return ideal_pixels, sensor_pixels, pixel_numbers(sensor_pixels, (ideal_pixels.shape[1], ideal_pixels.shape[2]))


def farthest_event_px(config: TrackerConfig) -> float:
    """How far from an object events can have to do with it (px)."""
    return max(MAX_GATE_PX, *config.association.gates_px) + _DRAWN_SIGMAS * LEAST_SIGMA_PX


@dataclass(frozen=True)
class Sensors:
    """The sensor of each stream, and which of them each object is seen by.

    Args:
        ideal_pixels: ideal pixel (u, v) of every sensor pixel.
        sensor_pixels: sensor pixel of every ideal pixel, with a border.
        sensor_numbers: numbers of these; all three from :func:`sensor_tables`.
        stream_index: the stream that each object is seen in.
        tiles: of the sensors.
    """

    ideal_pixels: Float[Tensor, "s h w 2"]
    sensor_pixels: Float[Tensor, "s bh bw 2"]
    sensor_numbers: Int[Tensor, "s bh bw"]
    stream_index: Int[Tensor, "b"]
    tiles: SensorTiles

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the largest sensor."""
        return self.ideal_pixels.shape[1], self.ideal_pixels.shape[2]

    def near_objects(self, events: NearbyEvents, prediction: Prediction, window_s: Float[Tensor, "b"], config: TrackerConfig) -> NearbyEvents:
        """The events that can have to do with the objects. A GPU would have to be waited for: there, all are kept."""
        if not host_sync.read_at_once(window_s):
            return events
        # They are chosen where they are seen.
        return replace(events, near_tiles=self.tiles.near(prediction, window_s, farthest_event_px(config)))

    @accelerable
    def window_events(
        self, nearby: NearbyEvents, burst_age_us: Int[Tensor, "s 2 h w"], t_us: Int[Tensor, "s"], elapsed_us: Int[Tensor, "s"]
    ) -> tuple[ObjectEvents, Int[Tensor, "s 2 h w"]]:
        """The events of a window as each object's camera saw them, and the bursts' ages with them (µs).

        Args:
            nearby: the events that count.
            burst_age_us: ages where the window begins; at its end, where ``nearby`` says that they are in the map.
            t_us: end of the window of each stream.
            elapsed_us: how long the window lasts.
        """
        near, streams = nearby.near_tiles, len(self.ideal_pixels)
        if near is not None and streams == 1:
            # What is near no object is left out before it is computed with.
            nearby = self.tiles.keep(of_streams(nearby.events, 1), near)
        window = pad_streams(nearby.events, streams, t_us)
        if host_sync.read_at_once(t_us):
            check_on_sensor(nearby.events, self.image_size[1], self.image_size[0])
        if not nearby.are_in_map:
            burst_age_us = update_bursts(burst_age_us, elapsed_us, window)
        seen = self.seen(window, nearby.number)
        if near is not None:
            tile = self.tiles.tile_of(window.x, window.y)
            seen = replace(seen, mask=seen.mask & near.gather(1, tile.expand(len(near), -1) if streams == 1 else tile[self.stream_index]))
        return seen, burst_age_us

    @accelerable
    def seen(self, window: PaddedEvents, number: Int[Tensor, "e"] | None = None) -> WindowEvents:
        """A window's events as each object's camera saw them."""
        streams = len(self.ideal_pixels)
        stream = torch.arange(streams, device=window.x.device)[:, None]
        pixels = at_pixels(self.ideal_pixels, stream, window.x, window.y).transpose(1, 2).contiguous().transpose(1, 2)
        age_s = window.age_us.to(pixels.dtype) * 1e-6
        values = (pixels, age_s, 2 * window.polarity.to(pixels.dtype) - 1, window.mask)
        # Of one stream without a copy for every object.
        each = [value.expand(len(self.stream_index), *value.shape[1:]) if streams == 1 else value[self.stream_index] for value in values]
        return WindowEvents(each[0], each[1], each[2], each[3], None if number is None else number.expand_as(each[1]))

    def view(self, maps: SensorMaps, t_us: Int[Tensor, "s"]) -> SensorView:
        """What the sensors show at the end of a window; ``maps`` are those at ``t_us``."""
        return SensorView(maps, t_us, self.ideal_pixels, self.stream_index)

    def corners(self, contours: Contours, view: SensorView, window_s: Float[Tensor, "s"], config: TrackerConfig) -> Corners:
        """Corners of the time surface around each object's contours, without their flow."""
        if config.corners.max_corners == 0:
            return no_corners(contours.pixels)
        margin_px = _ALONG_FLOW_MARGIN_PX if config.association.search == "along_flow" else REGION_MARGIN_PX
        regions = self.regions(contours, margin_px)
        surface = time_surface(view.maps.last_event_us, view.t_us, regions, config.surface.tau_s, self.ideal_pixels.dtype)
        return detect_corners(surface, regions, view, window_s, config)

    @accelerable
    def regions(self, contours: Contours, margin_px: int) -> Regions:
        """The rectangle of the sensor around each object's contours, with a margin."""
        return object_regions(self.on_sensor(contours.pixels), contours.mask, self.stream_index, self.image_size, margin_px, _MAX_REGION_PX)

    @accelerable
    def nearest_pixels(self, pixels: Float[Tensor, "b n 2"]) -> Int[Tensor, "b n 2"]:
        """Columns and rows of the sensor pixels nearest to ideal ones."""
        number, width = numbers_of(self.sensor_numbers, self.stream_index, pixels).long(), self.image_size[1]
        return torch.stack([number % width, torch.div(number, width, rounding_mode="floor")], -1)

    def on_sensor(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
        """Where the lens puts ideal pixels."""
        return on_sensor(self.sensor_pixels, self.stream_index, pixels)

    def history(self, last_event_us: Int[Tensor, "s h w"], t_us: Int[Tensor, "s"]) -> History:
        """How long ago anything happened at a pixel."""
        return History(self.sensor_numbers, self.stream_index, last_event_us, t_us)
