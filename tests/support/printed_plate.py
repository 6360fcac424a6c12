"""A thin plate with print that its model does not show, and of whose border only two sides fire."""

from functools import cache

import torch
import trimesh
from helpers import _crossings, generator, pose

from torchtrack.core.camera import Camera, project
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import so3_exp, transform_points
from torchtrack.io import Trajectory
from torchtrack.object_model import ObjectModel

PLATE_CAMERA = Camera(fx=450.0, fy=450.0, cx=159.5, cy=119.5, width=320, height=240)
EXTENTS_M = (0.20, 0.15, 0.01)
PLATE_POSE = pose((0.3, 0.3, 0.1))


@cache
def plate_model() -> ObjectModel:
    return ObjectModel.from_mesh(trimesh.creation.box(EXTENTS_M), name="plate")


def rectangle(half_width_m: float, half_height_m: float, x_m: float = 0.0, y_m: float = 0.0) -> torch.Tensor:
    """Four segments ``[4, 2, 3]`` on the side of the plate that faces the camera."""
    corners = [(x_m + a * half_width_m, y_m + b * half_height_m, -EXTENTS_M[2] / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return torch.tensor([(corners[i], corners[(i + 1) % 4]) for i in range(4)], dtype=torch.float64)


# A frame well inside the border, and what it frames. Nearer, at 5 mm, it is taken for the border in 23 of 24 tries.
FRAME, BORDER = rectangle(0.09, 0.065), rectangle(0.1, 0.075)[:2]
TEXT = [rectangle(0.02, 0.015, x_m, y_m) for x_m in (-0.065, 0.0, 0.065) for y_m in (-0.04, 0.0, 0.04)]
PRINTED = torch.cat([FRAME, BORDER, *TEXT])


def starting(
    duration_us: int, *, turn=(0.6, -0.8, 1.0), move=(0.5, 0.3, 0.3), T_start: torch.Tensor = PLATE_POSE, until_full_us: int = 100_000
) -> Trajectory:
    """A body that is at rest at first and gains speed, until it turns (rad/s) and moves (m/s) as given."""
    t_us = torch.arange(0, duration_us + 1, 250)
    seconds = 1e-6 * t_us.double()
    full_s = 1e-6 * until_full_us
    way_s = torch.where(seconds < full_s, 0.5 * seconds.square() / full_s, seconds - 0.5 * full_s)[:, None]
    T = T_start.repeat(len(t_us), 1, 1)
    T[:, :3, :3] = so3_exp(way_s * torch.tensor(turn, dtype=torch.float64)) @ T_start[:3, :3]
    T[:, :3, 3] = T_start[:3, 3] + way_s * torch.tensor(move, dtype=torch.float64)
    return Trajectory(t_us, T)


def line_events(trajectory: Trajectory, segments: torch.Tensor, camera: Camera = PLATE_CAMERA, *, seed: int = 0, stream: int = 0) -> EventBatch:
    """An event wherever a segment on the body passes the centre of a pixel; all are seen."""
    T = trajectory.T_cam_obj
    ends_cam = transform_points(T, segments.reshape(1, -1, 3).expand(len(T), -1, -1))
    pixels = project(ends_cam, camera.intrinsics(torch.float64).expand(len(T), 4)).unflatten(1, (-1, 2))
    shown = torch.ones(len(T), dtype=torch.bool)
    u, v, t_us = torch.cat([_crossings(pixels[:, line], shown, trajectory.t_us, camera) for line in range(len(segments))], 1)
    t_us, order = t_us.sort(stable=True)
    polarity = torch.randint(2, (len(t_us),), generator=generator(seed))
    return EventBatch.from_numpy(u[order].numpy(), v[order].numpy(), t_us.numpy(), polarity.numpy(), stream)
