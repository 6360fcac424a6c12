"""From a window's events to what each object sees of them: :class:`torchtrack.tracking.frontend.sensors.Sensors`, event by event."""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import PaddedArrays, as_arrays, padded_arrays
from torchtrack.backends.numba.bursts import age_all, fire
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.tiles import divide, grid_of, numbers_near, tiles_of
from torchtrack.core.dispatch import accelerates
from torchtrack.core.events import EventBatch, PaddedEvents, check_streams_in_order, of_streams, stream_bounds
from torchtrack.tracking.frontend.bursts import LONG_AGO_US, LONGEST_US
from torchtrack.tracking.frontend.history import BORDER_PX
from torchtrack.tracking.frontend.sensors import Sensors
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.frontend.window_events import ObjectEvents, SharedEvents, WindowEvents

# Rows of what an object sees of an event.
PIXELS, AGE, POLARITY = 0, 2, 3
SEEN = 4


@kernel(fastmath=FAST)
def see(events: PaddedArrays, ideal_pixels: Array, stream_index: Array, seen: Array) -> None:
    """Events of several streams as each object's camera saw them.

    Args:
        ideal_pixels: ``[s, h, w, 2]``.
        stream_index: ``[b]``; of one stream, ``[1]`` is enough for all that see it.
        seen: ``[SEEN, b, e]``, filled; zero where there is nothing.
    """
    (x, y, age_us, polarity, mask), width = events, np.uint64(ideal_pixels.shape[2])
    for b in range(len(stream_index)):
        s = stream_index[b]
        ideal = ideal_pixels[s].reshape(-1, 2)
        for i in range(seen.shape[2]):
            if not mask[s, i]:
                for k in range(SEEN):
                    seen[k, b, i] = 0.0
                continue
            pixel = np.uint64(y[s, i]) * width + np.uint64(x[s, i])
            seen[PIXELS, b, i], seen[PIXELS + 1, b, i] = ideal[pixel, 0], ideal[pixel, 1]
            seen[AGE, b, i] = age_us[s, i] * 1e-6
            seen[POLARITY, b, i] = 1.0 if polarity[s, i] else -1.0


class Kept(NamedTuple):
    """Which events are kept: ``numbers [n]`` of those of all streams; a stream's own from ``first`` to ``last``, with places for them to ``end``."""

    numbers: Array
    first: int
    last: int
    end: int


class StreamEvents(NamedTuple):
    """Events of all streams, ``[e]``."""

    x: Array
    y: Array
    t_us: Array
    polarity: Array


class Ages(NamedTuple):
    """When a window ends, how long it is, and how long a burst and what was long ago (µs)."""

    end_us: int
    elapsed_us: int
    longest_us: int
    long_ago_us: int


class StreamMaps(NamedTuple):
    """A stream's pixels without the lens's distortion, ``[h, w, 2]``, and its map of bursts before the window and after it, ``[2, h, w]``."""

    ideal_pixels: Array
    before: Array
    ages: Array


@kernel(fastmath=FAST)
def see_kept(events: StreamEvents, kept: Kept, ages: Ages, maps: StreamMaps, seen: Array, exists: Array) -> None:
    """Some events of one stream as its camera saw them, and the map of bursts brought up to the window's end.

    As :func:`torchtrack.backends.numba.bursts.update_bursts` and :func:`see` one after the other, without anything written in between.

    Args:
        seen, exists: ``[SEEN, n]`` and ``[n]``, filled where the stream's own are; where there are more places, with zeros.
    """
    (x, y, t_us, polarity), (numbers, first, last, end), (end_us, elapsed_us, longest_us, long_ago_us) = events, kept, ages
    ideal_pixels, before, aged = maps
    width, brighter = np.uint64(ideal_pixels.shape[1]), np.uint64(ideal_pixels.shape[0] * ideal_pixels.shape[1])
    aged, ideal = aged.ravel(), ideal_pixels.reshape(-1, 2)
    u, v, age_s, sign = seen[PIXELS], seen[PIXELS + 1], seen[AGE], seen[POLARITY]
    age_all(before.ravel(), np.int16(elapsed_us), np.int16(long_ago_us - elapsed_us), aged)
    for j in range(first, last):
        i = np.uint64(numbers[j])
        pixel, age = np.uint64(y[i]) * width + np.uint64(x[i]), end_us - t_us[i]
        fire(aged, pixel + np.uint64(polarity[i]) * brighter, min(age, long_ago_us), True, elapsed_us, longest_us)
        u[j], v[j], age_s[j] = ideal[pixel, 0], ideal[pixel, 1], age * 1e-6
        sign[j], exists[j] = 2.0 * polarity[i] - 1.0, True
    for j in range(last, end):
        exists[j] = False
        seen[:, j] = 0.0


@kernel()
def pixels_at(pixels: Array, stream_index: Array, numbers: Array, border_px: int, width: int, nearest: Array) -> None:
    """Fill ``nearest [b, n, 2]`` with columns and rows of the sensor pixels nearest to ideal ones, ``pixels [b, 2, n]``.

    Args:
        numbers: ``[s, bh, bw]`` of those pixels, row by row of a sensor so wide.
    """
    last_row, last_column, border = numbers.shape[1] - 1, numbers.shape[2] - 1, pixels.dtype.type(border_px)
    for b in range(len(pixels)):
        table = numbers[stream_index[b]]
        for i in range(pixels.shape[2]):
            column = np.uint64(np.rint(min(max(pixels[b, 0, i] + border, 0.0), last_column)))
            row = np.uint64(np.rint(min(max(pixels[b, 1, i] + border, 0.0), last_row)))
            number = np.uint32(table[row, column])
            nearest[b, i, 0], nearest[b, i, 1] = number % np.uint32(width), number // np.uint32(width)


