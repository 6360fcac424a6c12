"""How long Levenberg-Marquardt takes: many poses at once, of 200 observations each, ten iterations."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchtrack.bench.plots import Plot
from torchtrack.bench.results import Report, time_result
from torchtrack.bench.setup import Setup
from torchtrack.config.tracker import SolverConfig
from torchtrack.core.camera import Camera, project
from torchtrack.core.lie import retract_about, rotation_angle_deg, so3_exp, transform_points
from torchtrack.tracking.estimation.levenberg_marquardt import solve_pose
from torchtrack.tracking.estimation.terms import PoseProblem

# Poses at once, and the targets on one thread of a CPU (ms).
TARGETS_MS = {1: 2.0, 8: 3.0, 32: None, 128: 18.0, 1024: 140.0}
RESIDUALS, ITERATIONS = 200, 10
CONFIG = SolverConfig(iterations=ITERATIONS)
CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
# Radius of the object (m), and how far off the start is (rad and m), and noise (px).
_RADIUS_M, _OFF_RAD, _OFF_M, _NOISE_PX = 0.1, 0.02, 0.004, 0.3
# Scale of the robust loss: all are inliers (px).
_SCALE_PX = 50.0


@dataclass(frozen=True)
class Poses:
    """Poses to be found.

    Args:
        problem: points, where each was seen, and the direction along which the distance counts.
        T_start: where the search starts.
        T_true: what the observations were made with.
    """

    problem: PoseProblem
    T_start: Tensor
    T_true: Tensor


def poses(count: int, device: torch.device, dtype: torch.dtype = torch.float32) -> Poses:
    """Objects of random points, each seen with noise along a random direction."""
    random = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, RESIDUALS, 2, generator=random, dtype=torch.float64), dim=-1)
    return _poses(_points(count, RESIDUALS, random), directions, random, device, dtype)


def poses_of_points(count: int, device: torch.device, dtype: torch.dtype = torch.float32) -> Poses:
    """Objects of half as many random points, both of whose coordinates are seen with noise: u and v by turns."""
    random = torch.Generator().manual_seed(0)
    axes = torch.eye(2, dtype=torch.float64).repeat(RESIDUALS // 2, 1).expand(count, -1, -1)
    return _poses(_points(count, RESIDUALS // 2, random).repeat_interleave(2, 1), axes, random, device, dtype)


def _points(count: int, each: int, random: torch.Generator) -> Tensor:
    """Points on a ball."""
    return _RADIUS_M * torch.nn.functional.normalize(torch.randn(count, each, 3, generator=random, dtype=torch.float64), dim=-1)


def _poses(points: Tensor, directions: Tensor, random: torch.Generator, device: torch.device, dtype: torch.dtype) -> Poses:
    """Random poses of points, what is seen of them, and where the search starts."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    count = len(points)
    T_true = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T_true[:, :3, :3] = so3_exp(normal(count, 3))
    T_true[:, :3, 3] = 0.05 * normal(count, 3) + torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64)
    intrinsics = CAMERA.intrinsics(torch.float64).expand(count, 4)
    centre = torch.zeros(count, 3, dtype=torch.float64)
    # Noise of a point is the same in both of its rows.
    noise = _NOISE_PX * normal(count, RESIDUALS // 2, 2).repeat_interleave(2, 1)
    targets = project(transform_points(T_true, points), intrinsics) + noise
    off = torch.tensor([_OFF_RAD] * 3 + [_OFF_M] * 3, dtype=torch.float64)
    T_start = retract_about(T_true, off * normal(count, 6), centre)
    ones, scale, no_prior = torch.ones(count, RESIDUALS), torch.full((count,), _SCALE_PX), torch.zeros(count, 6, 6)
    given: tuple[Any, ...] = (points, targets, directions, ones, intrinsics, centre, scale, T_start, no_prior)
    problem = PoseProblem(*(value.to(device, dtype) for value in given))
    return Poses(problem, T_start.to(device, dtype), T_true.to(device))


def measure(setup: Setup) -> Report:
    """Time of the solver, by the number of poses."""
    results, notes = [], []
    for count, target_ms in TARGETS_MS.items():
        setup.show(f"B={count}")
        given = poses(count, setup.device)

        def solve(given: Poses = given) -> Tensor:
            with torch.inference_mode():
                return solve_pose(given.problem, given.T_start, CONFIG).T_cam_obj

        results.append(time_result(f"B={count}", setup.clock.seconds(solve, setup.repeats), setup.cpu_target(target_ms)))
        error_deg = rotation_angle_deg(solve()[:, :3, :3].double(), given.T_true[:, :3, :3])
        notes.append(f"B={count}: median error {float(error_deg.median()):.3f}° after the last iteration")
    title = f"Levenberg-Marquardt, {RESIDUALS} residuals, {ITERATIONS} iterations, float32; {setup.clock.meaning}"
    points = tuple((float(count), 1e3 * count / result.median) for count, result in zip(TARGETS_MS, results, strict=True))
    plot = Plot("throughput", "Levenberg-Marquardt", "poses at once", "poses/s", {"torchtrack": points})
    return Report("solver", title, tuple(results), tuple(notes), (plot,))
