"""The rounds of matching and solving of :func:`torchtrack.tracking.estimation.rounds.align`, object by object.

One Gauss-Newton step a round, as :func:`tracking.estimation.levenberg_marquardt.solve_pose` takes with one iteration, Tukey's loss and a prior.
"""

import numpy as np
import torch

from torchtrack.backends.alignment import (
    AGE,
    NORMAL_U,
    NORMAL_V,
    ROWS,
    TARGET_U,
    TARGET_V,
    UNKNOWNS,
    WEIGHT,
    DampingSettings,
    MatchingSettings,
    U,
    V,
    X,
    Y,
    Z,
    damping_settings,
    knows,
    matches_of,
    matching_settings,
    observed_rows,
)
from torchtrack.backends.numba.arrays import as_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, at_depth, centre_of, drift, entries, lens
from torchtrack.backends.numba.index import cells_of
from torchtrack.backends.numba.matching import BLOCK, believe, match, room_for
from torchtrack.backends.numba.parameters import Cells, RoundSettings
from torchtrack.backends.numba.solving import damped_step, move, normal_equations, row_of
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.constants import constant
from torchtrack.core.dispatch import accelerates
from torchtrack.tracking.association.matches import MatchesWithCues
from torchtrack.tracking.association.nearest import ContourTable
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.estimation import rounds
from torchtrack.tracking.estimation.rounds import Gates, Start
from torchtrack.tracking.estimation.terms import Linearisation

# In the rows that are derived, after their Jacobian: residual and weight.
_RESIDUAL, _WEIGHT = 12, 13
# What these are derived from, in rows: contour point, normal, target, age, and how far a match is believed.
_X, _Y, _Z, _NU, _NV, _TO_U, _TO_V, _AGE, _BELIEVED = range(9)
_GIVEN = 9


@kernel()
def align(
    seen: Array,
    exists: Array,
    table: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    velocity: Array,
    information: Array,
    intrinsics: Array,
    centre_obj: Array,
    gates_px: Array,
    wider: Array,
    subcell_lookup: Array,
    matching: MatchingSettings,
    rounds: RoundSettings,
    damping: DampingSettings,
    T_cam_obj: Array,
    offset: Array,
    gradient: Array,
    hessian: Array,
    contour: Array,
    is_near: Array,
    is_matched: Array,
    matches: Array,
) -> None:
    """Match and solve, one round per gate, for each object.

    Args:
        seen: ``[b, 5, n]``, and which of them exist.
        table: ``[b, m, COLUMNS]`` of contour points; ``nearest_of_cell [b, p]`` and ``first [b, 2]`` are their index.
        velocity: ``[b, 6]`` as predicted.
        information: ``[b, 12, 12]`` of the prior.
        gates_px: ``[r]``, and by how much each is ``wider [r, b]``.
        subcell_lookup: ``[b]``, whether contours are looked up between the cells of the index.
        T_cam_obj, offset: ``[b, 4, 4]`` and ``[b, 12]`` from the prior, where the rounds begin; changed to where they end.
        gradient, hessian, contour, is_near, is_matched, matches: of the last round; filled.
    """
    count = seen.shape[2]
    place, rows, weights = np.empty((2, count)), np.empty((UNKNOWNS + 1, count), seen.dtype), np.empty(count, seen.dtype)
    room, centre, step, used = room_for(seen, matching.patches), np.empty(3), np.empty(UNKNOWNS), np.empty(count + 1, np.int64)
    given, derived = np.zeros(_GIVEN * BLOCK, seen.dtype), np.empty((UNKNOWNS + 2) * BLOCK, seen.dtype)
    for b in range(len(seen)):
        centre_of(T_cam_obj[b], centre_obj[b], centre)
        moving, of_lens = drift(rounds.compensated * (velocity[b] + offset[b, 6:]), centre), lens(intrinsics[b])
        _first_place(seen[b], moving, centre, of_lens, place)
        for r in range(len(gates_px)):
            centre_of(T_cam_obj[b], centre_obj[b], centre)
            moving = drift(rounds.compensated * (velocity[b] + offset[b, 6:]), centre)
            match(
                seen[b], exists[b], place, table[b], nearest_of_cell[b], first[b], cells, entries(T_cam_obj[b]), moving, of_lens, gates_px[r],
                wider[r, b], subcell_lookup[b], r == len(gates_px) - 1, matching, contour[b], is_near[b], is_matched[b], matches[b], room,
            )  # fmt: skip
            believe(seen[b], is_matched[b], matches[b], matching)
            pose, scale_px = entries(T_cam_obj[b]), gates_px[r] * wider[r, b]
            total = _that_count(matches[b, WEIGHT], used)
            for begin in range(0, total, BLOCK):
                end = min(begin + BLOCK, total)
                _lay_out(used[begin:end], seen[b], table[b], contour[b], matches[b], given)
                _linearise(given, pose, centre_obj[b], centre, of_lens, scale_px, rounds.velocity_in_window, derived)
                for k in range(UNKNOWNS + 1):
                    rows[k, begin:end] = derived[k * BLOCK : k * BLOCK + end - begin]
                weights[begin:end] = derived[_WEIGHT * BLOCK : _WEIGHT * BLOCK + end - begin]
            normal_equations(rows, weights, total, information[b], offset[b], gradient[b], hessian[b])
            damped_step(gradient[b], hessian[b], damping.damping, damping, step)
            move(T_cam_obj[b], centre_obj[b], offset[b], step)


