"""From a window's events to what each object sees of them: :mod:`torchtrack.tracking.frontend.tiles`, ``bursts`` and ``sensors``, event by event."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, entries, lens, placed
from torchtrack.backends.numba.parameters import TileSettings
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerates
from torchtrack.core.events import EventBatch, PaddedEvents, check_on_sensor, of_streams, stream_bounds
from torchtrack.tracking.frontend import bursts, tiles, time_surface
from torchtrack.tracking.frontend.bursts import LONG_AGO_US, LONGEST_US
from torchtrack.tracking.frontend.sensors import Sensors
from torchtrack.tracking.frontend.tiles import TILE_BITS, NearbyEvents, SensorTiles
from torchtrack.tracking.frontend.window_events import ObjectEvents, SharedEvents, WindowEvents
from torchtrack.tracking.motion.prediction import Prediction

# Rows of what an object sees of an event.
PIXELS, AGE, POLARITY = 0, 2, 3
SEEN = 4
# Events that are looked at together: what is found of them stays in the processor's nearest memory.
_BLOCK = 1024


@kernel(fastmath=FAST)
def near_tiles(
    middle: Array,
    reach_px: Array,
    velocity: Array,
    variance: Array,
    T_cam_obj: Array,
    window_s: Array,
    centre_obj: Array,
    half_extent: Array,
    diameter_m: Array,
    intrinsics: Array,
    tiles: TileSettings,
    near: Array,
) -> None:
    """Tiles that anything can be seen in that is near an object: :meth:`torchtrack.tracking.frontend.tiles.SensorTiles.near`.

    Args:
        middle, reach_px: ``[t, 2]`` and ``[t]``.
        velocity, variance: ``[b, 6]``, and of the pose, ``[b, 6]``.
        near: ``[b, t]``, filled.
    """
    for b in range(len(near)):
        rim_m = 0.5 * diameter_m[b]
        turning = np.sqrt((velocity[b, :3] ** 2).sum())
        speed_m_s = np.sqrt((velocity[b, 3:] ** 2).sum())
        turned, moved = np.sqrt(variance[b, :3].max()), np.sqrt(variance[b, 3:].max())
        within_m = (speed_m_s + rim_m * turning) * window_s[b] + tiles.sigmas * (moved + rim_m * turned)
        pose, of_lens = entries(T_cam_obj[b]), lens(intrinsics[b])
        left, top, right, bottom = _around(pose, centre_obj[b], half_extent[b], of_lens, within_m, tiles.least_depth_m)
        for t in range(len(middle)):
            u, v, away_px = middle[t, 0], middle[t, 1], reach_px[t] + tiles.margin_px
            near[b, t] = u + away_px >= left and u - away_px <= right and v + away_px >= top and v - away_px <= bottom


@kernel(fastmath=FAST)
def _around(
    pose: Numbers, centre_obj: Array, half_extent: Array, intrinsics: Numbers, within_m: float, least_depth_m: float
) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of all pixels that any point so close to an object's bounding box may be seen at."""
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    for corner in range(8):
        # Each axis one way or the other, by a bit of the number.
        x, y, z = placed(
            pose,
            centre_obj[0] + half_extent[0] * ((corner & 1) * 2.0 - 1.0),
            centre_obj[1] + half_extent[1] * ((corner & 2) - 1.0),
            centre_obj[2] + half_extent[2] * ((corner & 4) * 0.5 - 1.0),
        )
        # Written so that what is not a number, or may lie beside or behind the camera, is near everywhere.
        if not z - within_m > least_depth_m:
            return -np.inf, -np.inf, np.inf, np.inf
        # No point of a ball is farther from its middle along an axis of the image: by the derivative of x/z along any way in it.
        around, slope_u, slope_v = within_m / (z - within_m), x / z, y / z
        u, across = intrinsics[0] * slope_u + intrinsics[2], intrinsics[0] * np.sqrt(1.0 + slope_u * slope_u) * around
        v, down = intrinsics[1] * slope_v + intrinsics[3], intrinsics[1] * np.sqrt(1.0 + slope_v * slope_v) * around
        left, right = min(left, u - across), max(right, u + across)
        top, bottom = min(top, v - down), max(bottom, v + down)
    return left, top, right, bottom


