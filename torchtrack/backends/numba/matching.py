"""Matching one object's observations with its contours: :func:`tracking.association.nearest.match_nearest`, and what its matches come to weigh."""

import numpy as np

from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, across, inverse_depth, placed
from torchtrack.backends.numba.look_up import nearest, nearest_of_four
from torchtrack.backends.numba.parameters import Cells, MatchingSettings

# Rows of what was observed.
U, V, AGE, POLARITY, TRUST = range(5)
# Columns of a contour point: its place on the object, its normal, where it was indexed, and marks.
X, Y, Z, NORMAL_U, NORMAL_V, INDEXED_U, INDEXED_V, SMOOTH, ORIENTED, EXPECTED = range(10)
COLUMNS = 10
# Rows of a match.
WEIGHT, MATCH_AGE, POINT_X, POINT_Y, POINT_Z, TARGET_U, TARGET_V, DIRECTION_U, DIRECTION_V = range(9)
OFFSET, DARK, AS_EXPECTED = range(9, 12)
ROWS = 12
# Patches of the image: votes of the observations in each.
_ON, _NEAR, _VOTES = range(3)


@kernel()
def _agreeing(agreement: float, settings: MatchingSettings) -> float:
    """Trust by how far a polarity is what it should be."""
    return min(max(1.0 + settings.polarity_gain * agreement, settings.least_agreement), 1.0)


@kernel()
def patch(u: float, v: float, bits: int, patches: int) -> int:
    """The patch of the image that a place lies in: :func:`torchtrack.tracking.association.weights.patch`."""
    return ((int(np.floor(v)) >> bits) & (patches - 1)) * patches + ((int(np.floor(u)) >> bits) & (patches - 1))


@kernel(fastmath=FAST)
def match(
    seen: Array,
    exists: Array,
    place: Array,
    table: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    pose: Numbers,
    motion: Numbers,
    intrinsics: Numbers,
    gate_px: float,
    wider: float,
    subcell_lookup: bool,
    settings: MatchingSettings,
    contour: Array,
    is_near: Array,
    is_matched: Array,
    matches: Array,
    votes: Array,
) -> None:
    """Match each observation with the contour point that is nearest to its place; ``place`` is moved on.

    Args:
        seen: ``[5, n]``, and which of them exist.
        place: ``[n, 2]``.
        table: ``[m, COLUMNS]``.
        pose, intrinsics: of the object, from :mod:`torchtrack.backends.numba.geometry`; so is its ``motion``.
        contour, is_near, is_matched, matches: filled; ``[n]``, and ``[ROWS, n]``. Weights are those of ``match_nearest``.
        votes: room for ``[patches², 3]``.
    """
    votes[:] = 0.0
    indexed = table[:, INDEXED_U : INDEXED_V + 1]
    for i in range(seen.shape[1]):
        nearest_index = -1
        if exists[i]:
            if subcell_lookup:
                nearest_index = nearest_of_four(nearest_of_cell, first, indexed, place[i, 0], place[i, 1], cells)
            else:
                nearest_index = nearest(nearest_of_cell, first, place[i, 0], place[i, 1], cells)
        contour[i], is_near[i], is_matched[i] = max(nearest_index, 0), nearest_index >= 0, False
        if nearest_index < 0:
            for k in range(ROWS):
                matches[k, i] = 0.0
        else:
            is_matched[i] = _match_one(i, nearest_index, seen, place, table, pose, motion, intrinsics, gate_px, wider, settings, matches, votes)
    _weigh(is_near, matches, votes, settings)


