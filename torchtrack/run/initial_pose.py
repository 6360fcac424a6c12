"""The pose that an object starts with: as configured, or by the ground truth of its sequence."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.run import ObjectConfig, PoseConfig
from torchtrack.core.lie import rotation_from_quaternion
from torchtrack.core.pose_checks import check_pose
from torchtrack.errors import ConfigError
from torchtrack.io import Trajectory, read_trajectory


def initial_pose(obj: ObjectConfig, truth: Trajectory | None, start_us: int) -> Float[Tensor, "4 4"]:
    """``T_cam_obj`` at the start, float64.

    Args:
        obj: what is configured of the object.
        truth: its ground truth, or None where it is not known.
        start_us: time of the start.

    Raises:
        ConfigError: if there is neither.
        PoseError: if it is no rigid motion, or a trajectory has nothing measured at the start.
    """
    if obj.initial_pose is not None:
        T = configured_pose(obj.initial_pose, start_us)
        check_pose(T, f"initial_pose of '{obj.label}'")
        return T
    if truth is None:
        raise ConfigError(f"objects: '{obj.label}' needs an initial_pose, as the source has no ground truth for it. `torchtrack pose` finds it.")
    return truth.measured_at(start_us, f"the ground truth of '{obj.label}'")


def configured_pose(pose: PoseConfig, start_us: int) -> Float[Tensor, "4 4"]:
    """``T_cam_obj`` (float64) as one of the ways to give it says.

    Raises:
        PoseError: if a trajectory has nothing measured at the start.
    """
    if pose.trajectory is not None:
        T_cam_world = None if pose.T_cam_world is None else torch.tensor(pose.T_cam_world, dtype=torch.float64)
        read = read_trajectory(pose.trajectory, name=pose.name, frame_us=pose.frame_us, T_cam_world=T_cam_world, time_unit=pose.time_unit)
        return read.measured_at(start_us, f"'{pose.trajectory}'")
    if pose.matrix is not None:
        return torch.tensor(pose.matrix, dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = rotation_from_quaternion(torch.tensor(pose.quaternion_xyzw, dtype=torch.float64))
    T[:3, 3] = torch.tensor(pose.translation_m, dtype=torch.float64)
    return T
