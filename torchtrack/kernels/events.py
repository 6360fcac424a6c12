"""From a window's events to what each object sees of them: :mod:`torchtrack.sensor_tiles`, ``bursts`` and ``sensors``, event by event."""

import numpy as np

from torchtrack.kernels.compiler import FAST, Array, kernel
from torchtrack.kernels.motion import inverse_depth
from torchtrack.kernels.settings import TileSettings

# Rows of what an object sees of an event.
PIXELS, AGE, INTO_BURST, POLARITY = 0, 2, 3, 4
SEEN = 5


@kernel(fastmath=FAST)
def near_tiles(
    middle: Array,
    reach_px: Array,
    velocity: Array,
    variance: Array,
    centre_cam: Array,
    diameter_m: Array,
    intrinsics: Array,
    window_s: Array,
    tiles: TileSettings,
    near: Array,
) -> None:
    """Tiles that anything can be seen in that is near an object: :meth:`torchtrack.sensor_tiles.SensorTiles.near`.

    Args:
        middle, reach_px: ``[t, 2]`` and ``[t]``.
        velocity, variance: ``[b, 6]``, and of the pose, ``[b, 6]``.
        near: ``[b, t]``, filled.
    """
    for b in range(len(near)):
        x, y, z = centre_cam[b]
        rim_m = 0.5 * diameter_m[b]
        turning = np.sqrt((velocity[b, :3] ** 2).sum())
        speed_m_s = np.sqrt((velocity[b, 3:] ** 2).sum())
        turned, moved = np.sqrt(variance[b, :3].max()), np.sqrt(variance[b, 3:].max())
        radius_m = rim_m + (speed_m_s + rim_m * turning) * window_s[b] + tiles.sigmas * (moved + rim_m * turned)
        # No point of a sphere is farther from its middle in the image: by the derivative of x/z along any way in it.
        slant = np.sqrt(1.0 + (x * x + y * y) / (z * z))
        radius_px = max(intrinsics[b, 0], intrinsics[b, 1]) * slant * radius_m * inverse_depth(z - radius_m) + tiles.margin_px
        inverse = inverse_depth(z)
        u, v = x * inverse * intrinsics[b, 0] + intrinsics[b, 2], y * inverse * intrinsics[b, 1] + intrinsics[b, 3]
        for t in range(len(middle)):
            du, dv = middle[t, 0] - u, middle[t, 1] - v
            # Written so that what is not a number is near.
            near[b, t] = not np.sqrt(du * du + dv * dv) - reach_px[t] > radius_px


@kernel()
def keep(x: Array, y: Array, near: Array, tile_bits: int, columns: int, kept: Array, own: Array, counts: Array) -> int:
    """Events in tiles near any object: how many, with their numbers in ``kept [e]``.

    Args:
        near: ``[b, t]``.
        own: ``[b, e]``, which of those that are kept each object is near, by their place among them; ``counts [b]`` of each. Of one
            object, ``[0, e]``: it is near all.
    """
    count = 0
    counts[:] = 0
    for i in range(len(x)):
        tile, is_near = (x[i] >> tile_bits) + (y[i] >> tile_bits) * columns, False
        for b in range(len(near)):
            if near[b, tile]:
                is_near = True
                if len(own):
                    own[b, counts[b]] = count
                    counts[b] += 1
        if is_near:
            kept[count] = i
            count += 1
    return count


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
    into_us: Array,
) -> None:
    """Bring a map of bursts up to a window's end, and tell how far into its burst each event is (µs).

    Events come in the order of their times: the first of a pixel that begins a burst in the window is the oldest, and those after
    it begin none.

    Args:
        x, y, age_us, polarity, mask: ``[s, e]``.
        elapsed_us: ``[s]``; what is younger than that began in the window.
        before: ``[s, 2, h, w]``, where the window began.
        ages, into_us: at its end, and ``[s, e]``; filled.
    """
    for s in range(len(mask)):
        elapsed = elapsed_us[s]
        _age(before[s].ravel(), np.int16(elapsed), np.int16(long_ago_us - elapsed), ages[s].ravel())
        for i in range(mask.shape[1]):
            into_us[s, i] = 0
            if not mask[s, i]:
                continue
            side, age = int(polarity[s, i]), min(age_us[s, i], long_ago_us)
            into = np.int64(ages[s, side, y[s, i], x[s, i]]) - age
            if into < longest_us:
                into_us[s, i] = into
            elif ages[s, side, y[s, i], x[s, i]] >= elapsed:
                ages[s, side, y[s, i], x[s, i]] = age


@kernel()
def _age(before: Array, elapsed: int, most: int, ages: Array) -> None:
    """All ages some time later: :func:`torchtrack.bursts.aged`."""
    for i in range(len(before)):
        ages[i] = min(before[i], most) + elapsed


@kernel(fastmath=FAST)
def see(
    x: Array,
    y: Array,
    age_us: Array,
    into_us: Array,
    polarity: Array,
    mask: Array,
    ideal_pixels: Array,
    stream_index: Array,
    own: Array,
    counts: Array,
    seen: Array,
    exists: Array,
) -> None:
    """Events as each object's camera saw them.

    Args:
        x, y, age_us, into_us, polarity, mask: ``[s, e]`` of a window.
        ideal_pixels: ``[s, h, w, 2]``.
        stream_index: ``[b]``.
        own, counts: ``[b, c]`` events of each object, and how many they are; ``[0, 0]`` for all of its stream.
        seen, exists: ``[b, SEEN, c]`` and ``[b, c]``, filled; zero where there is nothing.
    """
    for b in range(len(seen)):
        s = stream_index[b]
        for j in range(seen.shape[2]):
            i = j
            if len(own):
                i = own[b, j] if j < counts[b] else 0
            exists[b, j] = mask[s, i] and (len(own) == 0 or j < counts[b])
            if not exists[b, j]:
                for k in range(SEEN):
                    seen[b, k, j] = 0.0
                continue
            for k in range(2):
                seen[b, PIXELS + k, j] = ideal_pixels[s, y[s, i], x[s, i], k]
            seen[b, AGE, j], seen[b, INTO_BURST, j] = age_us[s, i] * 1e-6, into_us[s, i] * 1e-6
            seen[b, POLARITY, j] = 1.0 if polarity[s, i] else -1.0