# Called for each observation, with so many numbers, it takes a quarter longer.
@kernel(fastmath=FAST, forceinline=True)
def _match_one(
    i: int,
    nearest_index: int,
    seen: Array,
    place: Array,
    table: Array,
    pose: Numbers,
    motion: Numbers,
    intrinsics: Numbers,
    gate_px: float,
    wider: float,
    settings: MatchingSettings,
    rows: Array,
    votes: Array,
) -> bool:
    """Match one observation with the contour point that was found for it, and count it in its patch; whether they match."""
    point_x, point_y, point_z = table[nearest_index, X], table[nearest_index, Y], table[nearest_index, Z]
    x, y, z = placed(pose, point_x, point_y, point_z)
    inverse = inverse_depth(z)
    u, v = intrinsics[2] + x * inverse * intrinsics[0], intrinsics[3] + y * inverse * intrinsics[1]
    speed_u, speed_v = across(motion, x, y, z, inverse, intrinsics)
    nu, nv = table[nearest_index, NORMAL_U], table[nearest_index, NORMAL_V]
    crossing = nu * speed_u + nv * speed_v
    dark = seen[POLARITY, i] * crossing / (abs(crossing) + settings.slow_px_s)
    age = seen[AGE, i]
    carried_u, carried_v = seen[U, i] + age * speed_u, seen[V, i] + age * speed_v
    shift = dark * (settings.dark_shift_px + table[nearest_index, SMOOTH] * (settings.silhouette_dark_shift_px - settings.dark_shift_px))
    target_u, target_v = carried_u - nu * shift, carried_v - nv * shift
    du, dv = u - target_u, v - target_v
    is_matched, offset = du * du + dv * dv < (gate_px * wider) ** 2, (du * nu + dv * nv) / wider
    as_expected = _agreeing(dark * table[nearest_index, EXPECTED], settings)
    dark = dark * table[nearest_index, ORIENTED]
    rows[WEIGHT, i], rows[MATCH_AGE, i], rows[POINT_X, i], rows[POINT_Y, i], rows[POINT_Z, i] = as_expected, age, point_x, point_y, point_z
    rows[TARGET_U, i], rows[TARGET_V, i], rows[DIRECTION_U, i], rows[DIRECTION_V, i] = target_u, target_v, nu, nv
    rows[OFFSET, i], rows[DARK, i], rows[AS_EXPECTED, i] = offset, dark, as_expected
    # Without the dark shift: between edges that lie close, it would make a choice confirm itself.
    next_u, next_v = carried_u - (u - table[nearest_index, INDEXED_U]), carried_v - (v - table[nearest_index, INDEXED_V])
    place[i, 0], place[i, 1] = next_u if is_matched else place[i, 0], next_v if is_matched else place[i, 1]
    # Products in the place of branches, of which a processor would guess half wrong.
    cell = patch(target_u, target_v, settings.patch_bits, settings.patches)
    near, on = as_expected * (abs(offset) < settings.smear_px), as_expected * (abs(offset) < settings.on_contour_px)
    votes[cell, _NEAR] += near
    votes[cell, _ON] += on
    votes[cell, _VOTES] += on * dark
    return is_matched


@kernel(fastmath=FAST)
def _weigh(is_near: Array, matches: Array, votes: Array, settings: MatchingSettings) -> None:
    """How far each match is to be trusted by those around it."""
    gain = 1.0 / (settings.gathered_share - settings.smeared_share)
    for i in range(matches.shape[1]):
        if not is_near[i]:
            continue
        cell = patch(matches[TARGET_U, i], matches[TARGET_V, i], settings.patch_bits, settings.patches)
        on = votes[cell, _ON]
        weight = matches[AS_EXPECTED, i]
        if settings.concentration:
            share = (on + 1.0) / (votes[cell, _NEAR] + 2.0)
            weight *= min(max((share - settings.smeared_share) * gain, settings.least_trust), 1.0)
        if settings.polarity:
            weight *= _agreeing(matches[DARK, i] * votes[cell, _VOTES] / (on + 2.0), settings)
        matches[WEIGHT, i] = weight


@kernel(fastmath=FAST)
def believe(seen: Array, is_matched: Array, matches: Array, settings: MatchingSettings) -> None:
    """Make weights what there is to be said of each match: none without one, or where an object has too few of them."""
    total = 0.0
    for i in range(len(is_matched)):
        matches[WEIGHT, i] *= is_matched[i] * seen[TRUST, i]
        total += matches[WEIGHT, i]
    enough = total >= settings.min_observations
    for i in range(len(is_matched)):
        is_matched[i] = is_matched[i] and enough
        matches[WEIGHT, i] *= enough
