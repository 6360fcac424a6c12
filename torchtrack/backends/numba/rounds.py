"""The rounds of matching and solving of :func:`torchtrack.tracking.estimation.rounds.align`, object by object.

One Gauss-Newton step a round, as :func:`tracking.estimation.levenberg_marquardt.solve_pose` takes with one iteration, Tukey's loss and a prior.
"""

from typing import NamedTuple

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
from torchtrack.backends.numba.arrays import IndexArrays, SolutionArrays, as_arrays, index_arrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Plane, carried, centre_of, drift, entries, lens
from torchtrack.backends.numba.look_up import index_of
from torchtrack.backends.numba.matching import BLOCK, MatchArrays, Observed, Round, Table, believe, match, room_for
from torchtrack.backends.numba.parameters import RoundSettings
from torchtrack.backends.numba.solving import damped_step, move, normal_equations, row_of, solution_of
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


class Objects(NamedTuple):
    """What each object begins with: velocity ``[b, 6]`` as predicted, information ``[b, 12, 12]`` of the prior, camera and centre."""

    velocity: Array
    information: Array
    intrinsics: Array
    centre_obj: Array


class GateArrays(NamedTuple):
    """Gates of the rounds: ``px [r]``, and by how much each is ``wider [r, b]``."""

    px: Array
    wider: Array


class Aligned(NamedTuple):
    """Where the rounds begin, changed to where they end, and the matches of the last one."""

    solutions: SolutionArrays
    matches: MatchArrays


@kernel()
def align(observed: Observed, table: Table, objects: Objects, gates: GateArrays, settings: RoundSettings, aligned: Aligned) -> None:
    """Match and solve, one round per gate, for each object."""
    observed, objects, gates = Observed(*observed), Objects(*objects), GateArrays(*gates)
    table, aligned = Table(table[0], IndexArrays(*table[1]), table[2]), Aligned(SolutionArrays(*aligned[0]), MatchArrays(*aligned[1]))
    dtype, count, last = observed.rows.dtype, observed.rows.shape[2], len(gates.px) - 1
    rows, weights, used = np.empty((UNKNOWNS + 1, count), dtype), np.empty(count, dtype), np.empty(count + 1, np.int64)
    room, centre, step = room_for(observed.rows, settings.matching.patches), np.empty(3), np.empty(UNKNOWNS)
    given, derived = np.zeros(_GIVEN * BLOCK, dtype), np.empty((UNKNOWNS + 2) * BLOCK, dtype)
    for b in range(len(observed.rows)):
        seen, solution, matches = Observed(observed.rows[b], observed.exists[b]), solution_of(aligned.solutions, b), _matches_of(aligned.matches, b)
        of_object, centre_obj = Table(table.rows[b], index_of(table.nearest, b), table.subcell_lookup[b]), objects.centre_obj[b]
        T_cam_obj, offset, of_lens = solution.T_cam_obj, solution.offset, lens(objects.intrinsics[b])
        for r in range(len(gates.px)):
            centre_of(T_cam_obj, centre_obj, centre)
            moving = drift(settings.compensated * (objects.velocity[b] + offset[6:]), centre)
            if r == 0:
                _first_place(seen.rows, Plane(moving, centre[2], of_lens), room.place)
            current = Round(entries(T_cam_obj), moving, of_lens, gates.px[r], gates.wider[r, b], r == last)
            match(seen, of_object, current, settings.matching, matches, room)
            believe(seen, matches, settings.matching)
            total = _that_count(matches.rows[WEIGHT], used)
            for begin in range(0, total, BLOCK):
                end = min(begin + BLOCK, total)
                _lay_out(used[begin:end], seen.rows, of_object.rows, matches, given)
                _linearise(given, current, centre_obj, centre, settings.velocity_in_window, derived)
                for k in range(UNKNOWNS + 1):
                    rows[k, begin:end] = derived[k * BLOCK : k * BLOCK + end - begin]
                weights[begin:end] = derived[_WEIGHT * BLOCK : _WEIGHT * BLOCK + end - begin]
            normal_equations(rows, weights, total, objects.information[b], solution)
            damped_step(solution, settings.damping.damping, settings.damping, step)
            move(T_cam_obj, centre_obj, offset, step)


