"""Choosing the events that are observed: :func:`torchtrack.observations.select_events`, object by object."""

import numpy as np

from torchtrack.kernels.compiler import FAST, Array, kernel
from torchtrack.kernels.look_up import nearest
from torchtrack.kernels.motion import at_depth, drift, lens
from torchtrack.kernels.settings import Cells


@kernel(fastmath=FAST)
def select(
    pixels: Array,
    told: Array,
    mask: Array,
    number: Array,
    velocity: Array,
    centre_cam: Array,
    intrinsics: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    fill: float,
    golden_ratio: float,
    chosen: Array,
    exists: Array,
) -> None:
    """Take events near each object's contours once moved to the window's end, spread evenly in time.

    Args:
        pixels: ``[e, 2, n]``, with ``told [e, 3, n]`` (age, time into the burst, polarity) and ``mask [e, n]``: events of each object,
            or one row for all.
        number: ``[e, n]`` of each among all of the window, by which lots are drawn.
        chosen: ``[b, 5, c]`` pixels and what is told; filled as far as there are any, as ``exists [b, c]`` says, and else zero.
    """
    near = np.empty(mask.shape[1], np.int64)
    chosen[:] = 0.0
    for b in range(len(chosen)):
        e = b if len(mask) > 1 else 0
        motion, depth_m, of_lens = drift(velocity[b], centre_cam[b]), centre_cam[b, 2], lens(intrinsics[b])
        total = 0
        for i in range(mask.shape[1]):
            if mask[e, i]:
                u, v, age = pixels[e, 0, i], pixels[e, 1, i], told[e, 0, i]
                speed_u, speed_v = at_depth(motion, depth_m, u, v, of_lens)
                if nearest(nearest_of_cell[b], first[b], u + speed_u * age, v + speed_v * age, cells) >= 0:
                    near[total] = i
                    total += 1
        drawn = _draw(near, total, number[e], fill, golden_ratio, chosen.shape[2])
        _take(near, drawn, pixels[e], told[e], chosen[b], exists[b])


@kernel(fastmath=FAST)
def _draw(near: Array, total: int, number: Array, fill: float, golden_ratio: float, places: int) -> int:
    """Draw a share of the events, by their own numbers, where there are more than places; how many were drawn, first in ``near``."""
    if total <= places:
        return total
    share, drawn = fill * places / total, 0
    for j in range(total):
        if (number[near[j]] * golden_ratio) % 1.0 < share:
            near[drawn] = near[j]
            drawn += 1
    return drawn


@kernel(fastmath=FAST)
def _take(near: Array, drawn: int, pixels: Array, told: Array, chosen: Array, exists: Array) -> None:
    """Take what was drawn, spread evenly over it should it be more than places."""
    places = chosen.shape[1]
    apart = max(drawn / places, 1.0)
    for j in range(places):
        rank = int(j * apart)
        exists[j] = rank < drawn
        if exists[j]:
            i = near[rank]
            chosen[0, j], chosen[1, j] = pixels[0, i], pixels[1, i]
            for k in range(3):
                chosen[2 + k, j] = told[k, i]
