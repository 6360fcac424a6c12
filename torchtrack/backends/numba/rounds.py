"""The rounds of matching and solving of :func:`torchtrack.tracking.estimation.rounds.align`, object by object.

One Gauss-Newton step a round, as :func:`torchtrack.tracking.estimation.levenberg_marquardt.solve_pose` takes with one iteration, Tukey's loss and a prior.
"""

import numpy as np

from torchtrack.backends.numba.compiler import FAST, Array, kernel
from torchtrack.backends.numba.geometry import Numbers, at_depth, centre_of, drift, entries, lens
from torchtrack.backends.numba.matching import (
    AGE,
    DIRECTION_U,
    DIRECTION_V,
    IS_LIMB,
    MATCH_AGE,
    POINT_X,
    POINT_Y,
    POINT_Z,
    TARGET_U,
    TARGET_V,
    WEIGHT,
    U,
    V,
    believe,
    match,
)
from torchtrack.backends.numba.parameters import Cells, DampingSettings, MatchingSettings, RoundSettings
from torchtrack.backends.numba.solving import damped_step, move, normal_equations, row_of

# Pose, velocity and swelling; and their residual, in the rows of a Jacobian.
UNKNOWNS, _RESIDUAL = 13, 13


@kernel()
def align(
    seen: Array,
    exists: Array,
    table: Array,
    nearest_of_cell: Array,
    first: Array,
    cells: Cells,
    velocity: Array,
    acceleration: Array,
    rate_hz: Array,
    information: Array,
    intrinsics: Array,
    centre_obj: Array,
    gates_px: Array,
    wider: Array,
    finely: Array,
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
        seen: ``[b, 6, n]``, and which of them exist.
        table: ``[b, m, COLUMNS]`` of contour points; ``nearest_of_cell [b, p]`` and ``first [b, 2]`` are their index.
        velocity, acceleration, rate_hz: ``[b, 6]`` as predicted.
        information: ``[b, 13, 13]`` of the prior.
        gates_px: ``[r]``, and by how much each is ``wider [r, b]``.
        finely: ``[b]``, whether contours are looked up finely.
        T_cam_obj, offset: ``[b, 4, 4]`` and ``[b, 13]`` from the prior, where the rounds begin; changed to where they end.
        gradient, hessian, contour, is_near, is_matched, matches: of the last round; filled.
    """
    count = seen.shape[2]
    place, rows, weights = np.empty((count, 2)), np.empty((UNKNOWNS + 1, count), seen.dtype), np.empty(count, seen.dtype)
    votes, centre, step = np.empty((matching.patches**2, 3)), np.empty(3), np.empty(UNKNOWNS)
    for b in range(len(seen)):
        centre_of(T_cam_obj[b], centre_obj[b], centre)
        moving, of_lens = drift(rounds.compensated * (velocity[b] + offset[b, 6:12]), centre), lens(intrinsics[b])
        _first_place(seen[b], moving, centre, of_lens, place)
        for r in range(len(gates_px)):
            centre_of(T_cam_obj[b], centre_obj[b], centre)
            moving = drift(rounds.compensated * (velocity[b] + offset[b, 6:12]), centre)
            change = drift(rounds.compensated * (acceleration[b] + rate_hz[b] * offset[b, 6:12]), centre)
            match(
                seen[b], exists[b], place, table[b], nearest_of_cell[b], first[b], cells, entries(T_cam_obj[b]), moving, change, of_lens,
                gates_px[r], wider[r, b], finely[b], matching, contour[b], is_near[b], is_matched[b], matches[b], votes,
            )  # fmt: skip
            believe(seen[b], is_matched[b], matches[b], matching)
            pose, scale_px = entries(T_cam_obj[b]), gates_px[r] * wider[r, b]
            used = _linearise(matches[b], pose, centre_obj[b], centre, rate_hz[b], of_lens, scale_px, offset[b], rounds, rows, weights)
            normal_equations(rows, weights, used, information[b], offset[b], gradient[b], hessian[b])
            damped_step(gradient[b], hessian[b], damping.damping, damping, step)
            move(T_cam_obj[b], centre_obj[b], offset[b], step)


@kernel(fastmath=FAST)
def _first_place(seen: Array, moving: Numbers, centre: Array, intrinsics: Numbers, place: Array) -> None:
    """Where the first round looks for each observation: carried to the window's end at the depth of the object's centre."""
    for i in range(len(place)):
        u, v, age = seen[U, i], seen[V, i], seen[AGE, i]
        speed_u, speed_v = at_depth(moving, centre[2], u, v, intrinsics)
        place[i, 0], place[i, 1] = u + speed_u * age, v + speed_v * age


@kernel(fastmath=FAST)
def _linearise(
    matches: Array,
    pose: Numbers,
    centre_obj: Array,
    centre: Array,
    rate_hz: Array,
    intrinsics: Numbers,
    scale_px: float,
    offset: Array,
    rounds: RoundSettings,
    rows: Array,
    weights: Array,
) -> int:
    """Fill rows of the Jacobian, with residuals, and weights of those that count; how many these are."""
    used, swelling, middle = 0, offset[UNKNOWNS - 1], (centre[0], centre[1], centre[2])
    for i in range(matches.shape[1]):
        weight = matches[WEIGHT, i]
        if not weight > 0:
            continue
        px, py, pz = matches[POINT_X, i] - centre_obj[0], matches[POINT_Y, i] - centre_obj[1], matches[POINT_Z, i] - centre_obj[2]
        nu, nv, outward = matches[DIRECTION_U, i], matches[DIRECTION_V, i], matches[IS_LIMB, i]
        there = (matches[TARGET_U, i] - intrinsics[2]) * nu + (matches[TARGET_V, i] - intrinsics[3]) * nv
        row, residual = row_of(pose, px, py, pz, middle, intrinsics, nu, nv, there)
        residual += outward * swelling
        relative = residual / scale_px
        robust = max(1.0 - relative * relative, 0.0)
        if robust == 0.0:
            continue
        age = matches[MATCH_AGE, i] * rounds.velocity_in_window
        for k in range(6):
            rows[k, used] = row[k]
            # How far it was from where it is at the pose, for each unit of velocity beyond the predicted one.
            rows[6 + k, used] = row[k] * age * (0.5 * age * rate_hz[k] - 1.0)
        rows[12, used], rows[_RESIDUAL, used] = outward, residual
        weights[used] = weight * robust * robust
        used += 1
    return used
