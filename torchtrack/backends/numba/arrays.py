"""Tensors as kernels take them: arrays, and by name what belongs together.

Python hands a kernel plain tuples, in the order of a named one's fields: of named ones, Numba takes longer to find out what they are than for all
their arrays. So kernels that Python calls name them first.
"""

from typing import NamedTuple

import numpy as np
from torch import Tensor

from torchtrack.backends.numba.compiler import Array, kernel
from torchtrack.backends.numba.parameters import Cells
from torchtrack.core.events import PaddedEvents
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.tracking.contours.index import OFF_BORDER_PX, ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.time_surface import Regions
from torchtrack.tracking.frontend.window_events import ObjectEvents, WindowEvents, laid_out

Arrays = tuple[Array, ...]


def as_arrays(*values: Tensor) -> tuple[np.ndarray, ...]:
    """Tensors as arrays that lie row by row in memory: in the same memory where they do already."""
    return tuple([value.contiguous().numpy() for value in values])


class ContourArrays(NamedTuple):
    """Contour points at their poses: ``[b, 3, m]``, ``[b, 2, m]``, and ``[b, m]``."""

    points_cam: Array
    pixels: Array
    normals: Array
    mask: Array
    kind: Array


class IndexArrays(NamedTuple):
    """An index of nearest contour points.

    Args:
        nearest: ``[b, p]``, the number of the point nearest to each cell; -1 for none.
        first: ``[b, 2]``, the first cell (column, row) of each region.
        cells: the layout.
    """

    nearest: Array
    first: Array
    cells: Cells


class MovingArrays(NamedTuple):
    """How objects move before their cameras: ``[b, 6]``, ``[b, 3]``, and ``[b, 4]``."""

    velocity: Array
    centre_cam: Array
    intrinsics: Array


class MovingContours(NamedTuple):
    """Contours as they show and move, and their index."""

    shown: ContourArrays
    nearest: IndexArrays
    moving: MovingArrays


class EventArrays(NamedTuple):
    """Events of a window as objects see them.

    Args:
        u, v, age_s, polarity, mask: ``[e, n]``, a row for each object or one for all.
        own, counts: ``[b, n]``, which of the one row are each object's, and how many: ``[b]``; both empty where all are.
    """

    u: Array
    v: Array
    age_s: Array
    polarity: Array
    mask: Array
    own: Array
    counts: Array


class ObjectEventArrays(NamedTuple):
    """Events of one object: ``[n]`` of a row, of which the first ``total`` are its own, or the first ``total`` that are named as such."""

    u: Array
    v: Array
    age_s: Array
    polarity: Array
    mask: Array
    own: Array
    total: int


class PaddedArrays(NamedTuple):
    """Events of a window by stream: ``[s, e]``."""

    x: Array
    y: Array
    age_us: Array
    polarity: Array
    mask: Array


class RegionArrays(NamedTuple):
    """Rectangles of sensors: ``[b, 2]``, ``[b, 2]``, and the stream of each, ``[b]``."""

    origin: Array
    extent: Array
    stream_index: Array


class SolutionArrays(NamedTuple):
    """Poses and what else is solved for, with the last linearisation.

    Args:
        T_cam_obj, offset: ``[b, 4, 4]``, and from the prior ``[b, k]``.
        gradient, hessian: ``[b, k]`` and ``[b, k, k]``.
    """

    T_cam_obj: Array
    offset: Array
    gradient: Array
    hessian: Array


def contour_arrays(contours: Contours) -> Arrays:
    """Contour points at their poses: :class:`ContourArrays`."""
    places = (value.transpose(1, 2) for value in (contours.points_cam, contours.pixels, contours.normals))
    return as_arrays(*places, contours.mask, contours.kind)


def index_arrays(index: ContourIndex) -> tuple[Array, Array, Cells]:
    """An index of nearest contour points: :class:`IndexArrays`."""
    nearest, first = as_arrays(index.nearest, index.first)
    return nearest, first, Cells(*index.size, float(index.cell_px), OFF_BORDER_PX)


def moving_arrays(objects: MovingObjects) -> Arrays:
    """How objects move before their cameras: :class:`MovingArrays`."""
    return as_arrays(objects.velocity, objects.centre_cam, objects.intrinsics)


@kernel()
def moving_contours(contours: MovingContours) -> MovingContours:
    """The same with the names of all parts."""
    shown, nearest, moving = contours
    return MovingContours(ContourArrays(*shown), IndexArrays(*nearest), MovingArrays(*moving))


def event_arrays(events: ObjectEvents) -> tuple[WindowEvents, Arrays]:
    """Events of a window as objects see them: their rows, and :class:`EventArrays`."""
    rows, own, counts = laid_out(events)
    return rows, as_arrays(*rows.pixels.unbind(-1), rows.age_s, rows.polarity, rows.mask, own, counts)


@kernel()
def events_of(events: EventArrays, b: int) -> ObjectEventArrays:
    """The events of one object."""
    u, v, age_s, polarity, mask, own, counts = events
    e, of_object, count = b if len(mask) > 1 else 0, own[b] if len(own) else own.ravel(), counts[b] if len(own) else mask.shape[1]
    return ObjectEventArrays(u[e], v[e], age_s[e], polarity[e], mask[e], of_object, count)


def padded_arrays(events: PaddedEvents) -> Arrays:
    """Events of a window by stream: :class:`PaddedArrays`."""
    return as_arrays(events.x, events.y, events.age_us, events.polarity, events.mask)


def region_arrays(regions: Regions) -> Arrays:
    """Rectangles of sensors: :class:`RegionArrays`."""
    return as_arrays(regions.origin, regions.extent, regions.stream_index)