@kernel()
def newest(x: Array, y: Array, t_us: Array, bounds: Array, times_us: Array) -> bool:
    """Bring maps of newest times ``[s, h, w]`` up, if all events are on the sensor, and tell whether they are.

    Args:
        x, y, t_us: ``[e]``, one stream after the other; ``bounds [s + 1]``, where each begins, and where the last one ends.
    """
    right, bottom, end = np.uint32(0), np.uint32(0), bounds[len(times_us)]
    # Looked at before: several events at once, and none of the writes waits for it.
    for i in range(end):
        # Unsigned, a negative number is a large one.
        right, bottom = max(right, np.uint32(x[i])), max(bottom, np.uint32(y[i]))
    if end > 0 and not (right < times_us.shape[2] and bottom < times_us.shape[1]):
        return False
    width = np.uint32(times_us.shape[2])
    for s in range(len(times_us)):
        times = times_us[s].ravel()
        for i in range(np.uint64(bounds[s]), np.uint64(bounds[s + 1])):
            place = np.uint64(np.uint32(y[i]) * width + np.uint32(x[i]))
            times[place] = max(times[place], t_us[i])
    return True


@kernel()
def _tile(x: int, y: int, tile_bits: int, columns: int) -> np.uint64:
    """The tile that a pixel lies in; unsigned, as an index needs no look then whether it is negative."""
    return np.uint64(x >> tile_bits) + np.uint64(y >> tile_bits) * np.uint64(columns)


@kernel()
def keep(x: Array, y: Array, is_near: Array, tile_bits: int, columns: int, width: int, height: int, kept: Array) -> np.int64:
    """Numbers of the events in tiles near any object: how many; -1 where any event is outside the sensor.

    Args:
        kept: ``[e + 1]``, filled as far as there are any, and a zero after them.
        is_near: ``[t]``, tiles near any object.
    """
    count, tiles = np.uint64(0), np.empty(_BLOCK, np.uint32)
    for first in range(0, len(x), _BLOCK):
        if not _tiles_of(x[first : first + _BLOCK], y[first : first + _BLOCK], tile_bits, columns, width, height, tiles):
            return np.int64(-1)
        for i in range(first, min(first + _BLOCK, len(x))):
            # Products in the place of branches, of which a processor would guess many wrong.
            kept[count] = i
            count += np.uint64(is_near[np.uint64(tiles[i - first])])
    kept[count] = 0
    return np.int64(count)


@kernel()
def _tiles_of(x: Array, y: Array, tile_bits: int, columns: int, width: int, height: int, tiles: Array) -> bool:
    """The tile of each event, several at once, and whether all are on the sensor."""
    right, bottom = np.uint32(0), np.uint32(0)
    for i in range(len(x)):
        # Unsigned, a negative number is a large one.
        u, v = np.uint32(x[i]), np.uint32(y[i])
        right, bottom = max(right, u), max(bottom, v)
        tiles[i] = (u >> np.uint32(tile_bits)) + (v >> np.uint32(tile_bits)) * np.uint32(columns)
    return bool(right < width and bottom < height)


@kernel(fastmath=FAST)
def see_kept(
    kept: Array,
    x: Array,
    y: Array,
    t_us: Array,
    polarity: Array,
    end_us: int,
    elapsed_us: int,
    longest_us: int,
    long_ago_us: int,
    ideal_pixels: Array,
    before: Array,
    ages: Array,
    seen: Array,
    exists: Array,
) -> None:
    """Some events of one stream as its camera saw them, and the map of bursts brought up to the window's end.

    As :func:`update_bursts` and :func:`see` one after the other, without anything written in between.

    Args:
        kept: numbers of the events, ``[n]``.
        ideal_pixels: ``[h, w, 2]``; ``before`` and ``ages [2, h, w]``.
        seen, exists: ``[SEEN, n]`` and ``[n]``, filled; where there are more places, with zeros.
    """
    width, brighter = np.uint64(ideal_pixels.shape[1]), np.uint64(ideal_pixels.shape[0] * ideal_pixels.shape[1])
    aged, ideal = ages.ravel(), ideal_pixels.reshape(-1, 2)
    u, v, age_s, sign = seen[PIXELS], seen[PIXELS + 1], seen[AGE], seen[POLARITY]
    _age(before.ravel(), np.int16(elapsed_us), np.int16(long_ago_us - elapsed_us), aged)
    for j in range(len(kept)):
        i = np.uint64(kept[j])
        pixel, age = np.uint64(y[i]) * width + np.uint64(x[i]), end_us - t_us[i]
        _fire(aged, pixel + np.uint64(polarity[i]) * brighter, min(age, long_ago_us), True, elapsed_us, longest_us)
        u[j], v[j], age_s[j] = ideal[pixel, 0], ideal[pixel, 1], age * 1e-6
        sign[j], exists[j] = 2.0 * polarity[i] - 1.0, True
    for j in range(len(kept), len(exists)):
        exists[j] = False
        seen[:, j] = 0.0


