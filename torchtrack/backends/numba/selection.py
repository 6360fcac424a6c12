"""Choosing the events that are observed: :func:`torchtrack.tracking.association.observations.select_events`, object by object."""

import numpy as np
import torch

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import at_depth, drift, lens
from torchtrack.backends.numba.index import cells_of
from torchtrack.backends.numba.look_up import nearest
from torchtrack.backends.numba.parameters import Cells
from torchtrack.core.dispatch import accelerates
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.tracking.association import observations
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.frontend.corners import no_corners
from torchtrack.tracking.frontend.window_events import GOLDEN_RATIO, ObjectEvents, laid_out


@kernel(fastmath=FAST)
def select(
    u: Array,
    v: Array,
    age_s: Array,
    polarity: Array,
    mask: Array,
    number: Array,
    own: Array,
    counts: Array,
    velocity: Array,
    centre_cam: Array,
    intrinsics: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    count: int,
    fill: float,
    golden_ratio: float,
    corners: tuple[Array, Array, Array, Array],
    chosen: Array,
    exists: Array,
) -> None:
    """Take events near each object's contours once moved to the window's end, spread evenly in time, and corners, in their places.

    Args:
        u, v, age_s, polarity, mask: ``[e, n]``: events of each object, or one row for all.
        number: ``[e, n]`` of each among all of the window, by which lots are drawn.
        own, counts: ``[b, n]`` of the one row, those of each object, and how many these are: ``[b]``; ``[0, 0]`` for all.
        count: of events that are drawn, and of observations that events make up, where corners are fewer.
        corners: pixels ``[b, k, 2]``, ages, polarities, and which exist: ``[b, k]``.
        chosen: ``[b, 4, c]`` pixels, ages and polarities; filled as far as there are any, as ``exists [b, c]`` says, and else zero.
    """
    near, (corner_pixels, corner_age_s, corner_polarity, is_corner) = np.empty(mask.shape[1] + 1, np.int64), corners
    chosen[:], exists[:] = 0.0, False
    for b in range(len(chosen)):
        e = b if len(mask) > 1 else 0
        looked_at = counts[b] if len(own) else mask.shape[1]
        total = _find(
            u[e], v[e], age_s[e], mask[e], own[b] if len(own) else own.ravel(), looked_at, velocity[b], centre_cam[b], intrinsics[b],
            nearest_of_cell[b], first[b], cells, near,
        )  # fmt: skip
        drawn = _draw(near, total, number[e], fill, golden_ratio, count)
        for k in range(is_corner.shape[1]):
            if is_corner[b, k]:
                exists[b, k], chosen[b, 0, k], chosen[b, 1, k] = True, corner_pixels[b, k, 0], corner_pixels[b, k, 1]
                chosen[b, 2, k], chosen[b, 3, k] = corner_age_s[b, k], corner_polarity[b, k]
        share, apart, place = (count - is_corner[b].sum()) / max(min(drawn, count), 1), max(drawn / count, 1.0), 0
        for j in range(count):
            # Spread evenly over what was drawn, should it be more than places.
            rank, lot = int(j * apart), j * golden_ratio
            while place < exists.shape[1] and exists[b, place]:
                place += 1
            if rank >= drawn or place == exists.shape[1]:
                break
            if lot - np.floor(lot) < share:
                i = near[rank]
                chosen[b, 0, place], chosen[b, 1, place] = u[e, i], v[e, i]
                chosen[b, 2, place], chosen[b, 3, place], exists[b, place] = age_s[e, i], polarity[e, i], True


@kernel(fastmath=FAST)
def _find(
    u: Array,
    v: Array,
    age_s: Array,
    mask: Array,
    own: Array,
    looked_at: int,
    velocity: Array,
    centre_cam: Array,
    intrinsics: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    near: Array,
) -> np.int64:
    """Events near the contours of one object, of the first that are its ``own`` or, without a list of them, of all: how many, first in ``near``."""
    motion, depth_m, of_lens, total = drift(velocity, centre_cam), centre_cam[2], lens(intrinsics), np.uint64(0)
    for j in range(looked_at):
        i = np.uint64(own[j]) if len(own) else np.uint64(j)
        speed_u, speed_v = at_depth(motion, depth_m, u[i], v[i], of_lens)
        nearest_index = nearest(nearest_of_cell, first, u[i] + speed_u * age_s[i], v[i] + speed_v * age_s[i], cells)
        near[total] = i
        total += np.uint64(mask[i] and nearest_index >= 0)
    return np.int64(total)


@kernel(fastmath=FAST)
def _draw(near: Array, total: np.int64, number: Array, fill: float, golden_ratio: float, places: int) -> np.int64:
    """Draw a share of the events, by their own numbers, where there are more than places; how many were drawn, first in ``near``."""
    if total <= places:
        return total
    share, drawn = fill * places / total, np.int64(0)
    for j in range(total):
        lot = number[near[j]] * golden_ratio
        near[drawn] = near[j]
        drawn += lot - np.floor(lot) < share
    return drawn


@accelerates(observations.select_events)
def select_events_numba(
    events: ObjectEvents, index: ContourIndex, objects: MovingObjects, count: int, corners: Observations | None = None
) -> Observations:
    """Event by event."""
    rows, own, counts = laid_out(events)
    number = torch.arange(rows.mask.shape[1]).expand(len(rows.mask), -1) if rows.number is None else rows.number
    batch = len(objects.velocity)
    corners = observations.corner_observations(no_corners(rows.pixels.expand(batch, -1, -1))) if corners is None else corners
    places = max(count, corners.mask.shape[1])
    chosen, exists = rows.pixels.new_empty(batch, 4, places), torch.empty(batch, places, dtype=torch.bool)
    seen = as_arrays(*rows.pixels.unbind(-1), rows.age_s, rows.polarity, rows.mask, number, own, counts)
    moving = as_arrays(objects.velocity, objects.centre_cam, objects.intrinsics, index.nearest, index.first)
    of_corners = as_arrays(corners.pixels, corners.age_s, corners.polarity, corners.mask)
    drawing = (count, observations.FILL, GOLDEN_RATIO, tuple(of_corners))
    select(*seen, *moving, cells_of(index), *drawing, chosen.numpy(), exists.numpy())
    taken = observations.event_observations(chosen.transpose(1, 2), exists)
    if len(corners.flow[0]):
        taken.flow[:, : len(corners.flow[0])], taken.has_flow[:, : len(corners.flow[0])] = corners.flow, corners.has_flow
    return taken
