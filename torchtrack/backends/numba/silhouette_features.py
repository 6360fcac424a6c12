"""What describes observations of smooth silhouettes, one by one:
:func:`torchtrack.tracking.association.weighting_features.silhouette_features`.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, across, at_depth, drift, inverse_depth, lens
from torchtrack.backends.numba.index import cells_of
from torchtrack.backends.numba.look_up import nearest
from torchtrack.backends.numba.parameters import Cells, PatchSettings
from torchtrack.core.dispatch import accelerates
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association import weighting_features
from torchtrack.tracking.association.weighting_features import WeightingInputs
from torchtrack.tracking.frontend.history import BORDER_PX
from torchtrack.tracking.frontend.window_events import laid_out

# Places are worked out so many at once: what is left over would be, one at a time.
_AT_ONCE = 32
# Events of a polarity that are counted at a place, at most; those of the other one lie in the bits beside them.
_MOST, _BITS = 255, 8
# The last numbers of a description.
_SPEED, _POLARITY, _SIDE, _KNOWN, _AGE, _EXISTS = range(-6, 0)


@kernel(fastmath=FAST)
def describe(
    objects: Array,
    u: Array,
    v: Array,
    age_s: Array,
    polarity: Array,
    mask: Array,
    own: Array,
    counts: Array,
    pixels: Array,
    ages_s: Array,
    polarities: Array,
    exists: Array,
    points_cam: Array,
    normals: Array,
    kind: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    velocity: Array,
    centre_cam: Array,
    intrinsics: Array,
    sensor_numbers: Array,
    stream_index: Array,
    last_event_us: Array,
    t_us: Array,
    settings: PatchSettings,
    features: Array,
    is_smooth: Array,
) -> None:
    """Describe the observations of some objects whose nearest contour is a smooth silhouette.

    Args:
        objects: ``[r]``, which these are.
        u, v, age_s, polarity, mask: ``[e, n]``: events of each object, or one row for all.
        own, counts: as :func:`torchtrack.backends.numba.selection.select` takes them.
        pixels, ages_s, polarities, exists: ``[b, 2, n]`` and ``[b, n]`` of the observations.
        points_cam, normals, kind: ``[b, 3, m]``, ``[b, 2, m]`` and ``[b, m]`` of contour points; ``nearest_of_cell [b, p]`` and
            ``first [b, 2]`` are their index.
        velocity, centre_cam, intrinsics: of each object.
        sensor_numbers, stream_index, last_event_us, t_us: of a :class:`torchtrack.tracking.frontend.history.History`.
        features: ``[r, n, f]``, filled; with zeros where there is nothing to describe.
        is_smooth: ``[b, n]``, false so far: which these are.
    """
    counted, softened = np.zeros(settings.side * settings.side, np.uint16), _softened(features)
    across_px, along_px, aside_px = _patch(settings, features)
    places, table_width = np.zeros(len(across_px), np.int32), sensor_numbers.shape[2]
    for row in range(len(objects)):
        b = objects[row]
        e, s = b if len(mask) > 1 else 0, stream_index[b]
        looked_at = counts[b] if len(own) else mask.shape[1]
        motion, depth_m, of_lens = drift(velocity[b], centre_cam[b]), centre_cam[b, 2], lens(intrinsics[b])
        of_object, oldest_s = own[b] if len(own) else own.ravel(), _oldest(ages_s[b], exists[b])
        counted[:] = 0
        _count(u[e], v[e], age_s[e], polarity[e], mask[e], of_object, looked_at, motion, depth_m, of_lens, settings.side, counted)
        # Not in the loop: to point at a part of an array takes as long as to read several numbers.
        cells_of_object, first_of_object, points, lines = nearest_of_cell[b], first[b], points_cam[b], normals[b]
        of_sensor, newest_us, described = sensor_numbers[s].reshape(-1), last_event_us[s].reshape(-1), features[row]
        for i in range(exists.shape[1]):
            x, y, age = pixels[b, 0, i], pixels[b, 1, i], ages_s[b, i]
            speed_u, speed_v = at_depth(motion, depth_m, x, y, of_lens)
            nearest_index = nearest(cells_of_object, first_of_object, x + speed_u * age, y + speed_v * age, cells)
            is_smooth[b, i] = exists[b, i] and nearest_index >= 0 and kind[b, max(nearest_index, 0)] == settings.silhouette
            if not is_smooth[b, i]:
                described[i] = 0.0
                continue
            point = points[0, nearest_index], points[1, nearest_index], points[2, nearest_index], lines[0, nearest_index], lines[1, nearest_index]
            _describe_one(
                (x, y, age, polarities[b, i], age / oldest_s), point, motion, of_lens, counted, softened, across_px, along_px, aside_px,
                places, of_sensor, table_width, newest_us, t_us[s], settings, described[i],
            )  # fmt: skip


@kernel()
def _softened(features: Array) -> Array:
    """What is told of so many events: of n, n / (1 + n)."""
    events = np.arange(_MOST + 1)
    return (events / (events + 1)).astype(features.dtype)


@kernel()
def _patch(settings: PatchSettings, features: Array) -> tuple[Array, Array, Array]:
    """Across the contour and along it (px), where events are counted, and across it where their ages are looked at; zeros after that."""
    along, across = len(settings.along_px), len(settings.across_px)
    room = -(-along * across // _AT_ONCE) * _AT_ONCE
    across_px, along_px, aside_px = np.zeros(room, features.dtype), np.zeros(room, features.dtype), np.zeros(room, features.dtype)
    for i in range(across):
        aside_px[i] = settings.across_px[i]
        for k in range(along):
            across_px[i * along + k], along_px[i * along + k] = settings.across_px[i], settings.along_px[k]
    return across_px, along_px, aside_px


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
def _count(
    u: Array,
    v: Array,
    age_s: Array,
    polarity: Array,
    mask: Array,
    own: Array,
    looked_at: int,
    motion: Numbers,
    depth_m: float,
    intrinsics: Numbers,
    side: int,
    counted: Array,
) -> None:
    """Count an object's events, moved to the window's end at its depth, by place and polarity."""
    for j in range(looked_at):
        i = np.uint64(own[j]) if len(own) else np.uint64(j)
        speed_u, speed_v = at_depth(motion, depth_m, u[i], v[i], intrinsics)
        place = _place(u[i] + speed_u * age_s[i], v[i] + speed_v * age_s[i], side)
        if mask[i]:
            bits = _BITS if polarity[i] > 0 else 0
            if (counted[place] >> bits) & _MOST < _MOST:
                counted[place] += 1 << bits


@kernel(fastmath=FAST)
def _find_places(u: float, v: float, nu: float, nv: float, across_px: Array, along_px: Array, side: int, places: Array) -> None:
    """The places that a patch around a pixel is counted at, several at once."""
    # In the type of the patch, and 32 bits: of others, a processor takes half as many at once.
    kind, most = across_px.dtype.type, np.int32(side - 1)
    u, v, nu, nv = kind(u), kind(v), kind(nu), kind(nv)
    for k in range(len(places)):
        column = np.int32(np.rint(u + across_px[k] * nu - along_px[k] * nv)) & most
        row = np.int32(np.rint(v + across_px[k] * nv + along_px[k] * nu)) & most
        places[k] = row * np.int32(side) + column


@kernel(fastmath=FAST)
def _find_pixels(u: float, v: float, nu: float, nv: float, across_px: Array, height: int, width: int, places: Array) -> None:
    """Rows of a table of sensor pixels for places across the contour, several at once: as :func:`tracking.frontend.history.on_sensor` finds them."""
    kind = across_px.dtype.type
    u, v, nu, nv, right, bottom = kind(u), kind(v), kind(nu), kind(nv), kind(width - 1), kind(height - 1)
    for k in range(len(places)):
        column, row = u + across_px[k] * nu, v + across_px[k] * nv
        # Written so that what is not a number finds a place, too.
        column, row = min(column if column > 0 else kind(0), right), min(row if row > 0 else kind(0), bottom)
        places[k] = np.int32(np.rint(row)) * np.int32(width) + np.int32(np.rint(column))


# Called for each observation, with so many numbers, it takes a quarter longer.
@kernel(fastmath=FAST, forceinline=True)
def _describe_one(
    event: Numbers,
    point: Numbers,
    motion: Numbers,
    intrinsics: Numbers,
    counted: Array,
    softened: Array,
    across_px: Array,
    along_px: Array,
    aside_px: Array,
    places: Array,
    sensor_numbers: Array,
    table_width: int,
    last_event_us: Array,
    t_us: int,
    settings: PatchSettings,
    row: Array,
) -> None:
    """Fill the description of one observation, whose nearest contour point was found."""
    u, v, age, polarity, age_share = event
    x, y, z, nu, nv = point
    speed_u, speed_v = across(motion, x, y, z, inverse_depth(z), intrinsics)
    outward = -1.0 if nu * speed_u + nv * speed_v < 0 else 1.0
    speed = max(abs(nu * speed_u + nv * speed_v), settings.slow_px_s)
    nu, nv, count = outward * nu, outward * nv, len(settings.across_px) * len(settings.along_px)
    _find_places(u + speed_u * age, v + speed_v * age, nu, nv, across_px, along_px, settings.side, places)
    own = _BITS if polarity >= 0 else 0
    for k in range(count):
        both = counted[np.uint64(places[k])]
        row[k], row[count + k] = softened[(both >> own) & _MOST], softened[(both >> (_BITS - own)) & _MOST]
    _find_pixels(u + settings.border_px, v + settings.border_px, nu, nv, aside_px, len(sensor_numbers) // table_width, table_width, places)
    for k in range(len(settings.across_px)):
        newest_us = last_event_us[np.uint64(sensor_numbers[np.uint64(places[k])])]
        row[2 * count + k] = min(max(((t_us - newest_us) * 1e-6 - age) * speed / settings.oldest_px, -1.0), 1.0)
    for k in range(settings.of_kind, len(row)):
        row[k] = 0.0
    row[settings.of_kind + settings.silhouette] = row[_EXISTS] = 1.0
    row[_SPEED], row[_AGE] = np.log1p(speed / settings.unit_px_s), age_share
    row[_POLARITY], row[_SIDE], row[_KNOWN] = polarity, polarity * outward, abs(polarity)


@accelerates(weighting_features.silhouette_features)
def silhouette_features_numba(inputs: WeightingInputs) -> tuple[Float[Tensor, "r n f"], Bool[Tensor, "b n"], Int[Tensor, "r"]]:
    """Observation by observation."""
    observations, contours, index, history = inputs.observations, inputs.contours, inputs.index, inputs.history
    moving, (events, own, counts) = inputs.prediction.moving(compensated=True), laid_out(inputs.seen)
    has_smooth_silhouette = ((contours.kind == int(ContourKind.SMOOTH)) & contours.mask).any(1)
    objects, is_smooth = has_smooth_silhouette.nonzero()[:, 0], torch.zeros_like(observations.mask)
    # As many for all: how many a neighbour has would show in roundings.
    features = observations.age_s.new_empty(len(objects), observations.mask.shape[1], weighting_features.FEATURES)
    w = weighting_features
    describe(
        *as_arrays(objects, *events.pixels.unbind(-1), events.age_s, events.polarity, events.mask, own, counts),
        *as_arrays(observations.pixels.transpose(1, 2), observations.age_s, observations.polarity, observations.mask),
        *as_arrays(contours.points_cam.transpose(1, 2), contours.normals.transpose(1, 2), contours.kind, index.nearest, index.first),
        cells_of(index),
        *as_arrays(moving.velocity, moving.centre_cam, moving.intrinsics),
        *as_arrays(history.sensor_numbers, history.stream_index, history.last_event_us, history.t_us),
        PatchSettings(w.ACROSS_PX, w.ALONG_PX, w.SIDE, BORDER_PX, int(ContourKind.SMOOTH), w.OF_KIND, w.SLOW_PX_S, w.SPEED_UNIT_PX_S, w.OLDEST_PX),
        *as_arrays(features, is_smooth),
    )
    return features, is_smooth, objects
