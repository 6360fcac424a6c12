"""Choosing the events that are observed: :func:`torchtrack.tracking.association.observations.select_events`, object by object."""

from typing import NamedTuple

import numpy as np
import torch

from torchtrack.backends.numba.arrays import (
    EventArrays,
    IndexArrays,
    MovingArrays,
    ObjectEventArrays,
    as_arrays,
    event_arrays,
    events_of,
    index_arrays,
    moving_arrays,
)
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Plane, carried, plane_of
from torchtrack.backends.numba.look_up import index_of, nearest
from torchtrack.core.dispatch import accelerates
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.tracking.association import observations
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.frontend.corners import no_corners
from torchtrack.tracking.frontend.window_events import GOLDEN_RATIO, ObjectEvents


class Drawing(NamedTuple):
    """How events are drawn.

    Args:
        number: ``[e, n]`` of each among all of the window, by which lots are drawn.
        wanted: how many events are drawn, and how many observations that events make up, where corners are fewer.
        fill, golden_ratio: share of the places that events are drawn for, and what lots are multiples of.
    """

    number: Array
    wanted: int
    fill: float
    golden_ratio: float


class ObservedCorners(NamedTuple):
    """Corners: pixels ``[b, k, 2]``, ages, polarities, and which exist: ``[b, k]``."""

    pixels: Array
    age_s: Array
    polarity: Array
    mask: Array


class Chosen(NamedTuple):
    """What is observed: pixels, ages and polarities ``[b, 4, c]``, and which exist, ``[b, c]``."""

    rows: Array
    exists: Array


@kernel(fastmath=FAST)
def select(events: EventArrays, moving: MovingArrays, index: IndexArrays, drawing: Drawing, corners: ObservedCorners, chosen: Chosen) -> None:
    """Take events near each object's contours once moved to the window's end, spread evenly in time, and corners, in their places.

    Args:
        chosen: filled as far as there are any, and else zero.
    """
    events, corners, moving = EventArrays(*events), ObservedCorners(*corners), MovingArrays(*moving)
    (rows, exists), (number, count, _, golden_ratio), near = chosen, drawing, np.empty(events.mask.shape[1] + 1, np.int64)
    rows[:], exists[:] = 0.0, False
    for b in range(len(rows)):
        e = b if len(events.mask) > 1 else 0
        total = _find(events_of(events, b), plane_of(moving, b), index_of(index, b), near)
        drawn = _draw(near, total, number[e], drawing)
        for k in range(corners.mask.shape[1]):
            if corners.mask[b, k]:
                exists[b, k], rows[b, 0, k], rows[b, 1, k] = True, corners.pixels[b, k, 0], corners.pixels[b, k, 1]
                rows[b, 2, k], rows[b, 3, k] = corners.age_s[b, k], corners.polarity[b, k]
        share, apart, place = (count - corners.mask[b].sum()) / max(min(drawn, count), 1), max(drawn / count, 1.0), 0
        for j in range(count):
            # Spread evenly over what was drawn, should it be more than places.
            rank, lot = int(j * apart), j * golden_ratio
            while place < exists.shape[1] and exists[b, place]:
                place += 1
            if rank >= drawn or place == exists.shape[1]:
                break
            if lot - np.floor(lot) < share:
                i = near[rank]
                rows[b, 0, place], rows[b, 1, place] = events.u[e, i], events.v[e, i]
                rows[b, 2, place], rows[b, 3, place], exists[b, place] = events.age_s[e, i], events.polarity[e, i], True


@kernel(fastmath=FAST)
def _find(events: ObjectEventArrays, plane: Plane, index: IndexArrays, near: Array) -> np.int64:
    """Which events are near the contours of an object: how many, first in ``near``."""
    u, v, age_s, _, mask, own, count = events
    total = np.uint64(0)
    for j in range(count):
        i = np.uint64(own[j]) if len(own) else np.uint64(j)
        at_u, at_v = carried(plane, u[i], v[i], age_s[i])
        near[total] = i
        total += np.uint64(mask[i] and nearest(index, at_u, at_v) >= 0)
    return np.int64(total)


@kernel(fastmath=FAST)
def _draw(near: Array, total: np.int64, number: Array, drawing: Drawing) -> np.int64:
    """Draw a share of the events, by their own numbers, where there are more than places; how many were drawn, first in ``near``."""
    if total <= drawing.wanted:
        return total
    share, drawn = drawing.fill * drawing.wanted / total, np.int64(0)
    for j in range(total):
        lot = number[near[j]] * drawing.golden_ratio
        near[drawn] = near[j]
        drawn += lot - np.floor(lot) < share
    return drawn


@accelerates(observations.select_events)
def select_events_numba(
    events: ObjectEvents, index: ContourIndex, objects: MovingObjects, count: int, corners: Observations | None = None
) -> Observations:
    """Event by event."""
    rows, seen = event_arrays(events)
    number = torch.arange(rows.mask.shape[1]).expand(len(rows.mask), -1) if rows.number is None else rows.number
    batch = len(objects.velocity)
    corners = observations.corner_observations(no_corners(rows.pixels.expand(batch, -1, -1))) if corners is None else corners
    places = max(count, corners.mask.shape[1])
    chosen, exists = rows.pixels.new_empty(batch, 4, places), torch.empty(batch, places, dtype=torch.bool)
    drawing = Drawing(number.contiguous().numpy(), count, observations.FILL, GOLDEN_RATIO)
    of_corners = as_arrays(corners.pixels, corners.age_s, corners.polarity, corners.mask)
    select(seen, moving_arrays(objects), index_arrays(index), drawing, of_corners, as_arrays(chosen, exists))
    taken = observations.event_observations(chosen.transpose(1, 2), exists)
    if len(corners.flow[0]):
        taken.flow[:, : len(corners.flow[0])], taken.has_flow[:, : len(corners.flow[0])] = corners.flow, corners.has_flow
    return taken
