"""What describes observations of limbs, one at a time: :func:`torchtrack.trust_features.limb_features`."""

import numpy as np

from torchtrack.kernels.compiler import FAST, Array, kernel
from torchtrack.kernels.look_up import nearest
from torchtrack.kernels.motion import Numbers, across, at_depth, drift, inverse_depth, lens
from torchtrack.kernels.settings import Cells, PatchSettings

# Rows of what is told of an observation.
U, V, AGE, POLARITY, AGE_SHARE = range(5)
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
    told: Array,
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
    sensor_pixels: Array,
    stream_index: Array,
    last_event_us: Array,
    t_us: Array,
    settings: PatchSettings,
    features: Array,
    is_limb: Array,
) -> None:
    """Describe the observations of some objects whose nearest contour is a limb.

    Args:
        objects: ``[r]``, which these are.
        u, v, age_s, polarity, mask: ``[e, n]``: events of each object, or one row for all.
        own, counts: as :func:`torchtrack.kernels.selection.select` takes them.
        told: ``[b, 5, n]`` of the observations, and which of them ``exists [b, n]``.
        points_cam, normals, kind: ``[b, 3, m]``, ``[b, 2, m]`` and ``[b, m]`` of contour points; ``nearest_of_cell [b, p]`` and
            ``first [b, 2]`` are their index.
        velocity, centre_cam, intrinsics: of each object.
        sensor_pixels, stream_index, last_event_us, t_us: of a :class:`torchtrack.history.History`.
        features: ``[r, n, f]`` of zeros, filled for these.
        is_limb: ``[b, n]``, false so far: which these are.
    """
    counted = np.zeros((settings.side * settings.side, 2), features.dtype)
    for row in range(len(objects)):
        b = objects[row]
        e = b if len(mask) > 1 else 0
        looked_at = counts[b] if len(own) else mask.shape[1]
        motion, depth_m, of_lens = drift(velocity[b], centre_cam[b]), centre_cam[b, 2], lens(intrinsics[b])
        of_object = own[b] if len(own) else own.ravel()
        counted[:] = 0.0
        _count(u[e], v[e], age_s[e], polarity[e], mask[e], of_object, looked_at, motion, depth_m, of_lens, settings, counted)
        for i in range(told.shape[2]):
            speed_u, speed_v = at_depth(motion, depth_m, told[b, U, i], told[b, V, i], of_lens)
            age = told[b, AGE, i]
            found = nearest(nearest_of_cell[b], first[b], told[b, U, i] + speed_u * age, told[b, V, i] + speed_v * age, cells)
            is_limb[b, i] = exists[b, i] and found >= 0 and kind[b, max(found, 0)] == settings.limb
            if is_limb[b, i]:
                s = stream_index[b]
                _describe_one(
                    i, found, told[b], points_cam[b], normals[b], motion, of_lens, counted, sensor_pixels[s], last_event_us[s], t_us[s],
                    settings, features[row, i],
                )  # fmt: skip


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
    settings: PatchSettings,
    counted: Array,
) -> None:
    """Count an object's events, moved to the window's end at its depth, by place and polarity."""
    for j in range(looked_at):
        i = np.uint64(own[j]) if len(own) else np.uint64(j)
        speed_u, speed_v = at_depth(motion, depth_m, u[i], v[i], intrinsics)
        place = _place(u[i] + speed_u * age_s[i], v[i] + speed_v * age_s[i], settings.side)
        if mask[i]:
            # Of n events, n / (1 + n) is kept: with one more, that is one over two less it.
            sign = 1 if polarity[i] > 0 else 0
            counted[place, sign] = 1.0 / (2.0 - counted[place, sign])


@kernel(fastmath=FAST)
def _newest_us(u: float, v: float, sensor_pixels: Array, last_event_us: Array, border_px: int) -> int:
    """When anything last happened at an ideal pixel: as :meth:`torchtrack.history.History.age_s` looks it up."""
    column = int(np.rint(min(max(u + border_px, 0.0), sensor_pixels.shape[1] - 1.0)))
    row = int(np.rint(min(max(v + border_px, 0.0), sensor_pixels.shape[0] - 1.0)))
    placed = sensor_pixels[row, column]
    x = int(min(max(np.rint(placed[0]), 0.0), last_event_us.shape[1] - 1.0))
    y = int(min(max(np.rint(placed[1]), 0.0), last_event_us.shape[0] - 1.0))
    return last_event_us[y, x]


@kernel(fastmath=FAST)
def _describe_one(
    i: int,
    found: int,
    told: Array,
    points_cam: Array,
    normals: Array,
    motion: Numbers,
    intrinsics: Numbers,
    counted: Array,
    sensor_pixels: Array,
    last_event_us: Array,
    t_us: int,
    settings: PatchSettings,
    row: Array,
) -> None:
    """Fill the description of one observation, whose nearest contour point was found."""
    x, y, z = points_cam[0, found], points_cam[1, found], points_cam[2, found]
    speed_u, speed_v = across(motion, x, y, z, inverse_depth(z), intrinsics)
    speed = normals[0, found] * speed_u + normals[1, found] * speed_v
    outward = -1.0 if speed < 0 else 1.0
    nu, nv, polarity = outward * normals[0, found], outward * normals[1, found], told[POLARITY, i]
    u, v, age = told[U, i], told[V, i], told[AGE, i]
    moved_u, moved_v, speed = u + speed_u * age, v + speed_v * age, max(abs(speed), settings.slow_px_s)
    own, k, places = 1 if polarity >= 0 else 0, 0, len(settings.across_px) * len(settings.along_px)
    for a, aside in enumerate(settings.across_px):
        for along in settings.along_px:
            place = _place(moved_u + aside * nu - along * nv, moved_v + aside * nv + along * nu, settings.side)
            row[k], row[places + k] = counted[place, own], counted[place, 1 - own]
            k += 1
        newest_us = _newest_us(u + aside * nu, v + aside * nv, sensor_pixels, last_event_us, settings.border_px)
        behind_px = ((t_us - newest_us) * 1e-6 - age) * speed
        row[2 * places + a] = min(max(behind_px / settings.oldest_px, -1.0), 1.0)
    row[settings.of_kind :] = 0.0
    row[settings.of_kind + settings.limb] = row[_EXISTS] = 1.0
    row[_SPEED], row[_AGE] = np.log1p(speed / settings.unit_px_s), told[AGE_SHARE, i]
    row[_POLARITY], row[_SIDE], row[_KNOWN] = polarity, polarity * outward, abs(polarity)
