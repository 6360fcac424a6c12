"""Matching observations with contours: :func:`torchtrack.tracking.association.nearest.match_nearest`, and what its matches come to weigh."""

import triton.language as tl

from torchtrack.backends import alignment as rows
from torchtrack.backends.triton.compiler import kernel
from torchtrack.backends.triton.geometry import show

# Patches of the image: votes of the observations in each.
_ON, _NEAR, _VOTES = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2)
VOTES = 3
_NOWHERE = tl.constexpr(1e30)


@kernel
def match(
    seen, exists, place, table, nearest_of_cell, first, T_cam_obj, centre_obj, velocity, intrinsics, wider, subcell_lookup,
    votes, contour, is_near, is_matched, matches,
    count, points, cell_rows, cell_columns, side_px, aside_px, gate_px,
    settings: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Match a block of one object's observations with the contour points nearest to their places, which are moved on.

    Args:
        seen: ``[b, 5, n]``, and which of them ``exists [b, n]``.
        place: ``[b, 2, n]``; changed.
        table: ``[b, COLUMNS, m]`` of contour points; ``nearest_of_cell [b, p]`` and ``first [b, 2]`` are their index.
        velocity: ``[b, 6]``, with which observations are moved to the window's end.
        wider: ``[b]``, by how much the gate is wider, and ``subcell_lookup [b]`` whether contours are looked up between the index's cells.
        votes: ``[b, patches², VOTES]``, zero; added to.
        contour, is_near, is_matched, matches: ``[b, n]``, and ``[b, ROWS, n]``; filled but for the weights.
        count, points: ``n`` and ``m``.
        settings: :class:`torchtrack.backends.alignment.MatchingSettings`.
    """
    b = tl.program_id(0).to(tl.int64)
    i = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    seen, place, matches = seen + b * rows.OBSERVED * count + i, place + b * 2 * count + i, matches + b * rows.ROWS * count + i
    table += b * rows.COLUMNS * points
    place_u, place_v = tl.load(place, inside, 0.0), tl.load(place + count, inside, 0.0)
    index = nearest_of_cell + b * cell_rows * cell_columns, first + b * 2, cell_rows, cell_columns, side_px, aside_px
    if tl.load(subcell_lookup + b):
        nearest_index = _nearest_of_four(index, table + rows.INDEXED_U * points, points, place_u, place_v)
    else:
        nearest_index = _nearest(index, place_u, place_v)
    near = inside & tl.load(exists + b * count + i, inside, 0).to(tl.int1) & (nearest_index >= 0)
    point = tl.where(near, nearest_index, 0)
    table += point
    normal_u, normal_v = tl.load(table + rows.NORMAL_U * points), tl.load(table + rows.NORMAL_V * points)
    point_x, point_y, point_z = tl.load(table + rows.X * points), tl.load(table + rows.Y * points), tl.load(table + rows.Z * points)
    u, v, speed_u, speed_v = show(T_cam_obj + b * 16, centre_obj + b * 3, velocity + b * 6, intrinsics + b * 4, point_x, point_y, point_z)
    # Where the observation would be at the window's end, on its edge.
    crossing, smooth = normal_u * speed_u + normal_v * speed_v, tl.load(table + rows.SMOOTH * points)
    dark = tl.load(seen + rows.POLARITY * count, inside, 0.0) * crossing / (tl.abs(crossing) + settings.slow_px_s)
    age_s = tl.load(seen + rows.AGE * count, inside, 0.0)
    carried_u, carried_v = tl.load(seen, inside, 0.0) + age_s * speed_u, tl.load(seen + count, inside, 0.0) + age_s * speed_v
    shift = dark * (settings.dark_shift_px + smooth * (settings.silhouette_dark_shift_px - settings.dark_shift_px))
    target_u, target_v = carried_u - normal_u * shift, carried_v - normal_v * shift
    # How far its contour is from there.
    away_u, away_v, scale = u - target_u, v - target_v, tl.load(wider + b)
    matched = near & (away_u * away_u + away_v * away_v < gate_px * scale * gate_px * scale)
    offset = (away_u * normal_u + away_v * normal_v) / scale
    as_expected = tl.where(near, _agreeing(dark * tl.load(table + rows.EXPECTED * points), settings), 0.0)
    dark *= tl.load(table + rows.ORIENTED * points)
    cell = b * settings.patches * settings.patches + _patch(target_u, target_v, settings)
    _vote(votes + cell * 3, near, offset, as_expected, dark, settings)
    # Without the dark shift: between edges that lie close, it would make a choice confirm itself.
    next_u = carried_u - (u - tl.load(table + rows.INDEXED_U * points))
    next_v = carried_v - (v - tl.load(table + rows.INDEXED_V * points))
    tl.store(place, tl.where(matched, next_u, place_u), inside)
    tl.store(place + count, tl.where(matched, next_v, place_v), inside)
    tl.store(contour + b * count + i, point, inside)
    tl.store(is_near + b * count + i, near, inside)
    tl.store(is_matched + b * count + i, matched, inside)
    tl.store(matches + rows.MATCH_AGE * count, age_s, inside)
    tl.store(matches + rows.POINT_X * count, point_x, inside)
    tl.store(matches + rows.POINT_Y * count, point_y, inside)
    tl.store(matches + rows.POINT_Z * count, point_z, inside)
    tl.store(matches + rows.TARGET_U * count, target_u, inside)
    tl.store(matches + rows.TARGET_V * count, target_v, inside)
    tl.store(matches + rows.DIRECTION_U * count, normal_u, inside)
    tl.store(matches + rows.DIRECTION_V * count, normal_v, inside)
    tl.store(matches + rows.OFFSET * count, offset, inside)
    tl.store(matches + rows.DARK * count, dark, inside)
    tl.store(matches + rows.AS_EXPECTED * count, as_expected, inside)
    # Until it is known how many lie around it: whether it has an error in common with them.
    tl.store(matches + rows.EFFECTIVE * count, smooth, inside)


@kernel
def _vote(votes, near, offset, as_expected, dark, settings: tl.constexpr):
    """Count observations in their patches: those on a contour, those near one, and which side they say is the darker one."""
    on = tl.where(tl.abs(offset) < settings.on_contour_px, as_expected, 0.0)
    tl.atomic_add(votes + _ON, on, near)
    tl.atomic_add(votes + _NEAR, tl.where(tl.abs(offset) < settings.smear_px, as_expected, 0.0), near)
    tl.atomic_add(votes + _VOTES, on * dark, near)


@kernel
def believe(seen, votes, is_matched, matches, count, settings: tl.constexpr, BLOCK: tl.constexpr):
    """Weigh one object's matches by those around them; none counts without a match, or where the object has too few of them.

    Args:
        votes: ``[b, patches², VOTES]``, from :func:`match`; so are ``is_matched [b, n]`` and ``matches [b, ROWS, n]``, which are changed.
    """
    b = tl.program_id(0).to(tl.int64)
    matches, is_matched = matches + b * rows.ROWS * count, is_matched + b * count
    trust, votes = seen + (b * rows.OBSERVED + rows.TRUST) * count, votes + b * settings.patches * settings.patches * 3
    total = tl.zeros([BLOCK], matches.dtype.element_ty)
    for begin in range(0, count, BLOCK):
        i = begin + tl.arange(0, BLOCK)
        inside = i < count
        target_u, target_v = tl.load(matches + rows.TARGET_U * count + i, inside, 0.0), tl.load(matches + rows.TARGET_V * count + i, inside, 0.0)
        around = votes + _patch(target_u, target_v, settings) * 3
        on, smooth = tl.load(around + _ON), tl.load(matches + rows.EFFECTIVE * count + i, inside, 0.0)
        weight = tl.load(matches + rows.AS_EXPECTED * count + i, inside, 0.0)
        if settings.concentration:
            share = (on + 1.0) / (tl.load(around + _NEAR) + 2.0)
            gathered = (share - settings.smeared_share) * (1.0 / (settings.gathered_share - settings.smeared_share))
            weight *= tl.minimum(tl.maximum(gathered, settings.least_trust), 1.0)
        if settings.polarity:
            dark = tl.load(matches + rows.DARK * count + i, inside, 0.0)
            weight *= _agreeing(dark * tl.load(around + _VOTES) / (on + 2.0), settings)
        matched = tl.load(is_matched + i, inside, 0).to(tl.int1)
        weight = tl.where(matched, weight * tl.load(trust + i, inside, 0.0), 0.0)
        total += weight
        effective = 1.0 / (1.0 + on * smooth * settings.common_variance)
        tl.store(matches + rows.EFFECTIVE * count + i, effective, inside)
        tl.store(matches + rows.WEIGHT * count + i, weight * effective, inside)
    if not tl.sum(total) >= settings.min_observations:
        for begin in range(0, count, BLOCK):
            i = begin + tl.arange(0, BLOCK)
            tl.store(is_matched + i, tl.zeros([BLOCK], tl.int1), i < count)
            tl.store(matches + rows.WEIGHT * count + i, tl.zeros([BLOCK], matches.dtype.element_ty), i < count)


@kernel
def _nearest(index, u, v):
    """The contour point that the cell around each place knows, -1 for none: :meth:`tracking.contours.index.ContourIndex.look_up`."""
    nearest_of_cell, first, cell_rows, cell_columns, side_px, aside_px = index
    half = 0.5 * side_px + aside_px
    column, row = tl.floor((u + half) / side_px) - tl.load(first), tl.floor((v + half) / side_px) - tl.load(first + 1)
    # The region's border is empty: what lies outside finds nothing there, nor does what is not a number.
    column, row = tl.where(column >= 0, column, 0.0), tl.where(row >= 0, row, 0.0)
    column, row = tl.minimum(column, cell_columns - 1.0), tl.minimum(row, cell_rows - 1.0)
    return tl.load(nearest_of_cell + row.to(tl.int32) * cell_columns + column.to(tl.int32)).to(tl.int64)


@kernel
def _nearest_of_four(index, indexed, points, u, v):
    """Of the contour points that the four cells around each place know, the one nearest to it; -1 for none.

    Args:
        indexed: rows of the places of contour points when they were indexed.
    """
    nearest_of_cell, first, cell_rows, cell_columns, side_px, aside_px = index
    column, row = tl.floor((u + aside_px) / side_px) - tl.load(first), tl.floor((v + aside_px) / side_px) - tl.load(first + 1)
    inside = (column >= 0) & (row >= 0) & (column < cell_columns - 1) & (row < cell_rows - 1)
    begin = tl.where(inside, row, 0.0).to(tl.int32) * cell_columns + tl.where(inside, column, 0.0).to(tl.int32)
    best, least = tl.full(u.shape, -1, tl.int64), tl.full(u.shape, _NOWHERE, u.dtype)
    for number in tl.static_range(4):
        known = tl.load(nearest_of_cell + begin + (number // 2) * cell_columns + number % 2).to(tl.int64)
        is_known = inside & (known >= 0)
        away_u = tl.load(indexed + known, is_known, 0.0) - u
        away_v = tl.load(indexed + points + known, is_known, 0.0) - v
        away = away_u * away_u + away_v * away_v
        is_nearer = is_known & (away < least)
        best, least = tl.where(is_nearer, known, best), tl.where(is_nearer, away, least)
    return best


@kernel
def _agreeing(agreement, settings: tl.constexpr):
    """Trust by how far a polarity is what it should be: :func:`torchtrack.tracking.association.weights.agreeing`."""
    return tl.minimum(tl.maximum(1.0 + settings.polarity_gain * agreement, settings.least_agreement), 1.0)


@kernel
def _patch(u, v, settings: tl.constexpr):
    """The patch of the image that each place lies in: :func:`torchtrack.tracking.association.weights.patch`."""
    row, column = tl.floor(v).to(tl.int64) >> settings.patch_bits, tl.floor(u).to(tl.int64) >> settings.patch_bits
    return (row & (settings.patches - 1)) * settings.patches + (column & (settings.patches - 1))
