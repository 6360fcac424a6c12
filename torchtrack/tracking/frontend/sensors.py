"""From events to what each object's camera saw: the window's events and corners with their flow, in ideal pixels.

What is remembered of the past are maps over the sensor; the lens is undone with tables, once per event.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch, host_sync
from torchtrack.core.camera import Camera, distortion_table, stack_tables, undistortion_table
from torchtrack.core.events import EventBatch, PaddedEvents, check_on_sensor, of_streams, pad_streams
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.bursts import LONG_AGO_US, update_bursts
from torchtrack.tracking.frontend.corners import Corners, detect_corners, no_corners
from torchtrack.tracking.frontend.flow import estimate_flow
from torchtrack.tracking.frontend.history import BORDER_PX, History, on_sensor, pixel_numbers
from torchtrack.tracking.frontend.tiles import TILE_BITS, NearbyEvents, SensorTiles
from torchtrack.tracking.frontend.time_surface import at_pixels, object_regions, time_surface
from torchtrack.tracking.frontend.window_events import ObjectEvents, SharedEvents, WindowEvents
from torchtrack.tracking.motion.prediction import Prediction

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
    return max(config.matching.max_gate_px, *config.matching.gates_px) + _DRAWN_SIGMAS * config.search.least_sigma_px


@dataclass(frozen=True)
class Sensors:
    """The sensor of each stream, and which of them each object is seen by.

    Args:
        ideal_pixels: ideal pixel (u, v) of every sensor pixel.
        sensor_pixels: sensor pixel of every ideal pixel, with a border.
        sensor_numbers: numbers of these; all three from :func:`sensor_tables`.
        stream_index: the stream that each object is seen in.
        tiles: of the sensor, where there is one stream alone.
    """

    ideal_pixels: Float[Tensor, "s h w 2"]
    sensor_pixels: Float[Tensor, "s bh bw 2"]
    sensor_numbers: Int[Tensor, "s bh bw"]
    stream_index: Int[Tensor, "b"]
    tiles: SensorTiles | None

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the largest sensor."""
        return self.ideal_pixels.shape[1], self.ideal_pixels.shape[2]

    def near_objects(self, events: NearbyEvents, prediction: Prediction, window_s: Float[Tensor, "b"], config: TrackerConfig) -> NearbyEvents:
        """The events that can have to do with the objects. A GPU would have to be waited for: there, all are kept."""
        if self.tiles is None or not host_sync.read_at_once(window_s):
            return events
        near = self.tiles.near(prediction, window_s, farthest_event_px(config))
        # By a kernel, they are chosen where they are seen.
        return replace(events, near_tiles=near) if dispatch.apply_to(window_s) else self.tiles.keep(events.events, near)

    def window_events(
        self, nearby: NearbyEvents, burst_age_us: Int[Tensor, "s 2 h w"], t_us: Int[Tensor, "s"], elapsed_us: Int[Tensor, "s"], longest_us: int
    ) -> tuple[ObjectEvents, Int[Tensor, "s 2 h w"]]:
        """The events of a window as each object's camera saw them, and the bursts' ages with them (µs).

        Args:
            nearby: the events that count.
            burst_age_us: ages where the window begins; at its end, where ``nearby`` says how far into their bursts they are.
            t_us: end of the window of each stream.
            elapsed_us: how long the window lasts.
            longest_us: how long a pixel's events are of one burst.
        """
        if self.tiles is not None and nearby.near_tiles is not None:
            # Of longer windows, ages do not tell what began in them.
            if int(elapsed_us) < LONG_AGO_US:
                return self._chosen_by_kernel(nearby.events, nearby.near_tiles, self.tiles, burst_age_us, t_us, elapsed_us, longest_us)
            nearby = self.tiles.keep(nearby.events, nearby.near_tiles)
        window = pad_streams(nearby.events, len(self.ideal_pixels), t_us)
        if dispatch.apply_to(t_us):
            # Unlike PyTorch's operations, kernels do not look where they read and write.
            check_on_sensor(nearby.events, self.image_size[1], self.image_size[0])
        into_burst_us = nearby.into_burst_us
        if into_burst_us is None:
            burst_age_us, into_burst_us = update_bursts(burst_age_us, elapsed_us, window, longest_us)
        plain = nearby.number is None and nearby.of_each is None
        seen = self._seen_by_kernel(window, into_burst_us) if plain and dispatch.apply_to(t_us) else self.seen(window, into_burst_us, nearby.number)
        return seen if nearby.of_each is None else seen.only(*nearby.of_each), burst_age_us

    def seen(self, window: PaddedEvents, into_burst_us: Int[Tensor, "s e"] | None = None, number: Int[Tensor, "e"] | None = None) -> WindowEvents:
        """A window's events as each object's camera saw them; of bursts nothing is said where nothing is given."""
        streams = len(self.ideal_pixels)
        stream = torch.arange(streams, device=window.x.device)[:, None]
        pixels = at_pixels(self.ideal_pixels, stream, window.x, window.y).transpose(1, 2).contiguous().transpose(1, 2)
        age_s = window.age_us.to(pixels.dtype) * 1e-6
        into_burst_s = torch.zeros_like(age_s) if into_burst_us is None else into_burst_us.to(pixels.dtype) * 1e-6
        values = (pixels, age_s, into_burst_s, 2 * window.polarity.to(pixels.dtype) - 1, window.mask)
        # Of one stream without a copy for every object.
        each = [value.expand(len(self.stream_index), *value.shape[1:]) if streams == 1 else value[self.stream_index] for value in values]
        return WindowEvents(each[0], each[1], each[2], each[3], each[4], None if number is None else number.expand_as(each[1]))

    def _seen_by_kernel(self, window: PaddedEvents, into_burst_us: Int[Tensor, "s e"]) -> WindowEvents:
        """:meth:`seen`, event by event."""
        # Not at the top: Numba is an extra.
        from torchtrack.backends.numba import events as kernels

        batch = len(self.stream_index)
        # What all see alike is written once.
        own = self.stream_index[:1] if len(self.ideal_pixels) == 1 else self.stream_index
        seen = self.ideal_pixels.new_empty(kernels.SEEN, len(own), window.mask.shape[1])
        told = as_arrays(window.x, window.y, window.age_us, into_burst_us, window.polarity, window.mask, self.ideal_pixels)
        kernels.see(*told, *as_arrays(own), seen.numpy())
        return _of_rows(seen.expand(-1, batch, -1), window.mask[own].expand(batch, -1))

    def _chosen_by_kernel(
        self, events: EventBatch, near: Tensor, tiles: SensorTiles, burst_age_us: Tensor, t_us: Tensor, elapsed_us: Tensor, longest_us: int
    ) -> tuple[ObjectEvents, Int[Tensor, "s 2 h w"]]:
        """The events in tiles near each object, as it saw them, and the bursts' ages with them, event by event."""
        # Not at the top: Numba is an extra.
        from torchtrack.backends.numba import events as kernels

        events = of_streams(events, 1)
        (numbers, count), batch = tiles.numbers_near(events, near), len(near)
        # One place at least: what selects from events needs one to point at.
        kept, places = numbers[:count], max(count, 1)
        seen, ages_us = self.ideal_pixels.new_empty(kernels.SEEN, 1, places), torch.empty(burst_age_us.shape, dtype=burst_age_us.dtype)
        exists, bursts = torch.empty(1, places, dtype=torch.bool), (int(elapsed_us), longest_us, LONG_AGO_US)
        of_events = as_arrays(events.x, events.y, events.t_us, events.polarity)
        maps = as_arrays(self.ideal_pixels[0], burst_age_us[0], ages_us[0])
        kernels.see_kept(kept, *of_events, int(t_us), *bursts, *maps, *as_arrays(seen[:, 0], exists[0]))
        shared = replace(_of_rows(seen, exists), number=torch.from_numpy(numbers[None, :places]))
        if batch == 1:
            return shared, ages_us
        # Only what is written of this is ever looked at.
        own, counts = torch.empty(batch, places + 1, dtype=torch.int32), torch.empty(batch, dtype=torch.int64)
        kernels.divide(kept, *of_events[:2], *as_arrays(near), TILE_BITS, tiles.columns, *as_arrays(own, counts))
        return SharedEvents(shared, own, counts), ages_us

    def corners(
        self, contours: Contours, last_event_us: Int[Tensor, "s h w"], t_us: Int[Tensor, "s"], window_s: Float[Tensor, "s"], config: TrackerConfig
    ) -> Corners:
        """Corners of the time surface around each object's contours, with their flow where it is made use of."""
        if config.corners.max_corners == 0:
            return no_corners(contours.pixels)
        margin_px, largest_px = config.surface.margin_px, config.surface.max_region_px
        regions = object_regions(self.on_sensor(contours.pixels), contours.mask, self.stream_index, self.image_size, margin_px, largest_px)
        surface = time_surface(last_event_us, t_us, regions, config.surface.tau_s, self.ideal_pixels.dtype)
        corners = detect_corners(surface, regions, last_event_us, t_us, window_s, self.ideal_pixels, config.surface, config.corners)
        if not (config.flow.always or config.matching.along_flow):
            return corners
        return estimate_flow(corners, last_event_us, t_us, self.stream_index, self.ideal_pixels, config.flow)

    def on_sensor(self, pixels: Float[Tensor, "b n 2"]) -> Float[Tensor, "b n 2"]:
        """Where the lens puts ideal pixels."""
        return on_sensor(self.sensor_pixels, self.stream_index, pixels)

    def history(self, last_event_us: Int[Tensor, "s h w"], t_us: Int[Tensor, "s"]) -> History:
        """How long ago anything happened at a pixel."""
        return History(self.sensor_numbers, self.stream_index, last_event_us, t_us)


def _of_rows(seen: Float[Tensor, "5 b e"], exists: Bool[Tensor, "b e"]) -> WindowEvents:
    """Events by their rows: pixels, ages, times into their bursts, and polarities."""
    age_s, into_burst_s, polarity = seen[2:].unbind()
    return WindowEvents(seen[:2].permute(1, 2, 0), age_s, into_burst_s, polarity, exists)
