"""The rounds of matching and solving of :func:`torchtrack.alignment.align`, object by object.

One Gauss-Newton step a round, as :func:`torchtrack.pose_solver.solve_pose` takes with one iteration, Tukey's loss and a prior.
"""

import numpy as np

from torchtrack.kernels.cholesky import factorise, solve
from torchtrack.kernels.compiler import FAST, Array, kernel
from torchtrack.kernels.matching import (
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
from torchtrack.kernels.motion import Numbers, at_depth, centre_of, drift, entries, inverse_depth, is_finite, lens, turn, turned
from torchtrack.kernels.settings import Cells, MatchingSettings, RoundSettings

# Pose, velocity and swelling; and their residual, in the rows of a Jacobian.
UNKNOWNS, _RESIDUAL = 13, 13
# Sums of products run along as many observations at a time: what they need stays in the fastest memory.
_ALONG = FAST | {"reassoc"}


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
    votes, centre = np.empty((matching.patches**2, 3)), np.empty(3)
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
            _normal_equations(rows, weights, used, information[b], offset[b], gradient[b], hessian[b])
            _move(T_cam_obj[b], centre_obj[b], centre, offset[b], _step(gradient[b], hessian[b], rounds))


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
    used, swelling, (cx, cy, cz) = 0, offset[UNKNOWNS - 1], (centre[0], centre[1], centre[2])
    for i in range(matches.shape[1]):
        weight = matches[WEIGHT, i]
        if not weight > 0:
            continue
        px, py, pz = matches[POINT_X, i] - centre_obj[0], matches[POINT_Y, i] - centre_obj[1], matches[POINT_Z, i] - centre_obj[2]
        ax, ay, az = turned(pose, px, py, pz)
        inverse = inverse_depth(az + cz)
        nu, nv, outward = matches[DIRECTION_U, i], matches[DIRECTION_V, i], matches[IS_LIMB, i]
        gx, gy = nu * intrinsics[0] * inverse, nv * intrinsics[1] * inverse
        along = gx * (ax + cx) + gy * (ay + cy)
        gz = -along * inverse
        there = (matches[TARGET_U, i] - intrinsics[2]) * nu + (matches[TARGET_V, i] - intrinsics[3]) * nv
        residual = along - there + outward * swelling
        relative = residual / scale_px
        robust = max(1.0 - relative * relative, 0.0)
        if robust == 0.0:
            continue
        age = matches[MATCH_AGE, i] * rounds.velocity_in_window
        rows[0, used], rows[1, used], rows[2, used] = ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx
        rows[3, used], rows[4, used], rows[5, used] = gx, gy, gz
        for k in range(6):
            # How far it was from where it is at the pose, for each unit of velocity beyond the predicted one.
            rows[6 + k, used] = rows[k, used] * age * (0.5 * age * rate_hz[k] - 1.0)
        rows[12, used], rows[_RESIDUAL, used] = outward, residual
        weights[used] = weight * robust * robust
        used += 1
    return used


@kernel(fastmath=_ALONG)
def _normal_equations(rows: Array, weights: Array, used: int, information: Array, offset: Array, gradient: Array, hessian: Array) -> None:
    """Gradient of the cost, and its Gauss-Newton Hessian, prior included."""
    weighted = np.empty(used, rows.dtype)
    for j in range(UNKNOWNS + 1):
        row = rows[j]
        for i in range(used):
            weighted[i] = weights[i] * row[i]
        for k in range(min(j + 1, UNKNOWNS)):
            other, total = rows[k], rows.dtype.type(0)
            for i in range(used):
                total += weighted[i] * other[i]
            if j == _RESIDUAL:
                gradient[k] = total
            else:
                hessian[j, k] = hessian[k, j] = total
    for j in range(UNKNOWNS):
        pull = 0.0
        for k in range(UNKNOWNS):
            pull += information[j, k] * offset[k]
            hessian[j, k] += information[j, k]
        gradient[j] += pull


@kernel()
def _step(gradient: Array, hessian: Array, rounds: RoundSettings) -> Array:
    """The damped step to the optimum; none where the Hessian is not positive definite."""
    damped, factor, step = hessian.astype(np.float64), np.zeros((UNKNOWNS, UNKNOWNS)), -gradient.astype(np.float64)
    largest = 0.0
    for k in range(6):
        largest = max(largest, damped[k, k])
    for k in range(UNKNOWNS):
        damped[k, k] += rounds.least_diagonal + rounds.least_share * largest + rounds.damping * damped[k, k]
    if not factorise(damped, factor):
        return np.zeros(UNKNOWNS)
    solve(factor, step)
    return step if is_finite(step) else np.zeros(UNKNOWNS)


@kernel()
def _move(T_cam_obj: Array, centre_obj: Array, centre: Array, offset: Array, step: Array) -> None:
    """Take a step: turn about the object's centre, and move the centre."""
    rotation = T_cam_obj[:3, :3].astype(np.float64)
    into = np.empty((3, 3))
    turn(rotation, step, into)
    for j in range(3):
        back = into[j, 0] * centre_obj[0] + into[j, 1] * centre_obj[1] + into[j, 2] * centre_obj[2]
        T_cam_obj[j, 3] = centre[j] + step[3 + j] - back
        for k in range(3):
            T_cam_obj[j, k] = into[j, k]
    for k in range(UNKNOWNS):
        offset[k] += step[k]