@accelerates(Sensors.seen, supports=lambda sensors, window, number=None: number is None)
def seen_numba(sensors: Sensors, window: PaddedEvents, number: Int[Tensor, "e"] | None = None) -> WindowEvents:
    """Event by event."""
    batch = len(sensors.stream_index)
    # What all see alike is written once.
    own = sensors.stream_index[:1] if len(sensors.ideal_pixels) == 1 else sensors.stream_index
    seen = sensors.ideal_pixels.new_empty(SEEN, len(own), window.mask.shape[1])
    see(padded_arrays(window), *as_arrays(sensors.ideal_pixels, own), seen.numpy())
    return _of_rows(seen.expand(-1, batch, -1), window.mask[own].expand(batch, -1))


def _are_chosen(sensors: Sensors, nearby: NearbyEvents, burst_age_us: Tensor, t_us: Tensor, elapsed_us: Tensor) -> bool:
    """Whether the events that count are still to be chosen by their tiles, in a window short enough for ages of bursts to tell what began in it."""
    return nearby.near_tiles is not None and max(elapsed_us.tolist()) < LONG_AGO_US


@accelerates(Sensors.window_events, supports=_are_chosen)
def window_events_numba(
    sensors: Sensors,
    nearby: NearbyEvents,
    burst_age_us: Int[Tensor, "s 2 h w"],
    t_us: Int[Tensor, "s"],
    elapsed_us: Int[Tensor, "s"],
) -> tuple[ObjectEvents, Int[Tensor, "s 2 h w"]]:
    """The events in tiles near each object, as it saw them, and the bursts' ages with them, event by event."""
    near = nearby.near_tiles
    if near is None:
        raise ValueError("a kernel chooses events by their tiles: there have to be some.")
    streams = len(t_us)
    events = of_streams(nearby.events, streams)
    kept, number, bounds = _kept(sensors, events, near)
    # One place at least: what selects from events needs one to point at.
    places = max(len(kept), 1)
    seen, ages_us = sensors.ideal_pixels.new_empty(SEEN, 1, places), torch.empty(burst_age_us.shape, dtype=burst_age_us.dtype)
    exists = torch.empty(1, places, dtype=torch.bool)
    of_events = as_arrays(events.x, events.y, events.t_us, events.polarity)
    maps, filled = as_arrays(sensors.ideal_pixels, burst_age_us, ages_us), as_arrays(seen[:, 0], exists[0])
    for s, (end_us, elapsed) in enumerate(zip(t_us.tolist(), elapsed_us.tolist(), strict=True)):
        last = int(bounds[s + 1])
        of_stream = kept, int(bounds[s]), last, places if s + 1 == streams else last
        see_kept(of_events, of_stream, (end_us, elapsed, LONGEST_US, LONG_AGO_US), tuple([table[s] for table in maps]), *filled)
    shared = replace(_of_rows(seen, exists), number=torch.from_numpy(number if len(kept) else np.zeros(1, np.int64))[None])
    if len(near) == 1 == streams:
        return shared, ages_us
    # Only what is written of this is ever looked at.
    own, counts = torch.empty(len(near), int(np.diff(bounds).max()) + 1, dtype=torch.int32), torch.empty(len(near), dtype=torch.int64)
    tiles = tiles_of(*of_events[:2], kept, grid_of(sensors.tiles))
    divide(tiles, bounds, *as_arrays(near, sensors.stream_index, own, counts))
    return SharedEvents(shared, own, counts), ages_us


def _kept(sensors: Sensors, events: EventBatch, near: Bool[Tensor, "b t"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The events near any object of their stream: their numbers, those among their stream's, and where each stream begins among them."""
    streams = len(sensors.ideal_pixels)
    if streams == 1:
        kept = numbers_near(sensors.tiles, events, near)
        return kept, kept, np.array([0, len(kept)])
    check_streams_in_order(events.stream_index)
    firsts = stream_bounds(events, streams)
    own_numbers = [
        numbers_near(sensors.tiles, events[first:last], near[sensors.stream_index == s]) for s, (first, last) in enumerate(pairwise(firsts.tolist()))
    ]
    bounds = np.concatenate([[0], np.cumsum([len(own) for own in own_numbers])])
    number = np.concatenate(own_numbers)
    return number + np.repeat(firsts[:-1].numpy(), np.diff(bounds)), number, bounds


def _of_rows(seen: Float[Tensor, "4 b e"], exists: Bool[Tensor, "b e"]) -> WindowEvents:
    """Events by their rows: pixels, ages and polarities."""
    age_s, polarity = seen[AGE:].unbind()
    return WindowEvents(seen[:AGE].permute(1, 2, 0), age_s, polarity, exists)


@accelerates(Sensors.nearest_pixels)
def nearest_pixels_numba(sensors: Sensors, pixels: Float[Tensor, "b n 2"]) -> Int[Tensor, "b n 2"]:
    """Pixel by pixel."""
    nearest = torch.empty(pixels.shape, dtype=torch.int64)
    arrays = as_arrays(pixels.transpose(1, 2), sensors.stream_index, sensors.sensor_numbers)
    pixels_at(*arrays, BORDER_PX, sensors.image_size[1], nearest.numpy())
    return nearest