@kernel()
def _matches_of(matches: MatchArrays, b: int) -> MatchArrays:
    """The matches of one object."""
    return MatchArrays(matches.contour[b], matches.is_near[b], matches.is_matched[b], matches.rows[b])


@kernel(fastmath=FAST)
def _first_place(seen: Array, plane: Plane, place: Array) -> None:
    """Where the first round looks for each observation: carried to the window's end at the depth of the object's centre."""
    place_u, place_v = place
    for i in range(len(place_u)):
        place_u[i], place_v[i] = carried(plane, seen[U, i], seen[V, i], seen[AGE, i])


@kernel()
def _that_count(weights: Array, used: Array) -> np.int64:
    """Numbers of the matches with any weight, first in ``used``: how many."""
    total = np.uint64(0)
    for i in range(len(weights)):
        used[total] = i
        total += np.uint64(weights[i] > 0)
    return np.int64(total)


@kernel()
def _lay_out(used: Array, seen: Array, table: Array, matches: MatchArrays, given: Array) -> None:
    """Lay out a block of matches in rows."""
    ages, contour, targets_u, targets_v, weights = seen[AGE], matches.contour, matches.rows[TARGET_U], matches.rows[TARGET_V], matches.rows[WEIGHT]
    for k in range(len(used)):
        i = np.uint64(used[k])
        point = table[np.uint64(contour[i])]
        given[_X * BLOCK + k], given[_Y * BLOCK + k], given[_Z * BLOCK + k] = point[X], point[Y], point[Z]
        given[_NU * BLOCK + k], given[_NV * BLOCK + k] = point[NORMAL_U], point[NORMAL_V]
        given[_TO_U * BLOCK + k], given[_TO_V * BLOCK + k] = targets_u[i], targets_v[i]
        given[_AGE * BLOCK + k], given[_BELIEVED * BLOCK + k] = ages[i], weights[i]


@kernel(fastmath=FAST)
def _linearise(given: Array, current: Round, centre_obj: Array, centre: Array, velocity_in_window: bool, derived: Array) -> None:
    """Rows of the Jacobian of a block of matches, with residuals and weights."""
    intrinsics, scale_px = current.lens, current.gate_px * current.wider
    middle, own = (centre[0], centre[1], centre[2]), (centre_obj[0], centre_obj[1], centre_obj[2])
    for i in range(BLOCK):
        px, py, pz = given[_X * BLOCK + i] - own[0], given[_Y * BLOCK + i] - own[1], given[_Z * BLOCK + i] - own[2]
        nu, nv = given[_NU * BLOCK + i], given[_NV * BLOCK + i]
        there = (given[_TO_U * BLOCK + i] - intrinsics[2]) * nu + (given[_TO_V * BLOCK + i] - intrinsics[3]) * nv
        row, residual = row_of(current.pose, (px, py, pz), middle, intrinsics, (nu, nv), there)
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
    contour, matches = torch.empty(batch, count, dtype=torch.int64), torch.empty(batch, ROWS, count, dtype=offset.dtype)
    is_near, is_matched = torch.empty(2, batch, count, dtype=torch.bool)
    compensated, velocity_in_window = config.association.motion_compensation, config.uses(Component.VELOCITY_IN_WINDOW)
    rows, subcell_lookup = as_arrays(table.rows.transpose(1, 2), gates.subcell_lookup)
    align(
        as_arrays(observed_rows(observations), observations.mask),
        (rows, index_arrays(table.index), subcell_lookup),
        as_arrays(prediction.velocity, information, objects.intrinsics, objects.centre_obj),
        as_arrays(constant(config.association.gates_px, offset.dtype, offset.device), gates.wider),
        RoundSettings(matching_settings(config), damping_settings(config.solver, information), compensated, velocity_in_window),
        (as_arrays(T_cam_obj, offset, gradient, hessian), as_arrays(contour, is_near, is_matched, matches)),
    )
    return Linearisation(T_cam_obj, gradient, hessian, offset), matches_of(contour, is_near, is_matched, matches), start.contours
