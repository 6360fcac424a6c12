"""Matching one object's observations with its contours: :func:`tracking.association.nearest.match_nearest`, and what its matches come to weigh."""

from typing import NamedTuple

import numpy as np

from torchtrack.backends.alignment import (
    AS_EXPECTED,
    COLUMNS,
    DARK,
    DIRECTION_U,
    DIRECTION_V,
    EFFECTIVE,
    EXPECTED,
    INDEXED_U,
    INDEXED_V,
    MATCH_AGE,
    NORMAL_U,
    NORMAL_V,
    OFFSET,
    ORIENTED,
    POINT_X,
    POINT_Y,
    POINT_Z,
    ROWS,
    SMOOTH,
    TARGET_U,
    TARGET_V,
    TRUST,
    WEIGHT,
    MatchingSettings,
    U,
    X,
    Y,
    Z,
)
from torchtrack.backends.numba.arrays import IndexArrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, across, inverse_depth, placed
from torchtrack.backends.numba.look_up import nearest, nearest_of_four

# Patches of the image: votes of the observations in each.
_ON, _NEAR, _VOTES = range(3)
# Observations that are matched together. What is known of them lies in rows of this length, in one piece of memory: so a compiler sees that no row
# overlaps another, and takes several observations at once. One after the other, all rounds take a quarter longer.
BLOCK = 128
# Rows of a block: what is given of each observation, after the columns of its contour point; and what is derived, after the rows of a match.
_GIVEN_U, _GIVEN_V, _GIVEN_AGE, _GIVEN_POLARITY = range(COLUMNS, COLUMNS + 4)
_PLACE_U, _PLACE_V, _IS_NEAR, _IS_MATCHED = range(ROWS, ROWS + 4)
# What weights hang on is known after each round, the rest after the last.
_TO_WEIGH, _THE_REST = (TARGET_U, TARGET_V, DARK, AS_EXPECTED, EFFECTIVE), (MATCH_AGE, POINT_X, POINT_Y, POINT_Z, DIRECTION_U, DIRECTION_V, OFFSET)


class Observed(NamedTuple):
    """What was observed: ``rows [b, 5, n]``, and which of them exist, ``[b, n]``; or of one object."""

    rows: Array
    exists: Array


class Table(NamedTuple):
    """Contour points to match with, of all objects or of one.

    Args:
        rows: ``[b, m, COLUMNS]``.
        nearest: their index.
        subcell_lookup: ``[b]``, whether they are looked up between the cells of the index.
    """

    rows: Array
    nearest: IndexArrays
    subcell_lookup: Array


class MatchArrays(NamedTuple):
    """Matches: contour points ``[b, n]``, which observations are near any and which are matched, and rows ``[b, ROWS, n]``; or of one object."""

    contour: Array
    is_near: Array
    is_matched: Array
    rows: Array


class Round(NamedTuple):
    """One round of matching and solving.

    Args:
        pose, motion, lens: of the object, from :mod:`torchtrack.backends.numba.geometry`.
        gate_px, wider: how far observations are matched, and by how much that, and all that is measured against contours, is wider.
        is_last: whether all rows of matches are asked for, and not only what a weight and a residual hang on.
    """

    pose: Numbers
    motion: Numbers
    lens: Numbers
    gate_px: float
    wider: float
    is_last: bool


class Room(NamedTuple):
    """Where :func:`match` works.

    Args:
        place: ``[2, n]``, where each observation is looked for.
        given, derived: rows of a block of observations.
        patch: of each of the block.
        votes: ``[patches², 3]``.
    """

    place: Array
    given: Array
    derived: Array
    patch: Array
    votes: Array


@kernel()
def _agreeing(agreement: float, settings: MatchingSettings) -> float:
    """Trust by how far a polarity is what it should be."""
    return min(max(1.0 + settings.polarity_gain * agreement, settings.least_agreement), 1.0)


@kernel()
def patch(u: float, v: float, bits: int, patches: int) -> int:
    """The patch of the image that a place lies in: :func:`torchtrack.tracking.association.weights.patch`."""
    return ((int(np.floor(v)) >> bits) & (patches - 1)) * patches + ((int(np.floor(u)) >> bits) & (patches - 1))


@kernel()
def room_for(seen: Array, patches: int) -> Room:
    """Where :func:`match` works, for observations ``[b, 5, n]``."""
    given, derived = np.zeros((COLUMNS + 4) * BLOCK, seen.dtype), np.zeros((ROWS + 4) * BLOCK)
    return Room(np.empty((2, seen.shape[2])), given, derived, np.zeros(BLOCK, np.int64), np.empty((patches**2, 3)))