@kernel()
def divide(kept: Array, x: Array, y: Array, near: Array, tile_bits: int, columns: int, own: Array, counts: Array) -> None:
    """Which of the events that are kept are near each object.

    Args:
        kept: numbers of the events, ``[n]``.
        near: ``[b, t]``, tiles near each object.
        own, counts: ``[b, n + 1]`` places among those that are kept, and how many of them there are: ``[b]``; filled.
    """
    tile = np.empty(len(kept), np.uint32)
    for j in range(len(kept)):
        i = np.uint64(kept[j])
        tile[j] = _tile(x[i], y[i], tile_bits, columns)
    for b in range(len(near)):
        of_object, places, count = near[b], own[b], np.uint64(0)
        for j in range(len(tile)):
            places[count] = j
            count += np.uint64(of_object[np.uint64(tile[j])])
        counts[b] = count


@kernel()
def _fire(ages: Array, place: int, age: int, exists: bool, elapsed_us: int, longest_us: int) -> None:
    """Bring a map of bursts up with one event, which may begin one; ``ages`` are those of the map, all at the window's end.

    Events come in the order of their times: the first of a pixel that begins a burst in the window is the oldest, and those after
    it begin none. What is younger than the window began in it.
    """
    began = np.int64(ages[place])
    # Written always, in the place of a branch of which a processor would guess many wrong: twice as fast.
    ages[place] = np.int16(age if exists and began - age >= longest_us and began >= elapsed_us else began)


@kernel()
def update_bursts(
    x: Array,
    y: Array,
    age_us: Array,
    polarity: Array,
    mask: Array,
    elapsed_us: Array,
    longest_us: int,
    long_ago_us: int,
    before: Array,
    ages: Array,
) -> None:
    """Bring a map of bursts up to a window's end.

    Args:
        x, y, age_us, polarity, mask: ``[s, e]``.
        elapsed_us: ``[s]``.
        before: ``[s, 2, h, w]``, where the window began.
        ages: at its end; filled.
    """
    height, width = np.uint64(before.shape[2]), np.uint64(before.shape[3])
    for s in range(len(mask)):
        elapsed, aged = elapsed_us[s], ages[s].ravel()
        _age(before[s].ravel(), np.int16(elapsed), np.int16(long_ago_us - elapsed), aged)
        for i in range(mask.shape[1]):
            place = (np.uint64(polarity[s, i]) * height + np.uint64(y[s, i])) * width + np.uint64(x[s, i])
            _fire(aged, place, min(age_us[s, i], long_ago_us), mask[s, i], elapsed, longest_us)


@kernel()
def _age(before: Array, elapsed: int, most: int, ages: Array) -> None:
    """All ages some time later: :func:`torchtrack.tracking.frontend.bursts.aged`."""
    for i in range(len(before)):
        ages[i] = min(before[i], most) + elapsed


@kernel(fastmath=FAST)
def see(x: Array, y: Array, age_us: Array, polarity: Array, mask: Array, ideal_pixels: Array, stream_index: Array, seen: Array) -> None:
    """Events of several streams as each object's camera saw them.

    Args:
        x, y, age_us, polarity, mask: ``[s, e]`` of a window.
        ideal_pixels: ``[s, h, w, 2]``.
        stream_index: ``[b]``; of one stream, ``[1]`` is enough for all that see it.
        seen: ``[SEEN, b, e]``, filled; zero where there is nothing.
    """
    width = np.uint64(ideal_pixels.shape[2])
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


def _ages_tell(burst_age_us: Tensor, elapsed_us: Tensor, events: PaddedEvents) -> bool:
    """Whether ages of bursts tell what began in the window: not in longer ones."""
    return bool((elapsed_us < LONG_AGO_US).all())


@accelerates(bursts.update_bursts, supports=_ages_tell)
def update_bursts_numba(burst_age_us: Int[Tensor, "s 2 h w"], elapsed_us: Int[Tensor, "s"], events: PaddedEvents) -> Int[Tensor, "s 2 h w"]:
    """One event after the other."""
    ages = torch.empty(burst_age_us.shape, dtype=torch.int16)
    update_bursts(*as_arrays(*vars(events).values(), elapsed_us), LONGEST_US, LONG_AGO_US, *as_arrays(burst_age_us, ages))
    return ages


@accelerates(time_surface.update_last_event)
def update_last_event_numba(last_event_us: Int[Tensor, "s h w"], events: EventBatch) -> Int[Tensor, "s h w"]:
    """One event after the other."""
    updated = last_event_us.clone(memory_format=torch.contiguous_format)
    if not newest(*as_arrays(events.x, events.y, events.t_us, stream_bounds(events, len(updated)), updated)):
        check_on_sensor(events, width=last_event_us.shape[2], height=last_event_us.shape[1])
    return updated


