"""Points of a moving object in the image: :class:`torchtrack.core.image_velocity.MovingObjects`, one point at a time."""

from typing import NamedTuple

import numpy as np

from torchtrack.backends.numba.arrays import MovingArrays
from torchtrack.backends.numba.compiler import FAST, Array, kernel

Numbers = tuple[float, ...]

# As torchtrack.core.camera.MIN_DEPTH_M: with it, this would be no foundation.
_MIN_DEPTH_M = 1e-3


@kernel()
def entries(T_cam_obj: Array) -> Numbers:
    """Rotation and translation of a pose, row by row, as numbers: what is read from an array is read again after every write to another."""
    T = T_cam_obj
    return (
        np.float64(T[0, 0]), np.float64(T[0, 1]), np.float64(T[0, 2]), np.float64(T[0, 3]),
        np.float64(T[1, 0]), np.float64(T[1, 1]), np.float64(T[1, 2]), np.float64(T[1, 3]),
        np.float64(T[2, 0]), np.float64(T[2, 1]), np.float64(T[2, 2]), np.float64(T[2, 3]),
    )  # fmt: skip


@kernel()
def lens(intrinsics: Array) -> Numbers:
    """Focal lengths and principal point as numbers."""
    return np.float64(intrinsics[0]), np.float64(intrinsics[1]), np.float64(intrinsics[2]), np.float64(intrinsics[3])


@kernel(fastmath=FAST)
def placed(pose: Numbers, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point of the object in the camera's frame, by the pose's :func:`entries`."""
    u, v, w = turned(pose, x, y, z)
    return u + pose[3], v + pose[7], w + pose[11]


@kernel(fastmath=FAST)
def turned(pose: Numbers, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A direction of the object in the camera's frame."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z,
        pose[4] * x + pose[5] * y + pose[6] * z,
        pose[8] * x + pose[9] * y + pose[10] * z,
    )


@kernel(fastmath=FAST)
def inverse_depth(z: float) -> float:
    """One over a depth, of which none is too small."""
    return 1.0 / max(z, _MIN_DEPTH_M)


@kernel(fastmath=FAST)
def drift(velocity: Array, centre_cam: Array) -> Numbers:
    """How points of an object move: those at ``p`` with ``motion[:3] × p + motion[3:]``, in the camera's frame."""
    w0, w1, w2 = np.float64(velocity[0]), np.float64(velocity[1]), np.float64(velocity[2])
    x, y, z = np.float64(centre_cam[0]), np.float64(centre_cam[1]), np.float64(centre_cam[2])
    return w0, w1, w2, velocity[3] - (w1 * z - w2 * y), velocity[4] - (w2 * x - w0 * z), velocity[5] - (w0 * y - w1 * x)


@kernel(fastmath=FAST)
def across(motion: Numbers, x: float, y: float, z: float, inverse: float, intrinsics: Numbers) -> tuple[float, float]:
    """Image velocity (px/s) of a point in the camera's frame, by the inverse of its depth."""
    moving_z = (motion[0] * y - motion[1] * x + motion[5]) * inverse
    moving_x = (motion[1] * z - motion[2] * y + motion[3]) * inverse
    moving_y = (motion[2] * x - motion[0] * z + motion[4]) * inverse
    return (moving_x - x * inverse * moving_z) * intrinsics[0], (moving_y - y * inverse * moving_z) * intrinsics[1]


class Plane(NamedTuple):
    """The plane through an object's centre, parallel to the image, as it moves: :func:`drift`, depth (m), and :func:`lens`."""

    motion: Numbers
    depth_m: float
    lens: Numbers


@kernel(fastmath=FAST)
def plane_of(moving: MovingArrays, b: int) -> Plane:
    """The plane of one object."""
    return Plane(drift(moving.velocity[b], moving.centre_cam[b]), moving.centre_cam[b, 2], lens(moving.intrinsics[b]))


@kernel(fastmath=FAST)
def carried(plane: Plane, u: float, v: float, age_s: float) -> tuple[float, float]:
    """Where a pixel comes in some time with an object's plane: :meth:`torchtrack.core.image_velocity.MovingObjects.plane_velocity`."""
    motion, depth_m, (fx, fy, cx, cy) = plane
    x, y, inverse = (u - cx) / fx, (v - cy) / fy, inverse_depth(depth_m)
    moving_z = motion[0] * y - motion[1] * x + motion[5] * inverse
    moving_x = motion[1] - motion[2] * y + motion[3] * inverse
    moving_y = motion[2] * x - motion[0] + motion[4] * inverse
    return u + (moving_x - x * moving_z) * fx * age_s, v + (moving_y - y * moving_z) * fy * age_s


@kernel(fastmath=FAST)
def slope_of(point: Numbers, normal: Numbers, centre: Array, focal_px: Numbers) -> Numbers:
    """How a point moves along its normal in the image with the pose: :func:`torchtrack.core.image_velocity.pose_jacobian`."""
    inverse = inverse_depth(point[2])
    gx, gy = normal[0] * focal_px[0] * inverse, normal[1] * focal_px[1] * inverse
    gz = -(gx * point[0] + gy * point[1]) * inverse
    ax, ay, az = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    return ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx, gx, gy, gz


@kernel(fastmath=FAST)
def centre_of(T_cam_obj: Array, centre_obj: Array, centre_cam: Array) -> None:
    """Where the object's centre is in the camera's frame."""
    centre_cam[0], centre_cam[1], centre_cam[2] = placed(entries(T_cam_obj), centre_obj[0], centre_obj[1], centre_obj[2])


@kernel()
def depth_of(T_cam_obj: Array, centre_obj: Array) -> float:
    """Depth of the object's centre (m)."""
    T, c = T_cam_obj, centre_obj
    return np.float64(T[2, 3]) + T[2, 0] * c[0] + T[2, 1] * c[1] + T[2, 2] * c[2]


@kernel(fastmath=FAST)
def turn(rotation: Array, phi: Array, into: Array) -> None:
    """Turn a rotation by Cayley's map: :func:`torchtrack.core.lie.turned`."""
    a, b, c = 0.5 * phi[0], 0.5 * phi[1], 0.5 * phi[2]
    factor = 8.0 / (4.0 + phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    for k in range(3):
        x, y, z = rotation[0, k], rotation[1, k], rotation[2, k]
        # skew @ column, and skew @ that.
        p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
        into[0, k] = x + factor * (p + b * r - c * q)
        into[1, k] = y + factor * (q + c * p - a * r)
        into[2, k] = z + factor * (r + a * q - b * p)


@kernel(fastmath=FAST)
def is_finite(values: Array) -> bool:
    """Whether all values are finite."""
    return np.isfinite(values.sum())