@kernel(fastmath=FAST)
def match(observed: Observed, table: Table, current: Round, settings: MatchingSettings, matches: MatchArrays, room: Room) -> None:
    """Match each observation of an object with the contour point that is nearest to its place, which is moved on.

    Args:
        matches: filled; their weights are those of ``match_nearest``.
    """
    room.votes[:] = 0.0
    count = _places_in_use(observed.exists)
    # Of many objects, most have far fewer observations than places.
    matches.contour[count:], matches.is_near[count:], matches.is_matched[count:], matches.rows[:, count:] = 0, False, False, 0.0
    for begin in range(0, count, BLOCK):
        end = min(begin + BLOCK, count)
        _look_up(begin, end, observed, table, matches, room)
        _compare(current, settings, room.given, room.derived, room.patch)
        _vote(end - begin, settings, room)
        _take_over(begin, end, room, matches.is_matched)
        _write(begin, end, room.derived, _TO_WEIGH, matches.rows)
        if current.is_last:
            _write(begin, end, room.derived, _THE_REST, matches.rows)
    _weigh(count, matches.rows, room.votes, settings)


@kernel()
def _places_in_use(exists: Array) -> int:
    """How many places there are up to the last one with an observation."""
    for i in range(len(exists), 0, -1):
        if exists[i - 1]:
            return i
    return 0


@kernel(fastmath=FAST)
def _look_up(begin: int, end: int, observed: Observed, table: Table, matches: MatchArrays, room: Room) -> None:
    """Lay out a block of observations, each with the contour point nearest to its place; with the first one where there is none."""
    (seen, exists), (place, given, derived, _, _), contour, is_near = observed, room, matches.contour, matches.is_near
    indexed = table.rows[:, INDEXED_U : INDEXED_V + 1]
    for i in range(end - begin):
        at = begin + i
        u, v, nearest_index = place[0, at], place[1, at], -1
        if exists[at]:
            nearest_index = nearest_of_four(table.nearest, indexed, u, v) if table.subcell_lookup else nearest(table.nearest, u, v)
        contour[at], is_near[at], derived[_IS_NEAR * BLOCK + i] = max(nearest_index, 0), nearest_index >= 0, nearest_index >= 0
        point = table.rows[np.uint64(max(nearest_index, 0))]
        for k in range(COLUMNS):
            given[k * BLOCK + i] = point[k]
    for k in range(4):
        row = (_GIVEN_U + k) * BLOCK
        given[row : row + end - begin] = seen[U + k, begin:end]
    for k in range(2):
        row = (_PLACE_U + k) * BLOCK
        derived[row : row + end - begin] = place[k, begin:end]


@kernel(fastmath=FAST)
def _compare(current: Round, settings: MatchingSettings, given: Array, derived: Array, patches: Array) -> None:
    """Fill the rows of matches of a block, and the patch that each lies in; places are moved on."""
    pose, motion, intrinsics, gate_px, wider, _ = current
    for i in range(BLOCK):
        point_x, point_y, point_z = given[X * BLOCK + i], given[Y * BLOCK + i], given[Z * BLOCK + i]
        x, y, z = placed(pose, point_x, point_y, point_z)
        inverse = inverse_depth(z)
        u, v = intrinsics[2] + x * inverse * intrinsics[0], intrinsics[3] + y * inverse * intrinsics[1]
        speed_u, speed_v = across(motion, x, y, z, inverse, intrinsics)
        nu, nv = given[NORMAL_U * BLOCK + i], given[NORMAL_V * BLOCK + i]
        crossing = nu * speed_u + nv * speed_v
        dark = given[_GIVEN_POLARITY * BLOCK + i] * crossing / (abs(crossing) + settings.slow_px_s)
        age = given[_GIVEN_AGE * BLOCK + i]
        carried_u, carried_v = given[_GIVEN_U * BLOCK + i] + age * speed_u, given[_GIVEN_V * BLOCK + i] + age * speed_v
        smoother = given[SMOOTH * BLOCK + i] * (settings.silhouette_dark_shift_px - settings.dark_shift_px)
        shift = dark * (settings.dark_shift_px + smoother)
        target_u, target_v = carried_u - nu * shift, carried_v - nv * shift
        du, dv = u - target_u, v - target_v
        is_near, is_within = derived[_IS_NEAR * BLOCK + i], du * du + dv * dv < (gate_px * wider) ** 2
        is_matched = is_near * is_within
        derived[_IS_MATCHED * BLOCK + i], derived[MATCH_AGE * BLOCK + i] = is_matched, age
        derived[POINT_X * BLOCK + i], derived[POINT_Y * BLOCK + i], derived[POINT_Z * BLOCK + i] = point_x, point_y, point_z
        derived[TARGET_U * BLOCK + i], derived[TARGET_V * BLOCK + i] = target_u, target_v
        derived[DIRECTION_U * BLOCK + i], derived[DIRECTION_V * BLOCK + i] = nu, nv
        derived[OFFSET * BLOCK + i], derived[DARK * BLOCK + i] = (du * nu + dv * nv) / wider, dark * given[ORIENTED * BLOCK + i]
        derived[AS_EXPECTED * BLOCK + i] = is_near * _agreeing(dark * given[EXPECTED * BLOCK + i], settings)
        # Until it is known how many lie around it: whether it has an error in common with them.
        derived[EFFECTIVE * BLOCK + i] = given[SMOOTH * BLOCK + i]
        # Without the dark shift: between edges that lie close, it would make a choice confirm itself.
        next_u, next_v = carried_u - (u - given[INDEXED_U * BLOCK + i]), carried_v - (v - given[INDEXED_V * BLOCK + i])
        place_u, place_v = derived[_PLACE_U * BLOCK + i], derived[_PLACE_V * BLOCK + i]
        derived[_PLACE_U * BLOCK + i], derived[_PLACE_V * BLOCK + i] = next_u if is_matched > 0 else place_u, next_v if is_matched > 0 else place_v
        patches[i] = patch(target_u, target_v, settings.patch_bits, settings.patches)