@kernel(fastmath=FAST)
def _first_place(seen: Array, moving: Numbers, centre: Array, intrinsics: Numbers, place: Array) -> None:
    """Where the first round looks for each observation: carried to the window's end at the depth of the object's centre."""
    place_u, place_v = place
    for i in range(len(place_u)):
        u, v, age = seen[U, i], seen[V, i], seen[AGE, i]
        speed_u, speed_v = at_depth(moving, centre[2], u, v, intrinsics)
        place_u[i], place_v[i] = u + speed_u * age, v + speed_v * age


@kernel()
def _that_count(weights: Array, used: Array) -> np.int64:
    """Numbers of the matches with any weight, first in ``used``: how many."""
    total = np.uint64(0)
    for i in range(len(weights)):
        used[total] = i
        total += np.uint64(weights[i] > 0)
    return np.int64(total)


@kernel()
def _lay_out(used: Array, seen: Array, table: Array, contour: Array, matches: Array, given: Array) -> None:
    """Lay out a block of matches in rows."""
    ages, targets_u, targets_v, weights = seen[AGE], matches[TARGET_U], matches[TARGET_V], matches[WEIGHT]
    for k in range(len(used)):
        i = np.uint64(used[k])
        point = table[np.uint64(contour[i])]
        given[_X * BLOCK + k], given[_Y * BLOCK + k], given[_Z * BLOCK + k] = point[X], point[Y], point[Z]
        given[_NU * BLOCK + k], given[_NV * BLOCK + k] = point[NORMAL_U], point[NORMAL_V]
        given[_TO_U * BLOCK + k], given[_TO_V * BLOCK + k] = targets_u[i], targets_v[i]
        given[_AGE * BLOCK + k], given[_BELIEVED * BLOCK + k] = ages[i], weights[i]


@kernel(fastmath=FAST)
def _linearise(
    given: Array, pose: Numbers, centre_obj: Array, centre: Array, intrinsics: Numbers, scale_px: float, velocity_in_window: bool, derived: Array
) -> None:
    """Rows of the Jacobian of a block of matches, with residuals and weights."""
    middle, own = (centre[0], centre[1], centre[2]), (centre_obj[0], centre_obj[1], centre_obj[2])
    for i in range(BLOCK):
        px, py, pz = given[_X * BLOCK + i] - own[0], given[_Y * BLOCK + i] - own[1], given[_Z * BLOCK + i] - own[2]
        nu, nv = given[_NU * BLOCK + i], given[_NV * BLOCK + i]
        there = (given[_TO_U * BLOCK + i] - intrinsics[2]) * nu + (given[_TO_V * BLOCK + i] - intrinsics[3]) * nv
        row, residual = row_of(pose, px, py, pz, middle, intrinsics, nu, nv, there)
        relative = residual / scale_px
        robust = max(1.0 - relative * relative, 0.0)
        age = given[_AGE * BLOCK + i] * velocity_in_window
        derived[i], derived[BLOCK + i], derived[2 * BLOCK + i] = row[0], row[1], row[2]
        derived[3 * BLOCK + i], derived[4 * BLOCK + i], derived[5 * BLOCK + i] = row[3], row[4], row[5]
        # How far it was from where it is at the pose, for each unit of velocity beyond the predicted one.
        derived[6 * BLOCK + i], derived[7 * BLOCK + i], derived[8 * BLOCK + i] = -row[0] * age, -row[1] * age, -row[2] * age
        derived[9 * BLOCK + i], derived[10 * BLOCK + i], derived[11 * BLOCK + i] = -row[3] * age, -row[4] * age, -row[5] * age
        derived[_RESIDUAL * BLOCK + i], derived[_WEIGHT * BLOCK + i] = residual, given[_BELIEVED * BLOCK + i] * robust * robust


@accelerates(rounds.align_rounds, supports=lambda start, table, observations, gates, config: knows(config) and not start.extra_terms)
def align_rounds_numba(
    start: Start, table: ContourTable, observations: Observations, gates: Gates, config: TrackerConfig
) -> tuple[Linearisation, MatchesWithCues, Contours]:
    """Observation by observation, all rounds of an object at once."""
    prediction, information = start.prediction, rounds.prior_information(start.prediction, config)
    objects, (batch, count) = prediction.objects, observations.mask.shape
    # What the kernel writes to lies row by row in memory: of anything else it would be given a copy.
    T_cam_obj, offset = (value.clone(memory_format=torch.contiguous_format) for value in (start.begin.T_cam_obj, start.from_prior(information)))
    gradient, hessian = offset.new_empty(offset.shape), offset.new_empty(information.shape)
    contour = torch.empty(batch, count, dtype=torch.int64)
    is_near, is_matched = torch.empty(2, batch, count, dtype=torch.bool)
    matches = torch.empty(batch, ROWS, count, dtype=offset.dtype)
    align(
        *as_arrays(observed_rows(observations), observations.mask, table.rows.transpose(1, 2), table.index.nearest, table.index.first),
        cells_of(table.index),
        *as_arrays(prediction.velocity, information, objects.intrinsics, objects.centre_obj),
        *as_arrays(constant(config.association.gates_px, offset.dtype, offset.device), gates.wider, gates.subcell_lookup),
        matching_settings(config),
        RoundSettings(config.association.motion_compensation, config.uses(Component.VELOCITY_IN_WINDOW)),
        damping_settings(config.solver, information),
        *as_arrays(T_cam_obj, offset, gradient, hessian, contour, is_near, is_matched, matches),
    )
    return Linearisation(T_cam_obj, gradient, hessian, offset), matches_of(contour, is_near, is_matched, matches), start.contours
