"""What describes observations of smooth silhouettes, one by one:
:func:`torchtrack.tracking.association.weighting_features.silhouette_features`.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import (
    EventArrays,
    MovingContours,
    ObjectEventArrays,
    as_arrays,
    contour_arrays,
    event_arrays,
    events_of,
    index_arrays,
    moving_arrays,
    moving_contours,
)
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, Plane, across, carried, inverse_depth, plane_of
from torchtrack.backends.numba.look_up import index_of, nearest
from torchtrack.backends.numba.parameters import PatchSettings
from torchtrack.core.dispatch import accelerates
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association import weighting_features
from torchtrack.tracking.association.weighting_features import WeightingInputs
from torchtrack.tracking.frontend.history import BORDER_PX

# Places are worked out so many at once: what is left over would be, one at a time.
_AT_ONCE = 32
# Events of a polarity that are counted at a place, at most; those of the other one lie in the bits beside them.
_MOST, _BITS = 255, 8
# The last numbers of a description.
_SPEED, _POLARITY, _SIDE, _KNOWN, _AGE, _EXISTS = range(-6, 0)


class ObservationArrays(NamedTuple):
    """Observations: ``[b, 2, n]``, and ``[b, n]``."""

    pixels: Array
    age_s: Array
    polarity: Array
    exists: Array


class HistoryArrays(NamedTuple):
    """The newest event at every pixel: :class:`torchtrack.tracking.frontend.history.History` by its fields."""

    sensor_numbers: Array
    stream_index: Array
    last_event_us: Array
    t_us: Array


class Described(NamedTuple):
    """What is described, with zeros where there is nothing.

    Args:
        objects: ``[r]``, which are concerned.
        features: ``[r, n, f]`` of their observations.
        is_smooth: ``[b, n]``, false so far: which observations these are.
    """

    objects: Array
    features: Array
    is_smooth: Array


class Patch(NamedTuple):
    """Where events around a contour are looked at, and what is known of an object's.

    Args:
        across_px, along_px: across the contour and along it, where events are counted; zeros after that.
        aside_px: across it, where their ages are looked at.
        places: where these come to lie.
        counted: events of the object by place and polarity.
        softened: what is said of so many events.
    """

    across_px: Array
    along_px: Array
    aside_px: Array
    places: Array
    counted: Array
    softened: Array


class Event(NamedTuple):
    """An observation and its contour point: pixel, age and polarity; and the point's place before the camera, and its normal."""

    u: float
    v: float
    age_s: float
    polarity: float
    point: Numbers
    normal: Numbers


@kernel(fastmath=FAST)
def describe(
    events: EventArrays,
    observed: ObservationArrays,
    contours: MovingContours,
    history: HistoryArrays,
    settings: PatchSettings,
    described: Described,
) -> None:
    """Describe the observations of some objects whose nearest contour is a smooth silhouette."""
    contours, observed, described = moving_contours(contours), ObservationArrays(*observed), Described(*described)
    patch, shown = _patch(settings, described.features), contours.shown
    for row in range(len(described.objects)):
        b = described.objects[row]
        plane, oldest_s, index = plane_of(contours.moving, b), _oldest(observed.age_s[b], observed.exists[b]), index_of(contours.nearest, b)
        _count(events_of(events, b), plane, settings.side, patch.counted)
        # Not in the loop: to point at a part of an array takes as long as to read several numbers.
        points, lines, kind, sensor, features = shown.points_cam[b], shown.normals[b], shown.kind[b], _sensor_of(history, b), described.features[row]
        for i in range(observed.exists.shape[1]):
            u, v, age = observed.pixels[b, 0, i], observed.pixels[b, 1, i], observed.age_s[b, i]
            at_u, at_v = carried(plane, u, v, age)
            m = nearest(index, at_u, at_v)
            described.is_smooth[b, i] = observed.exists[b, i] and m >= 0 and kind[max(m, 0)] == settings.silhouette
            if not described.is_smooth[b, i]:
                features[i] = 0.0
                continue
            event = Event(u, v, age, observed.polarity[b, i], (points[0, m], points[1, m], points[2, m]), (lines[0, m], lines[1, m]))
            _describe_one(event, plane, sensor, settings, patch, features[i])
            features[i, _AGE] = age / oldest_s