@kernel(fastmath=FAST)
def _vote(count: int, settings: MatchingSettings, room: Room) -> None:
    """Count the observations of a block in their patches."""
    _, _, derived, patches, votes = room
    for i in range(count):
        as_expected, away, patch_of = derived[AS_EXPECTED * BLOCK + i], abs(derived[OFFSET * BLOCK + i]), np.uint64(patches[i])
        # Products in the place of branches, of which a processor would guess half wrong.
        near, on = as_expected * (away < settings.smear_px), as_expected * (away < settings.on_contour_px)
        votes[patch_of, _NEAR] += near
        votes[patch_of, _ON] += on
        votes[patch_of, _VOTES] += on * derived[DARK * BLOCK + i]


@kernel()
def _take_over(begin: int, end: int, room: Room, is_matched: Array) -> None:
    """Keep where the observations of a block are looked for next, and which are matched."""
    derived = room.derived
    matched, into = derived[_IS_MATCHED * BLOCK : (_IS_MATCHED + 1) * BLOCK], is_matched[begin:end]
    for i in range(len(into)):
        into[i] = matched[i] > 0
    for k in range(2):
        row = (_PLACE_U + k) * BLOCK
        room.place[k, begin:end] = derived[row : row + end - begin]


@kernel(fastmath=FAST)
def _write(begin: int, end: int, derived: Array, rows: tuple[int, ...], matches: Array) -> None:
    """Write some rows of the matches of a block; zeros for observations without a contour point."""
    near = derived[_IS_NEAR * BLOCK : (_IS_NEAR + 1) * BLOCK]
    for row in rows:
        values, into = derived[row * BLOCK : (row + 1) * BLOCK], matches[row, begin:end]
        for i in range(len(into)):
            into[i] = values[i] if near[i] > 0 else 0.0


@kernel(fastmath=FAST)
def _weigh(count: int, matches: Array, votes: Array, settings: MatchingSettings) -> None:
    """How far each match is to be trusted by those around it; what has no contour point, not at all."""
    gain = 1.0 / (settings.gathered_share - settings.smeared_share)
    as_expected, dark, weights, effective = matches[AS_EXPECTED], matches[DARK], matches[WEIGHT], matches[EFFECTIVE]
    for i in range(count):
        cell = np.uint64(patch(matches[TARGET_U, i], matches[TARGET_V, i], settings.patch_bits, settings.patches))
        on = votes[cell, _ON]
        weight = as_expected[i]
        if settings.concentration:
            share = (on + 1.0) / (votes[cell, _NEAR] + 2.0)
            weight *= min(max((share - settings.smeared_share) * gain, settings.least_trust), 1.0)
        if settings.polarity:
            weight *= _agreeing(dark[i] * votes[cell, _VOTES] / (on + 2.0), settings)
        weights[i] = weight
        effective[i] = 1.0 / (1.0 + on * effective[i] * settings.common_variance)


@kernel(fastmath=FAST)
def believe(observed: Observed, matches: MatchArrays, settings: MatchingSettings) -> None:
    """Make weights what there is to be said of each match: none without one, or where an object has too few of them."""
    trust, is_matched, rows, total = observed.rows[TRUST], matches.is_matched, matches.rows, 0.0
    for i in range(len(is_matched)):
        rows[WEIGHT, i] *= is_matched[i] * trust[i]
        total += rows[WEIGHT, i]
    enough = total >= settings.min_observations
    for i in range(len(is_matched)):
        is_matched[i] = is_matched[i] and enough
        rows[WEIGHT, i] *= enough * rows[EFFECTIVE, i]
