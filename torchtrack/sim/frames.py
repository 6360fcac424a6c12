"""When to render: frames so dense that no vertex moves further than it may between two of them."""

from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from torchtrack.camera import MIN_DEPTH_M, Camera, project
from torchtrack.lie import transform_points
from torchtrack.sim.trajectory import SinusoidMotion

# Speeds are looked up this often; between two look-ups they count as steady.
_GRID_US = 500
# Even where nothing moves there are frames this often.
_MAX_INTERVAL_US = 10_000
# Poses per round, to bound the memory that a large mesh and a long scene would take.
_POSES_PER_ROUND = 2048


def outer_points(mesh: trimesh.Trimesh) -> Float[Tensor, "n 3"]:
    """Vertices of the convex hull: seen by a camera, no other vertex moves much faster than all of them."""
    return torch.from_numpy(np.array(mesh.convex_hull.vertices, dtype=np.float64))


def frame_motion(
    motions: Sequence[SinusoidMotion], points: Sequence[Float[Tensor, "_ 3"]], camera: Camera, t_us: Int[ndarray, "p"]
) -> Float[ndarray, "p-1"]:
    """Furthest way of any point between each two neighbouring times, px; points at or behind the camera do not count."""
    longest = np.zeros(len(t_us) - 1)
    for first in range(0, len(longest), _POSES_PER_ROUND):
        t_s = torch.from_numpy(t_us[first : first + _POSES_PER_ROUND + 1]).double() * 1e-6
        for motion, of_object in zip(motions, points, strict=True):
            part = longest[first : first + len(t_s) - 1]
            np.maximum(part, _longest_way(motion.pose(t_s), of_object, camera).numpy(), out=part)
    return longest


def _longest_way(T_cam_obj: Float[Tensor, "p 4 4"], points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "q"]:
    points_cam = transform_points(T_cam_obj, points.expand(len(T_cam_obj), -1, -1))
    pixels = project(points_cam, camera.intrinsics(torch.float64).expand(len(T_cam_obj), -1))
    in_front = points_cam[..., 2] > MIN_DEPTH_M
    way = (pixels[1:] - pixels[:-1]).norm(dim=-1)
    return torch.where(in_front[1:] & in_front[:-1], way, 0.0).amax(-1)


def frame_times(
    motions: Sequence[SinusoidMotion], points: Sequence[Float[Tensor, "_ 3"]], camera: Camera, duration_us: int, max_motion_px: float
) -> tuple[Int[ndarray, "p"], float]:
    """Times (µs) from 0 to ``duration_us``, both included, and the furthest way of any point between two of them (px).

    Frames are equally far apart in image motion, not in time.
    """
    grid = np.append(np.arange(0, duration_us, _GRID_US), duration_us)
    # Time counts as motion too, so that the interval stays bounded where nothing moves.
    way = np.maximum(frame_motion(motions, points, camera, grid), np.diff(grid) * (max_motion_px / _MAX_INTERVAL_US))
    travelled = np.concatenate([[0.0], np.cumsum(way)])
    intervals = int(np.ceil(travelled[-1] / max_motion_px))
    while True:
        t_us = np.interp(np.linspace(0, travelled[-1], intervals + 1), travelled, grid)
        t_us = np.unique(np.rint(t_us).astype(np.int64))
        worst = float(frame_motion(motions, points, camera, t_us).max())
        # At one frame per microsecond there is nothing left to refine.
        if worst <= max_motion_px or len(t_us) > duration_us:
            return t_us, worst
        intervals = int(np.ceil(intervals * max(1.01, worst / max_motion_px)))
