"""Which events can have to do with which object: :mod:`torchtrack.tracking.frontend.tiles`, tile by tile and event by event."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, entries, lens, placed
from torchtrack.backends.numba.parameters import TileSettings
from torchtrack.core.camera import MIN_DEPTH_M
from torchtrack.core.dispatch import accelerates
from torchtrack.core.events import EventBatch, check_on_sensor
from torchtrack.tracking.frontend import tiles
from torchtrack.tracking.frontend.tiles import TILE_BITS, SensorTiles
from torchtrack.tracking.motion.prediction import Prediction

# Events that are looked at together: what is found of them stays in the processor's nearest memory.
_BLOCK = 1024


class Tiles(NamedTuple):
    """Tiles of each sensor: middles ``[s, t, 2]``, and how far anything in one reaches, ``[s, t]``."""

    middle: Array
    reach_px: Array


class Motions(NamedTuple):
    """How objects are expected to move: ``[b, 6]``, the variance of the pose ``[b, 6]``, ``[b, 4, 4]``, and the window ``[b]``."""

    velocity: Array
    variance: Array
    T_cam_obj: Array
    window_s: Array


class Boxes(NamedTuple):
    """Boxes around objects, in their frames, and what sees each."""

    centre_obj: Array
    half_extent: Array
    diameter_m: Array
    intrinsics: Array
    stream_index: Array


class TileGrid(NamedTuple):
    """Tiles of a sensor: so many bits of a pixel's place lie within one; so many ``columns`` of them; and the sensor's size (px)."""

    bits: int
    columns: int
    width: int
    height: int


@kernel(fastmath=FAST)
def near_tiles(tiles: Tiles, motions: Motions, boxes: Boxes, settings: TileSettings, near: Array) -> None:
    """Tiles that anything can be seen in that is near an object: :meth:`torchtrack.tracking.frontend.tiles.SensorTiles.near`.

    Args:
        near: ``[b, t]``, filled.
    """
    (velocity, variance, T_cam_obj, window_s), boxes, tiles = motions, Boxes(*boxes), Tiles(*tiles)
    for b in range(len(near)):
        rim_m = 0.5 * boxes.diameter_m[b]
        turning = np.sqrt((velocity[b, :3] ** 2).sum())
        speed_m_s = np.sqrt((velocity[b, 3:] ** 2).sum())
        turned, moved = np.sqrt(variance[b, :3].max()), np.sqrt(variance[b, 3:].max())
        within_m = (speed_m_s + rim_m * turning) * window_s[b] + settings.sigmas * (moved + rim_m * turned)
        pose, of_lens = entries(T_cam_obj[b]), lens(boxes.intrinsics[b])
        left, top, right, bottom = _around(pose, boxes.centre_obj[b], boxes.half_extent[b], of_lens, within_m, settings.least_depth_m)
        of_sensor, reach_of_sensor = tiles.middle[boxes.stream_index[b]], tiles.reach_px[boxes.stream_index[b]]
        for t in range(len(of_sensor)):
            u, v, away_px = of_sensor[t, 0], of_sensor[t, 1], reach_of_sensor[t] + settings.margin_px
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
def keep(x: Array, y: Array, is_near: Array, grid: TileGrid, kept: Array) -> np.int64:
    """Numbers of the events of one stream in tiles near any object: how many; -1 where any event is outside the sensor.

    Args:
        kept: ``[e + 1]``, filled as far as there are any, and a zero after them.
        is_near: ``[t]``, tiles near any object.
    """
    count, tiles = np.uint64(0), np.empty(_BLOCK, np.uint32)
    for first in range(0, len(x), _BLOCK):
        if not _fill(x[first : first + _BLOCK], y[first : first + _BLOCK], grid, tiles):
            return np.int64(-1)
        for i in range(first, min(first + _BLOCK, len(x))):
            # Products in the place of branches, of which a processor would guess many wrong.
            kept[count] = i
            count += np.uint64(is_near[np.uint64(tiles[i - first])])
    kept[count] = 0
    return np.int64(count)


@kernel()
def _fill(x: Array, y: Array, grid: TileGrid, tiles: Array) -> bool:
    """The tile of each event, several at once, and whether all are on the sensor."""
    right, bottom = np.uint32(0), np.uint32(0)
    for i in range(len(x)):
        # Unsigned, a negative number is a large one.
        u, v = np.uint32(x[i]), np.uint32(y[i])
        right, bottom = max(right, u), max(bottom, v)
        tiles[i] = (u >> np.uint32(grid.bits)) + (v >> np.uint32(grid.bits)) * np.uint32(grid.columns)
    return bool(right < grid.width and bottom < grid.height)


@kernel()
def tiles_of(x: Array, y: Array, kept: Array, grid: TileGrid) -> Array:
    """The tiles of the events that are kept, by their numbers ``[n]``."""
    tiles = np.empty(len(kept), np.uint32)
    for j in range(len(kept)):
        # Unsigned, an index needs no look whether it is negative.
        i = np.uint64(kept[j])
        tiles[j] = np.uint64(x[i] >> grid.bits) + np.uint64(y[i] >> grid.bits) * np.uint64(grid.columns)
    return tiles


@kernel()
def divide(tiles: Array, bounds: Array, near: Array, stream_index: Array, own: Array, counts: Array) -> None:
    """Which of the events that are kept are near each object.

    Args:
        tiles: of the events, ``[n]``, stream by stream, as ``bounds [s + 1]`` says.
        near: ``[b, t]``, tiles near each object.
        own, counts: ``[b, n + 1]`` places among those that are kept, and how many of them there are: ``[b]``; filled.
    """
    for b in range(len(near)):
        of_object, places, count = near[b], own[b], np.uint64(0)
        for j in range(bounds[stream_index[b]], bounds[stream_index[b] + 1]):
            places[count] = j
            count += np.uint64(of_object[np.uint64(tiles[j])])
        counts[b] = count


def grid_of(sensor: SensorTiles) -> TileGrid:
    """The tiles of a sensor."""
    return TileGrid(TILE_BITS, sensor.columns, sensor.width, sensor.height)


@accelerates(tiles.SensorTiles.near)
def near_numba(sensor: SensorTiles, prediction: Prediction, window_s: Float[Tensor, "b"], margin_px: float) -> Bool[Tensor, "b t"]:
    """Tile by tile."""
    objects = prediction.objects
    near = torch.empty(len(window_s), sensor.middle.shape[1], dtype=torch.bool)
    variance = prediction.covariance.diagonal(dim1=-2, dim2=-1)[:, :6]
    motions = as_arrays(prediction.velocity, variance, prediction.T_cam_obj, window_s)
    boxes = as_arrays(objects.centre_obj, objects.half_extent, objects.diameter_m, objects.intrinsics, objects.stream_index)
    settings = TileSettings(tiles.SIGMAS, margin_px + tiles.SLACK_PX, MIN_DEPTH_M)
    near_tiles(as_arrays(sensor.middle, sensor.reach_px), motions, boxes, settings, near.numpy())
    return near


def numbers_near(sensor: SensorTiles, events: EventBatch, near: Bool[Tensor, "b t"]) -> np.ndarray:
    """The numbers of the events of one stream in tiles near any object.

    Raises:
        EventDataError: if an event is outside the sensor.
    """
    kept = np.empty(len(events) + 1, np.int64)
    count = int(keep(*as_arrays(events.x, events.y, near.any(0)), grid_of(sensor), kept))
    if count < 0:
        check_on_sensor(events, sensor.width, sensor.height)
    return kept[:count]