@accelerates(tiles.SensorTiles.near)
def near_numba(sensor: SensorTiles, prediction: Prediction, window_s: Float[Tensor, "b"], margin_px: float) -> Bool[Tensor, "b t"]:
    """Tile by tile."""
    objects = prediction.objects
    near = torch.empty(len(window_s), len(sensor.middle), dtype=torch.bool)
    variance = prediction.covariance.diagonal(dim1=-2, dim2=-1)[:, :6]
    moving = as_arrays(prediction.velocity, variance, prediction.T_cam_obj, window_s)
    own = as_arrays(objects.centre_obj, objects.half_extent, objects.diameter_m, objects.intrinsics)
    settings = TileSettings(tiles.SIGMAS, margin_px + tiles.SLACK_PX, MIN_DEPTH_M)
    near_tiles(*as_arrays(sensor.middle, sensor.reach_px), *moving, *own, settings, near.numpy())
    return near


@accelerates(tiles.SensorTiles.numbers_near)
def numbers_near_numba(sensor: SensorTiles, events: EventBatch, near: Bool[Tensor, "b t"]) -> np.ndarray:
    """Event by event."""
    kept = np.empty(len(events) + 1, np.int64)
    count = int(keep(*as_arrays(events.x, events.y, near.any(0)), TILE_BITS, sensor.columns, sensor.width, sensor.height, kept))
    if count < 0:
        check_on_sensor(events, sensor.width, sensor.height)
    return kept[:count]


@accelerates(Sensors.seen, supports=lambda sensors, window, number=None: number is None)
def seen_numba(sensors: Sensors, window: PaddedEvents, number: Int[Tensor, "e"] | None = None) -> WindowEvents:
    """Event by event."""
    batch = len(sensors.stream_index)
    # What all see alike is written once.
    own = sensors.stream_index[:1] if len(sensors.ideal_pixels) == 1 else sensors.stream_index
    seen = sensors.ideal_pixels.new_empty(SEEN, len(own), window.mask.shape[1])
    arrays = as_arrays(window.x, window.y, window.age_us, window.polarity, window.mask, sensors.ideal_pixels)
    see(*arrays, *as_arrays(own), seen.numpy())
    return _of_rows(seen.expand(-1, batch, -1), window.mask[own].expand(batch, -1))


def _are_chosen(sensors: Sensors, nearby: NearbyEvents, burst_age_us: Tensor, t_us: Tensor, elapsed_us: Tensor) -> bool:
    """Whether the events that count are still to be chosen by their tiles, in a window short enough for ages of bursts to tell what began in it."""
    return nearby.near_tiles is not None and int(elapsed_us) < LONG_AGO_US


@accelerates(Sensors.window_events, supports=_are_chosen)
def window_events_numba(
    sensors: Sensors,
    nearby: NearbyEvents,
    burst_age_us: Int[Tensor, "s 2 h w"],
    t_us: Int[Tensor, "s"],
    elapsed_us: Int[Tensor, "s"],
) -> tuple[ObjectEvents, Int[Tensor, "s 2 h w"]]:
    """The events in tiles near each object, as it saw them, and the bursts' ages with them, event by event."""
    near, tiles_of = nearby.near_tiles, sensors.tiles
    if near is None or tiles_of is None:
        raise ValueError("a kernel chooses events by their tiles: there have to be some.")
    events = of_streams(nearby.events, 1)
    kept, batch = numbers_near_numba(tiles_of, events, near), len(near)
    # One place at least: what selects from events needs one to point at.
    numbers = kept if len(kept) else np.zeros(1, np.int64)
    places = len(numbers)
    seen, ages_us = sensors.ideal_pixels.new_empty(SEEN, 1, places), torch.empty(burst_age_us.shape, dtype=burst_age_us.dtype)
    exists, of_bursts = torch.empty(1, places, dtype=torch.bool), (int(elapsed_us), LONGEST_US, LONG_AGO_US)
    of_events = as_arrays(events.x, events.y, events.t_us, events.polarity)
    maps = as_arrays(sensors.ideal_pixels[0], burst_age_us[0], ages_us[0])
    see_kept(kept, *of_events, int(t_us), *of_bursts, *maps, *as_arrays(seen[:, 0], exists[0]))
    shared = replace(_of_rows(seen, exists), number=torch.from_numpy(numbers[None]))
    if batch == 1:
        return shared, ages_us
    # Only what is written of this is ever looked at.
    own, counts = torch.empty(batch, places + 1, dtype=torch.int32), torch.empty(batch, dtype=torch.int64)
    divide(kept, *of_events[:2], *as_arrays(near), TILE_BITS, tiles_of.columns, *as_arrays(own, counts))
    return SharedEvents(shared, own, counts), ages_us


def _of_rows(seen: Float[Tensor, "4 b e"], exists: Bool[Tensor, "b e"]) -> WindowEvents:
    """Events by their rows: pixels, ages and polarities."""
    age_s, polarity = seen[AGE:].unbind()
    return WindowEvents(seen[:AGE].permute(1, 2, 0), age_s, polarity, exists)
