"""One damped Gauss-Newton step of each object, as :func:`torchtrack.tracking.estimation.levenberg_marquardt.solve_pose` takes with one iteration.

The rows of the Jacobian and the residuals are one matrix of 16 rows, so that its product with itself holds the normal equations. They are solved
by elimination in double precision.
"""

import triton.language as tl

from torchtrack.backends import alignment as rows
from torchtrack.backends.triton.compiler import kernel
from torchtrack.backends.triton.geometry import inverse_depth, placed, rotated

# Rows of a product: unknowns, residual, and what makes them a power of two.
_SIZE = tl.constexpr(16)
# Unknowns of a pose.
_POSE = tl.constexpr(6)


@kernel
def solve(
    matches, information, centre_obj, intrinsics, wider, T_cam_obj, next_T_cam_obj, offset, gradient, hessian, count, gate_px,
    velocity_in_window: tl.constexpr, damping: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Linearise one object's matches at its pose, and take the step: turn about the object's centre, and move the centre.

    Args:
        matches: ``[b, ROWS, n]``, from :func:`torchtrack.backends.triton.matching.believe`.
        information: ``[b, 12, 12]`` of the prior.
        T_cam_obj: ``[b, 4, 4]``; in ``next_T_cam_obj``, but for its last row, it is after the step. Elsewhere: other threads may still read it.
        offset: ``[b, 12]`` from the prior; changed.
        gradient, hessian: ``[b, 12]`` and ``[b, 12, 12]``; filled.
        damping: :class:`torchtrack.backends.alignment.DampingSettings`.
    """
    b = tl.program_id(0).to(tl.int64)
    matches, T_cam_obj, centre_obj, intrinsics = matches + b * rows.ROWS * count, T_cam_obj + b * 16, centre_obj + b * 3, intrinsics + b * 4
    scale_px = gate_px * tl.load(wider + b)
    dtype: tl.constexpr = matches.dtype.element_ty
    k, j = tl.arange(0, _SIZE)[:, None], tl.arange(0, _SIZE)[None, :]
    product = tl.zeros([_SIZE, _SIZE], dtype)
    for begin in range(0, count, BLOCK):
        jacobian, weights = _linearised(matches, T_cam_obj, centre_obj, intrinsics, scale_px, begin, count, velocity_in_window, BLOCK)
        product += tl.dot(jacobian * weights[None, :], tl.trans(jacobian), input_precision="ieee", out_dtype=dtype)
    # The prior.
    is_entry, at = (k < rows.UNKNOWNS) & (j < rows.UNKNOWNS), b * rows.UNKNOWNS * rows.UNKNOWNS + k * rows.UNKNOWNS + j
    prior = tl.load(information + at, is_entry, 0.0)
    row = tl.arange(0, _SIZE)
    is_unknown, own = row < rows.UNKNOWNS, b * rows.UNKNOWNS + row
    offsets = tl.load(offset + own, is_unknown, 0.0)
    pulls = tl.sum(prior * offsets[None, :], 1)
    downhill = tl.sum(tl.where(j == rows.UNKNOWNS, product, 0.0), 1) + pulls
    matrix = tl.where(is_entry, product, 0.0) + prior
    tl.store(gradient + own, downhill, is_unknown)
    tl.store(hessian + at, matrix, is_entry)
    step = _damped_step(matrix.to(tl.float64), downhill.to(tl.float64), damping)
    tl.store(offset + own, offsets + step.to(offset.dtype.element_ty), is_unknown)
    _move(T_cam_obj, next_T_cam_obj + b * 16, centre_obj, step)


@kernel
def _linearised(
    matches, T_cam_obj, centre_obj, intrinsics, scale_px, begin, count, velocity_in_window: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Rows of the Jacobian of a block of matches, and after them their residuals, ``[16, BLOCK]``; and their weights.

    :class:`torchtrack.tracking.estimation.terms.ContourDistance`, with Tukey's weights.
    """
    i = begin + tl.arange(0, BLOCK)
    inside = i < count
    believed = tl.load(matches + rows.WEIGHT * count + i, inside, 0.0)
    # What does not count need not be anywhere.
    counts = believed > 0
    matches += i
    arm_x = tl.load(matches + rows.POINT_X * count, counts, 0.0) - tl.load(centre_obj)
    arm_y = tl.load(matches + rows.POINT_Y * count, counts, 0.0) - tl.load(centre_obj + 1)
    arm_z = tl.load(matches + rows.POINT_Z * count, counts, 0.0) - tl.load(centre_obj + 2)
    ax, ay, az = rotated(T_cam_obj, arm_x, arm_y, arm_z)
    centre_x, centre_y, centre_z = placed(T_cam_obj, tl.load(centre_obj), tl.load(centre_obj + 1), tl.load(centre_obj + 2))
    normal_u, normal_v = tl.load(matches + rows.DIRECTION_U * count, counts, 0.0), tl.load(matches + rows.DIRECTION_V * count, counts, 0.0)
    target_u, target_v = tl.load(matches + rows.TARGET_U * count, counts, 0.0), tl.load(matches + rows.TARGET_V * count, counts, 0.0)
    inverse = inverse_depth(az + centre_z)
    gx, gy = normal_u * tl.load(intrinsics) * inverse, normal_v * tl.load(intrinsics + 1) * inverse
    along = gx * (ax + centre_x) + gy * (ay + centre_y)
    gz = -along * inverse
    residual = along - (target_u - tl.load(intrinsics + 2)) * normal_u - (target_v - tl.load(intrinsics + 3)) * normal_v
    relative = residual / scale_px
    robust = tl.maximum(1.0 - relative * relative, 0.0)
    # How far it was from where it is at the pose, for each unit of velocity beyond the predicted one.
    back = -tl.load(matches + rows.MATCH_AGE * count, counts, 0.0) if velocity_in_window else tl.zeros([BLOCK], believed.dtype)
    k = tl.arange(0, _SIZE)[:, None]
    jacobian = tl.where(k == rows.UNKNOWNS, residual[None, :], 0.0)
    for number in tl.static_range(2):
        times = tl.where(counts, 1.0, 0.0).to(believed.dtype) if number == 0 else back
        jacobian = tl.where(k == number * _POSE, ((ay * gz - az * gy) * times)[None, :], jacobian)
        jacobian = tl.where(k == number * _POSE + 1, ((az * gx - ax * gz) * times)[None, :], jacobian)
        jacobian = tl.where(k == number * _POSE + 2, ((ax * gy - ay * gx) * times)[None, :], jacobian)
        jacobian = tl.where(k == number * _POSE + 3, (gx * times)[None, :], jacobian)
        jacobian = tl.where(k == number * _POSE + 4, (gy * times)[None, :], jacobian)
        jacobian = tl.where(k == number * _POSE + 5, (gz * times)[None, :], jacobian)
    return jacobian, tl.where(counts, believed * robust * robust, 0.0)


@kernel
def _damped_step(matrix, downhill, damping: tl.constexpr):
    """The damped step to the optimum ``[16]``; none where the Hessian is not positive definite."""
    k, j, row = tl.arange(0, _SIZE)[:, None], tl.arange(0, _SIZE)[None, :], tl.arange(0, _SIZE)
    diagonal = tl.sum(tl.where(k == j, matrix, 0.0), 1)
    largest = tl.max(tl.where(row < _POSE, diagonal, 0.0), 0)
    more = damping.least_diagonal + damping.least_share * largest + damping.damping * diagonal
    # What is left of the product has no unknowns: ones on its diagonal keep it out of the way.
    matrix = tl.where(k == j, tl.where(k < rows.UNKNOWNS, matrix + more[:, None], 1.0), matrix)
    # The right side is a column beside the unknowns'.
    matrix = tl.where((j == rows.UNKNOWNS) & (k < rows.UNKNOWNS), -downhill[:, None], matrix)
    is_positive = largest >= 0.0
    for number in range(rows.UNKNOWNS):
        pivots = tl.sum(tl.where(k == number, matrix, 0.0), 0)
        pivot = tl.sum(tl.where(row == number, pivots, 0.0), 0)
        is_positive = is_positive & (pivot > 0.0)
        factors = tl.sum(tl.where(j == number, matrix, 0.0), 1) / pivot
        matrix -= tl.where(row == number, 0.0, factors)[:, None] * pivots[None, :]
    diagonal = tl.sum(tl.where(k == j, matrix, 0.0), 1)
    step = tl.sum(tl.where(j == rows.UNKNOWNS, matrix, 0.0), 1) / diagonal
    step = tl.where(row < rows.UNKNOWNS, step, 0.0)
    is_finite = tl.abs(tl.sum(step, 0)) < float("inf")
    return tl.where(is_positive & is_finite, step, 0.0)


@kernel
def _move(T_cam_obj, next_T_cam_obj, centre_obj, step):
    """Take a step: :func:`torchtrack.core.lie.step_about`."""
    row = tl.arange(0, _SIZE)
    turn_x, turn_y, turn_z = _entry(step, row, 0), _entry(step, row, 1), _entry(step, row, 2)
    a, b, c = 0.5 * turn_x, 0.5 * turn_y, 0.5 * turn_z
    factor = 8.0 / (4.0 + turn_x * turn_x + turn_y * turn_y + turn_z * turn_z)
    shift_x, shift_y, shift_z = _entry(step, row, 3), _entry(step, row, 4), _entry(step, row, 5)
    for k in tl.static_range(3):
        x = tl.load(T_cam_obj + k).to(tl.float64)
        y, z = tl.load(T_cam_obj + 4 + k).to(tl.float64), tl.load(T_cam_obj + 8 + k).to(tl.float64)
        # skew @ column, and skew @ that.
        p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
        more_x, more_y, more_z = factor * (p + b * r - c * q), factor * (q + c * p - a * r), factor * (r + a * q - b * p)
        centre = tl.load(centre_obj + k)
        shift_x, shift_y, shift_z = shift_x - more_x * centre, shift_y - more_y * centre, shift_z - more_z * centre
        _store(next_T_cam_obj + k, x + more_x)
        _store(next_T_cam_obj + 4 + k, y + more_y)
        _store(next_T_cam_obj + 8 + k, z + more_z)
    _store(next_T_cam_obj + 3, tl.load(T_cam_obj + 3) + shift_x)
    _store(next_T_cam_obj + 7, tl.load(T_cam_obj + 7) + shift_y)
    _store(next_T_cam_obj + 11, tl.load(T_cam_obj + 11) + shift_z)


@kernel
def _store(place, value):
    """Write a number in the precision of its place."""
    tl.store(place, value.to(place.dtype.element_ty))


@kernel
def _entry(values, row, number: tl.constexpr):
    """One of the values."""
    return tl.sum(tl.where(row == number, values, 0.0), 0)
