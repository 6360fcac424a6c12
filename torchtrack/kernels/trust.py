"""What describes observations of limbs, one at a time: :func:`torchtrack.trust_features.limb_features`."""

import numpy as np

from torchtrack.kernels.compiler import FAST, Array, kernel
from torchtrack.kernels.look_up import nearest
from torchtrack.kernels.motion import Numbers, across, at_depth, drift, inverse_depth, lens
from torchtrack.kernels.settings import Cells, PatchSettings

# Rows of what is told of an observation.
U, V, AGE, POLARITY, AGE_SHARE = range(5)
# Numbers of a description after those of counts and kinds.
_EXISTS, _SPEED, _POLARITY, _OUTWARD, _SIDE, _AGE = range(6)


@kernel(fastmath=FAST)
def describe(
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
    patch_px: Array,
    settings: PatchSettings,
    rows: Array,
    is_limb: Array,
) -> int:
    """Describe the observations whose nearest contour is a limb; how many these are.

    Args:
        u, v, age_s, polarity, mask: ``[e, n]``: events of each object, or one row for all.
        own, counts: as :func:`torchtrack.kernels.selection.select` takes them.
        told: ``[b, 5, n]`` of the observations, and which of them ``exists [b, n]``.
        points_cam, normals, kind: ``[b, 3, m]``, ``[b, 2, m]`` and ``[b, m]`` of contour points; ``nearest_of_cell [b, p]`` and
            ``first [b, 2]`` are their index.
        velocity, centre_cam, intrinsics: of each object.
        patch_px: ``[k, 2]``, across the contour and along it.
        rows: ``[b * n, f]``; the first are filled.
        is_limb: ``[b, n]``, filled.
    """
    described = 0
    counted = np.zeros((settings.side * settings.side, 2), rows.dtype)
    for b in range(len(told)):
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
                _describe_one(i, found, told[b], points_cam[b], normals[b], motion, of_lens, patch_px, counted, settings, rows[described])
                described += 1
    return described


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
        counted[place, 1 if polarity[i] > 0 else 0] += mask[i]


@kernel(fastmath=FAST)
def _describe_one(
    i: int,
    found: int,
    told: Array,
    points_cam: Array,
    normals: Array,
    motion: Numbers,
    intrinsics: Numbers,
    patch_px: Array,
    counted: Array,
    settings: PatchSettings,
    row: Array,
) -> None:
    """Fill the description of one observation, whose nearest contour point was found."""
    x, y, z = points_cam[0, found], points_cam[1, found], points_cam[2, found]
    speed_u, speed_v = across(motion, x, y, z, inverse_depth(z), intrinsics)
    speed = normals[0, found] * speed_u + normals[1, found] * speed_v
    outward = -1.0 if speed < 0 else 1.0
    nu, nv, polarity = outward * normals[0, found], outward * normals[1, found], told[POLARITY, i]
    u, v = told[U, i] + speed_u * told[AGE, i], told[V, i] + speed_v * told[AGE, i]
    own, places = 1 if polarity >= 0 else 0, len(patch_px)
    for k in range(places):
        aside, along = patch_px[k, 0], patch_px[k, 1]
        place = _place(u + aside * nu - along * nv, v + aside * nv + along * nu, settings.side)
        same, other = counted[place, own], counted[place, 1 - own]
        row[k], row[places + k] = same / (1.0 + same), other / (1.0 + other)
    row[settings.counts :] = 0.0
    row[settings.counts + settings.limb] = 1.0
    single = settings.counts + settings.kinds
    row[single + _EXISTS], row[single + _SPEED] = 1.0, np.log1p(max(abs(speed), settings.slow_px_s) / settings.unit_px_s)
    row[single + _POLARITY], row[single + _OUTWARD], row[single + _SIDE] = polarity, outward, polarity * outward
    row[single + _AGE] = told[AGE_SHARE, i]