class Sensor(NamedTuple):
    """What a sensor saw last.

    Args:
        numbers: of the sensor pixels nearest to ideal ones, row by row of a table of so many ``columns``.
        last_event_us, t_us: the newest event at each, and the window's end.
    """

    numbers: Array
    columns: int
    last_event_us: Array
    t_us: int


@kernel()
def _sensor_of(history: HistoryArrays, b: int) -> Sensor:
    """The sensor that sees an object."""
    sensor_numbers, stream_index, last_event_us, t_us = history
    s = stream_index[b]
    return Sensor(sensor_numbers[s].reshape(-1), sensor_numbers.shape[2], last_event_us[s].reshape(-1), t_us[s])


@kernel()
def _softened(features: Array) -> Array:
    """What is told of so many events: of n, n / (1 + n)."""
    events = np.arange(_MOST + 1)
    return (events / (events + 1)).astype(features.dtype)


@kernel()
def _patch(settings: PatchSettings, features: Array) -> Patch:
    """Where events around a contour are looked at."""
    along, across = len(settings.along_px), len(settings.across_px)
    room = -(-along * across // _AT_ONCE) * _AT_ONCE
    across_px, along_px, aside_px = np.zeros(room, features.dtype), np.zeros(room, features.dtype), np.zeros(room, features.dtype)
    for i in range(across):
        aside_px[i] = settings.across_px[i]
        for k in range(along):
            across_px[i * along + k], along_px[i * along + k] = settings.across_px[i], settings.along_px[k]
    counted = np.zeros(settings.side * settings.side, np.uint16)
    return Patch(across_px, along_px, aside_px, np.zeros(room, np.int32), counted, _softened(features))


@kernel()
def _oldest(age_s: Array, exists: Array) -> float:
    """Age of the oldest observation (s)."""
    oldest_s = 1e-6
    for i in range(len(age_s)):
        oldest_s = max(oldest_s, age_s[i] if exists[i] else 0.0)
    return oldest_s


@kernel(fastmath=FAST)
def _place(u: float, v: float, side: int) -> int:
    """The place that a pixel is counted at."""
    return (int(np.rint(v)) & (side - 1)) * side + (int(np.rint(u)) & (side - 1))


@kernel(fastmath=FAST)
def _count(events: ObjectEventArrays, plane: Plane, side: int, counted: Array) -> None:
    """Count an object's events, moved to the window's end at its depth, by place and polarity."""
    u, v, age_s, polarity, mask, own, count = events
    counted[:] = 0
    for j in range(count):
        i = np.uint64(own[j]) if len(own) else np.uint64(j)
        at_u, at_v = carried(plane, u[i], v[i], age_s[i])
        place = _place(at_u, at_v, side)
        if mask[i]:
            bits = _BITS if polarity[i] > 0 else 0
            if (counted[place] >> bits) & _MOST < _MOST:
                counted[place] += 1 << bits


@kernel(fastmath=FAST)
def _find_places(u: float, v: float, normal: Numbers, side: int, patch: Patch) -> None:
    """The places that a patch around a pixel is counted at, several at once."""
    # In the type of the patch, and 32 bits: of others, a processor takes half as many at once.
    across_px, along_px, _, places, _, _ = patch
    kind, most = across_px.dtype.type, np.int32(side - 1)
    u, v, nu, nv = kind(u), kind(v), kind(normal[0]), kind(normal[1])
    for k in range(len(places)):
        column = np.int32(np.rint(u + across_px[k] * nu - along_px[k] * nv)) & most
        row = np.int32(np.rint(v + across_px[k] * nv + along_px[k] * nu)) & most
        places[k] = row * np.int32(side) + column


@kernel(fastmath=FAST)
def _find_pixels(u: float, v: float, normal: Numbers, sensor: Sensor, patch: Patch) -> None:
    """Rows of a table of sensor pixels for places across the contour, several at once: as :func:`tracking.frontend.history.on_sensor` finds them."""
    aside_px, places, width = patch.aside_px, patch.places, sensor.columns
    kind = aside_px.dtype.type
    u, v, nu, nv = kind(u), kind(v), kind(normal[0]), kind(normal[1])
    right, bottom = kind(width - 1), kind(len(sensor.numbers) // width - 1)
    for k in range(len(places)):
        column, row = u + aside_px[k] * nu, v + aside_px[k] * nv
        # Written so that what is not a number finds a place, too.
        column, row = min(column if column > 0 else kind(0), right), min(row if row > 0 else kind(0), bottom)
        places[k] = np.int32(np.rint(row)) * np.int32(width) + np.int32(np.rint(column))


# Called for each observation, with so many numbers, it takes a quarter longer.
@kernel(fastmath=FAST, forceinline=True)
def _describe_one(event: Event, plane: Plane, sensor: Sensor, settings: PatchSettings, patch: Patch, row: Array) -> None:
    """Fill the description of one observation, whose nearest contour point was found, but for how old it is among all."""
    u, v, age, polarity, (x, y, z), (nu, nv) = event
    speed_u, speed_v = across(plane.motion, x, y, z, inverse_depth(z), plane.lens)
    outward = -1.0 if nu * speed_u + nv * speed_v < 0 else 1.0
    speed = max(abs(nu * speed_u + nv * speed_v), settings.slow_px_s)
    normal, count = (outward * nu, outward * nv), len(settings.across_px) * len(settings.along_px)
    _find_places(u + speed_u * age, v + speed_v * age, normal, settings.side, patch)
    own, counted, softened, places = _BITS if polarity >= 0 else 0, patch.counted, patch.softened, patch.places
    for k in range(count):
        both = counted[np.uint64(places[k])]
        row[k], row[count + k] = softened[(both >> own) & _MOST], softened[(both >> (_BITS - own)) & _MOST]
    _find_pixels(u + settings.border_px, v + settings.border_px, normal, sensor, patch)
    for k in range(len(settings.across_px)):
        newest_us = sensor.last_event_us[np.uint64(sensor.numbers[np.uint64(places[k])])]
        row[2 * count + k] = min(max(((sensor.t_us - newest_us) * 1e-6 - age) * speed / settings.oldest_px, -1.0), 1.0)
    for k in range(settings.of_kind, len(row)):
        row[k] = 0.0
    row[settings.of_kind + settings.silhouette] = row[_EXISTS] = 1.0
    row[_SPEED] = np.log1p(speed / settings.unit_px_s)
    row[_POLARITY], row[_SIDE], row[_KNOWN] = polarity, polarity * outward, abs(polarity)


@accelerates(weighting_features.silhouette_features)
def silhouette_features_numba(inputs: WeightingInputs) -> tuple[Float[Tensor, "r n f"], Bool[Tensor, "b n"], Int[Tensor, "r"]]:
    """Observation by observation."""
    observations, contours, index, history = inputs.observations, inputs.contours, inputs.index, inputs.history
    has_smooth_silhouette = ((contours.kind == int(ContourKind.SMOOTH)) & contours.mask).any(1)
    objects, is_smooth = has_smooth_silhouette.nonzero()[:, 0], torch.zeros_like(observations.mask)
    # As many for all: how many a neighbour has would show in roundings.
    features = observations.age_s.new_empty(len(objects), observations.mask.shape[1], weighting_features.FEATURES)
    w = weighting_features
    describe(
        event_arrays(inputs.seen)[1],
        as_arrays(observations.pixels.transpose(1, 2), observations.age_s, observations.polarity, observations.mask),
        (contour_arrays(contours), index_arrays(index), moving_arrays(inputs.prediction.moving(compensated=True))),
        as_arrays(history.sensor_numbers, history.stream_index, history.last_event_us, history.t_us),
        PatchSettings(w.ACROSS_PX, w.ALONG_PX, w.SIDE, BORDER_PX, int(ContourKind.SMOOTH), w.OF_KIND, w.SLOW_PX_S, w.SPEED_UNIT_PX_S, w.OLDEST_PX),
        as_arrays(objects, features, is_smooth),
    )
    return features, is_smooth, objects
