"""Points of a moving object in the image: :class:`torchtrack.core.image_velocity.MovingObjects`, for many points of one object at a time."""

import triton.language as tl

from torchtrack.backends.triton.compiler import kernel

# As torchtrack.core.camera.MIN_DEPTH_M, which a kernel cannot import.
_MIN_DEPTH_M = tl.constexpr(1e-3)


@kernel
def rotated(T_cam_obj, x, y, z):
    """A direction of the object in the camera's frame; ``T_cam_obj`` points to a pose ``[4, 4]``."""
    along_x = tl.load(T_cam_obj) * x + tl.load(T_cam_obj + 1) * y + tl.load(T_cam_obj + 2) * z
    along_y = tl.load(T_cam_obj + 4) * x + tl.load(T_cam_obj + 5) * y + tl.load(T_cam_obj + 6) * z
    along_z = tl.load(T_cam_obj + 8) * x + tl.load(T_cam_obj + 9) * y + tl.load(T_cam_obj + 10) * z
    return along_x, along_y, along_z


@kernel
def placed(T_cam_obj, x, y, z):
    """A point of the object in the camera's frame."""
    along_x, along_y, along_z = rotated(T_cam_obj, x, y, z)
    return along_x + tl.load(T_cam_obj + 3), along_y + tl.load(T_cam_obj + 7), along_z + tl.load(T_cam_obj + 11)


@kernel
def inverse_depth(z):
    """One over a depth, of which none is too small."""
    return 1.0 / tl.maximum(z, _MIN_DEPTH_M)


@kernel
def velocity_at(T_cam_obj, centre_obj, velocity, x, y, z):
    """Velocity (m/s) of points in the camera's frame that turn about the object's centre and move with it.

    Args:
        centre_obj: points to the centre ``[3]``.
        velocity: points to ``[6]``: rotation and velocity of the centre (rad/s, m/s).
    """
    centre_x, centre_y, centre_z = placed(T_cam_obj, tl.load(centre_obj), tl.load(centre_obj + 1), tl.load(centre_obj + 2))
    arm_x, arm_y, arm_z = x - centre_x, y - centre_y, z - centre_z
    turn_x, turn_y, turn_z = tl.load(velocity), tl.load(velocity + 1), tl.load(velocity + 2)
    return (
        turn_y * arm_z - turn_z * arm_y + tl.load(velocity + 3),
        turn_z * arm_x - turn_x * arm_z + tl.load(velocity + 4),
        turn_x * arm_y - turn_y * arm_x + tl.load(velocity + 5),
    )


@kernel
def show(T_cam_obj, centre_obj, velocity, intrinsics, x, y, z):
    """Pixels of points of the object, and their velocities (px/s); ``intrinsics`` points to ``[fx, fy, cx, cy]``."""
    along_x, along_y, along_z = placed(T_cam_obj, x, y, z)
    inverse, focal_u, focal_v = inverse_depth(along_z), tl.load(intrinsics), tl.load(intrinsics + 1)
    ray_u, ray_v = along_x * inverse, along_y * inverse
    moving_x, moving_y, moving_z = velocity_at(T_cam_obj, centre_obj, velocity, along_x, along_y, along_z)
    speed_u, speed_v = (moving_x - ray_u * moving_z) * inverse * focal_u, (moving_y - ray_v * moving_z) * inverse * focal_v
    return tl.load(intrinsics + 2) + ray_u * focal_u, tl.load(intrinsics + 3) + ray_v * focal_v, speed_u, speed_v
